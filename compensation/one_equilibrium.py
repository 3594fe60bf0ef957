"""Whether all frames of a session are of one thermal equilibrium of the camera.

The event `camera_offset_changed` says that the camera's temperature minus that of the air around it, at settled
set-points, was another one before a gap than after it: the same temperature then stands for two states of the camera,
and a model fitted to both describes neither.
"""

from __future__ import annotations

from collections.abc import Iterable

from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Event
from thermostand.recording.format.restarts import begins_of, is_superseded
from thermostand.recording.reading.session import Session

CHANGED = "camera_offset_changed"
_TRANSIENT_ROLES = frozenset({"warm_up", "settling", "other"})  # of a camera that is not in equilibrium anyway


class TwoEquilibria(SessionError):
    """A session has frames of two equilibria of the camera."""


def check_one_equilibrium(session: Session) -> None:
    """TwoEquilibria when there are frames at settled set-points on both sides of such a gap."""
    times_ns: list[int] | None = None
    for event in session.events():
        gap_ns = event.data.get("gap_ns")
        if event.kind != CHANGED or not isinstance(gap_ns, int):
            continue
        times_ns = _settled_frames_ns(session) if times_ns is None else times_ns
        if times_ns and min(times_ns) <= gap_ns < max(times_ns):
            raise TwoEquilibria(
                f"{session.path}: camera minus air was {_kelvin(event, 'before_K')} before the gap at "
                f"{session.utc.local_text(gap_ns)} and {_kelvin(event, 'after_K')} after it; its frames are of two "
                "equilibria of the camera, and are used together only with --across-gap"
            )


def check_sessions(sessions: Iterable[Session], *, across_gap: bool) -> None:
    """Each of them, unless they are wanted together."""
    if not across_gap:
        for session in sessions:
            check_one_equilibrium(session)


def _kelvin(event: Event, name: str) -> str:
    value_K = event.data.get(name)
    return f"{value_K:.2f} K" if isinstance(value_K, int | float) else "unknown"


def _settled_frames_ns(session: Session) -> list[int]:
    """Instants of the frames that count and were taken at a settled set-point."""
    roles = {mark.step_id: mark.parameters.get("role") for mark in session.steps() if "role" in mark.parameters}
    begins_ns = begins_of(session.events())
    return [
        meta.time_ns
        for meta in session.frame_metas()
        if roles.get(meta.step_id, "warm_up") not in _TRANSIENT_ROLES
        and not is_superseded(meta.time_ns, meta.step_id, begins_ns)
    ]
