"""Asks for the decisions of a cycle that decides (experiments/known.py), as changes of the plan.

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

from thermostand.experiments.known import Answer, Enough, Undecided, Visit, after_decision, fixed_visits
from thermostand.experiments.steps import Decide, PlannedStep
from thermostand.foundation.calls import Lane
from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import StandError
from thermostand.foundation.helper import Helper
from thermostand.stand.running.memory.entries import Edited, edited
from thermostand.stand.running.memory.state import RunState

_LINE = "design"
Decides = Callable[[str, Mapping[str, Any]], Mapping[str, Any]]
"""A session's folder and the parameters of the plan's step -> kind, reason and, of a visit, chamber_degC and soak_s.
A function of a module that can be a process, see foundation/helper.py."""


@dataclass(frozen=True, slots=True)
class Decided:
    """An answer and its reason, in words."""

    answer: Answer
    reason: str


async def fixed_plan(decide: Decide) -> Decided:
    """The decision where nobody decides."""
    return Decided(Undecided(), "nobody decides here")


class Decider:
    """Of the run whose session is in `directory`. decides: is called in a process of its own."""

    def __init__(self, directory: Path, clock: Clock, decides: Decides) -> None:
        self._directory = directory
        self._clock = clock
        self._decides = decides

    async def decide(self, decide: Decide) -> Decided:
        """The decision, from what is on the disk; virtual time stands still meanwhile. A process that is killed (the
        machine is short of memory) is started once more: the same frames give the same decision."""
        try:
            async with asyncio.timeout(decide.wait_s):
                try:
                    return await self._decided_by_process(decide)
                except BrokenPipeError:
                    return await self._decided_by_process(decide)
        except TimeoutError:
            return Decided(Undecided(), f"the drift model was not fitted within {decide.wait_s:g} s")
        except (OSError, StandError, ValueError) as error:
            return Decided(Undecided(), getattr(error, "strerror", None) or str(error))

    async def _decided_by_process(self, decide: Decide) -> Decided:
        """BrokenPipeError when the process has ended."""
        try:
            helper = Helper(self._decides.__module__, (_LINE,), "the process that fits the drift model has ended")
        except OSError as error:
            return Decided(Undecided(), f"no process can be started that fits the drift model ({error.strerror})")
        lane = Lane("design", self._clock, patient=False)
        try:
            return _decided(await lane.call(self._asked, helper, decide))
        finally:
            lane.abandon()
            helper.close()

    def _asked(self, helper: Helper, decide: Decide) -> Mapping[str, Any]:
        """In the lane."""
        return helper.line(_LINE).run(self._decides, str(self._directory), decide.parameters)


def _decided(found: Mapping[str, Any]) -> Decided:
    """ValueError, or another error, for what is no decision."""
    reason = str(found["reason"])
    match found["kind"]:
        case "visit":
            visit = Visit(float(found["chamber_degC"]), float(found["soak_s"]))
            if not (math.isfinite(visit.chamber_degC) and 0 < visit.soak_s < math.inf):
                raise ValueError(f"a visit of {visit.chamber_degC} degC for {visit.soak_s} s was decided")
            return Decided(visit, reason)
        case "enough":
            return Decided(Enough(), reason)
        case _:
            return Decided(Undecided(), reason)


def change_of_plan(state: RunState, planned: PlannedStep, decided: Decided, time_ns: int) -> Edited | None:
    """What the decision of the step `planned` makes of the plan; None when an operator has changed what it decides
    about."""
    step = planned.step
    if not isinstance(step, Decide):
        raise ValueError(f"{step.kind} decides nothing")
    first = planned.index + 1
    fixed = fixed_visits(step)
    there = tuple(each.step for each in state.plan[first : first + len(fixed)])
    if there != fixed:
        return None
    steps = (*after_decision(step, decided.answer), *(each.step for each in state.plan[first + len(fixed) :]))
    return edited(time_ns, first, steps, planned.step_id, decided.reason)
