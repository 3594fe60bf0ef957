"""The history of recorded sessions: of one that is looked at, of two that are compared, and of the last week after a
restart. It reads disks: in a process of its own, never in that of the guard.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import StandError
from thermostand.recording.format.layout import FINISHED, TELEMETRY
from thermostand.recording.reading.session import Session
from thermostand.stand.serving.live_history import COARSE_CELLS, COARSE_S, Columns, History

WEEK_NS = to_ns(COARSE_S * COARSE_CELLS)


def read_recorded_week(directory: Path, now_ns: int) -> tuple[History, list[str]]:
    """Return, after a restart, what the sessions in `directory` have of the week before `now_ns`, and a sentence for
    each that could not be read."""
    history, troubles = History(), list[str]()
    for path in _find_sessions_since(directory, now_ns - WEEK_NS):
        try:
            fill_from(history, Session.open(path), now_ns - WEEK_NS)
        except StandError as error:
            troubles.append(str(error))
    return history, troubles


def read_session_columns(path: Path | str, points: int) -> Columns:
    """The whole of one session in at most `points` columns; SessionError when it cannot be read."""
    session, history = Session.open(path), History()
    first_ns, last_ns = fill_from(history, session)
    return history.columns(first_ns, last_ns + 1, points)


def fill_from(history: History, session: Session, from_ns: int = 0) -> tuple[int, int]:
    """Add what a session has from `from_ns` on; the first and last instant of it, (0, 0) when it has nothing."""
    ends: list[int] = []
    for channel, unit in session.units().items():
        times_ns, values = session.readings(channel)
        first = int(np.searchsorted(times_ns, from_ns))
        history.fill(channel, times_ns[first:], values[first:], unit)
        ends += [int(times_ns[at]) for at in (first, -1) if first < len(times_ns)]
    for mark in sorted((*session.events(), *session.steps()), key=lambda item: item.time_ns):
        if mark.time_ns >= from_ns:
            history.mark(mark)
            ends.append(mark.time_ns)
    return min(ends, default=0), max(ends, default=0)


def _find_sessions_since(directory: Path, from_ns: int) -> list[Path]:
    """Sessions in which something was written since, oldest first. Files' times are UTC, not the stand's clock, so a
    day more is looked at."""
    found: list[tuple[int, Path]] = []
    for telemetry in directory.glob(f"*/{TELEMETRY}"):
        times = [segment.stat().st_mtime_ns for segment in telemetry.glob(f"*{FINISHED}")]
        if times and max(times) >= from_ns - to_ns(86_400):
            found.append((max(times), telemetry.parent))
    return [path for _, path in sorted(found)]
