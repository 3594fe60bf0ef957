"""The time a run has left, corrected by what its steps have taken and by what earlier runs teach."""

import math
from pathlib import Path

import pytest

from tests.recording.full_session import record
from tests.stand.priced_plans import BEGIN_NS, CAPTURE, make_priced_plan, marks
from thermostand.experiments.steps import (
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PlannedStep,
    PowerCamera,
    SetTemperature,
    Soak,
    StartChamber,
    Step,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.estimating.estimate import PricedStep, price_plan
from thermostand.stand.estimating.eta import Eta
from thermostand.stand.estimating.learned_durations import (
    LEARNED_FILE,
    LearnedDurations,
    compute_overheads,
    learn_durations,
    load_learned_durations,
)
from thermostand.stand.running.memory.entries import Change, Edited, Extended, Skipped, make_change_data


@pytest.fixture(scope="module")
def config() -> StandConfig:
    return load_config(find_packaged("", "simulated"))


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
    plan = make_priced_plan(*cycle * 4)
    errors = eta_errors(price_plan(plan, config), plan, [0.0, 600.0, 1.1, 11.1, 1.1] * 4)
    assert errors[0] == pytest.approx(8 * 1.9 - 4 * 10.0)
    assert errors[20:] == pytest.approx([0.0] * 20, abs=1e-6)


def test_a_single_delay_that_nobody_announced_changes_nothing(config: StandConfig):
    plan = make_priced_plan(*[Soak(600.0)] * 4)
    assert eta_errors(price_plan(plan, config), plan, [5000.0, 600.0, 600.0, 600.0])[1:] == pytest.approx([0.0] * 7)


def test_within_a_step_the_time_left_falls_with_the_clock_but_not_in_a_pause(config: StandConfig):
    plan = make_priced_plan(Soak(600.0), Soak(300.0))
    eta = Eta(price_plan(plan, config))
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
    plan = make_priced_plan(StartChamber(24.0), Soak(600.0), SetTemperature(24.5), Soak(300.0), Soak(60.0))
    steps = price_plan(plan, config)
    eta = Eta(steps, done={item.step_id for item in plan[:3]}, soaked_s={plan[3].step_id: 120.0})
    assert eta.left_s(BEGIN_NS) == 240.0
    again = marks(plan[3:], [180.0, 60.0])
    eta.mark(again[0])
    assert eta.left_s(again[0].time_ns + 100 * NS_PER_S) == 140.0
    eta.mark(again[1])
    assert eta.left_s(again[1].time_ns) == pytest.approx(60.0)


def test_steps_that_are_begun_again_are_waited_for_again(config: StandConfig):
    plan = make_priced_plan(PowerCamera(False), CoolDown(0.5, 1200.0, 7200.0), PowerCamera(True), Soak(600), Soak(60))
    eta = Eta(price_plan(plan, config))
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
    return Event(BEGIN_NS, "warning", "plan_changed", "", make_change_data(change))


def test_what_an_operator_changes_of_the_plan_changes_the_time_left(config: StandConfig):
    plan = make_priced_plan(Soak(600.0), Soak(300.0), Soak(60.0))
    eta = Eta(price_plan(plan, config))
    eta.mark(marks(plan, [600.0, 300.0, 60.0])[0])
    now_ns = BEGIN_NS + 100 * NS_PER_S
    assert (eta.left_s(now_ns), eta.count) == (860.0, 3)
    eta.event(changed(Extended(0, plan[0].step_id, 50.0)))
    eta.event(changed(Extended(0, plan[1].step_id, 7.0)))
    assert eta.left_s(now_ns) == 917.0
    first, second, third = (each.step_id for each in plan)
    assert [eta.expected_s(each.step_id) for each in plan] == [650.0, 307.0, 60.0]
    assert eta.ends_s(now_ns) == {first: 550.0, second: 857.0, third: 917.0}
    eta.event(changed(Skipped(0, plan[2].step_id)))
    eta.mark(StepMark(now_ns, plan[2].step_id, 2, "soak", StepState.SKIPPED))
    assert eta.left_s(now_ns) == 857.0
    by: list[dict[str, object]] = [
        {"kind": "soak", "parameters": {"duration_s": each_s}} for each_s in (20.0, 30.0, 40.0)
    ]
    eta.event(changed(Edited(0, 1, by)))
    assert (eta.left_s(now_ns), eta.count) == (640.0, 4)
    assert list(eta.ends_s(now_ns).values()) == [550.0, 570.0, 600.0, 640.0]
    eta.mark(StepMark(now_ns, plan[0].step_id, 0, "soak", StepState.SKIPPED))
    eta.event(changed(Skipped(0, plan[0].step_id)))
    assert eta.left_s(now_ns) == 90.0
    eta.mark(StepMark(now_ns, "b", 1, "soak", StepState.STARTED))
    assert eta.left_s(now_ns + 5 * NS_PER_S) == 85.0


def test_steps_before_the_running_one_are_not_waited_for(config: StandConfig):
    plan = make_priced_plan(Soak(600.0), Soak(300.0), Soak(60.0))
    eta = Eta(price_plan(plan, config))
    eta.mark(marks(plan[1:], [300.0, 60.0])[0])
    assert eta.left_s(BEGIN_NS) == 360.0


async def test_runs_teach_what_work_takes_and_the_median_counts(tmp_path: Path, config: StandConfig):
    plan = make_priced_plan(MoveTo("linear", 0.0), CloseFlap(), OpenFlap(), Soak(5.0), CAPTURE, CloseFlap())
    for number, travel_s in enumerate((1.0, 1.2, 40.0)):
        await recorded(tmp_path / f"cycle-{number}", config.name, plan, [8.0, 0.2, travel_s, 5.0, 1.5, travel_s])
    await recorded(tmp_path / "cycle-other", "another-stand", plan, [9.0] * 6)
    (tmp_path / "cycle-none").mkdir()
    learned = learn_durations(tmp_path, config)
    assert learned.learned_from == ("cycle-0", "cycle-1", "cycle-2")
    assert learned.overheads_s["flap travel"] == pytest.approx(1.2, abs=1e-3)
    assert learned.overheads_s["flap at rest"] == pytest.approx(0.2, abs=1e-3)
    assert learned.overheads_s["capture"] == pytest.approx(0.4, abs=1e-3)
    assert "home and move linear" in learned.overheads_s
    assert load_learned_durations(tmp_path) == learned
    assert "3 runs, the last cycle-2" in str(learned)
    assert [path.name for path in tmp_path.glob(f"{LEARNED_FILE}*")] == [LEARNED_FILE]


async def test_a_step_that_was_begun_again_teaches_nothing(tmp_path: Path, config: StandConfig):
    plan = make_priced_plan(OpenFlap(), CloseFlap())
    killed, *rest = marks([plan[0], *plan], [2.0, 0.4, 1.1])
    session = await recorded_marks(tmp_path / "cycle", config.name, [killed, *rest[1:]])
    assert compute_overheads(session.steps(), config) == [("flap travel", pytest.approx(1.1, abs=1e-3))]


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
    assert load_learned_durations(tmp_path) == LearnedDurations()
    (tmp_path / LEARNED_FILE).write_text(content)
    assert load_learned_durations(tmp_path) == LearnedDurations()


def test_where_nothing_is_recorded_nothing_is_learned(tmp_path: Path, config: StandConfig):
    assert learn_durations(tmp_path, config) == LearnedDurations()
    assert learn_durations(tmp_path / "missing", config) == LearnedDurations()
    assert list(tmp_path.iterdir()) == []


def test_how_sure_the_end_is_follows_from_the_steps_of_the_kinds_that_are_still_to_come(config: StandConfig):
    plan = make_priced_plan(*[CloseFlap()] * 2, *[Soak(600.0)] * 6)
    steps = price_plan(plan, config)
    flaps = make_priced_plan(*[CloseFlap()] * 3, Soak(600.0))
    eta = Eta(price_plan(flaps, config))
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
