"""Opening a session to use all of it: an incomplete one is refused, or used with a message of what is missing."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from thermostand.foundation.errors import SessionError
from thermostand.recording.format.inventory import State, inventory
from thermostand.recording.reading.ends import frames_of_plan
from thermostand.recording.reading.journal_lines import journal_facts
from thermostand.recording.reading.run_word import Run
from thermostand.recording.reading.session import Session

_MOST = 6  # holes in a sentence before the rest is only counted
Say = Callable[[str], None]


def open_whole(path: Path | str, incomplete: Say | None = None) -> Session:
    """The session in `path`; SessionError when something of it is missing or was never finished, unless `incomplete`
    takes the sentence that says what. Frames that were never acknowledged, or that the recorder itself said it lost,
    are not missing."""
    session = Session.open(path)
    check_whole(session, incomplete)
    return session


def check_whole(session: Session, incomplete: Say | None = None) -> None:
    """As above, for a session that is open."""
    _check_finished(session.path, incomplete)
    journal = journal_facts(session.path)
    if journal is not None and (changed := journal.changed_texts(session.attachments)):
        raise SessionError(
            f"{session.path}: {changed[0]} is not attached as the run began with it, by its journal; "
            "take the session from its archive"
        )
    missing = [hole for hole in session.holes if not hole.excused]
    if not missing:
        return
    texts = [hole.text(session.utc) for hole in missing]
    more = [f"{len(texts) - _MOST} more"] if len(texts) > _MOST else []
    plan = frames_of_plan(session.events(), session.frame_count) if session.run is Run.COMPLETE else ""
    sentence = f"{session.path}: is incomplete; missing: {'; '.join([*texts[:_MOST], *more])}{plan}"
    if incomplete is None:
        raise SessionError(f"{sentence}; use --incomplete to read the rest")
    incomplete(f"{sentence}; only the rest is used")


def _check_finished(path: Path, incomplete: Say | None) -> None:
    """Segments that a killed recorder has left are not read: a salvage finishes them."""
    left = [file.name for file in inventory(path) if file.state is State.UNFINISHED]
    if not left:
        return
    sentence = f"{path}: {left[0]} {'is' if len(left) == 1 else f'and {len(left) - 1} more are'} not finished and"
    if incomplete is None:
        raise SessionError(f"{sentence} would be left out; `stand session salvage {path}` first")
    incomplete(f"{sentence} left out; `stand session salvage {path}` recovers what is in it")
