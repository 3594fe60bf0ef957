"""Frames that are recorded but do not count: a capture that cannot be continued has been begun anew after them.

One that was interrupted for long is such a capture, and a warm-up that was: it shows a camera that was cold when it was
switched on.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from recording.format.restarts import restarted_step

if TYPE_CHECKING:
    from recording.reading.session import Session


def begins_of(session: Session) -> dict[str, int]:
    """Of each capture that was begun anew, by step id, the instant (ns) before which its frames do not count."""
    found = ((restarted_step(event), event.time_ns) for event in session.events())
    return {step_id: time_ns for step_id, time_ns in found if step_id}


def is_superseded(time_ns: int, step_id: str, begins_ns: Mapping[str, int]) -> bool:
    """Whether a frame of that instant and step does not count, by what `begins_of` its session says."""
    return time_ns < begins_ns.get(step_id, time_ns)
