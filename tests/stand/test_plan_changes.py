"""A plan that an operator changes while it is run: steps left out, soaks made longer, the rest replaced.

Live, and after a kill; on a stand in memory."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import pytest

from tests.journals import lines_with, read_lines
from tests.stand.small_stand import Life, lives
from thermostand.experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    StopChamber,
    make_step,
    number_steps,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.foundation.readings import Frame
from thermostand.stand.running.memory.entries import (
    Change,
    Edited,
    Extended,
    Skipped,
    StepChanged,
    make_change_data,
    parse_change,
)
from thermostand.stand.running.memory.fold import find_refusal, fold
from thermostand.stand.running.memory.journal import JOURNAL_NAME
from thermostand.stand.safety.gate import OPERATOR

CAPTURE = Capture(4, 5.0, 0.1, Role.FIT, 24.0)
PLAN = tuple(
    number_steps(
        [
            StartChamber(24.0),
            Soak(100.0),
            OpenFlap(),
            CAPTURE,
            CloseFlap(),
            CoolDown(2.0, 100.0, 500.0),
            Prompt("turn it"),
            CheckHome("linear"),
            StopChamber(),
        ]
    )
)
ID = [planned.step_id for planned in PLAN]
START_NS = 1_767_290_400 * NS_PER_S


@pytest.fixture
def life(tmp_path: Path):
    with lives(tmp_path, PLAN, START_NS) as begin:
        yield begin


def passes_until(life: Life, kind: str, late_s: float = 0.0) -> None:
    """Until a step of that kind is under way, and so much longer."""
    while not any(isinstance(item, StepMark) and item.kind == kind for item in life.reported):
        assert not life.run.done()
        life.passes(0.5)
    life.passes(late_s)


def marks(life: Life) -> list[str]:
    """What became of the steps that have ended, in this life."""
    return [
        f"{m.kind} {m.state}" for m in life.reported if isinstance(m, StepMark) and m.state is not StepState.STARTED
    ]


def soaked_s(life: Life) -> float:
    begun, ended = (m.time_ns for m in life.reported if isinstance(m, StepMark) and m.kind == "soak")
    return (ended - begun) / NS_PER_S


def killed(life: Life) -> int:
    life.passes(2.0)  # the disk has what was published
    return life.kill()


@pytest.mark.parametrize("late_s", [10.0, 70.0])  # before and after the journal has what it has earned
def test_a_soak_that_is_left_out_ends_at_once(life: Callable[..., Life], late_s: float):
    here = life()
    passes_until(here, "soak", late_s)
    here.do(here.executor.skip(ID[1]))
    here.passes(3.0)
    assert marks(here) == ["start_chamber done", "soak skipped", "open_flap done"]
    assert soaked_s(here) == pytest.approx(late_s, abs=0.6)
    (event,) = [item for item in here.reported if isinstance(item, Event) and item.kind == "plan_changed"]
    assert event.data == {"change": "Skipped", "step_id": ID[1], "steps": 8, "frames": 4}


def test_a_capture_that_is_left_out_keeps_its_frames(life: Callable[..., Life]):
    here = life()
    passes_until(here, "capture", 7.0)
    here.do(here.executor.skip(ID[3]))
    frames = [item for item in here.reported if isinstance(item, Frame)]
    here.passes(3.0)
    assert marks(here)[-2:] == ["capture skipped", "close_flap done"]
    assert [item for item in here.reported if isinstance(item, Frame)] == frames
    assert here.log.state.size == {"steps": 8, "frames": len(frames)}
    assert 0 < len(frames) < CAPTURE.frames


def test_a_cool_down_and_a_prompt_under_way_are_left_out_and_others_end_by_themselves(life: Callable[..., Life]):
    here = life()
    passes_until(here, "cool_down", 10.0)
    here.do(here.executor.skip(ID[5]))
    passes_until(here, "prompt", 3.0)
    here.call(lambda: here.stand.gate.clear(OPERATOR))
    here.do(here.executor.skip(ID[6]))
    passes_until(here, "check_home", 0.2)
    with pytest.raises(ConfigError, match=r"step 8 \(check_home\) is under way"):
        here.do(here.executor.skip(ID[7]))
    here.passes(10.0)
    assert here.run.done()
    assert marks(here)[-4:] == ["cool_down skipped", "prompt skipped", "check_home done", "stop_chamber done"]


def test_a_change_of_another_step_breaks_nothing_off(life: Callable[..., Life]):
    here = life()
    passes_until(here, "cool_down", 10.0)
    here.do(here.executor.skip(ID[7]))
    here.passes(10.0)
    assert marks(here)[-1] == "check_home skipped"
    assert here.log.state.under_way == ID[5]


@pytest.mark.parametrize("late_s", [0.0, 30.0, 70.0])
def test_a_soak_under_way_that_is_extended_takes_longer_by_that(life: Callable[..., Life], late_s: float):
    here = life()
    passes_until(here, "soak", late_s)
    here.do(here.executor.extend(ID[1], 45.0))
    here.passes(150.0)
    assert soaked_s(here) == pytest.approx(145.0)
    done = next(m for m in here.reported if isinstance(m, StepMark) and m.kind == "soak" and m.state is StepState.DONE)
    assert done.parameters["duration_s"] == 145.0
    assert done.step_id == ID[1]


def test_the_rest_of_a_plan_is_replaced(life: Callable[..., Life]):
    here = life()
    passes_until(here, "soak", 10.0)
    rest = [SetTemperature(26.0), Soak(30.0), StopChamber()]
    here.do(here.executor.edit(2, rest))
    here.passes(200.0)
    assert here.run.done()
    assert marks(here) == [f"{step.kind} done" for step in (StartChamber(0), Soak(0), *rest)]
    (event,) = [item for item in here.reported if isinstance(item, Event) and item.kind == "plan_changed"]
    assert (event.data["from_index"], event.data["steps"], event.data["frames"]) == (2, 5, 0)
    assert [make_step(each["kind"], each["parameters"]) for each in cast("Any", event.data["by"])] == rest


def test_changes_hold_after_a_kill(life: Callable[..., Life]):
    here = life()
    passes_until(here, "soak", 20.0)
    here.do(here.executor.extend(ID[1], 45.0))
    here.do(here.executor.edit(3, [CloseFlap(), Soak(20.0), Soak(11.0), StopChamber()]))
    skipped = here.log.state.plan[4].step_id
    here.do(here.executor.skip(skipped))
    state = here.log.state
    here = life(here.kill() + NS_PER_S)  # at once: what was acknowledged is durable
    assert (here.log.state.plan, here.log.state.changes) == (state.plan, state.changes)
    here.passes(400.0)
    assert here.run.done()
    assert marks(here) == ["soak done", "open_flap done", "close_flap done", "soak done", "stop_chamber done"]
    assert marks(here).count("soak done") == 2


def test_a_capture_left_out_stays_so_after_a_kill_and_a_second_change_comes_on_top(life: Callable[..., Life]):
    here = life()
    passes_until(here, "capture", 7.0)
    here.do(here.executor.skip(ID[3]))
    here = life(killed(here))
    here.passes(1.0)
    here.do(here.executor.edit(6, [StopChamber()]))
    here = life(killed(here))
    here.do(here.executor.skip(ID[5]))
    here.passes(30.0)
    assert here.run.done()
    assert [each.step_id for each in here.log.state.plan[:6]] == ID[:6]
    assert marks(here)[-1] == "stop_chamber done"
    assert not [item for item in here.reported if isinstance(item, Frame)]


def test_a_change_whose_line_is_lost_is_known_by_the_recording(life: Callable[..., Life], tmp_path: Path):
    here = life()
    passes_until(here, "soak", 20.0)
    here.do(here.executor.extend(ID[1], 45.0))
    here.do(here.executor.edit(2, [StopChamber()]))
    state, start_ns = here.log.state, killed(here)
    path = tmp_path / JOURNAL_NAME
    entries = read_lines(path.read_bytes())[0]
    path.write_bytes(lines_with(entry for entry in entries if not isinstance(entry, Change)))
    here = life(start_ns)
    assert (here.log.state.plan, here.log.state.changes) == (state.plan, state.changes)


def test_a_plan_that_this_stand_may_not_do_changes_nothing(life: Callable[..., Life]):
    here = life()
    passes_until(here, "soak")

    def refuse(plan):
        raise ConfigError(f"{len(plan)} steps are too many")

    here.executor._allowed = refuse
    before = here.log.state
    with pytest.raises(ConfigError, match="3 steps are too many"):
        here.do(here.executor.edit(2, [StopChamber()]))
    assert here.log.state is before
    assert not [item for item in here.reported if isinstance(item, Event) and item.kind == "plan_changed"]


BEGUN = fold(PLAN, [StepChanged(0, ID[0], "started"), StepChanged(0, ID[0], "done"), StepChanged(0, ID[1], "started")])


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (Skipped(0, ID[1]), ""),
        (Skipped(0, ID[3]), ""),
        (Skipped(0, ID[0]), "step 1 (start_chamber) is done"),
        (Skipped(0, ID[2]), "step 3 (open_flap) sets up what later steps rely on; replace those from it on"),
        (Skipped(0, "x"), "the plan has no step x"),
        (Extended(0, ID[1], 1.0), ""),
        (Extended(0, ID[3], 1.0), "step 4 (capture) is no soak"),
        (Extended(0, ID[1], -1.0), "step 2 (soak) cannot be extended by -1 s"),
        (Extended(0, ID[1], math.inf), "step 2 (soak) cannot be extended by inf s"),
        (Extended(0, ID[1], math.nan), "step 2 (soak) cannot be extended by nan s"),
        (Edited(0, 2, []), ""),
        (Edited(0, 9, []), ""),
        (Edited(0, 1, []), "the steps from number 3 on can be replaced, not those from number 2 on"),
        (Edited(0, 10, []), "the steps from number 3 on can be replaced, not those from number 11 on"),
    ],
)
def test_what_cannot_be_changed_says_why_and_changes_nothing(change: Change, why: str):
    assert find_refusal(BEGUN, change) == why
    assert (
        fold(PLAN, [StepChanged(0, ID[0], "done"), StepChanged(0, ID[1], "started"), change]).changes == ()
    ) is bool(why)


@pytest.mark.parametrize(
    "change",
    [Skipped(7, "a"), Extended(7, "a", 1.5), Edited(7, 2, [{"kind": "soak", "parameters": {"duration_s": 1.0}}])],
)
def test_a_change_is_the_same_in_the_journal_and_in_the_recording(change: Change):
    assert read_lines(lines_with([change]))[0] == [change]
    assert parse_change(7, {**make_change_data(change), "frames": 3}) == change
    assert parse_change(7, {"change": "Teleported"}) is None
    assert parse_change(7, {"change": "Skipped"}) is None


def test_a_plan_that_is_done_takes_no_more_steps(life: Callable[..., Life]):
    here = life()
    passes_until(here, "soak")
    here.do(here.executor.edit(2, []))
    here.passes(150.0)
    assert here.run.done()
    with pytest.raises(ConfigError, match="the plan is done"):
        here.do(here.executor.edit(2, [StopChamber()]))


def test_a_soak_that_waits_for_the_camera_is_longer_at_the_least_and_at_the_most():
    step = SoakUntilSettled(900.0, 60.0, 240.0, 60.0, 0.2, 0.003, 0.1, 24.0)
    (planned,) = number_steps([step])
    (longer,) = fold([planned], [Extended(0, planned.step_id, 100.0)]).plan
    assert (longer.step.min_s, longer.step.max_s, longer.step_id) == (160.0, 1000.0, planned.step_id)


@pytest.mark.parametrize("step", [*(planned.step for planned in PLAN), MoveTo("linear", 2.0), SetTemperature(20)])
def test_a_step_is_made_again_of_its_kind_and_parameters(step: Any):
    assert make_step(step.kind, step.parameters) == step


@pytest.mark.parametrize(
    ("kind", "parameters", "why"),
    [
        ("Teleport", {}, "no step is called 'Teleport'"),
        ("soak", {}, "soak: duration_s: "),
        ("soak", {"duration_s": "x"}, "soak: duration_s: "),
        ("soak", {"duration_s": -1.0}, "soak: duration_s is -1.0"),
        ("soak", {"duration_s": math.nan}, "soak: duration_s is nan"),
        ("soak", {"duration_s": 1.0, "more": 2}, "soak has no more"),
        ("set_temperature", {"chamber_degC": math.inf}, "set_temperature: chamber_degC is inf"),
        ("capture", {**CAPTURE.parameters, "frames": 0}, "capture: frames is 0"),
        ("capture", {**CAPTURE.parameters, "role": "x"}, "capture: role: "),
    ],
)
def test_what_is_no_step_is_refused(kind: str, parameters: dict[str, object], why: str):
    with pytest.raises(ConfigError) as refused:
        make_step(kind, parameters)
    assert why in str(refused.value)
