"""The stock Aravis fake camera is grabbed through a configuration file alone."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.stock_camera import ADDRESS, SERIAL
from thermostand.drivers.devices.cameras.cameras_by_protocol import PROTOCOLS
from thermostand.foundation.clock import WallClock
from thermostand.stand.config.stand_config import load_config


@pytest.mark.usefixtures("stock_camera")
async def test_a_configuration_file_is_all_the_stock_camera_needs(tmp_path: Path, config_text: Callable[..., str]):
    file = tmp_path / "stock.yaml"
    section = {"address": ADDRESS, "serial_number": SERIAL, "width_px": 320, "height_px": 240, "packet_size": None}
    file.write_text(config_text(camera=section))
    camera = PROTOCOLS["gige"].Camera("camera", load_config(file).cameras["camera"], WallClock())
    await camera.open()
    try:
        frames = [await camera.grab(0.01) for _ in range(3)]
    finally:
        await camera.close()
    assert [frame.image.shape for frame in frames] == [(240, 320)] * 3
    # Its image is a diagonal ramp: pixel = (x + y + frame) mod 255 at 10 ms of exposure.
    assert all((int(frame.image[1, 0]) - int(frame.image[0, 0])) % 255 == 1 for frame in frames)
