"""A process that does nothing but wait for instants: how late it goes on is what the machine does to any."""

from __future__ import annotations

import json
import signal
import statistics
import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace

from tests.bench.figures import Figure

WAIT = """
import json, signal, sys
from thermostand.foundation.clock import WallClock, block_until

signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background jobs ignore it
clock, late_ms = WallClock(), []
due_ns, period_ns = clock.now_ns(), round(1e9 * float(sys.argv[1]))
try:
    while True:
        due_ns += period_ns
        block_until(clock, due_ns)
        late_ms.append((clock.now_ns() - due_ns) / 1e6)
except KeyboardInterrupt:
    print(json.dumps(late_ms))
"""
OFTEN_s = 0.05


@contextmanager
def run_waiting_process(interval_s: float = OFTEN_s) -> Generator[list[float]]:
    """How late a process beside that only waits goes on, ms; filled when the inside is left."""
    late_ms: list[float] = []
    command = [sys.executable, "-c", WAIT, str(interval_s)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield late_ms
        finally:
            process.send_signal(signal.SIGINT)
            late_ms += json.loads(process.communicate()[0])


def compute_p99(values: Sequence[float]) -> float:
    """The 99th percentile."""
    return statistics.quantiles(values, n=100, method="inclusive")[98]


def compare_with_waiting(figure: Figure, waited_ms: Sequence[float]) -> Figure:
    """The figure, a 99th percentile in ms, with that of a process that only waited meanwhile, and what it is more."""
    bare_ms = compute_p99(waited_ms)
    text = f"a process that only waits: p99 {bare_ms:.2f}, greatest {max(waited_ms):.2f} ms; "
    text += f"{figure.value / bare_ms:.1f} times that, {figure.value - bare_ms:+.2f} ms"
    return replace(figure, peer=f"{figure.peer}; {text}")
