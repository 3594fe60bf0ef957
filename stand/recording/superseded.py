"""Frames that are recorded but do not count: a capture that cannot be continued has been begun anew after them.

A warm-up is one: it shows a camera that was cold when it was switched on. The event `capture_restarted` says so.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

from stand.hub import Event
from stand.recording.session import Session

KIND = "capture_restarted"
_TEXT = "capture {} begins anew, from a cold camera; its {} frames so far do not count"
_STEP_ID = re.compile(r"^capture (\S+) begins anew")


def restarted(time_ns: int, step_id: str, frames: int) -> Event:
    """The event: so many frames of that step, all before `time_ns`, are superseded."""
    return Event(time_ns, "warning", KIND, _TEXT.format(step_id, frames))


def begins_of(session: Session) -> dict[str, int]:
    """Of each capture that was begun anew, by step id, the instant (ns) before which its frames do not count."""
    found = ((_STEP_ID.match(event.text), event.time_ns) for event in session.events() if event.kind == KIND)
    return {match[1]: time_ns for match, time_ns in found if match is not None}


def is_superseded(time_ns: int, step_id: str, begins_ns: Mapping[str, int]) -> bool:
    """Whether a frame of that instant and step does not count, by what `begins_of` its session says."""
    return time_ns < begins_ns.get(step_id, time_ns)
