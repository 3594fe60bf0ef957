"""Where the table stood while frames were taken: the recorded moves, and what the axes reported at rest."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepMark, StepState
from thermostand.recording.reading.session import Session

Axis = Literal["linear", "rotary"]
AXES: tuple[Axis, Axis] = ("linear", "rotary")
_END_NS = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True)
class Visit:
    """A capture: where the axes (linear mm, rotary deg) were sent, when they came to rest and when they moved on."""

    role: str
    sent: dict[str, float]
    since_ns: dict[str, int]
    until_ns: dict[str, int]


def visits_for(steps: Sequence[StepMark], roles: Collection[str]) -> dict[str, Visit]:
    """Step id -> visit of the captures with one of these roles, in order; SessionError when an axis was not moved
    before one."""
    sent: dict[str, float] = {}
    since_ns: dict[str, int] = {}
    visits: dict[str, Visit] = {}
    for mark in steps:
        if mark.kind == "move_to":
            axis = str(mark.parameters.get("axis"))
            if mark.state is StepState.STARTED:
                for visit in visits.values():
                    visit.until_ns.setdefault(axis, mark.time_ns)
            elif mark.state is StepState.DONE:
                sent[axis], since_ns[axis] = float(str(mark.parameters.get("position"))), mark.time_ns
        elif mark.kind == "capture" and mark.parameters.get("role") in roles and mark.state is StepState.STARTED:
            role = str(mark.parameters["role"])
            if not all(axis in sent for axis in AXES):
                raise SessionError(f"step {mark.index + 1}: a {role} capture, but no move of both axes before it")
            visits[mark.step_id] = Visit(role, dict(sent), dict(since_ns), {})
    return visits


def place(session: Session, axis: Axis, visit: Visit) -> float:
    """Mean of what the axis reported at rest during the visit, else where it was sent; mm or deg."""
    try:
        times_ns, values = session.readings(f"{axis}.position")
        moving_ns, moving = session.readings(f"{axis}.moving")
    except SessionError:
        return visit.sent[axis]
    resting = np.isin(times_ns, moving_ns[moving == 0])
    here = resting & (times_ns >= visit.since_ns[axis]) & (times_ns <= visit.until_ns.get(axis, _END_NS))
    reported = values[here & np.isfinite(values)]
    return float(reported.mean()) if len(reported) else visit.sent[axis]
