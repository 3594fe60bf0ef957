import itertools

import pytest
from pydantic import ValidationError

from thermostand.experiments.steps import (
    Capture,
    CloseFlap,
    KnownStand,
    OpenFlap,
    PowerCamera,
    Role,
    SetTemperature,
    Situation,
    Soak,
    SoakUntilSettled,
    StartChamber,
    StopChamber,
    estimate_duration_s,
    number_steps,
)
from thermostand.experiments.thermal_cycle import ThermalCycle, plan_thermal_cycle
from thermostand.experiments.validation import Validation, plan_validation
from thermostand.experiments.warm_up import WarmUp, plan_warm_up
from thermostand.stand.config.recipe import Recipe

CYCLE = ThermalCycle(set_points_degC=(34.0, 44.0, 24.0), held_out_degC=(34.0,), cycles=2)


def test_the_flap_is_open_for_captures_only():
    is_open = False
    for step in plan_thermal_cycle(CYCLE):
        match step:
            case OpenFlap():
                is_open = True
            case CloseFlap():
                is_open = False
            case Capture():
                assert is_open
            case Soak():
                assert not is_open
            case _:
                pass
    assert not is_open


def test_a_cycle_visits_every_set_point_with_its_role_and_ends_stopped():
    captures = [step for step in plan_thermal_cycle(CYCLE) if isinstance(step, Capture)]
    assert [(step.chamber_degC, step.role) for step in captures] == [
        (24.0, Role.REFERENCE),
        *[(34.0, Role.VALIDATION), (44.0, Role.FIT), (24.0, Role.FIT)] * 2,
    ]
    assert isinstance(list(plan_thermal_cycle(CYCLE))[-1], StopChamber)


def test_each_dwell_follows_its_set_point():
    steps = list(plan_thermal_cycle(CYCLE))
    for before, after in itertools.pairwise(steps):
        if isinstance(before, SetTemperature):
            assert after == Soak(CYCLE.soak_s)


UNTIL_SETTLED = SoakUntilSettled(2700.0, 600.0, 600.0, 120.0, 0.2, 0.003, 0.1, 34.0)


def test_a_dwell_until_settled_takes_the_place_of_the_fixed_one_at_its_set_point():
    """The equilibrium, which everything is measured against, stays as it is."""
    cycle = {"set_points_degC": [34], "equilibrium_s": 3000, "soak_s": 2700}
    fixed = list(plan_thermal_cycle(ThermalCycle.model_validate(cycle)))
    adaptive = list(plan_thermal_cycle(ThermalCycle.model_validate({**cycle, "until": "settled"})))
    assert adaptive == [UNTIL_SETTLED if step == Soak(2700.0) else step for step in fixed]
    assert adaptive.count(UNTIL_SETTLED) == 1
    assert not UNTIL_SETTLED.is_setup
    assert UNTIL_SETTLED.longest_s == 2700.0


def test_a_validation_waits_for_the_camera_too():
    places = [{"linear_mm": 0, "rotary_deg": 0}, {"linear_mm": 9, "rotary_deg": 0}]
    parameters = {"temperatures_degC": [24, 34], "positions": places, "until": {"settled": {"min_s": 900}}}
    soaks = [
        step for step in plan_validation(Validation.model_validate(parameters)) if isinstance(step, SoakUntilSettled)
    ]
    assert soaks == [SoakUntilSettled(2700.0, 900.0, 600.0, 120.0, 0.2, 0.003, 0.1, 34.0)]


@pytest.mark.parametrize(
    ("entries", "message"),
    [
        ({"until": "soon"}, "until takes `settled` or `known`, alone or with thresholds behind a colon, not 'soon'"),
        ({"until": {"min_s": 900}}, "until takes `settled`"),
        ({"until": {"settled": {"drift": 1}}}, "Extra inputs"),
        ({"until": {"settled": {"window_s": 300}}}, "window_s 300.0 holds less than four looks every 120.0 s"),
        ({"until": "settled", "soak_s": 500}, "soak_s 500.0 is the longest dwell; it must be at least"),
    ],
)
def test_thresholds_that_cannot_be_are_refused(entries: dict[str, object], message: str):
    with pytest.raises(ValidationError, match=message):
        ThermalCycle.model_validate({"set_points_degC": [34], **entries})


def test_a_warm_up_powers_the_camera_right_before_the_first_frame():
    steps = list(plan_warm_up(WarmUp(frames=10)))
    on = steps.index(PowerCamera(on=True))
    assert isinstance(steps[on + 1], Capture)
    assert isinstance(steps[on - 1], OpenFlap)
    assert steps.index(PowerCamera(on=False)) < steps.index(StartChamber(24.0)) < on


def test_ids_follow_place_and_parameters():
    first = [planned.step_id for planned in number_steps(plan_thermal_cycle(CYCLE))]
    again = [planned.step_id for planned in number_steps(plan_thermal_cycle(CYCLE))]
    edited = CYCLE.model_copy(update={"set_points_degC": (34.0, 45.0, 24.0)})
    changed = [planned.step_id for planned in number_steps(plan_thermal_cycle(edited))]
    assert first == again
    assert len(set(first)) == len(first)
    differing = [index for index, (one, other) in enumerate(zip(first, changed, strict=True)) if one != other]
    kinds = [type(step) for step in plan_thermal_cycle(edited)]
    assert differing
    assert {kinds[index] for index in differing} == {SetTemperature, Capture}


def test_a_capture_lasts_from_its_first_to_its_last_frame():
    assert estimate_duration_s([Capture(5, 0.5, 0.1, Role.FIT, 24.0)]) == pytest.approx(2.1)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"held_out_degC": (99.0,)}, "less than or equal to 70"),
        ({"held_out_degC": (40.0,)}, "never visits"),
        ({"held_out_degC": (24.0,)}, "reference"),
        ({"interval_s": 0.05}, "does not fit"),
        ({"soak_minutes": 45}, "Extra inputs"),
        ({"set_points_degC": (71.0,)}, "less than or equal to 70"),
        ({"set_points_degC": (34.0,) * 1001}, "at most 1000 items"),
        ({"soak_s": 604801}, "less than or equal to 604800"),
        ({"equilibrium_s": 604801}, "less than or equal to 604800"),
        ({"cycles": 101}, "less than or equal to 100"),
        ({"frames_per_point": 1_000_001}, "less than or equal to 1000000"),
        ({"interval_s": 86401}, "less than or equal to 86400"),
        ({"interval_s": 60, "exposure_s": 11}, "less than or equal to 10"),
    ],
)
def test_impossible_parameters_are_refused_with_a_reason(change: dict[str, object], sentence: str):
    with pytest.raises(ValidationError, match=sentence):
        ThermalCycle.model_validate({"set_points_degC": (34.0, 24.0), **change})


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"cool_down_max_s": 604801}, "less than or equal to 604800"),
        ({"frames": 1_000_001}, "less than or equal to 1000000"),
        ({"interval_s": 0.05}, "does not fit"),
        ({"soak_s": 5}, "Extra inputs"),
    ],
)
def test_an_impossible_warm_up_is_refused_with_a_reason(change: dict[str, object], sentence: str):
    with pytest.raises(ValidationError, match=sentence):
        WarmUp.model_validate(change)


def test_switching_the_camera_on_takes_its_own_boot_time():
    stand = KnownStand()
    stand.boot_s = 4.0
    assert [PowerCamera(on).price(Situation(), stand).duration_s for on in (True, False)] == [4.0, 0.0]


def test_the_longest_recipe_is_planned_and_a_longer_one_refused():
    cycle = {"set_points_degC": (34.0,) * 1000, "cycles": 10}
    recipe = {"name": "long", "experiments": [{"thermal_cycle": cycle}]}
    assert sum(isinstance(planned.step, Soak) for planned in Recipe.model_validate(recipe).plan()) == 10_001
    with pytest.raises(ValidationError, match="20000 visits"):
        Recipe.model_validate({"name": "longer", "experiments": [{"thermal_cycle": cycle}] * 2})
    with pytest.raises(ValidationError, match="at most 100 items"):
        Recipe.model_validate({"name": "more", "experiments": [{"warm_up": {}}] * 101})
