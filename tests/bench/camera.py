"""Frames per second by software trigger through the camera driver beside what the paced wire lets through.

Full 5 MP frames from the fake camera in its own process, whose image costs nothing and leaves without waiting for the
exposure. Limit: all packets of a frame at the pace, 40 MB/s as in real time and 120 MB/s as in virtual time.
The limit is worked out, not measured, so here other load on the machine does lower the ratio.
"""

from __future__ import annotations

import asyncio
import math
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tests.bench.figures import Figure, compare, report_progress, require_aravis
from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.sim.gige.camera import FakeCamera, HEIGHT_px, WIDTH_px
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.foundation.clock import WallClock

ROUNDS = 5
FRAMES = 8  # in one measurement
PACES_MBps = (40, 120)
ADDRESS = "127.0.0.91"
SERIAL_NUMBER = "BENCH-91"
PACKET_SIZE = 8000
HEADERS_bytes = 36  # IP, UDP and GVSP, of each packet
LEADER_AND_TRAILER = 2


def figures(directory: Path) -> list[Figure]:
    """One figure for each pace."""
    what = "camera, software trigger, 5 MP"
    require_aravis()
    return [_measure_at_pace(what, pace_MBps) for pace_MBps in PACES_MBps]


def _measure_at_pace(what: str, pace_MBps: int) -> Figure:
    report_progress(f"{what} at {pace_MBps} MB/s")
    settings = GigeCameraSettings(
        address=ADDRESS, serial_number=SERIAL_NUMBER, exposure_s=0.001, packet_size=PACKET_SIZE
    )
    with _run_fake(pace_MBps):
        own, limit = asyncio.run(_measure(AravisCamera("camera", settings, WallClock()), pace_MBps))
    return compare(what, "frames/s", f"wire paced at {pace_MBps} MB/s", own, limit)


async def _measure(camera: AravisCamera, pace_MBps: int) -> tuple[list[float], list[float]]:
    await camera.open()
    try:
        packets = math.ceil(camera.effective.payload_bytes / (PACKET_SIZE - HEADERS_bytes)) + LEADER_AND_TRAILER
        await camera.grab()
        own = [await _measure_frames_per_second(camera) for _ in range(ROUNDS)]
    finally:
        await camera.close()
    return own, [pace_MBps * 1e6 / (packets * PACKET_SIZE)] * ROUNDS


async def _measure_frames_per_second(camera: AravisCamera) -> float:
    begin_s = time.perf_counter()
    for _ in range(FRAMES):
        await camera.grab()
    return FRAMES / (time.perf_counter() - begin_s)


@contextmanager
def _run_fake(pace_MBps: int) -> Generator[None]:
    """The camera, in a process of its own, until the block ends."""
    command = [sys.executable, "-m", "tests.bench.camera", str(pace_MBps)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        try:
            if process.stdout.readline() != "ready\n":
                raise ValueError("the camera did not start")
            yield
        finally:
            process.stdin.close()


def main() -> None:
    """The fake: its image costs nothing and leaves at once when it is triggered, as in virtual time."""
    clock = WallClock()
    image = np.random.default_rng(1).integers(0, 256, (HEIGHT_px, WIDTH_px), dtype=np.uint8)

    def render(time_ns: int, exposure_s: float, gain_dB: float, rows: int) -> NDArray[np.uint8]:
        return image[:rows]

    plant = Plant(PlantSpec(camera_powered=True), clock.now_ns())
    fake = FakeCamera(plant, clock, render, ADDRESS, SERIAL_NUMBER, pace_MBps=float(sys.argv[1]))
    fake.start()
    sys.stdout.write("ready\n")
    sys.stdout.flush()
    sys.stdin.read()
    fake.close()


if __name__ == "__main__":
    main()
