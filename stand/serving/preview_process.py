"""The process that looks at frames for the page, see foundation/helper.py."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from thermostand.foundation.helper import go_behind_all_others

if TYPE_CHECKING:
    from thermostand.stand.serving.live_history import Columns, History
    from thermostand.stand.serving.preview import Previewer
    from thermostand.stand.serving.recorded_drift import Recalled, SessionDrift

MODULE = "thermostand.stand.serving.preview_process"
LEFT_NAME = "stand-look-left"  # of a process whose daemon has gone


def previewer(target_text: str) -> Previewer:
    """For a target; ConfigError when its text is none."""
    import cv2

    from thermostand.foundation.documents import parse_document
    from thermostand.markers.target import Target
    from thermostand.stand.serving.preview import Previewer

    cv2.setNumThreads(1)
    return Previewer(parse_document(target_text, Target, "the target"))


def session_columns(path: str, points: int) -> Columns:
    """A recorded session's curves; SessionError when it cannot be read."""
    from thermostand.stand.serving.recorded_history import session_columns

    return session_columns(path, points)


def session_drift(path: str, target_text: str) -> SessionDrift:
    """How a recorded session's markers moved; SessionError when it cannot be read."""
    import cv2

    from thermostand.stand.serving.recorded_drift import session_drift

    cv2.setNumThreads(1)
    return session_drift(path, target_text)


def run_references(path: str) -> tuple[Recalled, ...]:
    """What the drift of an interrupted run counts from; SessionError when its session cannot be read."""
    from thermostand.stand.serving.recorded_drift import run_references

    return run_references(path)


def recorded_week(directory: str, now_ns: int) -> tuple[History, list[str]]:
    """What a daemon before this one has recorded."""
    from thermostand.stand.serving.recorded_history import recorded_week

    return recorded_week(Path(directory), now_ns)


def prepare() -> None:
    """As a process of its own."""
    go_behind_all_others()
