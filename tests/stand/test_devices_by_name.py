"""Cameras, thermometers and axes are named in a stand's file: none of them, or several."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.documents import load_document, parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.estimating.estimate import price_plan


def changed(change: Callable[[dict[str, Any]], object]) -> StandConfig:
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    change(data)
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


def without(*sections: str) -> StandConfig:
    return changed(lambda data: [data.pop(section) for section in sections])


def plan(recipe: str, config: StandConfig) -> object:
    return price_plan(load_document(find_packaged("recipes", recipe), Recipe).plan(), config)


@pytest.mark.parametrize(
    "change",
    [
        lambda data: data.update(camera=data.pop("cameras")["camera"]),
        lambda data: data.update(thermometers={**data.pop("thermometer_module"), "channels": data["thermometers"]}),
    ],
)
def test_a_file_of_an_earlier_version_is_refused_and_says_what_goes_where(
    change: Callable[[dict[str, Any]], object],
):
    with pytest.raises(ConfigError, match=r"^stand.yaml: .*earlier, unreleased version"):
        changed(change)


def test_a_stand_without_cameras_axes_and_spare_thermometers_is_made():
    def change(data: dict[str, Any]) -> None:
        del data["cameras"], data["axes"], data["relays"]["channels"]["camera_power"]
        data["thermometers"] = {name: data["thermometers"][name] for name in ("air", "granite_inside")}

    assembly = assemble(changed(change), Hub(), VirtualClock(0))
    polled = [poller.sensor.name for poller in assembly.make_pollers()]
    assert polled == ["relays", "regulator", "thermometers", "flap"]
    assert assembly.make_guard(lambda fault: None) is not None


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
            "bus and devices need addresses",
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
    assert {"camera", "side"} <= {poller.sensor.name for poller in assembly.make_pollers()}
