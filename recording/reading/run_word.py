"""How the run of a session ended: the one word that lists, reports and programs use, and its journal's beside it."""

from __future__ import annotations

from collections.abc import Iterable
from enum import StrEnum

from thermostand.foundation.events import RUN_BEGINS, RUN_END
from thermostand.foundation.items import Event
from thermostand.recording.reading.journal_lines import JournalFacts


class Run(StrEnum):
    """complete: the plan is done. stopped: by its operator. tripped: the guard ended it. failed: an error did.
    interrupted: killed, or without any end. running: it is being recorded now."""

    COMPLETE = "complete"
    STOPPED = "stopped"
    TRIPPED = "tripped"
    FAILED = "failed"
    INTERRUPTED = "interrupted"
    RUNNING = "running"


class Files(StrEnum):
    """sound: everything that was acknowledged is there and as it was written. incomplete: something of it is missing.
    damaged: something is not as it was written. unknown: by another version, whose format this one does not know."""

    SOUND = "sound"
    INCOMPLETE = "incomplete"
    DAMAGED = "damaged"
    UNKNOWN = "unknown"


def last_run_event(events: Iterable[Event]) -> Event | None:
    """The last event of a run's beginning or end; None when none is recorded."""
    marks = [event for event in events if event.kind in (*RUN_BEGINS, RUN_END)]
    return max(marks, key=lambda event: event.time_ns, default=None)


def run_word(events: Iterable[Event], journal: JournalFacts | None, *, is_recording: bool = False) -> Run:
    """By the recording or by its journal, whichever has the later entry."""
    if is_recording:
        return Run.RUNNING
    last = last_run_event(events)
    ended_ns = -1 if last is None else last.time_ns
    if journal is not None and (journal.last_ns > ended_ns or (journal.status and journal.last_ns == ended_ns)):
        return known_word(journal.status)
    if last is None or last.kind != RUN_END:
        return Run.INTERRUPTED
    return known_word(str(last.data.get("status")))


def known_word(status: str) -> Run:
    """The word, interrupted for what is none."""
    return Run(status) if status in set(Run) - {Run.RUNNING} else Run.INTERRUPTED
