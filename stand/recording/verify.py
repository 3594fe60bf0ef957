"""Is a recorded session whole? Reads every byte of it and says what is damaged or missing, a sentence each.

An error is something that was recorded and cannot be trusted or is not there; a note is a hole in what was measured
that the recording itself tells of: silence of a device, frames the camera or a slow disk lost, a salvaged segment.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from math import inf
from pathlib import Path

from mcap.records import DataEnd
from mcap.records import Message as StoredMessage
from mcap.stream_reader import StreamReader

from drivers.clock import NS_PER_S
from drivers.interface import SessionError
from stand.recording.contents import RUN_END, Contents, FrameKey
from stand.recording.damage import DAMAGE
from stand.recording.gaps import FRAMES_DROPPED, silences, told_blocks
from stand.recording.images import CAMERA_IMAGE
from stand.recording.inventory import SegmentFile, State, inventory
from stand.recording.layout import (
    FINISHED,
    FRAMES,
    SEGMENT_METADATA,
    SESSION_CRC,
    SESSION_METADATA,
    TELEMETRY,
    segment_metadata,
)
from stand.recording.records import Message
from stand.recording.salvage import SALVAGE_METADATA
from stand.recording.segment_check import Damage, SegmentCheck, check_segment
from stand.recording.utc_offsets import UtcOffsets, offsets_of

# Between the middle of a frame's exposure and its description being on the disk, or the frame itself.
TORN_NS = 5 * NS_PER_S


class Severity(StrEnum):
    """error: damaged or missing. note: a hole in the data that is recorded as such."""

    ERROR = "error"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class Finding:
    """One sentence; `where` is the file it is about, as in `telemetry/0003.mcap`, or "" for the whole session."""

    severity: Severity
    where: str
    text: str

    def __str__(self) -> str:
        return f"{self.severity}: {self.where}{': ' if self.where else ''}{self.text}"


@dataclass(frozen=True, slots=True)
class Verification:
    """What was read (finished segments) and what was found."""

    findings: tuple[Finding, ...]
    segments: int
    messages: int
    frames: int
    bytes: int

    @property
    def is_sound(self) -> bool:
        """Nothing is damaged or missing."""
        return not any(finding.severity is Severity.ERROR for finding in self.findings)


@dataclass
class _Read:
    """What the finished ones of `files` hold, their checks by their names."""

    files: tuple[SegmentFile, ...]
    contents: Contents = field(default_factory=Contents)
    images: Counter[FrameKey] = field(default_factory=Counter[FrameKey])
    checks: dict[str, SegmentCheck] = field(default_factory=dict[str, SegmentCheck])

    def receive(self, message: Message) -> None:
        """Keep what is compared later; SessionError when the message cannot be read."""
        if message.topic == CAMERA_IMAGE:
            self.images[message.time_ns, message.sequence] += 1
        else:
            self.contents.receive(message)

    def is_damaged_at(self, series: str, time_ns: int) -> bool:
        """What the series held of that instant may be in damage that is a finding already."""
        return any(
            damage.begin_ns <= time_ns <= damage.end_ns
            for name, check in self.checks.items()
            if name.startswith(f"{series}/")
            for damage in check.damages
        )

    def is_torn_at(self, series: str, time_ns: int) -> bool:
        """The series lost what it held of that instant because the recorder was killed: it lies behind the end of a
        salvaged segment and before the next one, or right behind the last segment of a run without an end."""
        checks = [check for name, check in self.checks.items() if name.startswith(f"{series}/")]
        is_ended = any(event.kind == RUN_END for event in self.contents.events)
        late_ns = _late_ns(series)
        next_ns = [*(check.first_ns for check in checks[1:]), inf]
        for check, end_ns in zip(checks, next_ns, strict=False):  # without any check there is no next either
            if SALVAGE_METADATA in check.metadata:
                torn_ns = end_ns
            elif end_ns == inf and not is_ended:
                torn_ns = check.last_ns + TORN_NS
            else:
                continue
            if check.last_ns - late_ns < time_ns < torn_ns:
                return True
        return False

    def unread(self, series: str) -> list[tuple[float, float]]:
        """Between which instants the series goes on in segments that were not read: from the end of one that was to
        the begin of the next. A recorder at work may be about to write what comes behind the last one."""
        stretches: list[tuple[float, float]] = []
        begin_ns, is_open, number = -inf, False, -1
        for file in self.files:
            check = self.checks.get(file.name)
            if file.series != series or (check is None and file.number == number):
                continue  # what was left beside a finished segment of the same number counts for nothing
            if check is None:
                is_open |= file.state is not State.DAMAGED
                continue
            number = file.number
            if check.messages:
                stretches += [(begin_ns, check.first_ns)] if is_open else []
                begin_ns, is_open = check.last_ns - _late_ns(series), False
        if is_open or any(file.state is State.RECORDING for file in self.files):
            stretches.append((begin_ns, inf))
        return stretches


def _late_ns(series: str) -> int:
    """How long before the end of a segment something may have been that is in the next one."""
    return TORN_NS if series == TELEMETRY else 0  # a description is written after what happened meanwhile


def _no_report(done_bytes: float, text: str) -> None:
    """Nobody watches."""


def verify(path: Path, report: Callable[[float, str], None] = _no_report) -> Verification:
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
    findings = (
        *_not_finished(files, read.checks),
        *_missing(files),
        *_damaged(read),
        *_metadata(finished, read),
        *_frames_against_descriptions(read),
        *_frames_lost(read.contents),
        *_silences(read.contents),
    )
    total = sum(check.messages for check in read.checks.values())
    return Verification(findings, len(finished), total, read.images.total(), done_bytes)


def _checked(file: SegmentFile, read: _Read, report: Callable[[float, str], None], before_bytes: int) -> SegmentCheck:
    unreadable: list[Damage] = []

    def receive(message: Message) -> None:
        try:
            read.receive(message)
        except SessionError as error:
            unreadable.append(Damage(str(error), message.time_ns, message.time_ns))

    check = check_segment(file.path, receive, lambda done_bytes: report(before_bytes + done_bytes, file.name))
    check.damages.extend(unreadable)
    return check


def _not_finished(files: Iterable[SegmentFile], checks: Mapping[str, SegmentCheck]) -> Iterator[Finding]:
    for file in files:
        match file.state:
            case State.UNFINISHED:
                yield _error("is not finished; `stand session salvage` recovers what is in it", file.name)
            case State.DAMAGED if _is_recovered(file, checks.get(f"{file.series}/{file.number:04d}{FINISHED}")):
                yield _note(
                    "a salvage recovered every message and kept the original because it was finished and damaged; "
                    "remove it when it is not needed",
                    file.name,
                )
            case State.DAMAGED:
                yield _error("is what a salvage kept of a segment because it could not recover all of it", file.name)
            case State.RECORDING:
                yield _note("is being recorded now and was not read", file.name)
            case State.FINISHED:
                pass


def _is_recovered(kept: SegmentFile, salvaged: SegmentCheck | None) -> bool:
    """Whether the salvaged segment has every message of the original: its salvage lost no byte, and both have as many.
    The original must go on to the end of its data; of one that was cut short nobody knows how many it had."""
    if salvaged is None or salvaged.metadata.get(SALVAGE_METADATA, {}).get("lost_bytes") != "0":
        return False
    messages = 0
    try:
        with kept.path.open("rb") as file:
            for record in StreamReader(file, validate_crcs=True, record_size_limit=kept.size_bytes).records:
                if isinstance(record, DataEnd):
                    return messages == salvaged.messages
                messages += isinstance(record, StoredMessage)
    except DAMAGE:
        pass
    return False


def _error(text: str, where: str = "") -> Finding:
    return Finding(Severity.ERROR, where, text)


def _note(text: str, where: str = "") -> Finding:
    return Finding(Severity.NOTE, where, text)


def _missing(files: Iterable[SegmentFile]) -> Iterator[Finding]:
    """Segments are numbered from 0 without a hole."""
    numbers: dict[str, set[int]] = {}
    for file in files:
        numbers.setdefault(file.series, set()).add(file.number)
    for series, present in numbers.items():
        for number in sorted(set(range(max(present))) - present):
            yield _error("is missing", f"{series}/{number:04d}.mcap")
    if TELEMETRY not in numbers:
        yield _error("is missing", TELEMETRY)


def _damaged(read: _Read) -> Iterator[Finding]:
    for name, check in read.checks.items():
        for damage in check.damages:
            yield _error(f"is damaged: {damage.text}", name)


def _metadata(finished: list[SegmentFile], read: _Read) -> Iterator[Finding]:
    """Every segment tells of the same session, and of its own place in it."""
    told = {file.name: check.metadata for file, check in zip(finished, read.checks.values(), strict=True)}
    sessions = Counter(_entries(metadata.get(SESSION_METADATA)) for metadata in told.values())
    for file in finished:
        metadata = told[file.name]
        is_whole = SESSION_METADATA in metadata and SEGMENT_METADATA in metadata
        if not is_whole and read.checks[file.name].damages:
            continue  # a finding already
        if _entries(metadata.get(SESSION_METADATA)) != sessions.most_common(1)[0][0]:
            yield _error("tells of another session than the other segments", file.name)
        segment, session = metadata.get(SEGMENT_METADATA, {}), metadata.get(SESSION_METADATA, {})
        place = segment_metadata(file.series, file.number, session)
        if segment.keys() - place.keys() or any(segment.get(key) != place[key] for key in place.keys() - {SESSION_CRC}):
            yield _error("tells of another place in the session than its name does", file.name)
        if (salvage := metadata.get(SALVAGE_METADATA)) is not None:
            yield _note(f"was salvaged ({', '.join(f'{key}: {text}' for key, text in salvage.items())})", file.name)


def _entries(metadata: dict[str, str] | None) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((metadata or {}).items()))


def _frames_against_descriptions(read: _Read) -> Iterator[Finding]:
    """Every image has its description in the telemetry and the other way round; what was not read may have it."""
    described = Counter(key for key, _ in read.contents.metas)
    block_ids = {key: meta.block_id for key, meta in read.contents.metas}
    told, utc = told_blocks(read.contents.events), offsets_of(read.contents.events)
    bare = _without_a_reason(read.images - described, TELEMETRY, read)
    gone = _without_a_reason(described - read.images, FRAMES, read)
    bare_torn = [key for key in bare if read.is_torn_at(TELEMETRY, key[0])]
    gone_told = [key for key in gone if any(block_ids[key] in blocks for blocks in told)]
    gone_torn = [key for key in gone if key not in gone_told and read.is_torn_at(FRAMES, key[0])]
    yield from _frames(_error, set(bare) - {*bare_torn}, "without a description in the telemetry", utc)
    yield from _frames(_error, set(gone) - {*gone_told, *gone_torn}, "missing, though described in the telemetry", utc)
    yield from _frames(_note, gone_told, "described but lost by the recorder, as its events say", utc)
    yield from _frames(_note, bare_torn, "without a description, which was lost when the recorder was killed", utc)
    yield from _frames(_note, gone_torn, "described but lost when the recorder was killed", utc)


def _without_a_reason(keys: Iterable[FrameKey], series: str, read: _Read) -> list[FrameKey]:
    """Those that no finding about a segment of `series` explains."""
    unread = read.unread(series)
    return [
        key
        for key in keys
        if not read.is_damaged_at(series, key[0]) and not any(begin < key[0] < end for begin, end in unread)
    ]


def _frames(
    kind: Callable[[str], Finding], keys: Collection[FrameKey], what: str, utc: UtcOffsets
) -> Iterator[Finding]:
    """One finding for all frames of a kind."""
    if keys:
        times_ns, blocks = sorted(time_ns for time_ns, _ in keys), sorted(block for _, block in keys)
        if len(keys) == 1:
            yield kind(f"1 frame is {what}: block {blocks[0]}, {utc.date_time(times_ns[0])} UTC")
            return
        yield kind(
            f"{len(keys)} frames are {what}: blocks {blocks[0]} to {blocks[-1]}, "
            f"{utc.date_time(times_ns[0])} to {utc.date_time(times_ns[-1])} UTC"
        )


def _frames_lost(contents: Contents) -> Iterator[Finding]:
    """What the recorder, and what camera and wire lost, as recorded."""
    utc = offsets_of(contents.events)
    for event in contents.events:
        if event.kind == FRAMES_DROPPED:
            yield _note(f"{utc.date_time(event.time_ns)} UTC: {event.text}")
    dropped: Counter[str] = Counter()
    for _, meta in contents.metas:
        dropped[meta.step_id] += meta.dropped
    steps = {mark.step_id: f"step {mark.index} ({mark.kind})" for mark in contents.marks}
    for step_id, count in dropped.items():
        if count:
            lost = "1 frame" if count == 1 else f"{count} frames"
            yield _note(f"{lost} of {steps.get(step_id, 'no step')} lost by the camera or its wire")


def _silences(contents: Contents) -> Iterator[Finding]:
    utc = offsets_of(contents.events)
    for silence in silences({name: channel.sorted_times_ns() for name, channel in contents.channels.items()}):
        yield _note(silence.text(utc))
