"""A camera driver, through Aravis, and our own GigE Vision camera before it on a loopback address."""

import asyncio
from collections.abc import AsyncGenerator, Generator
from contextlib import asynccontextmanager, contextmanager

import numpy as np
from numpy.typing import NDArray

from tests.addresses import get_usual_camera_address
from tests.still_plant import StillPlant
from thermostand.drivers.devices.cameras.camera_gige import AravisCamera
from thermostand.drivers.sim.gige.camera import FakeCamera
from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.foundation.clock import NS_PER_S, FollowedClock, VirtualClock, WallClock

SERIAL = "C0061"
WIDTH_px, HEIGHT_px = 640, 480
START_NS = 1_700_000_000 * NS_PER_S
EXPOSURE_S = 0.05


def noise(time_ns: int, exposure_s: float, gain_dB: float, rows: int = HEIGHT_px) -> NDArray[np.uint8]:
    """An image that belongs to one instant only."""
    return np.random.default_rng(time_ns).integers(0, 256, (HEIGHT_px, WIDTH_px), dtype=np.uint8)[:rows]


@contextmanager
def run_simulated_camera(
    clock: WallClock | FollowedClock, plant: StillPlant, serial: str = SERIAL
) -> Generator[FakeCamera]:
    real_time = isinstance(clock, WallClock)
    fake = FakeCamera(
        plant,
        clock,
        noise,
        get_usual_camera_address(),
        serial,
        size_px=(WIDTH_px, HEIGHT_px),
        real_time=real_time,
        boot_s=0.2,
    )
    fake.start()
    try:
        yield fake
    finally:
        fake.close()


def settings(**changes: object) -> GigeCameraSettings:
    usual: dict[str, object] = {"serial_number": SERIAL, "exposure_s": EXPOSURE_S, "heartbeat_s": 1.5}
    return GigeCameraSettings.model_validate({"address": get_usual_camera_address(), **usual, **changes})


@asynccontextmanager
async def open_camera(clock: WallClock | VirtualClock | None = None, **changes: object) -> AsyncGenerator[AravisCamera]:
    camera = AravisCamera("camera", settings(**changes), clock or WallClock())
    try:
        await camera.open()
        yield camera
    finally:
        await camera.close()


@asynccontextmanager
async def run_virtual_camera(plant: StillPlant) -> AsyncGenerator[tuple[VirtualClock, FakeCamera]]:
    """A simulated camera that follows a virtual clock."""
    followed = FollowedClock(START_NS)
    with run_simulated_camera(followed, plant) as fake:

        async def advance(time_ns: int) -> None:
            followed.follow(time_ns)
            fake.advance(time_ns)

        clock = VirtualClock(START_NS, advance)
        running = asyncio.create_task(clock.run())
        yield clock, fake
        running.cancel()
