"""What a plan is expected to take, and how that follows what steps really take."""

import json
import math
from collections.abc import Iterable
from pathlib import Path

import pytest

from drivers.devices.motion.stage_profiles import PROFILES
from experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PlannedStep,
    PowerCamera,
    Role,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    Step,
    StopChamber,
    kind_of,
    number_steps,
    parameters_of,
)
from foundation.clock import NS_PER_S, seconds_ns
from foundation.errors import ConfigError
from foundation.items import Event, StepMark, StepState
from recording.reading.session import Session
from stand.config.stand_config import StandConfig, load_config, packaged
from stand.estimating.chamber_model import ChamberModel, Response
from stand.estimating.durations import Situation, expect, move_s
from stand.estimating.estimate import PricedStep, price, way_back_s
from stand.estimating.eta import Eta
from stand.estimating.learned import LEARNED_FILE, Learned, learn, load_learned, overheads_of
from stand.running.memory.entries import Change, Edited, Extended, Skipped, data_of
from tests.recording.recorded import record

BEGIN_NS = 1_767_290_400 * NS_PER_S
RESPONSE = Response(dead_s=0.0, rate_K_per_s=0.05, time_constant_s=100.0)
CHAMBER = ChamberModel(heating=RESPONSE, cooling=RESPONSE, camera_time_constant_s=900.0)
CAPTURE = Capture(3, 0.5, 0.1, Role.FIT, 31.0)


@pytest.fixture(scope="module")
def config() -> StandConfig:
    return load_config(packaged("", "simulated"))


def planned(*steps: Step) -> list[PlannedStep]:
    return list(number_steps(steps))


def marks(plan: Iterable[PlannedStep], durations_s: Iterable[float]) -> list[StepMark]:
    """What a run publishes when the steps take so long."""
    found: list[StepMark] = []
    now_ns = BEGIN_NS
    for item, duration_s in zip(plan, durations_s, strict=True):
        for state in (StepState.STARTED, StepState.DONE):
            parameters = parameters_of(item.step)
            found.append(StepMark(now_ns, item.step_id, item.index, kind_of(item.step), state, parameters))
            now_ns += seconds_ns(duration_s) if state is StepState.STARTED else 0
    return found


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
    assert move_s(PROFILES["8MT160-300"], steps) == pytest.approx(duration_s, abs=1e-3)


def test_a_move_is_priced_by_the_way_from_where_the_axis_stands(config: StandConfig):
    plan = planned(MoveTo("linear", 0.0), MoveTo("linear", 100.0), MoveTo("linear", 50.0), CheckHome("linear"))
    homing, up, down, check = (step.duration_s for step in price(plan, config))
    assert homing > 10.0
    assert up == pytest.approx(100 / 2.5, abs=1.0)
    assert down == pytest.approx(50.5 / 2.5 + 0.375 + 0.548 + 0.1, abs=0.05)  # past it, then up
    assert check == pytest.approx(15 + 50 / 1.25 + 50 / 2.5, abs=1.0)


def test_a_flap_that_is_closed_already_takes_no_travel(config: StandConfig):
    plan = planned(CloseFlap(), OpenFlap(), OpenFlap(), CloseFlap())
    works = [step.work for step in price(plan, config)]
    assert works == ["flap at rest", "flap travel", "flap at rest", "flap travel"]


def test_what_was_learned_replaces_what_is_usual(config: StandConfig):
    learned = Learned(overheads_s={"flap travel": 1.1, "PowerCamera": 2.5, "Capture": -5.0})
    plan = planned(OpenFlap(), PowerCamera(on=True), CAPTURE, Soak(60.0))
    durations_s = [step.duration_s for step in price(plan, config, learned)]
    assert durations_s == pytest.approx([1.1, config.cameras["camera"].boot_s + 2.5, 0.0, 60.0])


def test_a_soak_says_when_the_chamber_arrives(config: StandConfig):
    plan = planned(StartChamber(24.0), Soak(600.0), SetTemperature(52.0), Soak(300.0), Soak(900.0), Soak(900.0))
    steps = price(plan, config, Learned(chamber=CHAMBER))
    arrives_s = CHAMBER.arrival_s(24.0, 52.0)
    assert arrives_s > 300.0
    wanted_s = [None, None, None, arrives_s, arrives_s - 300.0, None]
    assert [step.in_band_after_s for step in steps] == [
        pytest.approx(wait_s) if wait_s else None for wait_s in wanted_s
    ]
    assert json.loads(json.dumps(steps[3].as_json()))["in_band_after_s"] == pytest.approx(arrives_s)


@pytest.mark.parametrize(
    ("dwell_s", "warning"),
    [
        (300.0, "the dwell at 52 degC ends 7 min before the chamber arrives; the camera needs 30 min to follow"),
        (900.0, "the dwell at 52 degC ends 3 min after the chamber arrives; the camera needs 30 min to follow"),
        (2700.0, ""),
    ],
)
def test_the_first_capture_warns_of_a_dwell_too_short_for_the_camera(config: StandConfig, dwell_s: float, warning: str):
    soak = Soak(dwell_s / 2)
    plan = planned(OpenFlap(), StartChamber(24.0), SetTemperature(52.0), soak, soak, CAPTURE, CAPTURE)
    warnings = [step.warning for step in price(plan, config, Learned(chamber=CHAMBER))]
    assert warnings == ["", "", "", "", "", warning, ""]


def test_a_capture_through_a_closed_flap_warns(config: StandConfig):
    *_, capture = price(planned(OpenFlap(), CloseFlap(), CAPTURE), config)
    assert capture.warning.startswith("the flap is closed, so these frames are dark; put open_flap before them")


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
    *_, step = price(planned(PowerCamera(True), CoolDown(1.0, 1480.0, max_s)), config)
    assert step.warning == warning


@pytest.mark.parametrize("before", [PowerCamera(True), CAPTURE])
def test_how_warm_the_run_finds_the_camera_nobody_knows_before_a_run_has_shown_it(config: StandConfig, before: Step):
    plan = planned(CoolDown(1.0, 1480.0, 7200.0), before, CoolDown(1.0, 1480.0, 7200.0))
    first, _, second = price(plan, config)
    assert first.duration_s == second.duration_s == pytest.approx(1480.0 * math.log(20.0))
    assert first.warning == "as of a camera that was on; one that is cold already takes no time"
    assert second.warning == ""
    learned = Learned(overheads_s={first.work: -4423.6}, nights=("last",))
    cold, _, warm = price(plan, config, learned)
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
def test_limits_that_exclude_what_homing_needs_are_found_before_the_night(
    config: StandConfig, axis: str, limits: tuple[float, float], step: Step, sentence: str
):
    data = config.model_dump()
    data["axes"][axis]["limits"] = limits
    with pytest.raises(ConfigError) as caught:
        price(planned(step), StandConfig.model_validate(data))
    assert sentence in str(caught.value)
    price(planned(step), config)  # with the installed limits nothing is wrong


def test_moves_alone_need_no_place_for_a_home_check(config: StandConfig):
    data = config.model_dump()
    data["axes"]["rotary"]["limits"] = (-10, 10)
    price(planned(MoveTo("rotary", 5)), StandConfig.model_validate(data))


def test_a_soak_until_settled_is_priced_by_the_chamber_and_the_camera(config: StandConfig):
    def soak(max_s: float) -> SoakUntilSettled:
        return SoakUntilSettled(max_s, 600.0, 600.0, 120.0, 0.2, 0.003, 0.1, 52.0)

    plan = planned(StartChamber(24.0), SetTemperature(52.0), soak(9000.0), CAPTURE, SetTemperature(52.0), soak(9000.0))
    steps = price(plan, config, Learned(chamber=CHAMBER))
    arrives_s = CHAMBER.arrival_s(24.0, 52.0)
    follows_s = 900.0 * math.log(28.0 / 15.0 / 0.2)  # from 28 K in 15 min to 0.2 K/min
    assert steps[2].in_band_after_s == pytest.approx(arrives_s)
    assert steps[2].duration_s == pytest.approx(arrives_s + follows_s + 600.0)
    assert steps[2].frames == math.ceil((follows_s + 600.0) / 120.0)
    assert steps[2].size_bytes > steps[2].frames * 0.4 * 2448 * 2048
    assert "the dwell" not in steps[3].warning
    assert steps[5].duration_s == 600.0  # nothing has to move: the shortest
    short = price(planned(StartChamber(24.0), SetTemperature(52.0), soak(1200.0), CAPTURE), config)
    assert short[2].duration_s == 1200.0
    assert short[3].warning.startswith("the dwell at 52 degC ends")


@pytest.mark.parametrize("step", [MoveTo("vertical", 1.0), CheckHome("vertical")])
def test_an_axis_that_the_stand_lacks_is_refused(config: StandConfig, step: Step):
    with pytest.raises(ConfigError, match=r"step 1 .*no axis 'vertical', only linear, rotary"):
        price(planned(step), config)


def eta_errors(steps: tuple[PricedStep, ...], plan: list[PlannedStep], durations_s: list[float]) -> list[float]:
    """Time left less the truth, s, at each mark."""
    eta, errors = Eta(steps), list[float]()
    found = marks(plan, durations_s)
    for mark in found:
        eta.mark(mark)
        errors.append(eta.left_s(mark.time_ns) - (found[-1].time_ns - mark.time_ns) / NS_PER_S)
    return errors


def test_the_time_left_is_corrected_by_what_steps_have_taken(config: StandConfig):
    """The flap takes 1.1 s instead of 3, a capture 10 s more than is stated: known once each was done twice."""
    cycle: tuple[Step, ...] = (SetTemperature(31.0), Soak(600.0), OpenFlap(), CAPTURE, CloseFlap())
    plan = planned(*cycle * 4)
    errors = eta_errors(price(plan, config), plan, [0.0, 600.0, 1.1, 11.1, 1.1] * 4)
    assert errors[0] == pytest.approx(8 * 1.9 - 4 * 10.0)
    assert errors[20:] == pytest.approx([0.0] * 20, abs=1e-6)


def test_a_single_delay_that_nobody_announced_changes_nothing(config: StandConfig):
    plan = planned(*[Soak(600.0)] * 4)
    assert eta_errors(price(plan, config), plan, [5000.0, 600.0, 600.0, 600.0])[1:] == pytest.approx([0.0] * 7)


def test_within_a_step_the_time_left_falls_with_the_clock_but_not_in_a_pause(config: StandConfig):
    plan = planned(Soak(600.0), Soak(300.0))
    eta = Eta(price(plan, config))
    assert eta.left_s(BEGIN_NS) == 900.0
    eta.mark(marks(plan, [600.0, 300.0])[0])
    assert eta.left_s(BEGIN_NS + 100 * NS_PER_S) == 800.0
    eta.event(Event(BEGIN_NS + 200 * NS_PER_S, "warning", "held", "operator", {"reason": "operator"}))
    eta.event(Event(BEGIN_NS + 300 * NS_PER_S, "warning", "held", "disk_low", {"reason": "disk_low"}))
    eta.event(Event(BEGIN_NS + 400 * NS_PER_S, "info", "released", "operator", {"reason": "operator"}))
    assert eta.left_s(BEGIN_NS + 5000 * NS_PER_S) == 700.0
    eta.event(Event(BEGIN_NS + 5000 * NS_PER_S, "info", "released", "disk_low", {"reason": "disk_low"}))
    assert eta.left_s(BEGIN_NS + 5100 * NS_PER_S) == 600.0
    assert eta.left_s(BEGIN_NS + 9000 * NS_PER_S) == 300.0  # late: it may end any moment


def test_what_an_earlier_part_of_the_run_has_done_is_not_waited_for(config: StandConfig):
    plan = planned(StartChamber(24.0), Soak(600.0), SetTemperature(31.0), Soak(300.0), Soak(60.0))
    steps = price(plan, config)
    eta = Eta(steps, done={item.step_id for item in plan[:3]}, earned_s={plan[3].step_id: 120.0})
    assert eta.left_s(BEGIN_NS) == 240.0
    again = marks(plan[3:], [180.0, 60.0])
    eta.mark(again[0])
    assert eta.left_s(again[0].time_ns + 100 * NS_PER_S) == 140.0
    eta.mark(again[1])
    assert eta.left_s(again[1].time_ns) == pytest.approx(60.0)


def test_steps_that_are_begun_again_are_waited_for_again(config: StandConfig):
    plan = planned(PowerCamera(False), CoolDown(0.5, 1200.0, 7200.0), PowerCamera(True), Soak(600), Soak(60))
    eta = Eta(price(plan, config))
    first, second, third, fourth = (
        StepMark(0, step.step_id, step.index, "Any", StepState.STARTED) for step in plan[:4]
    )
    eta.mark(first)
    all_s = eta.left_s(0)
    for mark in (second, third, fourth):
        eta.mark(mark)
    assert eta.left_s(0) == pytest.approx(660)
    eta.mark(first)
    assert eta.left_s(0) == pytest.approx(all_s)
    eta.mark(second)
    assert eta.left_s(0) == pytest.approx(all_s)
    eta.mark(third)
    eta.mark(fourth)
    assert eta.left_s(0) == pytest.approx(660)


def changed(change: Change) -> Event:
    return Event(BEGIN_NS, "warning", "plan_changed", "", data_of(change))


def test_what_an_operator_changes_of_the_plan_changes_the_time_left(config: StandConfig):
    plan = planned(Soak(600.0), Soak(300.0), Soak(60.0))
    eta = Eta(price(plan, config))
    eta.mark(marks(plan, [600.0, 300.0, 60.0])[0])
    now_ns = BEGIN_NS + 100 * NS_PER_S
    assert (eta.left_s(now_ns), eta.count) == (860.0, 3)
    eta.event(changed(Extended(0, plan[0].step_id, 50.0)))
    eta.event(changed(Extended(0, plan[1].step_id, 7.0)))
    assert eta.left_s(now_ns) == 917.0
    eta.event(changed(Skipped(0, plan[2].step_id)))
    eta.mark(StepMark(now_ns, plan[2].step_id, 2, "Soak", StepState.SKIPPED))
    assert eta.left_s(now_ns) == 857.0
    by: list[dict[str, object]] = [
        {"kind": "Soak", "parameters": {"duration_s": each_s}} for each_s in (20.0, 30.0, 40.0)
    ]
    eta.event(changed(Edited(0, 1, by)))
    assert (eta.left_s(now_ns), eta.count) == (640.0, 4)
    eta.mark(StepMark(now_ns, plan[0].step_id, 0, "Soak", StepState.SKIPPED))
    eta.event(changed(Skipped(0, plan[0].step_id)))
    assert eta.left_s(now_ns) == 90.0
    eta.mark(StepMark(now_ns, "b", 1, "Soak", StepState.STARTED))
    assert eta.left_s(now_ns + 5 * NS_PER_S) == 85.0


def test_steps_before_the_running_one_are_not_waited_for(config: StandConfig):
    plan = planned(Soak(600.0), Soak(300.0), Soak(60.0))
    eta = Eta(price(plan, config))
    eta.mark(marks(plan[1:], [300.0, 60.0])[0])
    assert eta.left_s(BEGIN_NS) == 360.0


async def test_runs_teach_what_work_takes_and_the_median_counts(tmp_path: Path, config: StandConfig):
    plan = planned(MoveTo("linear", 0.0), CloseFlap(), OpenFlap(), Soak(5.0), CAPTURE, CloseFlap())
    for night, travel_s in enumerate((1.0, 1.2, 40.0)):
        await recorded(tmp_path / f"night-{night}", config.name, plan, [8.0, 0.2, travel_s, 5.0, 1.5, travel_s])
    await recorded(tmp_path / "night-other", "another-stand", plan, [9.0] * 6)
    (tmp_path / "night-none").mkdir()
    learned = learn(tmp_path, config)
    assert learned.nights == ("night-0", "night-1", "night-2")
    assert learned.overheads_s["flap travel"] == pytest.approx(1.2, abs=1e-3)
    assert learned.overheads_s["flap at rest"] == pytest.approx(0.2, abs=1e-3)
    assert learned.overheads_s["Capture"] == pytest.approx(0.4, abs=1e-3)
    assert "home and move linear" in learned.overheads_s
    assert load_learned(tmp_path) == learned
    assert "3 runs, the last night-2" in str(learned)
    assert [path.name for path in tmp_path.glob(f"{LEARNED_FILE}*")] == [LEARNED_FILE]


async def test_a_step_that_was_begun_again_teaches_nothing(tmp_path: Path, config: StandConfig):
    plan = planned(OpenFlap(), CloseFlap())
    killed, *rest = marks([plan[0], *plan], [2.0, 0.4, 1.1])
    session = await recorded_marks(tmp_path / "night", config.name, [killed, *rest[1:]])
    assert overheads_of(session.steps(), config) == [("flap travel", pytest.approx(1.1, abs=1e-3))]


async def recorded(directory: Path, stand: str, plan: list[PlannedStep], durations_s: list[float]) -> Session:
    """A session of the stand of that name in which the steps took so long."""
    return await recorded_marks(directory, stand, marks(plan, durations_s))


async def recorded_marks(directory: Path, stand: str, waiting: list[StepMark]) -> Session:
    def items(time_ns: int, index: int):
        yield from (mark for mark in waiting if index <= (mark.time_ns - BEGIN_NS) / NS_PER_S < index + 1)

    seconds = (waiting[-1].time_ns - BEGIN_NS) // NS_PER_S + 2
    attachments = {"config.yaml": f"name: {stand}\n"}
    await record(directory, seconds, items, segment_s=1e6, period_ns=NS_PER_S, attachments=attachments)
    return Session.open(directory)


@pytest.mark.parametrize("content", ["", "{", '{"overheads_s": {"x": "soon"}}', '{"chamber": {"unknown": 1}}'])
def test_a_file_that_cannot_be_understood_is_no_reason_not_to_run(tmp_path: Path, content: str):
    assert load_learned(tmp_path) == Learned()
    (tmp_path / LEARNED_FILE).write_text(content)
    assert load_learned(tmp_path) == Learned()


def test_where_nothing_is_recorded_nothing_is_learned(tmp_path: Path, config: StandConfig):
    assert learn(tmp_path, config) == Learned()
    assert learn(tmp_path / "missing", config) == Learned()
    assert list(tmp_path.iterdir()) == []


def test_a_situation_is_what_the_steps_before_have_left(config: StandConfig):
    found = Situation().after(MoveTo("linear", 3.0)).after(OpenFlap())
    assert found == Situation(flap_open=True, positions={"linear": 3.0})
    assert expect(OpenFlap(), found, config).work == "flap at rest"


def test_how_sure_the_end_is_follows_from_the_steps_of_the_kinds_that_are_still_to_come(config: StandConfig):
    plan = planned(*[CloseFlap()] * 2, *[Soak(600.0)] * 6)
    steps = price(plan, config)
    flaps = planned(*[CloseFlap()] * 3, Soak(600.0))
    eta = Eta(price(flaps, config))
    for mark in marks(flaps[:3], [3.0, 0.0, 0.0]):
        eta.mark(mark)
    assert eta.within_s() is None  # nothing is known of soaks yet, which take nearly all of the time
    eta = Eta(steps)
    lasted_s = [steps[0].duration_s + 3000.0, steps[1].duration_s, 600.0, 630.0, 570.0]
    for mark in marks(plan[:3], lasted_s[:3]):
        eta.mark(mark)
    assert eta.within_s() == 60.0  # no flap is to come, and the soak was as expected
    for mark in marks(plan[:5], lasted_s)[6:]:
        eta.mark(mark)
    deviation_s = math.sqrt((0.0 + 30.0**2 + 30.0**2) / 3)
    assert eta.within_s() == pytest.approx(2 * deviation_s * math.sqrt(3), rel=0.3)
    assert Eta(steps).within_s() is None


def test_the_way_back_to_the_laboratory_is_part_of_the_night(config: StandConfig):
    plan = planned(StartChamber(10.0), Soak(600.0), StopChamber())
    back = config.model_copy(update={"ending": config.ending.model_copy(update={"to_ambient": True})})
    after_s = way_back_s(plan, back, Learned())
    assert way_back_s(plan, config, Learned()) == 0.0
    assert way_back_s(planned(StartChamber(back.ending.ambient_degC)), back, Learned()) == 0.0
    assert ChamberModel().heating.arrival_s(13.0, back.ending.band_K) < after_s < back.ending.max_s
    eta = Eta(price(plan, back), after_s=after_s)
    assert eta.left_s(BEGIN_NS) == pytest.approx(Eta(price(plan, back)).left_s(BEGIN_NS) + after_s)
    for mark in marks(plan, [0.0, 600.0, 0.0]):
        eta.mark(mark)
    eta.event(Event(BEGIN_NS, "info", "to_ambient", ""))
    assert eta.left_s(BEGIN_NS + 60 * NS_PER_S) == pytest.approx(after_s - 60.0)
    eta.event(Event(BEGIN_NS, "info", "at_ambient", ""))
    assert eta.left_s(BEGIN_NS) == 0.0
