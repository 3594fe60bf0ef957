"""Whether a sequence of steps makes sense: what each step needs of those before it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from thermostand.experiments.steps import Capture, Situation
from thermostand.experiments.written import PlanError, Written

MOST_STEPS = 100_000  # of a plan: weeks; it is still listed within seconds
MOST_CAPTURES = 20_000  # more than any camera lives through


def checked(steps: Iterable[Written]) -> Iterator[Written]:
    """The steps as they are; PlanError at the first that cannot be where it is, or is one too many."""
    for written, fault in faults(steps):
        if fault:
            raise PlanError(written.place, fault)
        yield written


def faults(steps: Iterable[Written]) -> Iterator[tuple[Written, str]]:
    """Each step, and why it cannot be where it is or that it is one too many; "" when it can."""
    found, captures = Situation(), 0
    for count, written in enumerate(steps):
        captures += isinstance(written.step, Capture)
        fault = written.step.placement_fault(found)
        if count >= MOST_STEPS or captures > MOST_CAPTURES:
            fault = f"the plan has more than {MOST_STEPS} steps or {MOST_CAPTURES} captures here; repeat less often"
        found = written.step.situation_after(found)
        yield written, fault
