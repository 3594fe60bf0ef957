"""Fake devices in a process of their own, so that neither side of a benchmark waits for the other's interpreter.

`python -m tests.bench.fakes NAME ARGUMENTS` builds them, prints one line when they answer, and ends with its standard
input.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.sim.gige.camera import FakeCamera, HEIGHT_px, WIDTH_px
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.modbus import RtuEngine, TcpEngine
from thermostand.drivers.sim.units.regulator import FakeRegulator
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.foundation.clock import WallClock

Close = Callable[[], None]


@contextmanager
def fakes(name: str, *arguments: object) -> Generator[str]:
    """The fakes `name`, running; yields the line they printed."""
    command = [sys.executable, "-m", "tests.bench.fakes", name, *map(str, arguments)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        if process.stdin is None or process.stdout is None:
            raise ValueError("the fakes were started without their pipes")
        try:
            line = process.stdout.readline().strip()
            if not line:
                raise ValueError(f"the fakes {name} did not start")
            yield line
        finally:
            process.stdin.close()


def modbus(ours: str, other: str) -> tuple[str, list[Close]]:
    """One regulator, unit 1, behind a TCP port and at the ends of two serial wires; prints the port."""
    clock = WallClock()
    units = (FakeRegulator(Plant(PlantSpec(), clock.now_ns()), clock, 1),)
    tcp = TcpWire("127.0.0.1", 0, lambda: TcpEngine(units), LinkFaults())
    ptys = [PtyWire(Path(path), RtuEngine(units), LinkFaults()) for path in (ours, other)]
    return str(tcp.port), [tcp.close, *(pty.close for pty in ptys)]


def camera(address: str, serial_number: str, pace_MBps: str) -> tuple[str, list[Close]]:
    """A camera whose image costs nothing and leaves at once when it is triggered, as in virtual time."""
    clock = WallClock()
    image = np.random.default_rng(1).integers(0, 256, (HEIGHT_px, WIDTH_px), dtype=np.uint8)

    def render(time_ns: int, exposure_s: float, gain_dB: float, rows: int) -> NDArray[np.uint8]:
        return image[:rows]

    plant = Plant(PlantSpec(camera_powered=True), clock.now_ns())
    fake = FakeCamera(plant, clock, render, address, serial_number, pace_MBps=float(pace_MBps))
    fake.start()
    return "ready", [fake.close]


def main() -> None:
    """Build, tell, wait, close."""
    build = {"modbus": modbus, "camera": camera}[sys.argv[1]]
    line, closers = build(*sys.argv[2:])
    sys.stdout.write(line + "\n")
    sys.stdout.flush()
    sys.stdin.read()
    for close in closers:
        close()


if __name__ == "__main__":
    main()
