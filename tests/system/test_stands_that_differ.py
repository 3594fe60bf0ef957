"""Stands that are not the paper's: each plans and runs a short recipe in virtual time, and says what it cannot."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from thermostand.foundation.documents import load_document
from thermostand.foundation.errors import ConfigError
from thermostand.recording.reading.session import Session
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.missing_devices import list_missing_devices
from thermostand.stand.running.order import Order, check_plan
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: short
steps:
  - start_chamber: 27
  - soak: 240
"""
FRAMES = """  - open_flap
  - capture: {frames: 2, interval_s: 10, exposure_s: 0.1, role: reference, chamber_degC: 27}
  - close_flap
"""


def bare(data: dict[str, Any]) -> None:
    """The least: a window, a camera, no compressor, the two thermometers that guard the heat."""
    del data["flap"]
    data["axes"] = {}
    del data["relays"]["channels"]["compressor"]
    data["thermometers"] = {name: data["thermometers"][name] for name in ("air", "granite_inside")}


def sixteen(data: dict[str, Any]) -> None:
    """Sixteen thermometers on three modules of another make, two instruments beside them, stages of other models."""
    data["thermometer_module"] |= {"registers": "adam-4015", "further_units": [5, 6]}
    data["thermometers"] |= {f"pt_{number}": {"channel": number} for number in range(5, 16)}
    data["probes"] = {
        "reference": {"protocol": "hart", "address": "serial:/dev/none", "serial_number": "B71234"},
        "hygrometer": {"protocol": "vaisala", "address": "tcp:127.0.0.1:1"},
    }
    data["dew"] = {"humidity_percent": 60, "hygrometer": "hygrometer"}
    stage = {"overshoot": 0.5, "acceleration": 1000, "deceleration": 1000, "source": "of nobody, p. 1"}
    data["axes"]["linear"] |= {
        "profile": {**stage, "unit": "mm", "unit_per_step": 0.01, "travel": 100, "speed": 3000, "homing_speed": 1000},
        "limits": [0, 90],
    }


@pytest.fixture
def build(tmp_path: Path, config_text: Callable[..., str]) -> Callable[..., Order]:
    def built(change: Callable[[dict[str, Any]], None], recipe: str, **sections: object) -> Order:
        data = yaml.safe_load(config_text(**sections))
        change(data)
        config_file, recipe_file = tmp_path / "stand.yaml", tmp_path / "recipe.yaml"
        config_file.write_text(yaml.safe_dump(data))
        recipe_file.write_text(recipe)
        target = find_packaged("targets", "paper-9x6").read_text()
        loaded = load_document(recipe_file, Recipe)
        return Order(load_config(config_file), loaded, config_file.read_text(), recipe, target)

    return built


async def test_a_window_a_camera_and_no_cold_is_a_stand(tmp_path: Path, build: Callable[..., Order]):
    ordered = build(bare, RECIPE + FRAMES)
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, lambda _: None))
    assert len(session.frame_metas()) == 2
    assert [frame.image.mean() > 40 for frame in session.frames()] == [True, True]  # seen through the window
    reported = [event.data["what"] for event in session.events() if event.kind == "absent"]
    assert reported == ["flap", "stages", "compressor", "thermometer in the laboratory"]
    assert max(session.readings("regulator.pv")[1]) > 26
    assert not [channel for channel in session.channels() if channel.startswith("flap.")]
    with pytest.raises(ConfigError, match="no axis 'linear', only none"):
        check_plan(Recipe.model_validate(yaml.safe_load(RECIPE + "  - move_to: {linear: 3}\n")).plan(), ordered.config)


async def test_sixteen_thermometers_other_stages_and_instruments_are_one(tmp_path: Path, build: Callable[..., Order]):
    ordered = build(sixteen, RECIPE + "  - move_to: {linear: 42, rotary: 3}\n")
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, lambda _: None))
    air_degC = session.readings("thermometers.air")[1]
    assert all(len(session.readings(f"thermometers.pt_{number}")[1]) == len(air_degC) > 20 for number in range(5, 16))
    assert abs(session.readings("thermometers.pt_15")[1][-1] - air_degC[-1]) < 0.1
    outside_degC = session.readings("thermometers.laboratory")[1][-1]
    assert abs(session.readings("reference.temperature")[1][-1] - outside_degC) < 0.1
    assert abs(session.readings("hygrometer.humidity")[1][-1] - 45) < 1
    assert session.readings("linear.position")[1][-1] == pytest.approx(42, abs=0.01)
    assert not [event.kind for event in session.events() if event.kind.startswith(("guard.", "absent"))]


def test_what_a_stand_lacks_is_reported_before_it_runs(build: Callable[..., Order]):
    assert list_missing_devices(build(lambda data: None, RECIPE).config) == ()
    with pytest.raises(ConfigError, match="needs a camera"):
        check_plan(
            Recipe.model_validate(yaml.safe_load(RECIPE + FRAMES)).plan(),
            build(lambda data: data.pop("cameras") and None, RECIPE).config,
        )
