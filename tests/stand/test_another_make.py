"""Another make of a regulator is a YAML; another camera protocol is one file in drivers/devices."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.stand_config import StandConfig, find_packaged

CAMERA_FILE = '''
"""A camera that always sees the same."""

from typing import Literal

import numpy as np

from thermostand.drivers.settings import CameraSettings, Identity
from thermostand.foundation.readings import Frame, bad_reading


class Settings(CameraSettings):
    protocol: Literal["still"] = "still"
    shade_DN: int = 7


class Camera:
    restarted, is_usable, identity = "", True, Identity("nobody", "still", "S-1", "1")

    def __init__(self, name, settings, clock):
        self.name, self.settings, self._clock = name, settings, clock

    async def open(self): ...

    async def close(self): ...

    async def read(self):
        return (bad_reading(f"{self.name}.temperature", "degC", self._clock.now_ns(), "it has none"),)

    async def describe_temperature_place(self):
        return ""

    async def grab(self, exposure_s=None, due_ns=0):
        image = np.full((4, 6), self.settings.shade_DN, np.uint8)
        return Frame(f"{self.name}.image", image, self._clock.now_ns(), exposure_s or 0.1, 0.0, np.nan, 1, 0)
'''
USED = """
import asyncio, sys
from pathlib import Path
import thermostand.drivers.devices.cameras
thermostand.drivers.devices.cameras.__path__.append(sys.argv[1])
from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.documents import load_document
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.stand_config import StandConfig
for path in sys.argv[2:]:
    try:
        config = load_document(Path(path), StandConfig)
    except ConfigError as error:
        print(error)
        continue
    cameras = assemble(config, Hub(), VirtualClock(0)).devices.cameras
    modules = [(name, type(camera).__module__) for name, camera in cameras.items()]
    print(modules, asyncio.run(cameras["side"].grab()).image.mean())
"""


SIDES: dict[str, dict[str, object]] = {
    "right": {"protocol": "still", "address": "nowhere", "shade_DN": 9, "has_temperature": False},
    "key": {"protocol": "still", "address": "nowhere", "packet_size": 8000},
    "protocol": {"protocol": "film", "address": "nowhere"},
}


@pytest.fixture(scope="module")
def answers(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What a program in which that file is beside ours makes of a stand with each camera: a line each."""
    folder = tmp_path_factory.mktemp("stands")
    (folder / "devices").mkdir()
    (folder / "devices" / "camera_still.py").write_text(CAMERA_FILE)
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    for name, side in SIDES.items():
        data["cameras"]["side"] = side
        (folder / f"{name}.yaml").write_text(yaml.safe_dump(data))
    done = subprocess.run(
        [sys.executable, "-c", USED, str(folder / "devices"), *(str(folder / f"{name}.yaml") for name in SIDES)],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )
    assert (done.returncode, done.stderr) == (0, "")
    return dict(zip(SIDES, done.stdout.splitlines(), strict=True))


def test_a_second_camera_protocol_is_one_file(answers: dict[str, str]):
    assert answers["right"] == (
        "[('camera', 'thermostand.drivers.devices.cameras.camera_gige'), "
        "('side', 'thermostand.drivers.devices.cameras.camera_still')] 9.0"
    )


def test_the_keys_of_a_second_camera_protocol_are_checked(answers: dict[str, str]):
    assert "packet_size: unknown key" in answers["key"]
    assert answers["protocol"].endswith(" gige, still, usb3 (line 32)")


def test_a_second_regulator_make_is_a_yaml(tmp_path: Path):
    other = yaml.safe_load(find_packaged("registers", "omron-e5cc").read_text())
    other |= {"vendor": "Another", "model": "of nobody"}
    other["points"]["pv"]["address"] = 0x2040
    (tmp_path / "another.yaml").write_text(yaml.safe_dump(other))
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["regulator"]["registers"] = str(tmp_path / "another.yaml")
    assembly = assemble(parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml"), Hub(), VirtualClock(0))
    assert assembly.devices.regulator.name == "regulator"
