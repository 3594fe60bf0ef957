"""The paper's whole protocol in virtual time, every device polled at 1 Hz: how long it takes, whether it is repeatable,
what it leaves in memory. Section 3.2: 45 min of equilibrium, two cycles up and down, 45 min at each set-point; 15.8 h.

`python -m tests.system.protocol_run DIRECTORY` takes a pickled order on standard input, runs it as a daemon of its
own, and prints an Outcome as JSON.
"""

from __future__ import annotations

import asyncio
import gc
import hashlib
import json
import math
import os
import pickle
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

POLL_s = 1.0
PROTOCOL = """
name: protocol
experiments:
  - thermal_cycle:
      equilibrium_s: 2700
      set_points_degC: [30, 36, 42, 47, 52, 47, 42, 36, 30, 24]
      soak_s: 2700
      cycles: 2
"""
GROWTH_LIMIT_MB = 5.0
LOOK_EVERY_s = 1800.0
SETTLED_s = 3600.0  # by then every frame buffer and every code path has been used


@dataclass(frozen=True, slots=True)
class Outcome:
    """One run: real and simulated duration (s), the daemon's resident memory after an hour (NaN in a shorter run) and
    half an hour before the end at most (MB), the digest of all bytes of the session."""

    wall_s: float
    simulated_s: float
    settled_MB: float
    end_MB: float
    digest: str


def outcomes(order: Order, directory: Path, count: int) -> list[Outcome]:
    """`count` runs of the order, each in a process of its own, as many side by side as there are processors."""
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return list(pool.map(lambda number: _run_apart(order, directory / f"cycle-{number}"), range(count)))


def _run_apart(order: Order, out: Path) -> Outcome:
    command = [sys.executable, "-m", "tests.system.protocol_run", str(out)]
    done = subprocess.run(command, input=pickle.dumps(order), stdout=subprocess.PIPE, check=True)
    shutil.rmtree(out)
    return Outcome(**json.loads(done.stdout))


def _run_here(order: Order, out: Path) -> Outcome:
    watch = _Watch()
    begin_s = time.perf_counter()
    session = asyncio.run(run_virtual(order, out, None, watch.follow))
    wall_s = time.perf_counter() - begin_s
    simulated_s = (watch.last_ns - watch.first_ns) / NS_PER_S
    return Outcome(wall_s, simulated_s, watch.settled_MB, watch.last_MB, _digest(session))


class _Watch:
    """Times and memory of the run that is followed."""

    def __init__(self) -> None:
        self.first_ns = self.last_ns = 0
        self.settled_MB = self.last_MB = math.nan
        self._looks = 0

    def follow(self, hub: Hub) -> None:
        """Look on from now on."""
        hub.subscribe(self._receive)

    def _receive(self, item: Item) -> None:
        self.first_ns, self.last_ns = self.first_ns or item.time_ns, item.time_ns
        if item.time_ns - self.first_ns >= self._looks * LOOK_EVERY_s * NS_PER_S:
            self._looks += 1
            gc.collect()  # what is collected later, in a quiet moment, is not left in memory
            self.last_MB = _resident_MB()
            if math.isnan(self.settled_MB) and self.last_ns - self.first_ns >= SETTLED_s * NS_PER_S:
                self.settled_MB = self.last_MB


def _resident_MB() -> float:
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 1e6


def _digest(session: Path) -> str:
    """Of the names and bytes of all files."""
    digest = hashlib.sha256()
    for path in sorted(session.rglob("*")):
        if path.is_file():
            digest.update(str(path.relative_to(session)).encode())
            digest.update(path.read_bytes())
    return digest.hexdigest()


def main() -> None:
    """Run the order, print its outcome."""
    order: Order = pickle.loads(sys.stdin.buffer.read())
    sys.stdout.write(json.dumps(asdict(_run_here(order, Path(sys.argv[1])))))


if __name__ == "__main__":
    main()
