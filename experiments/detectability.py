"""What a plan's looks at the target can show besides drift: a step of the image, when a camera was touched or a fixing
slipped."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from thermostand.experiments.steps import Capture, PlannedStep, Role

_DRIFT_ROLES = (Role.REFERENCE, Role.FIT, Role.VALIDATION)
_SMALLEST_STEPS = ((14, 0.05), (8, 0.3))
"""Looks, and the smallest step, px, that was found in each of 6 to 8 sessions of drawn cameras with as many: 25 and 14
looks, with and without set-points seen before, showed 50 mpx, 13 that in 5 of 6 sessions, 8 looks 300 mpx."""


@dataclass(frozen=True, slots=True)
class Detectability:
    """How often a plan looks at the target for its drift. bump_px: the smallest step of the image that sessions with as
    many looks have shown; None where none can be distinguished from drift."""

    count: int
    bump_px: float | None

    def __str__(self) -> str:
        if self.bump_px is None:
            return f"{self.count} looks at the drift: too few to tell a step of the image from it"
        return f"{self.count} looks at the drift: a step of the image from {1e3 * self.bump_px:g} mpx on shows"


def estimate_detectability(plan: Iterable[PlannedStep]) -> Detectability | None:
    """Estimate the detectability of a plan; None when it looks at no drift over set-points."""
    visits: list[float] = []
    for planned in plan:
        step = planned.step
        if isinstance(step, Capture) and step.role in _DRIFT_ROLES:
            visits.append(step.chamber_degC)
    if len(set(visits)) < 2:
        return None
    return Detectability(
        len(visits), min((bump_px for least, bump_px in _SMALLEST_STEPS if len(visits) >= least), default=None)
    )
