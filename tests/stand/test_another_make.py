"""Another make of a regulator is a YAML; another camera protocol is one file in drivers/devices."""

import os
import subprocess
import sys
from pathlib import Path

import yaml

from foundation.clock import VirtualClock
from foundation.documents import parse_document
from foundation.hub import Hub
from stand.assembly import assemble
from stand.config.stand_config import StandConfig, packaged

CAMERA_FILE = '''
"""A camera that always sees the same."""

from typing import Literal

import numpy as np

from drivers.settings import CameraSettings, Identity
from foundation.readings import Frame, bad_reading


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

    async def temperature_place(self):
        return ""

    async def grab(self, exposure_s=None, due_ns=0):
        image = np.full((4, 6), self.settings.shade_DN, np.uint8)
        return Frame(f"{self.name}.image", image, self._clock.now_ns(), exposure_s or 0.1, 0.0, np.nan, 1, 0)
'''
USED = """
import asyncio, sys
from pathlib import Path
import drivers.devices.cameras
drivers.devices.cameras.__path__.append(sys.argv[1])
from foundation.clock import VirtualClock
from foundation.errors import ConfigError
from foundation.documents import load_document
from foundation.hub import Hub
from stand.assembly import assemble
from stand.config.stand_config import StandConfig
try:
    config = load_document(Path(sys.argv[2]), StandConfig)
except ConfigError as error:
    sys.exit(str(error))
cameras = assemble(config, Hub(), VirtualClock(0)).devices.cameras
print([(name, type(camera).__module__) for name, camera in cameras.items()])
print(asyncio.run(cameras["side"].grab()).image.mean())
"""


def used(tmp_path: Path, side: dict[str, object]) -> "subprocess.CompletedProcess[str]":
    (tmp_path / "devices").mkdir(exist_ok=True)
    (tmp_path / "devices" / "camera_still.py").write_text(CAMERA_FILE)
    data = yaml.safe_load(packaged("", "simulated").read_text())
    data["cameras"]["side"] = side
    (tmp_path / "stand.yaml").write_text(yaml.safe_dump(data))
    return subprocess.run(
        [sys.executable, "-c", USED, str(tmp_path / "devices"), str(tmp_path / "stand.yaml")],
        capture_output=True,
        text=True,
        check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)},
    )


def test_a_second_camera_protocol_is_one_file(tmp_path: Path):
    done = used(tmp_path, {"protocol": "still", "address": "nowhere", "shade_DN": 9, "has_temperature": False})
    assert done.stdout.splitlines() == [
        "[('camera', 'drivers.devices.cameras.camera_gige'), ('side', 'drivers.devices.cameras.camera_still')]",
        "9.0",
    ], done.stderr


def test_the_keys_of_a_second_camera_protocol_are_checked(tmp_path: Path):
    done = used(tmp_path, {"protocol": "still", "address": "nowhere", "packet_size": 8000})
    assert (done.returncode, done.stderr.count("\n")) == (1, 1)
    assert "packet_size: unknown key" in done.stderr
    other = used(tmp_path, {"protocol": "film", "address": "nowhere"})
    assert other.stderr.endswith("stand.yaml: cameras.side: protocol has to be one of gige, still, usb3 (line 32)\n")


def test_a_second_regulator_make_is_a_yaml(tmp_path: Path):
    other = yaml.safe_load(packaged("registers", "omron-e5cc").read_text())
    other |= {"vendor": "Another", "model": "of nobody"}
    other["points"]["pv"]["address"] = 0x2040
    (tmp_path / "another.yaml").write_text(yaml.safe_dump(other))
    data = yaml.safe_load(packaged("", "simulated").read_text())
    data["regulator"]["registers"] = str(tmp_path / "another.yaml")
    assembly = assemble(parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml"), Hub(), VirtualClock(0))
    assert assembly.devices.regulator.name == "regulator"
