"""Is a recorded session whole? Reads every byte of it and says what is damaged or missing, a sentence each.

An error is something that was recorded and cannot be trusted or is not there; a note is a hole in what was measured
that the recording itself reports: silence of a device, frames the camera or a slow disk lost, a salvaged segment.
How the run ended is another matter: a stopped run has sound files.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields
from enum import StrEnum
from math import inf
from pathlib import Path

from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import FRAMES_DROPPED
from thermostand.recording.format.chain import MOST_MISSING, Link, foreign_numbers, misplaced, missing_segments
from thermostand.recording.format.holes import Hole, holes_in, segments_text
from thermostand.recording.format.inventory import SegmentFile, State, inventory, strays
from thermostand.recording.format.layout import (
    FINISHED,
    FRAMES,
    SALVAGE_METADATA,
    SEGMENT_METADATA,
    SESSION_METADATA,
    TELEMETRY,
    unknown_format,
)
from thermostand.recording.format.messages import FrameMeta, decode_frame_meta
from thermostand.recording.format.records import Message
from thermostand.recording.format.utc_offsets import UtcOffsets, offsets_of
from thermostand.recording.reading.contents import Contents
from thermostand.recording.reading.ends import Coverage, is_of_a_run, lost_end
from thermostand.recording.reading.extent import Extent, extent_of
from thermostand.recording.reading.gaps import silences
from thermostand.recording.reading.glance import NO_TEMPERATURE, has_temperature, is_recovered
from thermostand.recording.reading.hole_finder import all_frames_are_read, find_shortages, frames_not_begun
from thermostand.recording.reading.journal_lines import JOURNAL_NAME, JournalFacts, journal_facts
from thermostand.recording.reading.notes import NOTES_NAME, Notes, read_notes
from thermostand.recording.reading.run_word import Files, Run, run_word
from thermostand.recording.repair.salvage import no_report
from thermostand.recording.repair.segment_check import Damage, SegmentCheck, check_segment
from thermostand.recording.writing.recorder_settings import SessionInfo


class Severity(StrEnum):
    """error: damaged or missing. note: a hole in the data that is recorded as such."""

    ERROR = "error"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence; `where` is the file it is about, as in `telemetry/0003.mcap`, or "" for the whole session. `files`:
    what an error makes of the session's files, sound for a note."""

    severity: Severity
    where: str
    text: str
    files: Files = Files.SOUND

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}{': ' if self.where else ''}{self.text}"


@dataclass(frozen=True, slots=True)
class Verification:
    """What was read (finished segments), what was found, and how the run ended."""

    findings: tuple[Finding, ...]
    segments: int
    messages: int
    frames: int
    bytes: int
    run: Run

    @property
    def files(self) -> Files:
        """The gravest of what was found."""
        words = {finding.files for finding in self.findings}
        return next((word for word in (Files.DAMAGED, Files.INCOMPLETE, Files.UNKNOWN) if word in words), Files.SOUND)

    @property
    def is_sound(self) -> bool:
        """Nothing is damaged or missing."""
        return not any(finding.severity is Severity.ERROR for finding in self.findings)


@dataclass
class _Read:
    """What the finished ones of `files` hold, their checks by their names."""

    files: tuple[SegmentFile, ...]
    contents: Contents = field(default_factory=Contents)
    metas: list[FrameMeta] = field(default_factory=list[FrameMeta])
    checks: dict[str, SegmentCheck] = field(default_factory=dict[str, SegmentCheck])

    def is_damaged(self, series: str) -> bool:
        """What is missing of the series may be in damage that is a finding already."""
        return any(check.damages for name, check in self.checks.items() if name.startswith(f"{series}/"))

    def coverage(self) -> Coverage:
        """Which instants the segments that were read cover."""
        session = self.session()
        links = {file.name: _link(file, self.checks[file.name]) for file in self.files if file.name in self.checks}
        return Coverage(self.files, links, holes_in(session.get("holes", "")))

    def session(self) -> dict[str, str]:
        """The record `session` that most segments have."""
        stated = Counter(_entries(check.metadata.get(SESSION_METADATA)) for check in self.checks.values())
        return dict(stated.most_common(1)[0][0]) if stated else {}


def _link(file: SegmentFile, check: SegmentCheck) -> Link:
    is_salvaged = SALVAGE_METADATA in check.metadata
    return Link(file.series, file.number, check.messages, check.first_ns, check.last_ns, is_salvaged)


def _format(session: Mapping[str, str]) -> Iterator[Finding]:
    """What another version of thermostand may have recorded is not known here."""
    if text := unknown_format(session):
        yield Finding(Severity.ERROR, "", f"{text}: what that format adds was not checked", Files.UNKNOWN)
    elif unknown := sorted(session.keys() - {field.name for field in fields(SessionInfo)}):
        names = ", ".join(name[:40] for name in unknown[:6])
        yield _note(
            f"the record of the session has fields that this version does not know: {names}; they were not checked"
        )


def _extent(extent: Extent | None, utc: UtcOffsets) -> Iterator[Finding]:
    if extent is not None:
        yield _note(extent.text(utc))


def verify(path: Path, report: Callable[[float, str], None] = no_report) -> Verification:
    """Read the whole session in `path`; `report` gets the bytes read so far and the segment.

    SessionError when `path` is no session. Damage is not raised, it is found.
    """
    files = inventory(path)
    if not files:
        raise SessionError(f"{path}: not a session: there is no segment in its folders {TELEMETRY} and {FRAMES}")
    finished = [file for file in files if file.state is State.FINISHED]
    read = _Read(files)
    done_bytes = 0
    for file in finished:
        read.checks[file.name] = _checked(file, read, report, done_bytes)
        done_bytes += file.size_bytes
    journal, utc = journal_facts(path), offsets_of(read.contents.events)
    coverage = read.coverage()
    extent = extent_of(read.session())
    findings = (
        *_format(read.session()),
        *_extent(extent, utc),
        *_not_finished(files, read.checks),
        *(_note("is no segment by its name, or no file; it counts for nothing", name) for name in strays(path)),
        *_missing(coverage, utc),
        *_damaged(read),
        *_metadata(finished, read),
        *_texts(finished, read, journal),
        *(() if extent else _journal_and_end(read, coverage, journal, utc)),
        *_notes(read_notes(path)),
        *(() if extent else _steps_without_frames(read, coverage)),
        *_frames_lost(read),
        *_silences(read.contents),
        *_camera_temperature(read),
    )
    total = sum(check.messages for check in read.checks.values())
    is_recording = any(file.state is State.RECORDING for file in files)
    run = extent.run if extent else run_word(read.contents.events, journal, is_recording=is_recording)
    return Verification(findings, len(finished), total, len(read.metas), done_bytes, run)


def _checked(file: SegmentFile, read: _Read, report: Callable[[float, str], None], before_bytes: int) -> SegmentCheck:
    unreadable: list[Damage] = []

    def receive(message: Message) -> None:
        try:
            read.contents.receive(message)
        except SessionError as error:
            unreadable.append(Damage(str(error), message.time_ns, message.time_ns))

    check = check_segment(file.path, receive, lambda done_bytes: report(before_bytes + done_bytes, file.name))
    for description in check.descriptions:
        try:
            read.metas.append(decode_frame_meta(description))
        except SessionError as error:
            unreadable.append(Damage(str(error), -inf, inf))
    check.damages.extend(unreadable)
    return check


def _not_finished(files: Iterable[SegmentFile], checks: Mapping[str, SegmentCheck]) -> Iterator[Finding]:
    for file in files:
        match file.state:
            case State.UNFINISHED:
                yield _missing_part("is not finished; `stand session salvage` recovers what is in it", file.name)
            case State.DAMAGED if _is_recovered(file, checks.get(f"{file.series}/{file.number:04d}{FINISHED}")):
                yield _note(
                    "a salvage recovered every message and kept the original because it was finished and damaged; "
                    "remove it when it is not needed",
                    file.name,
                )
            case State.DAMAGED:
                yield _error("is an original that a salvage kept because it could not recover all of it", file.name)
            case State.RECORDING:
                yield _note("is being recorded now and was not read", file.name)
            case State.FINISHED:
                pass


def _is_recovered(kept: SegmentFile, salvaged: SegmentCheck | None) -> bool:
    return salvaged is not None and is_recovered(kept, salvaged.metadata.get(SALVAGE_METADATA, {}), salvaged.messages)


def _error(text: str, where: str = "") -> Finding:
    return Finding(Severity.ERROR, where, text, Files.DAMAGED)


def _missing_part(text: str, where: str = "") -> Finding:
    return Finding(Severity.ERROR, where, text, Files.INCOMPLETE)


def _note(text: str, where: str = "") -> Finding:
    return Finding(Severity.NOTE, where, text)


def _missing(coverage: Coverage, utc: UtcOffsets) -> Iterator[Finding]:
    """Segments are numbered from 0 without a gap; a copy of a session with gaps has them in its record."""
    for series in (TELEMETRY, FRAMES):
        numbers = {file.number for file in coverage.files if file.series == series}
        for number in sorted(foreign_numbers(numbers)):
            yield _error(
                f"is foreign: no segment of this session has a number beyond {MOST_MISSING} missing ones",
                f"{series}/{number:04d}.mcap",
            )
        for hole in missing_segments(series, numbers, coverage.links.values()):
            yield _missing_part(_are_missing(hole, utc), f"{series}/{hole.first:04d}.mcap")
        if not numbers and series == TELEMETRY:
            yield _missing_part("is missing", TELEMETRY)
    for hole in coverage.holes:
        found = _note if hole.excused else _missing_part
        yield found(f"missing in the session this was copied from: {hole.text(utc)}")


def _are_missing(hole: Hole, utc: UtcOffsets) -> str:
    if hole.first == hole.last:
        return "is missing"
    when = hole.when(utc)
    return f"is missing, and so are all up to {hole.last:04d}.mcap{f', {when}' if when else ''}"


def _journal_and_end(
    read: _Read, coverage: Coverage, journal: JournalFacts | None, utc: UtcOffsets
) -> Iterator[Finding]:
    """The journal by itself, and what it says that is not in the recording, nor in what is damaged of it."""
    contents = read.contents
    if journal is None and is_of_a_run(contents.events, contents.marks):
        yield _missing_part("is missing; what the recording itself says of the run counts", JOURNAL_NAME)
    if journal is not None and journal.damage:
        yield _error(journal.damage, JOURNAL_NAME)
    if journal is not None and journal.unended:
        yield _note(journal.unended, JOURNAL_NAME)
    telemetry = [file for file in coverage.files if file.series == TELEMETRY]
    damaged = {name for name, check in read.checks.items() if check.damages}
    if telemetry and telemetry[-1].name in damaged:
        return
    has_gap = (
        any(hole.series == TELEMETRY for hole in coverage.holes)
        or any(file.name in damaged or file.state is State.UNFINISHED for file in telemetry)
        or any(missing_segments(TELEMETRY, (file.number for file in telemetry), ()))
    )
    lost = lost_end(coverage, contents.events, () if has_gap else contents.marks, journal, utc)
    if lost is not None and lost.hole.first is not None:
        where = segments_text(TELEMETRY, lost.hole.first, None).partition(" ")[0]
        yield _missing_part(f"is missing, with all that followed: {lost.why}", where)


def _notes(said: Notes) -> Iterator[Finding]:
    """What people said of the session."""
    if said.damage:
        yield _error(said.damage, NOTES_NAME)
    if said.unended:
        yield _note(said.unended, NOTES_NAME)


def _damaged(read: _Read) -> Iterator[Finding]:
    for name, check in read.checks.items():
        for damage in check.damages:
            yield _error(f"is damaged: {damage.text}", name)


def _metadata(finished: list[SegmentFile], read: _Read) -> Iterator[Finding]:
    """Every segment names the same session, and its own place in it."""
    stated = {file.name: check.metadata for file, check in zip(finished, read.checks.values(), strict=True)}
    sessions = Counter(_entries(metadata.get(SESSION_METADATA)) for metadata in stated.values())
    for file in finished:
        metadata = stated[file.name]
        is_whole = SESSION_METADATA in metadata and SEGMENT_METADATA in metadata
        if not is_whole and read.checks[file.name].damages:
            continue  # a finding already
        if _entries(metadata.get(SESSION_METADATA)) != sessions.most_common(1)[0][0]:
            yield _error("belongs to another session than the other segments", file.name)
        segment, session = metadata.get(SEGMENT_METADATA, {}), metadata.get(SESSION_METADATA, {})
        if misplaced(file.series, file.number, segment, session):
            yield _error("records another place in the session than its name", file.name)
        if (salvage := metadata.get(SALVAGE_METADATA)) is not None:
            yield _note(f"was salvaged ({', '.join(f'{key}: {text}' for key, text in salvage.items())})", file.name)


def _texts(finished: list[SegmentFile], read: _Read, journal: JournalFacts | None) -> Iterator[Finding]:
    """Every segment has the same texts attached, and they are those that the run began with."""
    attached = {file.name: read.checks[file.name].texts for file in finished if not read.checks[file.name].damages}
    stated = Counter(tuple(sorted(texts.items())) for texts in attached.values())
    most = dict(stated.most_common(1)[0][0]) if stated else {}
    for name, texts in attached.items():
        if texts != most:
            yield _error("has other texts attached than the other segments", name)
    if journal is not None and attached:
        for name in journal.changed_texts(most):
            yield _error(f"{name} is not attached as the run began with it, by its journal")


def _entries(metadata: dict[str, str] | None) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((metadata or {}).items()))


def _steps_without_frames(read: _Read, coverage: Coverage) -> Iterator[Finding]:
    """Every step that is done has its frames; what was not read may have them."""
    if not all_frames_are_read(coverage) or any(hole.series == FRAMES for hole in coverage.holes):
        return
    contents, utc = read.contents, offsets_of(read.contents.events)
    shortages = find_shortages(contents.marks, contents.events, read.metas)
    is_whole = not any(check.damages for check in read.checks.values())
    is_whole &= not any(any(missing_segments(name, _numbers(coverage, name), ())) for name in (TELEMETRY, FRAMES))
    if is_whole and not shortages and (missing := frames_not_begun(contents.marks, contents.events, read.metas)):
        frames = "1 frame" if missing == 1 else f"{missing} frames"
        yield _missing_part(f"{frames} of the plan: missing, though the run is complete")
    for short in shortages:
        frames = "1 frame" if short.missing == 1 else f"{short.missing} frames"
        steps = short.step_ids[0] if len(short.step_ids) == 1 else f"{short.step_ids[0]} to {short.step_ids[-1]}"
        which = f"{frames} of {steps}, {utc.date_time(short.begin_ns)} to {utc.local_text(short.end_ns)}"
        if short.is_reported:
            yield _note(f"{which}: lost by the recorder, as its events say")
        elif not read.is_damaged(FRAMES):
            yield _missing_part(f"{which}: missing, though their steps are done")


def _numbers(coverage: Coverage, series: str) -> set[int]:
    return {file.number for file in coverage.files if file.series == series}


def _frames_lost(read: _Read) -> Iterator[Finding]:
    """What the recorder, and what camera and wire lost, as recorded."""
    contents = read.contents
    utc = offsets_of(contents.events)
    for event in contents.events:
        if event.kind == FRAMES_DROPPED:
            yield _note(f"{utc.local_text(event.time_ns)}: {event.text}")
    dropped: Counter[str] = Counter()
    for meta in read.metas:
        dropped[meta.step_id] += meta.dropped
    steps = {mark.step_id: f"step {mark.index + 1} ({mark.kind})" for mark in contents.marks}
    for step_id, count in dropped.items():
        if count:
            lost = "1 frame" if count == 1 else f"{count} frames"
            yield _note(f"{lost} of {steps.get(step_id, 'no step')} lost by the camera or its wire")


def _camera_temperature(read: _Read) -> Iterator[Finding]:
    if has_temperature(read.metas) is False:
        yield _note(f"{NO_TEMPERATURE}: no drift over temperature can be fitted to them")


def _silences(contents: Contents) -> Iterator[Finding]:
    utc = offsets_of(contents.events)
    for silence in silences({name: channel.sorted_times_ns() for name, channel in contents.channels.items()}):
        yield _note(silence.text(utc))
