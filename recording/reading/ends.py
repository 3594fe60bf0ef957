"""The end of a recording compared with its run's journal, and with the end that a run leaves.

A journal's entries are on the disk after what they describe. So when it has an end, steps or a resumption
that the telemetry does not have, the last segments are missing. Without a journal a run leaves either the event of its
end or a segment that a salvage has made; a recording with neither has lost its last segments, or was killed in the
moment between two of them, and counts as incomplete.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import RUN_BEGINS, RUN_END, TELL_PLAN
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.format.chain import Link
from thermostand.recording.format.holes import Hole
from thermostand.recording.format.inventory import SegmentFile, State
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.journal_lines import JOURNAL_NAME, JournalFacts
from thermostand.recording.reading.run_word import last_run_event

# The journal may be ahead of telemetry that waits for its next commit, on a virtual clock for 20 s.
AHEAD_NS = 60 * NS_PER_S


@dataclass(frozen=True, slots=True)
class Coverage:
    """links: the finished segments that were read, by their names, in order. holes: those that the session's own record
    lists, as a copy of an incomplete session does."""

    files: Sequence[SegmentFile]
    links: dict[str, Link]
    holes: tuple[Hole, ...]


@dataclass(frozen=True, slots=True)
class LostEnd:
    """The telemetry behind its last segment is missing; `why` gives the evidence."""

    hole: Hole
    why: str


def lost_end(
    coverage: Coverage,
    events: Iterable[Event],
    marks: Iterable[StepMark],
    journal: JournalFacts | None,
    utc: UtcOffsets,
) -> LostEnd | None:
    """Whether the end of the telemetry is missing; None while something of it is unread. `marks`: those that the reader
    has, all of them when it knows of any."""
    links = [link for link in coverage.links.values() if link.series == TELEMETRY and link.count]
    series = [file for file in coverage.files if file.series == TELEMETRY]
    is_open = any(file.state is State.RECORDING for file in coverage.files)
    if not links or is_open or series[-1].state is State.UNFINISHED:
        return None
    last, end_ns = links[-1], int(max(link.last_ns for link in links))
    events = tuple(events)
    why = _why(end_ns, last.salvaged, last_run_event(events), frozenset(_done(marks)), journal, utc)
    if not why:
        return None
    why += frames_of_plan(events, sum(link.count // 2 for link in coverage.links.values() if link.series == FRAMES))
    to_ns = None if journal is None or journal.last_ns <= end_ns else journal.last_ns
    return LostEnd(Hole(TELEMETRY, series[-1].number + 1, None, end_ns, to_ns), why)


def frames_of_plan(events: Iterable[Event], frames: int) -> str:
    """How many of the frames of the plan `frames` are, as the end of a sentence; "" when the recording has no number
    of planned frames, or when there are as many."""
    planned = [event.data.get("frames") for event in events if event.kind in TELL_PLAN]
    last = planned[-1] if planned else None
    return f"; {frames} of the {last} frames of the plan are there" if isinstance(last, int) and frames < last else ""


def is_of_a_run(events: Iterable[Event], marks: Iterable[StepMark]) -> bool:
    """Whether a run was recorded whose journal was begun: its first step comes after that."""
    return any(event.kind in RUN_BEGINS for event in events) and any(True for _ in marks)


def _done(marks: Iterable[StepMark]) -> Iterable[str]:
    return (mark.step_id for mark in marks if mark.state is StepState.DONE)


def _why(
    end_ns: int,
    is_salvaged: bool,
    last: Event | None,
    done: frozenset[str],
    journal: JournalFacts | None,
    utc: UtcOffsets,
) -> str:
    """The evidence that more was recorded; "" when there is none."""
    is_ended = last is not None and last.kind == RUN_END
    if journal is None:
        if last is None or is_ended or is_salvaged:
            return ""
        return f"the recording stops at {utc.local_text(end_ns)} without an end of its run"
    stops = f"the telemetry stops at {utc.local_text(end_ns)}"
    if journal.status and not is_ended:
        return f"{JOURNAL_NAME} says that the run ended at {utc.local_text(journal.ended_ns)}, {stops}"
    if journal.resumed_ns > (last.time_ns if is_ended and last is not None else end_ns + AHEAD_NS):
        return f"{JOURNAL_NAME} says that the run was resumed at {utc.local_text(journal.resumed_ns)}, {stops}"
    if done and (more := len(journal.done - done)):
        return f"{JOURNAL_NAME} says that {len(journal.done)} steps are done, {more} more than the telemetry; {stops}"
    if journal.last_ns > end_ns + AHEAD_NS and not is_salvaged and not is_ended:
        return f"{JOURNAL_NAME} continues to {utc.local_text(journal.last_ns)}, {stops}"
    return ""
