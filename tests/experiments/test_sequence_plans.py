"""The installed recipes hold what the paper asks for, counted; and what is so whatever the parameters are."""

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.experiments.sequence_steps import (
    GRID,
    PLACES,
    captures,
    check_ids,
    check_order,
    table_positions,
)
from thermostand.experiments.calibration import CalibrationGrid, plan_calibration
from thermostand.experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PowerCamera,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    StartChamber,
    Step,
    StopChamber,
    estimate_duration_s,
)
from thermostand.experiments.validation import Validation, plan_validation
from thermostand.experiments.warm_up import WarmUp, plan_warm_up
from thermostand.foundation.documents import load_document
from thermostand.stand.config.recipe import Experiment, Recipe
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.estimating.estimate import price_plan

RECIPES = [
    "calibration",
    "demo",
    "overnight",
    "ramps",
    "thermal-cycle",
    "thermal-cycle-settled",
    "trial",
    "validation",
    "warm-up",
]


def recipe(name: str) -> Recipe:
    return load_document(find_packaged("recipes", name), Recipe)


def steps_of(name: str) -> list[Step]:
    return [planned.step for planned in recipe(name).plan()]


# The installed recipes


def test_every_installed_recipe_is_among_the_tested():
    assert sorted(path.stem for path in Path(find_packaged("recipes", "demo")).parent.glob("*.yaml")) == RECIPES


@pytest.mark.parametrize("name", RECIPES)
def test_an_installed_recipe_keeps_the_order_and_fits_both_stands(name: str):
    check_order(steps_of(name))
    check_ids(steps_of(name))
    for stand in ("simulated", "laboratory"):
        assert price_plan(recipe(name).plan(), load_config(find_packaged("", stand)))


def test_the_calibration_sees_34_different_positions_at_the_reference():
    for name in ("calibration", "validation", "overnight"):
        steps = steps_of(name)
        positions = table_positions(steps, Role.CALIBRATION)
        assert len(positions) == len(set(positions)) == 34
        assert {step.chamber_degC for step in captures(steps, Role.CALIBRATION)} == {24.0}


def test_the_warm_up_takes_3600_frames_every_half_second_twice_the_second_time_rolled():
    steps = steps_of("warm-up")
    assert [(step.frames, step.interval_s, step.exposure_s) for step in captures(steps, Role.WARM_UP)] == [
        (3600, 0.5, 0.1)
    ] * 2
    (prompt,) = [step.text for step in steps if isinstance(step, Prompt)]
    assert "from 0 to 20 deg" in prompt


def test_the_validation_visits_v0_to_v3_and_v0_again_at_12_temperatures():
    steps = steps_of("validation")
    places = [(70.0, 0.0), (95.0, 8.0), (10.0, -20.0), (140.0, 22.0)]
    assert table_positions(steps, Role.POSE) == places * 12
    assert table_positions(steps, Role.REPEATABILITY) == places[:1] * 12
    temperatures_degC = [step.chamber_degC for step in captures(steps, Role.REPEATABILITY)]
    assert len(set(temperatures_degC)) == 12
    roles = [step.role for step in captures(steps, Role.POSE, Role.REPEATABILITY)]
    assert roles == [*[Role.POSE] * 4, Role.REPEATABILITY] * 12


def test_no_validation_temperature_but_the_reference_was_fitted():
    fitted = {step.chamber_degC for step in captures(steps_of("overnight"), Role.FIT)}
    validated = {step.chamber_degC for step in captures(steps_of("validation"), Role.POSE)}
    assert fitted & validated == {24.0}
    assert min(fitted) <= min(validated)
    assert max(validated) <= max(fitted)


def test_validation_positions_lie_within_the_calibrated_ones():
    calibrated = table_positions(steps_of("validation"), Role.CALIBRATION)
    for axis in (0, 1):
        own = [position[axis] for position in table_positions(steps_of("validation"), Role.POSE)]
        assert min(position[axis] for position in calibrated) <= min(own)
        assert max(own) <= max(position[axis] for position in calibrated)


def test_the_session_fits_between_six_in_the_evening_and_eight_in_the_morning():
    priced = price_plan(recipe("overnight").plan(), load_config(find_packaged("", "laboratory")))
    assert 13.0 < sum(step.duration_s for step in priced) / 3600 < 14.0


def test_the_session_meets_each_set_point_in_between_once_from_below_and_once_from_above():
    set_points = [24.0, *(step.chamber_degC for step in steps_of("overnight") if isinstance(step, SetTemperature))]
    visits = list(itertools.pairwise(set_points))
    for chamber_degC in (17.0, 24.0, 31.0, 38.0, 45.0):
        assert sorted(begin < end for begin, end in visits if end == chamber_degC) == [False, True]
    assert (set_points.count(52.0), set_points.count(10.0)) == (2, 2)
    assert {step.chamber_degC for step in captures(steps_of("overnight"), Role.VALIDATION)} == {17.0, 38.0}


def test_the_table_is_moved_before_the_camera_is_switched_on_so_that_nothing_delays_the_first_frame():
    steps = list(plan_warm_up(WarmUp(table_position={"linear": 5.0})))
    kinds = [type(step) for step in steps]
    assert kinds == [
        CloseFlap,
        PowerCamera,
        StartChamber,
        CoolDown,
        MoveTo,
        OpenFlap,
        PowerCamera,
        Capture,
        CloseFlap,
        StopChamber,
    ]


# Steps


def test_set_up_is_restored_after_an_interruption_and_work_is_done_once():
    set_up = [
        StartChamber(24.0),
        SetTemperature(24.0),
        StopChamber(),
        PowerCamera(on=True),
        MoveTo("linear", 1.0),
        OpenFlap(),
        CloseFlap(),
    ]
    work = [
        Soak(1.0),
        CoolDown(0.5, 1200.0, 7200.0),
        Capture(1, 0.5, 0.1, Role.FIT, 24.0),
        CheckHome("linear"),
        Prompt("roll the camera"),
    ]
    assert [step.is_setup for step in (*set_up, *work)] == [True] * len(set_up) + [False] * len(work)


def test_a_cool_down_lasts_until_20_K_have_decayed_to_the_band_or_its_limit_is_reached():
    assert estimate_duration_s([CoolDown(0.5, 1200.0, 7200.0)]) == pytest.approx(4426.7, abs=0.1)
    assert estimate_duration_s([CoolDown(0.5, 1200.0, 3600.0)]) == 3600.0
    assert estimate_duration_s([CoolDown(20.0, 1200.0, 3600.0)]) == 0.0


def test_each_kind_of_entry_plans_its_own_steps():
    def steps(entry: dict[str, object]) -> Iterator[Step]:
        return (written.step for written in Experiment.model_validate(entry).make_sequence())

    assert list(steps({"calibration": GRID})) == list(plan_calibration(CalibrationGrid.model_validate(GRID)))
    assert list(steps({"validation": PLACES})) == list(plan_validation(Validation.model_validate(PLACES)))
    assert list(steps({"warm_up": {}})) == list(plan_warm_up(WarmUp()))
