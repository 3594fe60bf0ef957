"""A thermal cycle whose visits are decided one after the other: live, after a kill, and without the process that
decides. On a stand in memory."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.journals import read_lines
from tests.stand.decisions_process import ANSWERS, ASKED, decide_next_visit
from tests.stand.small_stand import Life, lives
from thermostand.experiments.adaptive import CycleComplete, DecisionPending, Visit, apply_decision, plan_fixed_visits
from thermostand.experiments.parameters import Known
from thermostand.experiments.steps import (
    Capture,
    Decide,
    PlannedStep,
    Role,
    SetTemperature,
    Soak,
    Step,
    estimate_duration_s,
    number_steps,
)
from thermostand.experiments.thermal_cycle import ThermalCycle, plan_thermal_cycle
from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.items import Event
from thermostand.foundation.readings import Frame
from thermostand.stand.running.executing.decisions import Decider
from thermostand.stand.running.memory.entries import Edited
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.memory.journal import JOURNAL_NAME

CYCLE = ThermalCycle(
    equilibrium_s=100.0,
    set_points_degC=(30.0, 40.0, 50.0, 40.0, 30.0, 20.0, 10.0, 20.0),
    held_out_degC=(40.0,),
    soak_s=600.0,
    until=Known(soaks_s=(60.0, 120.0)),
)
PLAN = tuple(number_steps(plan_thermal_cycle(CYCLE)))
DECIDE = next(planned.step for planned in PLAN if isinstance(planned.step, Decide))
START_NS = 1_767_290_400 * NS_PER_S
ENOUGH = {"kind": "enough", "reason": "known to 4 mpx"}


def visit(chamber_degC: float, soak_s: float) -> dict[str, object]:
    return {"kind": "visit", "chamber_degC": chamber_degC, "soak_s": soak_s, "reason": "it teaches most"}


@pytest.fixture
def life(tmp_path: Path):
    """begin(answers): a daemon that runs PLAN, or resumes it; the last one is ended with the test."""
    with lives(tmp_path, PLAN, START_NS, decide_next_visit) as begin_life:

        def begin(*answers: object, start_ns: int = START_NS) -> Life:
            if answers:
                (tmp_path / ANSWERS).write_text(json.dumps(answers))
            return begin_life(start_ns)

        yield begin


def captured(plan: tuple[PlannedStep, ...]) -> list[tuple[float, Role]]:
    return [(each.step.chamber_degC, each.step.role) for each in plan if isinstance(each.step, Capture)]


def asked_times(folder: Path) -> int:
    return len((folder / ASKED).read_text().splitlines())


def test_visits_are_decided_until_enough_is_known(life: Callable[..., Life], tmp_path: Path):
    here = life(visit(47.0, 120.0), visit(12.0, 60.0), visit(33.0, 60.0), ENOUGH)
    here.passes(1500.0)
    assert here.run.done()
    assert not [item.text for item in here.reported if isinstance(item, Event) and item.kind == "undecided"]
    fit = [(47.0, Role.FIT), (12.0, Role.FIT), (33.0, Role.FIT)]
    assert captured(here.log.state.plan) == [(24.0, Role.REFERENCE), *fit, (40.0, Role.VALIDATION)]
    assert sum(isinstance(item, Frame) for item in here.reported) == 20 + 4
    entries, _ = read_lines((tmp_path / JOURNAL_NAME).read_bytes())
    decisions = [entry for entry in entries if isinstance(entry, Edited)]
    assert [each.reason for each in decisions] == ["it teaches most"] * 3 + ["known to 4 mpx"]
    assert fold(PLAN, entries).plan == here.log.state.plan


def test_a_killed_session_decides_the_same_and_asks_for_nothing_twice(life: Callable[..., Life], tmp_path: Path):
    answers = visit(47.0, 120.0), visit(12.0, 60.0), visit(33.0, 60.0), ENOUGH
    first = life(*answers)
    while not (tmp_path / ASKED).exists():
        first.passes(0.5)
    killed_ns = first.kill()
    entries, _ = read_lines((tmp_path / JOURNAL_NAME).read_bytes())
    assert isinstance(entries[-1], Edited)  # the end of its step is not in the journal
    second = life(start_ns=killed_ns + 5 * NS_PER_S)
    assert captured(second.log.state.plan)[1] == (47.0, Role.FIT)
    second.passes(400.0)
    third = life(start_ns=second.kill() + 5 * NS_PER_S)
    third.passes(1500.0)
    assert third.run.done()
    assert [degC for degC, _ in captured(third.log.state.plan)] == [24.0, 47.0, 12.0, 33.0, 40.0]
    assert asked_times(tmp_path) == len(answers)


def test_a_fit_whose_process_is_killed_is_made_again(life: Callable[..., Life], tmp_path: Path):
    here = life("die", visit(47.0, 120.0), visit(12.0, 60.0), "die", visit(33.0, 60.0), ENOUGH)
    here.passes(1500.0)
    assert here.run.done()
    assert not [item for item in here.reported if isinstance(item, Event) and item.kind == "undecided"]
    assert [degC for degC, _ in captured(here.log.state.plan)] == [24.0, 47.0, 12.0, 33.0, 40.0]
    asked = (tmp_path / ASKED).read_text().splitlines()
    assert (asked[0], asked[3]) == (asked[1], asked[4])


def test_a_daemon_that_is_killed_during_the_fit_asks_the_same_again(life: Callable[..., Life], tmp_path: Path):
    first = life(*[visit(47.0, 120.0)] * 2, visit(12.0, 60.0), ENOUGH)
    while not (tmp_path / ASKED).exists():
        first.passes(0.5)
    killed_ns = first.kill()
    journal = tmp_path / JOURNAL_NAME
    before = journal.read_bytes()
    undecided = before[: before.rstrip(b"\n").rindex(b"\n") + 1]
    assert isinstance(read_lines(before)[0][-1], Edited)
    journal.write_bytes(undecided)  # the decision was not made when it was killed
    assert not any(isinstance(entry, Edited) for entry in read_lines(undecided)[0])
    second = life(start_ns=killed_ns + 5 * NS_PER_S)
    second.passes(1500.0)
    assert second.run.done()
    assert [degC for degC, _ in captured(second.log.state.plan)] == [24.0, 47.0, 12.0, 40.0]
    asked = (tmp_path / ASKED).read_text().splitlines()
    assert asked[0] == asked[1]
    assert len(asked) == 4


def test_without_decisions_the_fixed_plan_goes_on_and_that_is_reported(life: Callable[..., Life]):
    here = life(visit(47.0, 120.0), *["die"] * 2, *[{"kind": "none", "reason": "too few frames"}] * 8)
    here.passes(8 * 700.0)
    assert here.run.done()
    assert [degC for degC, _ in captured(here.log.state.plan)] == [24.0, 47.0, *CYCLE.set_points_degC]
    texts = [item.text for item in here.reported if isinstance(item, Event) and item.kind == "undecided"]
    assert "process that fits" in texts[0]
    assert "too few frames" in texts[1]


async def test_a_late_decision_is_not_waited_for(tmp_path: Path):
    (tmp_path / ANSWERS).write_text('["hang"]')
    decider = Decider(tmp_path, WallClock(), decide_next_visit)
    found = await decider.decide(replace(DECIDE, wait_s=0.5))
    assert isinstance(found.answer, DecisionPending)
    assert "within 0.5 s" in found.reason


def total_s(steps: tuple[Step, ...]) -> float:
    return estimate_duration_s(step for step in steps if not isinstance(step, Decide))


@pytest.mark.parametrize("answer", [Visit(47.0, 120.0), Visit(11.0, 60.0), DecisionPending()])
def test_no_course_of_decisions_takes_much_longer_than_the_fixed_cycle(answer: Any):
    steps: tuple[Step, ...] = (DECIDE, *plan_fixed_visits(DECIDE))
    gone: list[Step] = []
    while steps:
        step, *rest = steps
        if isinstance(step, Decide):
            assert tuple(rest) == plan_fixed_visits(step)
            steps = apply_decision(step, answer)
        else:
            gone.append(step)
            steps = tuple(rest)
    assert total_s(tuple(gone)) < 1.1 * total_s(plan_fixed_visits(DECIDE))
    held_out = [step for step in gone if isinstance(step, Capture) and step.role is Role.VALIDATION]
    assert held_out
    assert all(step.chamber_degC == 40.0 for step in held_out)


def test_enough_ends_the_cycle_with_what_was_not_validated():
    steps = apply_decision(DECIDE, CycleComplete())
    assert [step for step in steps if isinstance(step, SetTemperature | Soak)] == [SetTemperature(40.0), Soak(120.0)]
    assert not math.isnan(DECIDE.left_s)
