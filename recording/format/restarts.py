"""The event `capture_restarted`: a capture has been begun anew, its frames so far do not count.

Its data has `step_id` and the number of `frames`.
"""

from __future__ import annotations

import re

from foundation.items import Event

KIND = "capture_restarted"
_TEXT = "capture {} begins anew, {}; its {} frames so far do not count"
_STEP_ID = re.compile(r"^capture (\S+) begins anew")  # of sessions whose events have no data


def restarted(time_ns: int, step_id: str, frames: int, how: str) -> Event:
    """The event: so many frames of that step, all before `time_ns`, are superseded. how: as in `from a cold camera`."""
    data: dict[str, object] = {"step_id": step_id, "frames": frames}
    return Event(time_ns, "warning", KIND, _TEXT.format(step_id, how, frames), data)


def restarted_step(event: Event) -> str:
    """The id of the capture that was begun anew; "" when the event says something else."""
    if event.kind != KIND:
        return ""
    named = event.data.get("step_id")
    if isinstance(named, str):
        return named
    match = _STEP_ID.match(event.text)
    return "" if match is None else match[1]
