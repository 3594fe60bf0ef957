"""Cameras, thermometers and axes are named in a stand's file: none of them, several, and the forms of before."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from foundation.clock import VirtualClock
from foundation.documents import load_document, parse_document
from foundation.errors import ConfigError
from foundation.hub import Hub
from stand.assembly import assemble
from stand.config.recipe import Recipe
from stand.config.stand_config import StandConfig, packaged
from stand.estimating.estimate import price

OLDER = """
name: of before
target: paper-9x6
bus: {address: "tcp:127.0.0.1:15020"}
regulator: {registers: omron-e5cc, unit: 1}
relays:
  registers: waveshare-relay
  unit: 2
  channels: {heater_enable: 0, compressor: 1, camera_power: 2}
thermometers:
  registers: icpdas-m7015
  unit: 3
  poll_s: 5.0
  channels:
    granite_inside: {channel: 0}
    air: {channel: 3, polynomial: [0, 0.2]}
flap: {serial_number: "00351210"}
camera: {address: 127.0.0.20, exposure_s: 0.2, temperature: {entry: Mainboard}}
guard: {accept: [thermometers.channels.air.polynomial], stale_after_s: 15.0}
"""


def changed(change: Callable[[dict[str, Any]], object]) -> StandConfig:
    data = yaml.safe_load(packaged("", "simulated").read_text())
    change(data)
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


def without(*sections: str) -> StandConfig:
    return changed(lambda data: [data.pop(section) for section in sections])


def plan(recipe: str, config: StandConfig) -> object:
    return price(load_document(packaged("recipes", recipe), Recipe).plan(), config)


def test_a_file_of_before_opens_as_if_it_had_todays_form():
    found = parse_document(OLDER, StandConfig, "older.yaml")
    assert found.cameras.keys() == {"camera"}
    assert found.cameras["camera"].exposure_s == 0.2
    assert found.thermometer_module.model_dump() == {
        "registers": "icpdas-m7015",
        "unit": 3,
        "poll_s": 5.0,
        "further_units": (),
    }
    assert found.thermometers["air"].polynomial == (0.0, 0.2)
    assert found.accepted() == {"thermometers.air.polynomial": 20.0}


@pytest.mark.parametrize(
    ("added", "sentence"),
    [
        ("cameras: {}", "camera and cameras are both given"),
        (
            "thermometer_module: {registers: icpdas-m7015, unit: 3}",
            "thermometer_module and thermometers.channels are b",
        ),
    ],
)
def test_both_forms_in_one_file_are_refused(added: str, sentence: str):
    with pytest.raises(ConfigError, match=f"^older.yaml: {sentence}"):
        parse_document(OLDER + added, StandConfig, "older.yaml")


def test_a_fault_in_a_file_of_before_is_reported_at_todays_place():
    with pytest.raises(ConfigError, match=r"^older.yaml: cameras.camera.exposure_s: must be greater than 0"):
        parse_document(OLDER.replace("exposure_s: 0.2", "exposure_s: 0"), StandConfig, "older.yaml")


def test_a_stand_without_cameras_axes_and_spare_thermometers_is_made():
    def change(data: dict[str, Any]) -> None:
        del data["cameras"], data["axes"], data["relays"]["channels"]["camera_power"]
        data["thermometers"] = {name: data["thermometers"][name] for name in ("air", "granite_inside")}

    assembly = assemble(changed(change), Hub(), VirtualClock(0))
    polled = [poller.sensor.name for poller in assembly.pollers()]
    assert polled == ["regulator", "thermometers", "relays", "flap"]
    assert assembly.guard(lambda fault: None) is not None


@pytest.mark.parametrize(
    ("sections", "recipe", "sentence"),
    [
        (["cameras"], "thermal-cycle", "needs a camera, and this stand has none; name it under cameras"),
        (["axes"], "calibration", "this stand has no axis 'linear', only none"),
    ],
)
def test_a_plan_says_which_device_it_lacks(sections: list[str], recipe: str, sentence: str):
    with pytest.raises(ConfigError, match=rf"^step \d+ \(\w+\): {sentence}"):
        plan(recipe, without(*sections))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda data: data["thermometers"].pop("air"), "thermometers lacks air, without which nothing is heated"),
        (lambda data: data["cameras"].update(left=data["cameras"].pop("camera")), "cameras: one of them has to be nam"),
        (lambda data: data["axes"].update(flap=data["axes"].pop("linear")), "the name flap is that of two devices"),
        (lambda data: data["relays"]["channels"].pop("camera_power"), "relays.channels lacks camera_power"),
        (
            lambda data: data["cameras"].update(left=data["cameras"]["camera"]),
            "bus, axes, probes and cameras need addresses",
        ),
        (
            lambda data: data["cameras"].update({"Left": data["cameras"]["camera"]}),
            "cameras.Left: begins with a lower-case letter",
        ),
    ],
)
def test_names_that_do_not_fit_are_reported_in_one_sentence(change: Callable[[dict[str, Any]], object], sentence: str):
    with pytest.raises(ConfigError, match=f"^stand.yaml: {sentence}") as caught:
        changed(change)
    assert "\n" not in str(caught.value)


def test_several_cameras_are_made_polled_and_guarded(tmp_path: Path):
    second = {"address": "127.0.0.21", "serial_number": "TS-0002", "poll_s": 2.0}
    assembly = assemble(changed(lambda data: data["cameras"].update(side=second)), Hub(), VirtualClock(0))
    assert list(assembly.devices.cameras) == ["camera", "side"]
    assert {"camera", "side"} <= {poller.sensor.name for poller in assembly.pollers()}
