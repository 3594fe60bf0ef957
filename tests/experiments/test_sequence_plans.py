"""The installed recipes hold what the paper asks for, counted; and what is so whatever the parameters are."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from experiments.calibration import Calibration, calibration
from experiments.steps import (
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
    SoakUntilSettled,
    StartChamber,
    Step,
    StopChamber,
    estimate_s,
    is_setup,
    number_steps,
)
from experiments.validation import Validation, validation
from experiments.warm_up import WarmUp, warm_up
from foundation.documents import load_document
from foundation.errors import ConfigError
from stand.config.recipe import Experiment, Recipe
from stand.config.stand_config import load_config, packaged
from stand.estimating.estimate import price

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
GRID = {"linear_mm": (0.0, 100.0), "rotary_deg": (-10.0, 0.0, 10.0)}
POSITIONS = ({"linear_mm": 70.0, "rotary_deg": 0.0}, {"linear_mm": 95.0, "rotary_deg": 8.0})
PLACES = {"temperatures_degC": (24.0, 30.0, 12.0), "positions": POSITIONS}


def recipe(name: str) -> Recipe:
    return load_document(packaged("recipes", name), Recipe)


def steps_of(name: str) -> list[Step]:
    return [planned.step for planned in recipe(name).plan()]


def captures(steps: list[Step], *roles: Role) -> list[Capture]:
    return [step for step in steps if isinstance(step, Capture) and step.role in roles]


def table_positions(steps: list[Step], role: Role) -> list[tuple[float, float]]:
    """(linear mm, rotary deg) at each capture of the role."""
    table: dict[str, float] = {}
    found: list[tuple[float, float]] = []
    for step in steps:
        match step:
            case MoveTo(axis, position):
                table[axis] = position
            case Capture() if step.role is role:
                found.append((table["linear"], table["rotary"]))
            case _:
                pass
    return found


def check_order(steps: list[Step]) -> None:
    """Flap open for captures only (and the camera's start before one); chamber running and at rest at each capture; a
    camera that cools is off, one that captures on; nothing is left running at the end."""
    flap_open, camera_on, chamber_degC, settled = False, True, None, False
    for before, step in zip([None, *steps], steps, strict=False):
        match step:
            case OpenFlap():
                flap_open = True
            case CloseFlap():
                flap_open = False
            case PowerCamera(on):
                camera_on = on
                assert not on or flap_open, "nothing may come between the camera's start and its first frame"
            case StartChamber(set_point_degC) | SetTemperature(set_point_degC):
                chamber_degC, settled = set_point_degC, False
            case StopChamber():
                chamber_degC = None
            case CoolDown():
                assert not camera_on
                assert chamber_degC is not None
                assert not flap_open
                settled = True
            case Soak() | SoakUntilSettled():
                assert isinstance(step, Soak) or step.chamber_degC == chamber_degC
                assert camera_on
                assert not flap_open
                settled = True
            case Capture():
                assert flap_open
                assert camera_on
                assert settled
                assert step.chamber_degC == chamber_degC
                assert isinstance(before, OpenFlap | PowerCamera)
            case MoveTo() | CheckHome():
                assert not flap_open
            case Prompt():
                assert chamber_degC is None
                assert not camera_on
    assert (flap_open, chamber_degC, camera_on) == (False, None, True)


def check_ids(steps: list[Step]) -> None:
    ids = [planned.step_id for planned in number_steps(steps)]
    assert ids == [planned.step_id for planned in number_steps(steps)]
    assert len(set(ids)) == len(ids)


# The installed recipes


def test_every_installed_recipe_is_among_the_tested():
    assert sorted(path.stem for path in Path(packaged("recipes", "demo")).parent.glob("*.yaml")) == RECIPES


@pytest.mark.parametrize("name", RECIPES)
def test_an_installed_recipe_keeps_the_order_and_fits_both_stands(name: str):
    check_order(steps_of(name))
    check_ids(steps_of(name))
    for stand in ("simulated", "laboratory"):
        assert price(recipe(name).plan(), load_config(packaged("", stand)))


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
    assert [step.text for step in steps if isinstance(step, Prompt)] == [
        "roll the camera about its optical axis, from 0 to 20 deg"
    ]


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


def test_the_night_fits_between_six_in_the_evening_and_eight_in_the_morning():
    priced = price(recipe("overnight").plan(), load_config(packaged("", "laboratory")))
    assert 13.0 < sum(step.duration_s for step in priced) / 3600 < 14.0


def test_the_night_meets_each_set_point_in_between_once_from_below_and_once_from_above():
    set_points = [24.0, *(step.chamber_degC for step in steps_of("overnight") if isinstance(step, SetTemperature))]
    visits = list(itertools.pairwise(set_points))
    for chamber_degC in (17.0, 24.0, 31.0, 38.0, 45.0):
        assert sorted(begin < end for begin, end in visits if end == chamber_degC) == [False, True]
    assert (set_points.count(52.0), set_points.count(10.0)) == (2, 2)
    assert {step.chamber_degC for step in captures(steps_of("overnight"), Role.VALIDATION)} == {17.0, 38.0}


# Whatever the parameters are

temperatures = st.floats(-10, 70)
lengths = st.floats(0, 280)
angles = st.floats(-40, 40)
grids = st.fixed_dictionaries(
    {
        "linear_mm": st.lists(lengths, min_size=1, max_size=6, unique=True),
        "rotary_deg": st.lists(angles, min_size=1, max_size=6, unique=True),
        "reference_degC": temperatures,
        "frames_per_position": st.integers(1, 9),
    }
)
places = st.lists(st.tuples(lengths, angles), min_size=2, max_size=6, unique=True).map(
    lambda pairs: [{"linear_mm": linear, "rotary_deg": rotary} for linear, rotary in pairs]
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
    parameters = Calibration.model_validate({**grid, "left_out": omitted})
    steps = list(calibration(parameters))
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
    steps = list(validation(parameters))
    check_order(steps)
    check_ids(steps)
    first = (parameters.positions[0].linear_mm, parameters.positions[0].rotary_deg)
    assert set(table_positions(steps, Role.REPEATABILITY)) == {first}
    taken = captures(steps, Role.POSE, Role.REPEATABILITY)
    assert len(taken) == parameters.visits == len(parameters.temperatures_degC) * (len(parameters.positions) + 1)
    assert tuple(dict.fromkeys(step.chamber_degC for step in taken)) == parameters.temperatures_degC
    set_points = [index for index, step in enumerate(steps) if isinstance(step, SetTemperature)]
    assert [steps[index + 1] for index in set_points] == [Soak(parameters.dwell_s)] * len(set_points)
    checks = sum(isinstance(step, CheckHome) for step in steps)
    assert checks == 2 * (2 + (len(parameters.temperatures_degC) - 1) // parameters.check_home_every)


@given(warm_ups)
def test_any_warm_up_asks_for_what_only_hands_can_do_and_for_nothing_else(given_parameters: dict[str, Any]):
    parameters = WarmUp.model_validate(given_parameters)
    steps = list(warm_up(parameters))
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


def test_the_table_is_moved_before_the_camera_is_switched_on_so_that_nothing_delays_the_first_frame():
    steps = list(warm_up(WarmUp(table_position={"linear": 5.0})))
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
    assert [is_setup(step) for step in (*set_up, *work)] == [True] * len(set_up) + [False] * len(work)


def test_a_cool_down_lasts_until_20_K_have_decayed_to_the_band_or_its_limit_is_reached():
    assert estimate_s(CoolDown(0.5, 1200.0, 7200.0), 8.0) == pytest.approx(4426.7, abs=0.1)
    assert estimate_s(CoolDown(0.5, 1200.0, 3600.0), 8.0) == 3600.0
    assert estimate_s(CoolDown(20.0, 1200.0, 3600.0), 8.0) == 0.0


# What is refused


@pytest.mark.parametrize(
    ("model", "change", "sentence"),
    [
        (Calibration, {"left_out": [{"linear_mm": 5, "rotary_deg": 0}]}, r"left_out has \(5.0, 0.0\), which is not"),
        (Calibration, {"linear_mm": (1, 1)}, "same position twice"),
        (Calibration, {"linear_mm": (301,)}, "less than or equal to 300"),
        (Calibration, {"rotary_deg": (361,)}, "less than or equal to 360"),
        (Calibration, {"rotary_deg": ()}, "at least 1 item"),
        (Calibration, {"table_position": {"linear": 0}}, "Extra inputs"),
        (Calibration, {"settle_s": -1}, "greater than or equal to 0"),
        (Calibration, {"frames_per_position": 0}, "greater than or equal to 1"),
        (
            Calibration,
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
    model: type[Calibration | Validation | WarmUp], change: dict[str, object], sentence: str
):
    base = {Calibration: GRID, Validation: PLACES, WarmUp: {}}[model]
    model.model_validate(base)
    with pytest.raises(ValidationError, match=sentence):
        model.model_validate({**base, **change})


@pytest.mark.parametrize(
    ("entry", "sentence"),
    [
        ({"calibration": {**GRID, "linear_mm": [1, 999]}}, r"experiments\.0\.calibration\.linear_mm\.1"),
        ({"validation": {**PLACES, "positions": [{}]}}, r"experiments\.0\.validation\.positions\.0\.linear_mm"),
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


def test_each_kind_of_entry_plans_its_own_steps():
    def steps(entry: dict[str, object]) -> Iterator[Step]:
        return (written.step for written in Experiment.model_validate(entry).sequence())

    assert list(steps({"calibration": GRID})) == list(calibration(Calibration.model_validate(GRID)))
    assert list(steps({"validation": PLACES})) == list(validation(Validation.model_validate(PLACES)))
    assert list(steps({"warm_up": {}})) == list(warm_up(WarmUp()))
