"""The event `capture_restarted`: a capture has been begun anew, its frames so far do not count.

Its data have `step_id` and the number of `frames`.
"""

from __future__ import annotations

from foundation.items import Event

KIND = "capture_restarted"
_TEXT = "capture {} begins anew, {}; its {} frames so far do not count"


def restarted(time_ns: int, step_id: str, frames: int, how: str) -> Event:
    """The event: so many frames of that step, all before `time_ns`, are superseded. how: as in `from a cold camera`."""
    data: dict[str, object] = {"step_id": step_id, "frames": frames}
    return Event(time_ns, "warning", KIND, _TEXT.format(step_id, how, frames), data)


def restarted_step(event: Event) -> str:
    """The id of the capture that was begun anew; "" when the event says something else."""
    named = event.data.get("step_id") if event.kind == KIND else None
    return named if isinstance(named, str) else ""
