"""The event `capture_restarted`: a capture that could not be continued was begun again, its frames so far do not count.

Its data have `step_id`, the number of `frames` and, when it is for frames that the disk has lost, how many these are:
`frames_lost`. One that was interrupted for long is such a capture, and a warm-up that was: it shows a camera that was
cold when it was switched on.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from thermostand.foundation.events import CAPTURE_RESTARTED
from thermostand.foundation.items import Event


def make_restart_event(time_ns: int, step_id: str, frames: int, how: str, frames_lost: int = 0) -> Event:
    """The event: so many frames of that step, all before `time_ns`, are superseded. how: as in `from a cold camera`."""
    lost = {"frames_lost": frames_lost} if frames_lost else {}
    return CAPTURE_RESTARTED.at(time_ns, how, step_id=step_id, frames=frames, **lost)


def find_restarted_step(event: Event) -> str:
    """The id of the capture that was restarted; "" when the event is of another kind."""
    named = event.data.get("step_id") if event.kind == CAPTURE_RESTARTED else None
    return named if isinstance(named, str) else ""


def count_frames_lost(event: Event) -> int:
    """Return how many frames of the capture were lost by the disk; 0 when it was restarted for another reason."""
    count = event.data.get("frames_lost")
    return count if isinstance(count, int) else 0


def find_restart_times(events: Iterable[Event]) -> dict[str, int]:
    """Return, for each capture that was begun again, by step id, the instant (ns) before which its frames do not
    count."""
    found = ((find_restarted_step(event), event.time_ns) for event in events)
    return {step_id: time_ns for step_id, time_ns in found if step_id}


def is_superseded(time_ns: int, step_id: str, begins_ns: Mapping[str, int]) -> bool:
    """Return whether a frame of that instant and step does not count, by what `find_restart_times` its session says."""
    return time_ns < begins_ns.get(step_id, time_ns)
