"""A camera that is no GigE Vision one: the way of USB3 Vision, with the fake device within Aravis. No USB3 camera was
seen."""

import ctypes

import numpy as np
import pytest

from tests.system.conftest import require_aravis
from thermostand.drivers.devices.cameras.camera_usb3 import Camera, Settings
from thermostand.drivers.framing.aravis_library import ARAVIS_SONAMES, load
from thermostand.drivers.wires.camera_settings import GigeCameraSettings
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import Refused
from thermostand.foundation.readings import Quality

FAKE = "Fake_1"


@pytest.fixture(autouse=True)
def _fake() -> None:
    require_aravis()
    enable = load(ARAVIS_SONAMES, "libaravis-0.8-0").arv_enable_interface
    enable.argtypes = [ctypes.c_char_p]
    enable(b"Fake")


def settings(**changes: object) -> Settings:
    usual: dict[str, object] = {"address": FAKE, "width_px": 320, "height_px": 240, "exposure_s": 0.01}
    return Settings.model_validate({**usual, **changes})


@pytest.mark.parametrize("trigger", ["software", "free_run"])
async def test_it_is_set_read_back_and_grabs_without_packets_and_heartbeat(trigger: str):
    camera = Camera("camera", settings(trigger=trigger, frame_rate_hz=20.0), WallClock())
    await camera.open()
    try:
        frames = [await camera.grab() for _ in range(3)]
        (reading,) = await camera.read()
        effective, identity = camera.effective, camera.identity
    finally:
        await camera.close()
    assert [frame.image.shape for frame in frames] == [(240, 320)] * 3
    assert all(np.ptp(frame.image) > 100 for frame in frames)
    assert [frame.time_ns for frame in frames] == sorted(frame.time_ns for frame in frames)
    assert (effective.packet_size, effective.heartbeat_s, effective.receive_buffer_bytes) == (0, 0.0, 0)
    assert (identity.vendor, identity.serial_number) == ("Aravis", "1")
    assert reading.quality is Quality.BAD  # it has no temperature


async def test_a_camera_of_the_other_kind_is_refused_by_its_address():
    camera = Camera(
        "camera", GigeCameraSettings.model_construct(**{**settings().model_dump(), "heartbeat_s": 1.5}), WallClock()
    )
    with pytest.raises(Refused, match="no GigE Vision camera"):
        await camera.open()
    await camera.close()
