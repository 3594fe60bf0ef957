"""`stand device` on a stand that no daemon has: what a device is asked, through the same gate, and left as it was."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import pytest
from typer.testing import CliRunner, Result

from tests.system.test_check import laboratory
from thermostand.stand.assembly.simulator import Simulator
from thermostand.stand.commands.command_table import app
from thermostand.stand.config.stand_config import load_config
from thermostand.stand.running.order import Order


@pytest.fixture
def tell(tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., Simulator]) -> Callable[..., Result]:
    order(camera={"boot_s": 0.2, "serial_number": "TS-0001"}, recording={"directory": str(tmp_path / "none")})
    config = tmp_path / "config.yaml"
    simulator(load_config(config), False)

    def asked(*words: object) -> Result:
        return CliRunner().invoke(app, ["device", *map(str, words), "--config", str(config), "--json"])

    return asked


def test_devices_are_operated_by_hand_and_left_safe(tell: Callable[..., Result], tmp_path: Path):
    devices = {each["name"]: [verb["verb"] for verb in each["verbs"]] for each in json.loads(tell().stdout)}
    assert list(devices)[:2] == ["relays", "regulator"]
    assert (devices["thermometers"], devices["flap"]) == (["read", "registers"], ["read", "open", "close"])
    assert "grab" in devices["camera"]
    readings = {each["channel"]: each["value"] for each in json.loads(tell("thermometers", "read").stdout)}
    assert readings["thermometers.air"] == pytest.approx(24, abs=0.5)
    assert json.loads(tell("relays", "registers").stdout)["relay_0"] == {"raw": 0, "value": 0.0}
    assert json.loads(tell("flap", "open", "open_s=0.1").stdout)[0]["value"] == pytest.approx(1, abs=0.05)
    picture = tmp_path / "frame.png"
    found = json.loads(tell("camera", "grab", "flap=open", "-o", picture).stdout)
    image = cv2.imread(str(picture), cv2.IMREAD_UNCHANGED)
    assert (found["mean_grey"], image.shape) == (round(float(image.mean()), 2), (found["height_px"], found["width_px"]))
    assert found["brightest"] > 100
    state = laboratory(tmp_path / "config.yaml", {"do": "state"})
    assert (state["flap_open"], state["camera_powered"]) == (pytest.approx(0, abs=0.05), 0)


def test_what_is_not_done_by_hand_is_reported(tell: Callable[..., Result]):
    for words, sentence in (
        (("regulator", "set", "setpoint_degC=30"), "heat needs a recording and a guard"),
        (("linear", "move", "position=500"), "outside the limits"),
        (("linear", "registers"), "linear has no registers"),
        (("linear", "mvoe", "position=1"), "linear does not know mvoe; it takes read, move, stop, home"),
        (("lid", "open"), "this stand has no device lid; there are relays, regulator"),
    ):
        done = tell(*words)
        assert done.exit_code
        assert sentence in done.stderr
