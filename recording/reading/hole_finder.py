"""What of a session is not there: by the numbers of its segments, by its steps, by its journal, and by its own record
when it is a copy.

A step's end is recorded when all its frames are on the disk, or counted as lost. So a capture that is done has as many
frames of each of its cameras as it says.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from operator import attrgetter

from thermostand.foundation.events import RUN_END, TELL_PLAN
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.format.chain import missing_segments
from thermostand.recording.format.holes import Hole
from thermostand.recording.format.inventory import State
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.messages import FrameMeta
from thermostand.recording.format.restarts import begins_of, is_superseded
from thermostand.recording.format.utc_offsets import offsets_of
from thermostand.recording.reading.contents import Contents
from thermostand.recording.reading.ends import Coverage, lost_end
from thermostand.recording.reading.gaps import lost_frames_of, reported_blocks
from thermostand.recording.reading.journal_lines import JournalFacts
from thermostand.recording.reading.run_word import Run, last_run_event

CAPTURE = "capture"


@dataclass(frozen=True, slots=True)
class Shortage:
    """Captures that follow each other and are done with `missing` frames less than they say. begin_ns, end_ns: of the
    steps. is_reported: the recorder itself said that it lost them."""

    step_ids: tuple[str, ...]
    missing: int
    begin_ns: int
    end_ns: int
    is_reported: bool

    @property
    def hole(self) -> Hole:
        """As a stretch of the frames."""
        return Hole(FRAMES, None, None, self.begin_ns - 1, self.end_ns + 1, self.missing, self.is_reported)


def find_shortages(marks: Iterable[StepMark], events: Sequence[Event], metas: Iterable[FrameMeta]) -> list[Shortage]:
    """By the steps that are done, in order of time, and all the frames that are there."""
    begins_ns = begins_of(events)
    counts: Counter[tuple[str, str]] = Counter()
    channels: set[str] = set()
    for meta in metas:
        channels.add(meta.channel)
        counts[meta.step_id, meta.channel] += not is_superseded(meta.time_ns, meta.step_id, begins_ns)
    begun_ns: dict[str, int] = {}
    found: list[Shortage] = []
    follows = False
    for mark in sorted(marks, key=attrgetter("time_ns")):
        if mark.state is StepState.STARTED:
            begun_ns[mark.step_id] = mark.time_ns
        due, names = mark.parameters.get("frames"), mark.parameters.get("cameras")
        if mark.kind != CAPTURE or mark.state is not StepState.DONE or not isinstance(due, int):
            continue
        cameras = [f"{name}.image" for name in names] if isinstance(names, list | tuple) and names else channels or {""}
        missing = sum(max(0, due - counts[mark.step_id, channel]) for channel in cameras)
        if missing:
            is_reported = missing <= lost_frames_of(mark.step_id, events)
            begin_ns = begun_ns.get(mark.step_id, mark.time_ns)
            one = Shortage((mark.step_id,), missing, begin_ns, mark.time_ns, is_reported)
            is_one = follows and found[-1].is_reported == is_reported
            found.append(_joined(found.pop(), one) if is_one else one)
        follows = missing > 0
    return found


def _joined(one: Shortage, other: Shortage) -> Shortage:
    steps, missing = one.step_ids + other.step_ids, one.missing + other.missing
    return Shortage(steps, missing, one.begin_ns, other.end_ns, one.is_reported)


def frames_not_begun(marks: Sequence[StepMark], events: Sequence[Event], metas: Iterable[FrameMeta]) -> int:
    """How many frames of the plan of a complete run are not there, of whatever step; 0 when an operator has left out
    one, or the recording does not say that the run is complete."""
    last = last_run_event(events)
    planned = [event.data.get("frames") for event in events if event.kind in TELL_PLAN]
    due = planned[-1] if planned else None
    is_complete = last is not None and last.kind == RUN_END and last.data.get("status") == Run.COMPLETE
    if not is_complete or not isinstance(due, int) or any(mark.state is StepState.SKIPPED for mark in marks):
        return 0
    most: dict[str, int] = {}
    for (step_id, _), count in Counter((meta.step_id, meta.channel) for meta in metas).items():
        most[step_id] = max(most.get(step_id, 0), count)
    return max(0, due - sum(most.values()) - sum(map(len, reported_blocks(events))))


def find_holes(
    coverage: Coverage,
    contents: Contents,
    metas: Sequence[FrameMeta],
    journal: JournalFacts | None,
    *,
    is_part: bool,
) -> tuple[Hole, ...]:
    """The holes of the telemetry, then of the frames. `contents`: events and step marks; `metas`: of all frames.
    `is_part`: the session was cut out of another one, whose journal and end, and the ends of whose steps it has not."""
    gaps = {series: tuple(_gaps(series, coverage)) for series in (TELEMETRY, FRAMES)}
    shortages: list[Shortage] = []
    if not is_part:
        has_gap = gaps[TELEMETRY] or any(hole.series == TELEMETRY for hole in coverage.holes)
        marks = () if has_gap else contents.marks
        lost = lost_end(coverage, contents.events, marks, journal, offsets_of(contents.events))
        gaps[TELEMETRY] += () if lost is None else (replace(lost.hole, end_ns=None),)
        if all_frames_are_read(coverage) and not any(hole.series == FRAMES for hole in coverage.holes):
            shortages = find_shortages(contents.marks, contents.events, metas)
    found = (*coverage.holes, *gaps[TELEMETRY], *_with_frames(gaps[FRAMES], shortages, coverage))
    if not found and not is_part and all_frames_are_read(coverage):
        missing = frames_not_begun(contents.marks, contents.events, metas)
        return (Hole(FRAMES, None, None, None, None, missing),) if missing else ()
    return found


def all_frames_are_read(coverage: Coverage) -> bool:
    """Whether no frame may be in a segment that was not read."""
    unread = (State.UNFINISHED, State.RECORDING)
    return not any(file.series == FRAMES and file.state in unread for file in coverage.files)


def _gaps(series: str, coverage: Coverage) -> Iterator[Hole]:
    numbers = (link.number for link in coverage.links.values() if link.series == series)
    return missing_segments(series, numbers, coverage.links.values())


def _with_frames(gaps: Sequence[Hole], shortages: Iterable[Shortage], coverage: Coverage) -> Iterator[Hole]:
    """The gaps with the number of frames that went with them, then what is missing without a missing number: behind the
    last segment, or in between."""
    links = [link for link in coverage.links.values() if link.series == FRAMES]
    last_ns = max((int(link.last_ns) for link in links if link.count), default=None)
    tail = Hole(FRAMES, max((link.number for link in links), default=-1) + 1, None, last_ns, None)
    counts: Counter[Hole] = Counter()
    loose: list[Hole] = []
    for shortage in shortages:
        gap = next((gap for gap in gaps if gap.within(shortage.begin_ns, shortage.end_ns + 1) is not None), None)
        if gap is None and tail.covers(shortage.begin_ns) and not shortage.is_reported:
            gap = tail
        if gap is None:
            loose.append(shortage.hole)
        else:
            counts[gap] += shortage.missing
    yield from (replace(gap, frames=counts[gap]) for gap in (*gaps, *([tail] if counts[tail] else [])))
    yield from loose
