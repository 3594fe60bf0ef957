"""Frames per second by software trigger through the camera driver beside what the paced wire lets through.

Full 5 MP frames from the fake camera in its own process, whose image costs nothing and leaves without waiting for the
exposure. Limit: all packets of a frame at the pace, 40 MB/s as in real time and 120 MB/s as in virtual time.
The limit is worked out, not measured, so here other load on the machine does lower the ratio.
"""

from __future__ import annotations

import asyncio
import math
import time
from pathlib import Path

from tests.bench.fakes import fakes
from tests.bench.figures import Figure, progress, require_aravis, side_by_side
from thermostand.drivers.devices.cameras.camera_gige import Camera
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
    return [_at_pace(what, pace_MBps) for pace_MBps in PACES_MBps]


def _at_pace(what: str, pace_MBps: int) -> Figure:
    progress(f"{what} at {pace_MBps} MB/s")
    settings = GigeCameraSettings(
        address=ADDRESS, serial_number=SERIAL_NUMBER, exposure_s=0.001, packet_size=PACKET_SIZE
    )
    with fakes("camera", ADDRESS, SERIAL_NUMBER, pace_MBps):
        own, limit = asyncio.run(_measure(Camera("camera", settings, WallClock()), pace_MBps))
    return side_by_side(what, "frames/s", f"wire paced at {pace_MBps} MB/s", own, limit)


async def _measure(camera: Camera, pace_MBps: int) -> tuple[list[float], list[float]]:
    await camera.open()
    try:
        packets = math.ceil(camera.effective.payload_bytes / (PACKET_SIZE - HEADERS_bytes)) + LEADER_AND_TRAILER
        await camera.grab()
        own = [await _frames_per_second(camera) for _ in range(ROUNDS)]
    finally:
        await camera.close()
    return own, [pace_MBps * 1e6 / (packets * PACKET_SIZE)] * ROUNDS


async def _frames_per_second(camera: Camera) -> float:
    begin_s = time.perf_counter()
    for _ in range(FRAMES):
        await camera.grab()
    return FRAMES / (time.perf_counter() - begin_s)
