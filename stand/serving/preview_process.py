"""The process that looks at frames for the page, see foundation/worker_process.py."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from thermostand.foundation.worker_process import lower_priority

if TYPE_CHECKING:
    from thermostand.stand.serving.live_history import Columns, History
    from thermostand.stand.serving.preview import Previewer
    from thermostand.stand.serving.recorded_drift import RecalledReference, SessionDrift

MODULE = "thermostand.stand.serving.preview_process"
LEFT_NAME = "stand-look-left"  # of a process whose daemon has gone


def make_previewer(target_text: str) -> Previewer:
    """Make a previewer for a target; ConfigError when its text is none."""
    import cv2

    from thermostand.foundation.documents import parse_document
    from thermostand.markers.target import Target
    from thermostand.stand.serving.preview import Previewer

    cv2.setNumThreads(1)
    return Previewer(parse_document(target_text, Target, "the target"))


def load_session_columns(path: str, points: int) -> Columns:
    """A recorded session's curves; SessionError when it cannot be read."""
    from thermostand.stand.serving.recorded_history import read_session_columns

    return read_session_columns(path, points)


def load_session_drift(path: str, target_text: str) -> SessionDrift:
    """Return how a recorded session's markers moved; SessionError when it cannot be read."""
    import cv2

    from thermostand.stand.serving.recorded_drift import compute_session_drift

    cv2.setNumThreads(1)
    return compute_session_drift(path, target_text)


def load_run_references(path: str) -> tuple[RecalledReference, ...]:
    """Return what the drift of an interrupted run counts from; SessionError when its session cannot be read."""
    from thermostand.stand.serving.recorded_drift import find_run_references

    return find_run_references(path)


def load_recorded_week(directory: str, now_ns: int) -> tuple[History, list[str]]:
    """Return what a daemon before this one has recorded."""
    from thermostand.stand.serving.recorded_history import read_recorded_week

    return read_recorded_week(Path(directory), now_ns)


def prepare() -> None:
    """Prepare the process that makes previews."""
    lower_priority()
