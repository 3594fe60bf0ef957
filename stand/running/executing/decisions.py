"""Asks for the decisions of a cycle that decides (experiments/adaptive.py), as changes of the plan.

The drift model is fitted in a process of its own, which runs behind everything else on the machine and reads what is
on the disk. It is started for one decision and ended after it. One that is late, has ended twice or finds no answer
leaves the fixed plan, and the change says so.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from thermostand.experiments.adaptive import (
    Answer,
    CycleComplete,
    DecisionPending,
    Visit,
    apply_decision,
    plan_fixed_visits,
)
from thermostand.experiments.steps import Decide, PlannedStep
from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import StandError
from thermostand.foundation.worker_process import WorkerProcess
from thermostand.foundation.workers import WorkerThread
from thermostand.stand.running.memory.entries import Edited, make_edit
from thermostand.stand.running.memory.state import RunState

_LINE = "design"
DecideFunction = Callable[[str, Mapping[str, Any]], Mapping[str, Any]]
"""A session's folder and the parameters of the plan's step -> kind, reason and, of a visit, chamber_degC and soak_s.
A function of a module that can be a process, see foundation/worker_process.py."""


@dataclass(frozen=True, slots=True)
class Decision:
    """An answer and its reason, in words."""

    answer: Answer
    reason: str


async def keep_fixed_plan(decide: Decide) -> Decision:
    """The decision where nobody decides."""
    return Decision(DecisionPending(), "nobody decides here")


class Decider:
    """Decides for the run whose session is in `directory`. decides: is called in a process of its own."""

    def __init__(self, directory: Path, clock: Clock, decides: DecideFunction) -> None:
        self._directory = directory
        self._clock = clock
        self._decides = decides

    async def decide(self, decide: Decide) -> Decision:
        """The decision, from what is on the disk; virtual time stands still meanwhile. A process that is killed (the
        machine is short of memory) is started once more: the same frames give the same decision."""
        try:
            async with asyncio.timeout(decide.wait_s):
                try:
                    return await self._ask_process(decide)
                except BrokenPipeError:
                    return await self._ask_process(decide)
        except TimeoutError:
            return Decision(DecisionPending(), f"the drift model was not fitted within {decide.wait_s:g} s")
        except (OSError, StandError, ValueError) as error:
            return Decision(DecisionPending(), getattr(error, "strerror", None) or str(error))

    async def _ask_process(self, decide: Decide) -> Decision:
        """BrokenPipeError when the process has ended."""
        try:
            helper = WorkerProcess(
                self._decides.__module__, (_LINE,), "the process that fits the drift model has ended"
            )
        except OSError as error:
            return Decision(
                DecisionPending(), f"no process can be started that fits the drift model ({error.strerror})"
            )
        lane = WorkerThread("design", self._clock, patient=False)
        try:
            return _parse_decision(await lane.call(self._call_process, helper, decide))
        finally:
            lane.abandon()
            helper.close()

    def _call_process(self, helper: WorkerProcess, decide: Decide) -> Mapping[str, Any]:
        """Call the process, in the worker thread."""
        return helper.line(_LINE).run(self._decides, str(self._directory), decide.parameters)


def _parse_decision(found: Mapping[str, Any]) -> Decision:
    """ValueError, or another error, for what is no decision."""
    reason = str(found["reason"])
    match found["kind"]:
        case "visit":
            visit = Visit(float(found["chamber_degC"]), float(found["soak_s"]))
            if not (math.isfinite(visit.chamber_degC) and 0 < visit.soak_s < math.inf):
                raise ValueError(f"a visit of {visit.chamber_degC} degC for {visit.soak_s} s was decided")
            return Decision(visit, reason)
        case "enough":
            return Decision(CycleComplete(), reason)
        case _:
            return Decision(DecisionPending(), reason)


def make_plan_change(state: RunState, planned: PlannedStep, decided: Decision, time_ns: int) -> Edited | None:
    """Return what the decision of the step `planned` makes of the plan; None when an operator has changed what it
    decides about."""
    step = planned.step
    if not isinstance(step, Decide):
        raise ValueError(f"{step.kind} decides nothing")
    first = planned.index + 1
    fixed = plan_fixed_visits(step)
    remote = tuple(each.step for each in state.plan[first : first + len(fixed)])
    if remote != fixed:
        return None
    steps = (*apply_decision(step, decided.answer), *(each.step for each in state.plan[first + len(fixed) :]))
    return make_edit(time_ns, first, steps, planned.step_id, decided.reason)
