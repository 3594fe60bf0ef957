"""What `stand check` says of a thermal imager's folder and of a camera's packets."""

from pathlib import Path

import numpy as np
import pytest

from thermostand.drivers.devices.cameras.cameras_by_protocol import check_packets
from thermostand.drivers.devices.imager.thermal_imager import ThermalImagerSettings, check_folder
from thermostand.drivers.sim.units.thermal_imager import HEIGHT, WIDTH, RadiometricShot, make_jpeg

WARM = np.full((HEIGHT, WIDTH), 31.0)


def looked(folder: Path, **settings: object) -> tuple[str, str, str]:
    spots = {"lens": {"x_px": 80, "y_px": 60, "emissivity": 1.0}}
    found = check_folder(ThermalImagerSettings.model_validate({"folder": folder, "spots": spots, **settings}))
    return found.what, found.verdict, found.text


def test_the_newest_picture_of_an_imager_is_looked_at(tmp_path: Path):
    verdict, text = looked(tmp_path / "card")[1:]
    assert verdict == "failed"
    assert text.startswith(f"{tmp_path / 'card'} cannot be read")
    assert looked(tmp_path)[:2] == ("reading", "unverified")
    (tmp_path / "IR_0001.jpg").write_bytes(make_jpeg(RadiometricShot(WARM, 1.7e9)))
    what, verdict, text = looked(tmp_path, serial_number="49001234")
    assert (what, verdict) == ("reading", "ok")
    assert text == "FLIR E40, serial number 49001234; its newest picture, IR_0001.jpg, shows lens 31.0 degC"
    assert looked(tmp_path, serial_number="5")[:2] == ("identity", "failed")
    assert looked(tmp_path, spots={"lens": {"x_px": 500, "y_px": 60}})[:2] == ("settings", "failed")
    assert looked(tmp_path, spots={"lens": {"x_px": WIDTH - 1, "y_px": 60}})[:2] == (
        "settings",
        "failed",
    )  # nor by a run
    odd = RadiometricShot(
        WARM - np.where(np.arange(WIDTH) < 9, 10.0, 0.0), 1.7e9, spots={"": (4, 4)}
    )  # a measurement without a name
    (tmp_path / "IR_0001.jpg").write_bytes(make_jpeg(odd))
    assert looked(tmp_path)[2].endswith("lens 31.0 degC")
    (tmp_path / "IR_0001.jpg").write_bytes(b"\xff\xd8\xff\xd9")
    assert looked(tmp_path)[:2] == ("reading", "failed")


@pytest.mark.parametrize(("packet_size", "verdict"), [(8000, "ok"), (65_600, "failed")])
def test_packets_larger_than_the_interface_takes_are_reported(packet_size: int, verdict: str):
    assert check_packets("camera", "127.0.0.9", packet_size).verdict == verdict
