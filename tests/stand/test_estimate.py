"""What a plan is expected to take, and how that follows what steps really take."""

import json
import math

import pytest

from tests.stand.priced_plans import BEGIN_NS, CAPTURE, make_priced_plan, marks
from thermostand.drivers.devices.motion.stage_profiles import PROFILES
from thermostand.experiments.steps import (
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PowerCamera,
    SetTemperature,
    Situation,
    Soak,
    SoakUntilSettled,
    StartChamber,
    Step,
    StopChamber,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.items import Event
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.estimating.chamber_model import ChamberModel, Response
from thermostand.stand.estimating.durations import ConfiguredStand, compute_move_s, price_step
from thermostand.stand.estimating.estimate import estimate_return_s, price_plan
from thermostand.stand.estimating.eta import Eta
from thermostand.stand.estimating.learned_durations import LearnedDurations

RESPONSE = Response(dead_s=0.0, rate_K_per_s=0.05, time_constant_s=100.0)
CHAMBER = ChamberModel(
    heating=RESPONSE, cooling=RESPONSE, camera_time_constant_s=900.0, heating_ramps=1, cooling_ramps=1
)


@pytest.fixture(scope="module")
def config() -> StandConfig:
    return load_config(find_packaged("", "simulated"))


@pytest.mark.parametrize(
    ("steps", "duration_s"),
    [
        (0.0, 0.0),
        (200.0, 0.5477),  # a triangle: 0.5 v (t1 + t2) with v = 730 steps/s
        (375.0, 0.75),  # just reaches 1000 steps/s
        (10_375.0, 10.75),
        (-10_375.0, 10.75),
    ],
)
def test_a_move_is_a_trapezoid_of_speed(steps: float, duration_s: float):
    assert compute_move_s(PROFILES["8MT160-300"], steps) == pytest.approx(duration_s, abs=1e-3)


def test_a_move_is_priced_by_the_way_from_where_the_axis_stands(config: StandConfig):
    plan = make_priced_plan(MoveTo("linear", 0.0), MoveTo("linear", 100.0), MoveTo("linear", 50.0), CheckHome("linear"))
    homing, up, down, check = (step.duration_s for step in price_plan(plan, config))
    assert homing > 10.0
    assert up == pytest.approx(100 / 2.5, abs=1.0)
    assert down == pytest.approx(50.5 / 2.5 + 0.375 + 0.548 + 0.1, abs=0.05)  # past it, then up
    assert check == pytest.approx(15 + 50 / 1.25 + 50 / 2.5, abs=1.0)


def test_a_flap_that_is_closed_already_takes_no_travel(config: StandConfig):
    plan = make_priced_plan(CloseFlap(), OpenFlap(), OpenFlap(), CloseFlap())
    works = [step.work for step in price_plan(plan, config)]
    assert works == ["flap at rest", "flap travel", "flap at rest", "flap travel"]


def test_what_was_learned_replaces_what_is_usual(config: StandConfig):
    learned = LearnedDurations(overheads_s={"flap travel": 1.1, "power_camera": 2.5, "capture": -5.0})
    plan = make_priced_plan(OpenFlap(), PowerCamera(on=True), CAPTURE, Soak(60.0))
    durations_s = [step.duration_s for step in price_plan(plan, config, learned)]
    assert durations_s == pytest.approx([1.1, config.cameras["camera"].boot_s + 2.5, 0.0, 60.0])


def test_a_soak_says_when_the_chamber_arrives(config: StandConfig):
    plan = make_priced_plan(
        StartChamber(24.0), Soak(600.0), SetTemperature(52.0), Soak(300.0), Soak(900.0), Soak(900.0)
    )
    steps = price_plan(plan, config, LearnedDurations(chamber=CHAMBER))
    arrives_s = CHAMBER.arrival_s(24.0, 52.0)
    assert arrives_s > 600.0  # the first soak ends at its limit, twice its time
    wanted_s = [None, None, None, arrives_s, arrives_s - 600.0, None]
    assert [step.duration_s for step in steps[3:]] == [600.0, 900.0, 900.0]
    assert [step.in_band_after_s for step in steps] == [
        pytest.approx(wait_s) if wait_s else None for wait_s in wanted_s
    ]
    assert json.loads(json.dumps(steps[3].as_json()))["in_band_after_s"] == pytest.approx(arrives_s)


@pytest.mark.parametrize(
    ("soak_s", "warning"),
    [
        (300.0, "the dwell at 52 degC ends 2 min before the chamber arrives; the camera needs 30 min to follow"),
        (900.0, "the dwell at 52 degC ends 9 min after the chamber arrives; the camera needs 30 min to follow"),
        (2700.0, ""),
    ],
)
def test_the_first_capture_warns_of_a_dwell_too_short_for_the_camera(config: StandConfig, soak_s: float, warning: str):
    soak = Soak(soak_s / 2)
    plan = make_priced_plan(OpenFlap(), StartChamber(24.0), SetTemperature(52.0), soak, soak, CAPTURE, CAPTURE)
    warnings = [step.warning for step in price_plan(plan, config, LearnedDurations(chamber=CHAMBER))]
    assert (*warnings[:3], *warnings[5:]) == ("", "", "", warning, "")


@pytest.mark.parametrize(
    ("soak", "expected_s", "warning"),
    [
        (Soak(1800.0), 1800.0, ""),
        (Soak(60.0, band_K=0.0), 60.0, ""),
        (Soak(600.0), 820.9, "the chamber is within 1 K of 52 degC after 10 min: the soak is expected to go on"),
        (Soak(300.0), 600.0, "too late for a soak of at most 10 min; the frames after it are marked as unsettled"),
        (Soak(300.0, unsettled="hold"), 600.0, "too late for a soak of at most 10 min; the run is held then"),
    ],
)
def test_a_soak_that_will_not_end_in_its_time_is_expected_to_go_on_and_says_so(
    config: StandConfig, soak: Soak, expected_s: float, warning: str
):
    *_, step = price_plan(
        make_priced_plan(StartChamber(24.0), SetTemperature(52.0), soak), config, LearnedDurations(chamber=CHAMBER)
    )
    assert step.duration_s == pytest.approx(expected_s, abs=1.0)
    assert warning in step.warning
    assert bool(warning) == bool(step.warning)


def test_a_capture_through_a_closed_flap_warns(config: StandConfig):
    *_, capture = price_plan(make_priced_plan(OpenFlap(), CloseFlap(), CAPTURE), config)
    assert capture.warning.startswith("the flap is closed")


@pytest.mark.parametrize(
    ("max_s", "warning"),
    [
        (7200.0, ""),
        (4440.0, ""),
        (4400.0, "the cool-down ends after 73 min; the camera needs 74 min to be within its band"),
    ],
)
def test_a_cool_down_too_short_for_the_camera_is_warned_of(config: StandConfig, max_s: float, warning: str):
    """20 K of excess down to 1 K takes ln 20 = 3.0 time constants."""
    *_, step = price_plan(make_priced_plan(PowerCamera(True), CoolDown(1.0, 1480.0, max_s)), config)
    assert step.warning == warning


@pytest.mark.parametrize("before", [PowerCamera(True), CAPTURE])
def test_how_warm_the_run_finds_the_camera_nobody_knows_before_a_run_has_shown_it(config: StandConfig, before: Step):
    plan = make_priced_plan(CoolDown(1.0, 1480.0, 7200.0), before, CoolDown(1.0, 1480.0, 7200.0))
    first, _, second = price_plan(plan, config)
    assert first.duration_s == second.duration_s == pytest.approx(1480.0 * math.log(20.0))
    assert "camera that was on" in first.warning
    assert second.warning == ""
    learned = LearnedDurations(overheads_s={first.work: -4423.6}, learned_from=("last",))
    cold, _, warm = price_plan(plan, config, learned)
    assert cold.duration_s == pytest.approx(10.0, abs=1.0)
    assert cold.warning == ""
    assert warm.duration_s == second.duration_s


@pytest.mark.parametrize(
    ("axis", "limits", "step", "sentence"),
    [
        (
            "rotary",
            (-10, 10),
            CheckHome("rotary"),
            "homing rotary goes to 16 deg, which axes.rotary.limits (-10.0, 10.0)",
        ),
        ("rotary", (10, 20), CheckHome("rotary"), "homing rotary goes to 0 deg"),
        ("rotary", (17, 40), MoveTo("rotary", 20), "homing rotary goes to 0 deg"),
        ("linear", (5, 280), MoveTo("linear", 20), "homing linear goes to 0 mm"),
        ("linear", (5, 280), CheckHome("linear"), "homing linear goes to 0 mm"),
    ],
)
def test_limits_that_exclude_what_homing_needs_are_found_before_the_session(
    config: StandConfig, axis: str, limits: tuple[float, float], step: Step, sentence: str
):
    data = config.model_dump()
    data["axes"][axis]["limits"] = limits
    with pytest.raises(ConfigError) as caught:
        price_plan(make_priced_plan(step), StandConfig.model_validate(data))
    assert sentence in str(caught.value)
    price_plan(make_priced_plan(step), config)  # with the installed limits nothing is wrong


def test_moves_alone_need_no_place_for_a_home_check(config: StandConfig):
    data = config.model_dump()
    data["axes"]["rotary"]["limits"] = (-10, 10)
    price_plan(make_priced_plan(MoveTo("rotary", 5)), StandConfig.model_validate(data))


def test_a_soak_until_settled_is_priced_by_the_chamber_and_the_camera(config: StandConfig):
    def soak(max_s: float) -> SoakUntilSettled:
        return SoakUntilSettled(max_s, 600.0, 600.0, 120.0, 0.2, 0.003, 0.1, 52.0)

    plan = make_priced_plan(
        StartChamber(24.0), SetTemperature(52.0), soak(9000.0), CAPTURE, SetTemperature(52.0), soak(9000.0)
    )
    steps = price_plan(plan, config, LearnedDurations(chamber=CHAMBER))
    arrives_s = CHAMBER.arrival_s(24.0, 52.0)
    follows_s = 900.0 * math.log(28.0 / 15.0 / 0.2)  # from 28 K in 15 min to 0.2 K/min
    assert steps[2].in_band_after_s == pytest.approx(arrives_s)
    assert steps[2].duration_s == pytest.approx(arrives_s + follows_s + 600.0)
    assert steps[2].frames == math.ceil((follows_s + 600.0) / 120.0)
    assert steps[2].size_bytes > steps[2].frames * 0.4 * 2448 * 2048
    assert "the dwell" not in steps[3].warning
    assert steps[5].duration_s == 600.0  # nothing has to move: the shortest
    short = price_plan(make_priced_plan(StartChamber(24.0), SetTemperature(52.0), soak(1200.0), CAPTURE), config)
    assert short[2].duration_s == 1200.0
    assert short[3].warning.startswith("the dwell at 52 degC ends")


@pytest.mark.parametrize("step", [MoveTo("vertical", 1.0), CheckHome("vertical")])
def test_an_axis_that_the_stand_lacks_is_refused(config: StandConfig, step: Step):
    with pytest.raises(ConfigError, match=r"step 1 .*no axis 'vertical', only linear, rotary"):
        price_plan(make_priced_plan(step), config)


def test_a_situation_is_what_the_steps_before_have_left(config: StandConfig):
    found = OpenFlap().situation_after(MoveTo("linear", 3.0).situation_after(Situation()))
    assert found == Situation(flap_open=True, positions={"linear": 3.0})
    assert price_step(OpenFlap(), found, ConfiguredStand(config)).work == "flap at rest"


def test_the_way_back_to_the_laboratory_is_part_of_the_session(config: StandConfig):
    plan = make_priced_plan(StartChamber(10.0), Soak(600.0), StopChamber())
    back = config.model_copy(update={"ending": config.ending.model_copy(update={"to_ambient": True})})
    after_s = estimate_return_s(plan, back, LearnedDurations())
    assert estimate_return_s(plan, config, LearnedDurations()) == 0.0
    assert estimate_return_s(make_priced_plan(StartChamber(back.ending.ambient_degC)), back, LearnedDurations()) == 0.0
    assert ChamberModel().heating.arrival_s(13.0, back.ending.band_K) < after_s < back.ending.max_s
    eta = Eta(price_plan(plan, back), after_s=after_s)
    assert eta.left_s(BEGIN_NS) == pytest.approx(Eta(price_plan(plan, back)).left_s(BEGIN_NS) + after_s)
    for mark in marks(plan, [0.0, 600.0, 0.0]):
        eta.mark(mark)
    eta.event(Event(BEGIN_NS, "info", "to_ambient", ""))
    assert eta.left_s(BEGIN_NS + 60 * NS_PER_S) == pytest.approx(after_s - 60.0)
    eta.event(Event(BEGIN_NS, "info", "at_ambient", ""))
    assert eta.left_s(BEGIN_NS) == 0.0
