"""Whatever the parameters of a sequence are, its plan keeps the order, and what cannot be is refused."""

import itertools
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.experiments.sequence_steps import (
    GRID,
    PLACES,
    POSITIONS,
    angles,
    captures,
    check_ids,
    check_order,
    lengths,
    places,
    table_positions,
)
from thermostand.experiments.calibration import CalibrationGrid, plan_calibration
from thermostand.experiments.steps import (
    Capture,
    CheckHome,
    PowerCamera,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    StopChamber,
)
from thermostand.experiments.validation import Validation, plan_validation
from thermostand.experiments.warm_up import WarmUp, plan_warm_up
from thermostand.foundation.documents import load_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.recipe import Recipe

# Whatever the parameters are

temperatures = st.floats(-10, 70)
grids = st.fixed_dictionaries(
    {
        "linear_mm": st.lists(lengths, min_size=1, max_size=6, unique=True),
        "rotary_deg": st.lists(angles, min_size=1, max_size=6, unique=True),
        "reference_degC": temperatures,
        "frames_per_position": st.integers(1, 9),
    }
)
validations = st.fixed_dictionaries(
    {
        "temperatures_degC": st.lists(temperatures, min_size=2, max_size=14, unique=True),
        "positions": places,
        "check_home_every": st.integers(1, 20),
    }
)
warm_ups = st.fixed_dictionaries(
    {
        "chamber_degC": temperatures,
        "rolls_deg": st.lists(st.floats(-180, 180), min_size=1, max_size=4, unique=True),
        "cameras": st.lists(st.sampled_from(["a", "b", "c"]), max_size=3, unique=True),
        "table_position": st.dictionaries(st.sampled_from(["linear", "rotary"]), lengths),
    }
)


@given(grids, st.data())
def test_any_calibration_sees_every_position_of_its_grid_that_is_not_left_out(
    grid: dict[str, Any], data: st.DataObject
):
    whole = {(linear, rotary) for linear in grid["linear_mm"] for rotary in grid["rotary_deg"]}
    left_out = data.draw(st.sets(st.sampled_from(sorted(whole)), max_size=len(whole) - 1))
    omitted = [{"linear_mm": linear, "rotary_deg": rotary} for linear, rotary in left_out]
    parameters = CalibrationGrid.model_validate({**grid, "left_out": omitted})
    steps = list(plan_calibration(parameters))
    check_order(steps)
    check_ids(steps)
    positions = table_positions(steps, Role.CALIBRATION)
    assert set(positions) == whole - left_out
    assert len(positions) == len(whole - left_out) == parameters.visits
    assert [type(step) for step in steps[-3:]] == [CheckHome, CheckHome, StopChamber]
    assert next(index for index, step in enumerate(steps) if isinstance(step, CheckHome)) < steps.index(Soak(2700.0))


@given(validations)
def test_any_validation_ends_each_temperature_where_it_began(given_parameters: dict[str, Any]):
    parameters = Validation.model_validate(given_parameters)
    steps = list(plan_validation(parameters))
    check_order(steps)
    check_ids(steps)
    first = (parameters.positions[0].linear_mm, parameters.positions[0].rotary_deg)
    assert set(table_positions(steps, Role.REPEATABILITY)) == {first}
    taken = captures(steps, Role.POSE, Role.REPEATABILITY)
    assert len(taken) == parameters.visits == len(parameters.temperatures_degC) * (len(parameters.positions) + 1)
    assert tuple(dict.fromkeys(step.chamber_degC for step in taken)) == parameters.temperatures_degC
    set_points = [index for index, step in enumerate(steps) if isinstance(step, SetTemperature)]
    assert [steps[index + 1] for index in set_points] == [Soak(parameters.soak_s)] * len(set_points)
    checks = sum(isinstance(step, CheckHome) for step in steps)
    assert checks == 2 * (2 + (len(parameters.temperatures_degC) - 1) // parameters.check_home_every)


@given(warm_ups)
def test_any_warm_up_asks_for_what_only_hands_can_do_and_for_nothing_else(given_parameters: dict[str, Any]):
    parameters = WarmUp.model_validate(given_parameters)
    steps = list(plan_warm_up(parameters))
    check_order(steps)
    check_ids(steps)
    assert len(captures(steps, Role.WARM_UP)) == parameters.visits
    prompts = [step.text for step in steps if isinstance(step, Prompt)]
    assert sum(text.startswith("mount") for text in prompts) == len(parameters.cameras)
    rolls = [0.0, *parameters.rolls_deg] if not parameters.cameras else parameters.rolls_deg
    changes = sum(before != after for before, after in itertools.pairwise(rolls))
    assert sum(text.startswith("roll") for text in prompts) == changes * max(1, len(parameters.cameras))
    starts = [index for index, step in enumerate(steps) if step == PowerCamera(on=True)]
    assert all(isinstance(steps[index + 1], Capture) for index in starts)


# What is refused


@pytest.mark.parametrize(
    ("model", "change", "sentence"),
    [
        (
            CalibrationGrid,
            {"left_out": [{"linear_mm": 5, "rotary_deg": 0}]},
            r"left_out has \(5.0, 0.0\), which is not",
        ),
        (CalibrationGrid, {"linear_mm": (1, 1)}, "same position twice"),
        (CalibrationGrid, {"linear_mm": (301,)}, "less than or equal to 300"),
        (CalibrationGrid, {"rotary_deg": (361,)}, "less than or equal to 360"),
        (CalibrationGrid, {"rotary_deg": ()}, "at least 1 item"),
        (CalibrationGrid, {"table_position": {"linear": 0}}, "Extra inputs"),
        (CalibrationGrid, {"settle_s": -1}, "greater than or equal to 0"),
        (CalibrationGrid, {"frames_per_position": 0}, "greater than or equal to 1"),
        (
            CalibrationGrid,
            {"linear_mm": (0,), "rotary_deg": (0,), "left_out": [{"linear_mm": 0, "rotary_deg": 0}]},
            "leaves no position",
        ),
        (Validation, {"temperatures_degC": (24,)}, "at least 2 items"),
        (Validation, {"temperatures_degC": (24, 30, 24)}, "same temperature twice"),
        (Validation, {"temperatures_degC": (24, 71)}, "less than or equal to 70"),
        (Validation, {"positions": (*POSITIONS, POSITIONS[0])}, "in the plan already"),
        (Validation, {"positions": ({"linear_mm": 1},)}, "Field required"),
        (Validation, {"check_home_every": 0}, "greater than or equal to 1"),
        (WarmUp, {"rolls_deg": ()}, "at least 1 item"),
        (WarmUp, {"rolls_deg": (0, 0)}, "same roll twice"),
        (WarmUp, {"rolls_deg": (181,)}, "less than or equal to 180"),
        (WarmUp, {"cameras": ("a", "a")}, "same camera twice"),
        (WarmUp, {"cameras": ("a\nb",)}, "match pattern"),
        (WarmUp, {"band_K": 0}, "greater than 0"),
        (WarmUp, {"time_constant_s": 0}, "greater than 0"),
    ],
)
def test_an_impossible_parameter_is_refused_with_a_reason(
    model: type[CalibrationGrid | Validation | WarmUp], change: dict[str, object], sentence: str
):
    base = {CalibrationGrid: GRID, Validation: PLACES, WarmUp: {}}[model]
    model.model_validate(base)
    with pytest.raises(ValidationError, match=sentence):
        model.model_validate({**base, **change})


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"calibration": {**GRID, "linear_mm": [1, 999]}}, r"experiments\.1\.calibration\.linear_mm\.2"),
        ({"validation": {**PLACES, "positions": [{}]}}, r"experiments\.1\.validation\.positions\.1\.linear_mm"),
        ({"calibration": GRID, "warm_up": {}}, "exactly one of warm_up, thermal_cycle, calibration, validation"),
        ({}, "exactly one of"),
    ],
)
def test_a_recipe_file_is_refused_with_file_and_path(tmp_path: Path, entry: dict[str, object], sentence: str):
    path = tmp_path / "wrong.yaml"
    path.write_text(yaml.safe_dump({"name": "wrong", "experiments": [plain(entry)]}))
    with pytest.raises(ConfigError, match=sentence) as refused:
        load_document(path, Recipe)
    assert str(path) in str(refused.value)
    assert len(str(refused.value).splitlines()) == 1


def plain(value: Any) -> Any:
    """Tuples as lists, as YAML has them."""
    if isinstance(value, dict):
        return {key: plain(entry) for key, entry in value.items()}
    return [plain(entry) for entry in value] if isinstance(value, list | tuple) else value


def test_positions_count_towards_the_longest_recipe():
    whole = {"linear_mm": tuple(range(100)), "rotary_deg": tuple(range(100))}
    entries: list[dict[str, object]] = [{"calibration": whole}]
    assert Recipe.model_validate({"name": "long", "experiments": entries})
    with pytest.raises(ValidationError, match="10001 visits"):
        Recipe.model_validate({"name": "longer", "experiments": [*entries, {"warm_up": {}}]})
