"""A recorded session at a glance: from the ends of its files, the events near both ends of the run and its
journal. Damage and unfinished segments are part of the answer, not a reason to give none.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap.records import DataEnd, Message
from mcap.stream_reader import StreamReader

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Event, StepMark
from thermostand.recording.format import messages
from thermostand.recording.format.chain import Link, misplaced, missing_segments
from thermostand.recording.format.damage import DAMAGE, reading
from thermostand.recording.format.decoded_items import event_of, step_of
from thermostand.recording.format.holes import holes_in, segments_text
from thermostand.recording.format.inventory import SegmentFile, State, inventory
from thermostand.recording.format.layout import FINISHED, FRAMES, TELEMETRY, unknown_format
from thermostand.recording.format.mcap_bytes import Source
from thermostand.recording.format.messages import FrameMeta
from thermostand.recording.format.records import Head, frame_places, read_head, telemetry_messages
from thermostand.recording.format.summary import Summary, read_summary
from thermostand.recording.format.utc_offsets import REPEATED_NS, UtcOffsets, offsets_of
from thermostand.recording.reading.ends import Coverage, frames_of_plan, is_of_a_run, lost_end
from thermostand.recording.reading.extent import extent_of
from thermostand.recording.reading.journal_lines import JOURNAL_NAME, JournalFacts, journal_facts
from thermostand.recording.reading.notes import NOTES_NAME, read_notes
from thermostand.recording.reading.run_word import Files, Run, run_word
from thermostand.recording.reading.session import Session
from thermostand.recording.reading.walk import survey

_NEAR = (messages.EVENT, messages.STEP)
_LAST = 2  # segments of the telemetry: a run's end is recorded before its stand is safe, which may take ten minutes


@dataclass(frozen=True, slots=True)
class Glance:
    """What names, sizes, heads and indexes show. begin_ns and end_ns: log times of the first and the last message of
    the finished segments, None when they hold none; `frames` are theirs, too. `troubles`: a sentence for each that is
    damaged, `missing`: for each that is not there. utc: to UTC near both ends; the steps of the system clock between
    them are not looked for. run: how the run ended. has_camera_degC: whether any frame has a good camera temperature,
    None when no description of a frame can be read."""

    path: Path
    files: tuple[SegmentFile, ...]
    metadata: dict[str, str]
    attachments: dict[str, str]
    frames: int
    begin_ns: int | None
    end_ns: int | None
    troubles: tuple[str, ...]
    missing: tuple[str, ...]
    utc: UtcOffsets
    run: Run
    has_camera_degC: bool | None

    @property
    def size_bytes(self) -> int:
        """All segments, also those that are not finished."""
        return sum(file.size_bytes for file in self.files)

    @property
    def simulated(self) -> bool:
        """The devices were fakes."""
        return self.metadata.get("simulated") == "true"

    def count(self, state: State) -> int:
        """How many segments are in that state."""
        return sum(file.state is state for file in self.files)

    @property
    def state(self) -> Files:
        """Whether the files are sound, as far as a glance shows; `stand session verify` reads all of them."""
        if self.troubles:
            return Files.DAMAGED
        if self.missing:
            return Files.INCOMPLETE
        return Files.UNKNOWN if unknown_format(self.metadata) else Files.SOUND

    @property
    def lacks(self) -> str:
        """What a fit would miss in these frames, in words; "" when there is nothing."""
        return NO_TEMPERATURE if self.has_camera_degC is False else ""

    @property
    def state_text(self) -> str:
        """The same with the first reason: `incomplete: telemetry/0003.mcap is missing`."""
        reasons = self.troubles or self.missing or tuple(filter(None, [unknown_format(self.metadata)]))
        more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
        return f"{self.state}: {reasons[0]}{more}" if reasons else str(self.state)


class _Seen(NamedTuple):
    """A finished segment that can be read."""

    file: SegmentFile
    head: Head
    summary: Summary

    @property
    def link(self) -> Link:
        """Its place in the chain."""
        totals = self.summary.statistics
        times_ns = (totals.message_start_time, totals.message_end_time)
        return Link(self.file.series, self.file.number, totals.message_count, *times_ns, bool(self.head.salvaged))


class _Near(NamedTuple):
    """The events and step marks near both ends of the recording."""

    events: list[Event]
    marks: list[StepMark]


def glance(path: Path) -> Glance:
    """The session in `path` at a glance; SessionError when there is none. Costs a look at both ends of each segment."""
    files = inventory(path)
    if not files:
        raise SessionError(f"{path}: not a session: there is no segment in its folders {TELEMETRY} and {FRAMES}")
    troubles: list[str] = []
    seen: list[_Seen] = []
    for file in files:
        if file.state is State.FINISHED:
            try:
                seen.append(_Seen(file, read_head(file.path), _summary(file.path)))
            except SessionError as error:
                troubles.append(within(path, error))
    metadata, attachments = _opening(files, seen)
    totals = [each.summary.statistics for each in seen if each.summary.statistics.message_count]
    near, journal = _near([each for each in seen if each.file.series == TELEMETRY]), journal_facts(path)
    extent, utc = extent_of(metadata), offsets_of(near.events)
    links = {each.file.name: each.link for each in seen}
    coverage = Coverage(files, links, holes_in(metadata.get("holes", "")))
    troubles += [*_misfits(seen, metadata), *_kept(files, seen)]
    if journal is not None and journal.damage and extent is None:
        troubles.append(f"{JOURNAL_NAME}: {journal.damage}")
    if journal is not None and attachments:
        changed = journal.changed_texts(attachments)
        troubles += [f"{name} is not attached as the run began with it, by its journal" for name in changed]
    if damage := read_notes(path).damage:
        troubles.append(f"{NOTES_NAME}: {damage}")
    missing = [*_missing(coverage), *(() if extent else _lost_end(coverage, near, journal, utc))]
    is_recording = any(file.state is State.RECORDING for file in files)
    frames = sum(each.link.count // 2 for each in seen if each.file.series == FRAMES)
    run = extent.run if extent else run_word(near.events, journal, is_recording=is_recording)
    is_short = run is not Run.COMPLETE or frames_of_plan(near.events, frames)
    if is_short and not is_recording and not troubles and not missing:
        troubles, missing = _steps_without_frames(path)
    return Glance(
        path,
        files,
        metadata,
        attachments,
        frames,
        min((statistics.message_start_time for statistics in totals), default=None),
        max((statistics.message_end_time for statistics in totals), default=None),
        tuple(troubles),
        tuple(missing),
        utc,
        run,
        has_recorded_temperature(each.file.path for each in seen if each.file.series == FRAMES),
    )


def _near(telemetry: Sequence[_Seen]) -> _Near:
    """What the first segment of the telemetry, and those of the last minutes, say of the run and of UTC, as far as
    they can be read."""
    ends_ns = [each.summary.statistics.message_end_time for each in telemetry]
    last_ns = max(ends_ns, default=0) - REPEATED_NS - NS_PER_S
    near = _Near([], [])
    for index, (each, end_ns) in enumerate(zip(telemetry, ends_ns, strict=True)):
        if not index or end_ns >= last_ns or index >= len(telemetry) - _LAST:
            with suppress(SessionError):
                for message in telemetry_messages(each.file.path, lambda channel: channel.topic in _NEAR):
                    if message.topic == messages.EVENT:
                        near.events.append(event_of(message))
                    else:
                        near.marks.append(step_of(message))
    return near


def _misfits(seen: Sequence[_Seen], metadata: dict[str, str]) -> Iterator[str]:
    """Segments of another session, or of another place in this one, or with other texts."""
    texts = Counter(tuple(each.head.attachments.items()) for each in seen)
    most = dict(texts.most_common(1)[0][0]) if texts else {}
    for each in seen:
        if each.head.session != metadata:
            yield f"{each.file.name}: belongs to another session than the other segments"
        elif each.head.attachments != most:
            yield f"{each.file.name}: has other texts attached than the other segments"
        if misplaced(each.file.series, each.file.number, each.head.place, each.head.session):
            yield f"{each.file.name}: records another place in the session than its name"


def _kept(files: Sequence[SegmentFile], seen: Sequence[_Seen]) -> Iterator[str]:
    """Originals that a salvage kept because it could not recover all of them."""
    by_name = {each.file.name: each for each in seen}
    for file in files:
        each = by_name.get(f"{file.series}/{file.number:04d}{FINISHED}")
        if file.state is State.DAMAGED and (
            each is None or not is_recovered(file, each.head.salvaged, each.link.count)
        ):
            yield f"{file.name}: is an original that a salvage could not recover completely"


def _missing(coverage: Coverage) -> Iterator[str]:
    files = coverage.files
    if unfinished := sum(file.state is State.UNFINISHED for file in files):
        yield f"{unfinished} segment{'' if unfinished == 1 else 's'} not finished"
    if not any(file.series == TELEMETRY and file.state is not State.DAMAGED for file in files):
        yield f"{TELEMETRY} is missing"
    for series in (TELEMETRY, FRAMES):
        for hole in missing_segments(series, (file.number for file in files if file.series == series), ()):
            yield f"{segments_text(series, hole.first or 0, hole.last)} missing"
    for hole in coverage.holes:
        if not hole.excused:
            yield "it is a copy of an incomplete session"
            return


def _lost_end(coverage: Coverage, near: _Near, journal: JournalFacts | None, utc: UtcOffsets) -> Iterator[str]:
    if journal is None and is_of_a_run(near.events, near.marks):
        yield f"{JOURNAL_NAME} is missing"
    lost = lost_end(coverage, near.events, (), journal, utc)
    if lost is not None:
        yield f"the end of the telemetry is missing: {lost.why}"


def _steps_without_frames(path: Path) -> tuple[list[str], list[str]]:
    """Where there are fewer frames than planned, the reasons are looked for in all of the telemetry: troubles, and what
    is missing."""
    try:
        session = Session.open(path)
        missing = [hole.text(session.utc) for hole in session.holes if not hole.excused]
    except SessionError as error:
        return [within(path, error)], []
    return [], [f"{text} missing" for text in missing]


def within(directory: Path, error: SessionError) -> str:
    """Its sentence, with the file's name as it is within the session."""
    return str(error).removeprefix(f"{directory}/")


def _summary(path: Path) -> Summary:
    with reading(path), path.open("rb") as file:
        return read_summary(file, path.stat().st_size)


def _opening(files: Sequence[SegmentFile], seen: Sequence[_Seen]) -> tuple[dict[str, str], dict[str, str]]:
    """Metadata `session` and the attachments: those that most finished segments have, else those of the first other
    segment that has them; empty when none has."""
    if seen:
        sessions = Counter(tuple(each.head.session.items()) for each in seen)
        most = dict(sessions.most_common(1)[0][0])
        return most, next(each.head.attachments for each in seen if each.head.session == most)
    for file in files:
        try:
            with file.path.open("rb") as opened:
                found = survey(Source(opened.fileno()), to_first_chunk=True)
        except OSError:
            continue
        if found.session is not None:
            return found.session, {
                name: entry.data.decode(errors="replace") for name, entry in found.attachments.items()
            }
    return {}, {}


# The originals of damaged segments that a salvage has kept, compared with what it recovered of them.


def is_recovered(kept: SegmentFile, salvage: Mapping[str, str], recovered: int) -> bool:
    """Whether the salvaged segment (its record `salvage`, its number of messages) has every message of the original:
    its salvage lost no byte, and both have as many. The original must reach the end of its data; of one that was cut
    short the number of messages is unknown."""
    if salvage.get("lost_bytes") != "0":
        return False
    messages = 0
    try:
        with kept.path.open("rb") as file:
            for record in StreamReader(file, validate_crcs=True, record_size_limit=kept.size_bytes).records:
                if isinstance(record, DataEnd):
                    return messages == recovered
                messages += isinstance(record, Message)
    except DAMAGE:
        pass
    return False


# Whether any frame has the camera's own temperature, without which no drift over it can be fitted.

NO_TEMPERATURE = "no frame has a good camera temperature"


def has_temperature(metas: Iterable[FrameMeta]) -> bool | None:
    """By the descriptions of the frames, as far as the first that has one; None without any description."""
    found = None
    for meta in metas:
        if not math.isnan(meta.camera_degC):
            return True
        found = False
    return found


def has_recorded_temperature(segments: Iterable[Path]) -> bool | None:
    """By these segments of the frames, as far as they can be read."""

    def metas() -> Iterable[FrameMeta]:
        for path in segments:
            with suppress(SessionError):
                yield from (place.meta for place in frame_places(path))

    return has_temperature(metas())
