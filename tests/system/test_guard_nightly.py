"""At full lengths: the guard goes on looking whatever the disk, the bus, the clients and the other programs do."""

import asyncio
import signal
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from tests.daemon_queries import ask_status
from tests.recording.disks import ext4, run
from tests.stand.test_listening import STATE, connected
from tests.system.test_run import fault
from tests.system.test_unrecorded_heat import heater_is
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.errors import SessionError
from thermostand.stand.running.order import Order

FRAMES = """
name: frames
experiments:
  - thermal_cycle:
      equilibrium_s: 0.5
      set_points_degC: [26]
      reference_frames: 5000
      interval_s: 0.5
"""
LIMIT_S = 240.0
# A reading is up to 5 s old when the bus goes, and trips at 15 s.
HANGS_S, GONE_S = 95.0, 5.0
CLIENTS, BUSY = 64, 2


@contextmanager
def busy_loops(count: int) -> Iterator[None]:
    loops = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for loop in loops:
            loop.kill()
            loop.wait(60)


@contextmanager
def flood(session: Path, count: int) -> Iterator[list[int]]:
    """Clients that ask for the state as fast as it is answered, and come back when they are shut out; how often each
    was answered."""
    over, answers = threading.Event(), [0] * count

    def ask(number: int) -> None:
        while not over.is_set():
            with suppress(OSError, ValueError), connected(session) as client:
                client.settimeout(10.0)
                while not over.is_set():
                    client.sendall(STATE)
                    if not client.recv(65536):
                        break
                    answers[number] += 1

    threads = [threading.Thread(target=ask, args=(number,), daemon=True) for number in range(count)]
    for thread in threads:
        thread.start()
    try:
        yield answers
    finally:
        over.set()
        for thread in threads:
            thread.join(60)


def frames_saved(out: Path) -> int:
    with suppress(SessionError, OSError, StopIteration):
        return ask_status(next(out.iterdir())).frames_saved
    return 0


@pytest.mark.nightly
async def test_the_guard_looks_on_and_a_stop_leaves_while_everything_hangs(
    tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., object]
):
    ordered, clock = order(FRAMES, guard={"period_s": 5.0}), WallClock()
    await asyncio.to_thread(simulator, ordered.config, False)
    with ext4(tmp_path / "disk", 6 << 30) as disk, busy_loops(BUSY):
        out = disk / "out"
        command = ["run", tmp_path / "recipe.yaml", "--config", tmp_path / "config.yaml", "--out", out]
        process = subprocess.Popen(
            [sys.executable, "-m", "thermostand.stand.cli", *command],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        try:
            async with asyncio.timeout(LIMIT_S):
                while await asyncio.to_thread(frames_saved, out) < 10:
                    assert process.poll() is None, process.stderr.read()
                    await asyncio.sleep(0.2)
            with flood(next(out.iterdir()), CLIENTS) as answers:
                run("fsfreeze", "-f", disk)
                try:
                    await asyncio.sleep(GONE_S)
                    await fault(ordered, "bus.unplugged", True)
                    await asyncio.sleep(GONE_S)
                    await fault(ordered, "bus.unplugged", False)
                    await asyncio.sleep(HANGS_S - 2 * GONE_S)
                    begun_ns = clock.now_ns()
                    process.send_signal(signal.SIGTERM)
                    await heater_is(ordered, 0)
                    safe_ns = clock.now_ns()
                    status = await asyncio.to_thread(process.wait, LIMIT_S)
                    left_ns = clock.now_ns()
                finally:
                    run("fsfreeze", "-u", disk)
            output = process.stderr.read()
        finally:
            process.kill()
            process.wait(LIMIT_S)
            process.stderr.close()
    assert status == 130, output
    assert "stopped by the operator" in output
    assert "limit 60 s" in output
    assert "guard has not looked" not in output  # what is reported when two looks are more than two periods apart
    assert sum(answers) > CLIENTS
    assert (safe_ns - begun_ns) / NS_PER_S < 15.0
    assert (left_ns - safe_ns) / NS_PER_S < 15.0  # 5 s where nothing else keeps the machine busy
