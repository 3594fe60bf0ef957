"""What a session is, and what is wrong with it or missing: the one look at it that lists, info, verify, export, fit and
page ask.

How deep it looks is for the caller to say (Depth): a list reads both ends of each file, `verify` every byte. What it
finds are sentences, the same at any depth. An error is something that was recorded and cannot be trusted, or is not
there; a note is a hole in what was measured that the recording itself reports: silence of a device, frames that the
camera or a slow disk lost, a repaired segment. How the run ended is another matter: a stopped run has sound files.

What should be there is known from `session.json` (format/manifest.py), from the numbers of the segments, from the steps
and their frames, and from the run's journal, whose entries are on the disk after what they describe.
"""

from __future__ import annotations

import hashlib
import math
import re
from array import array
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, fields, replace
from enum import IntEnum, StrEnum
from functools import cached_property
from math import inf
from operator import attrgetter
from pathlib import Path

import numpy as np
from mcap.records import Channel, DataEnd
from mcap.records import Message as StoredMessage
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import FRAMES_DROPPED, RUN_BEGINS, RUN_END, TELL_PLAN
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.format import messages
from thermostand.recording.format.batches import READINGS, disambiguate_channel
from thermostand.recording.format.capture_restarts import find_restart_times, is_superseded
from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.holes import Hole, format_segments, parse_holes
from thermostand.recording.format.images import name_frame_topics
from thermostand.recording.format.inventory import (
    MOST_MISSING,
    SegmentFile,
    SegmentState,
    explain_changed_names,
    find_foreign_numbers,
    find_missing_numbers,
    is_misplaced,
    list_segments,
    list_strays,
)
from thermostand.recording.format.journal_lines import JOURNAL_NAME, JournalFacts, hash_text, read_journal_facts
from thermostand.recording.format.layout import (
    FINISHED,
    FRAMES,
    SALVAGE_METADATA,
    SEGMENT_METADATA,
    SESSION_METADATA,
    TELEMETRY,
    explain_unknown_format,
)
from thermostand.recording.format.manifest import MANIFEST_NAME, Manifest, NoManifest, SessionInfo, read_manifest
from thermostand.recording.format.mcap_bytes import Source
from thermostand.recording.format.mcap_contents import McapContents
from thermostand.recording.format.messages import FrameMeta, decode_frame_meta
from thermostand.recording.format.records import (
    RecordedMessage,
    find_strangers,
    list_frame_places,
    read_head,
    read_telemetry_messages,
)
from thermostand.recording.format.utc_offsets import REPEATED_NS, UtcOffsets, collect_offsets
from thermostand.recording.reading.gaps import count_lost_frames, find_silences, list_reported_blocks
from thermostand.recording.reading.notes import NOTES_NAME, read_notes
from thermostand.recording.reading.run_status import (
    Files,
    RunOutcome,
    determine_run_outcome,
    find_last_run_event,
    parse_extent,
)
from thermostand.recording.reading.segment_check import SegmentDamage, check_segment, judge_rewritten
from thermostand.recording.reading.segment_scan import scan_segment

Report = Callable[[float, str], None]
NO_TEMPERATURE = "no frame has a good camera temperature"
CAPTURE = "capture"
_GRAVEST_FIRST = (Files.DAMAGED, Files.CHANGED, Files.INCOMPLETE, Files.UNKNOWN)
# The journal may be ahead of telemetry that waits for its next commit, on a virtual clock for 20 s.
# Three commits of virtual time; a journal that is further ahead has lost telemetry.
AHEAD_NS = 60 * NS_PER_S
_LAST = 2  # segments of the telemetry: a run's end is recorded before its stand is safe, which may take ten minutes


class Depth(IntEnum):
    """How much is read. ENDS: both ends of each file, and the events near both ends of the run. STEPS: all events,
    steps and descriptions of frames. TELEMETRY: all readings, too. BYTES: every byte."""

    ENDS = 0
    STEPS = 1
    TELEMETRY = 2
    BYTES = 3


class Severity(StrEnum):
    """error: damaged or missing. note: a hole in the data that is recorded as such."""

    ERROR = "error"
    NOTE = "note"


@dataclass(frozen=True, slots=True)
class SessionFinding:
    """One sentence; `where` is the file it is about, as in `telemetry/0003.mcap`, or "" for the whole session. `files`:
    what an error makes of the session's files, sound for a note."""

    severity: Severity
    where: str
    text: str
    files: Files = Files.SOUND

    def __str__(self) -> str:
        return f"{self.severity}: {self.sentence}"

    @property
    def sentence(self) -> str:
        """Where, and what."""
        return f"{self.where}{': ' if self.where else ''}{self.text}"


@dataclass(frozen=True, slots=True)
class ChannelReadings:
    """The readings of one channel in the order they came."""

    unit: str
    times_ns: array[int] = field(default_factory=lambda: array("q"))
    values: array[float] = field(default_factory=lambda: array("d"))

    def sorted_times_ns(self) -> NDArray[np.int64]:
        """The instants, ascending, shape (n,)."""
        return np.sort(np.array(self.times_ns, np.int64))


@dataclass
class Recorded:
    """What was read, but for the images: `channels` by their names, `metas` of the frames."""

    events: list[Event] = field(default_factory=list[Event])
    marks: list[StepMark] = field(default_factory=list[StepMark])
    channels: dict[str, ChannelReadings] = field(default_factory=dict[str, ChannelReadings])
    metas: list[FrameMeta] = field(default_factory=list[FrameMeta])

    def receive(self, message: RecordedMessage) -> None:
        """Keep what a message of the telemetry says; SessionError when it cannot be read."""
        if message.form is not None:
            for reading in message.form.decode(message.data, message.time_ns).readings:
                channel = self.channels.setdefault(reading.channel, ChannelReadings(reading.unit))
                if channel.unit != reading.unit:
                    name = disambiguate_channel(reading.channel, reading.unit, channel.unit)
                    channel = self.channels.setdefault(name, ChannelReadings(reading.unit))
                channel.times_ns.append(reading.time_ns)
                channel.values.append(reading.value)
            return
        match message.topic:
            case messages.EVENT:
                self.events.append(messages.decode_event(message.data, message.time_ns))
            case messages.STEP:
                self.marks.append(messages.decode_step(message.data, message.time_ns))
            case _:
                pass  # what viewers read: the same things in another form


@dataclass
class ScannedSegment:
    """A finished segment, as far as it was read: its records, its texts, how many messages it has and between which
    instants. sha256: of its bytes, "" when not all were read. rewritten: the contents of one that another program has
    written. damages: what is wrong with it."""

    file: SegmentFile
    session: Mapping[str, str] = field(default_factory=dict[str, str])
    place: Mapping[str, str] = field(default_factory=dict[str, str])
    salvage: Mapping[str, str] = field(default_factory=dict[str, str])
    texts: Mapping[str, str] = field(default_factory=dict[str, str])
    messages: int = 0
    first_ns: float = inf
    last_ns: float = -inf
    sha256: str = ""
    rewritten: McapContents | None = None
    damages: list[SegmentDamage] = field(default_factory=list[SegmentDamage])

    @property
    def is_described(self) -> bool:
        """Whether its records say which session it is of, and which place it has in that."""
        return bool(self.session and self.place)


@dataclass(frozen=True)
class Scan:
    """A session that was looked at. metadata, attachments: those that most segments have. begin_ns, end_ns: log times
    of the first and the last message of the finished segments, None when they hold none; `messages` and `frames` are
    theirs, too. holes: what is not there, of the telemetry first; those that are excused make it no less whole. utc: to
    UTC, by the events that were read. run: how the run ended. has_camera_degC: whether any frame has a good camera
    temperature, None when no description of a frame can be read. planned: how many frames the plan has, None when that
    is not known. recorded: what was read, by the depth."""

    path: Path
    depth: Depth
    inventory: tuple[SegmentFile, ...]
    metadata: dict[str, str]
    attachments: dict[str, str]
    segments: int
    messages: int
    frames: int
    bytes: int
    begin_ns: int | None
    end_ns: int | None
    findings: tuple[SessionFinding, ...]
    holes: tuple[Hole, ...]
    utc: UtcOffsets
    run: RunOutcome
    has_camera_degC: bool | None
    planned: int | None
    recorded: Recorded

    @property
    def files(self) -> Files:
        """The gravest of what was found."""
        words = {finding.files for finding in self.findings}
        return next((word for word in _GRAVEST_FIRST if word in words), Files.SOUND)

    @property
    def is_sound(self) -> bool:
        """Whether nothing is damaged or missing, or of another version."""
        return self.files is Files.SOUND

    def sentences(self, files: Files) -> tuple[str, ...]:
        """Return the sentences about what puts the files in that state."""
        return tuple(finding.sentence for finding in self.findings if finding.files is files)

    @property
    def state_text(self) -> str:
        """The word with its first reason: `incomplete: telemetry/0003.mcap: is missing`."""
        reasons = () if self.is_sound else self.sentences(self.files)
        more = f" and {len(reasons) - 1} more" if len(reasons) > 1 else ""
        return f"{self.files}: {reasons[0]}{more}" if reasons else str(self.files)

    @property
    def size_bytes(self) -> int:
        """All segments, also those that are not finished."""
        return sum(file.size_bytes for file in self.inventory)

    @property
    def simulated(self) -> bool:
        """The devices were fakes."""
        return self.metadata.get("simulated") == "true"

    @property
    def lacks(self) -> str:
        """What a fit would miss in these frames, in words; "" when there is nothing."""
        return NO_TEMPERATURE if self.has_camera_degC is False else ""

    def count(self, state: SegmentState) -> int:
        """Return how many segments are in that state."""
        return sum(file.state is state for file in self.inventory)


_ALIKE = 10  # lines that differ in numbers only; more of them are one line with a count


def summarise_findings(findings: Iterable[SessionFinding]) -> list[str]:
    """The findings as lines. Where more than ten differ in nothing but numbers, the first stands for all of them."""
    lines = [str(finding) for finding in findings]
    kinds = [re.sub(r"\d+", "0", line) for line in lines]
    counts, found = Counter(kinds), dict[str, str]()
    for line, kind in zip(lines, kinds, strict=True):
        if counts[kind] <= _ALIKE:
            found[line] = line
        else:
            found.setdefault(kind, f"{line} (and {counts[kind] - 1} more like this)")
    return list(found.values())


def _no_report(share: float, text: str) -> None:
    """Show no progress."""


def verify(path: Path, report: Report = _no_report) -> Scan:
    """Read every byte of a session and judge it.

    Parameters
    ----------
    path
        The session's folder.
    report
        Is called with the bytes read so far and the segment.

    Returns
    -------
    Scan
        What was found. Damage is not raised, it is among the findings of the result.

    Raises
    ------
    SessionError
        When `path` is no session.
    """
    return scan(path, Depth.BYTES, report)


def scan(path: Path, depth: Depth = Depth.ENDS, report: Report = _no_report) -> Scan:
    """The session in `path`, as far as `depth` says; as `verify`. Where its ends show fewer frames than its plan, and
    nothing that explains it, its steps are read as well."""
    strangers = find_strangers(path)
    files = tuple(file for file in list_segments(path) if file.name not in strangers)
    if not files:
        why = explain_changed_names(path) or f"there is no segment in its folders {TELEMETRY} and {FRAMES}"
        raise SessionError(f"{path}: not a session: {why}")
    look = _SessionScanner(path, files, strangers, depth)
    look.read(report)
    found = look.build_result()
    is_quiet = found.is_sound and not any(file.state is SegmentState.RECORDING for file in files)
    if depth is Depth.ENDS and is_quiet and (found.run is not RunOutcome.COMPLETE or look.frames_short()):
        deeper = scan(path, Depth.STEPS, report)
        return replace(deeper, recorded=found.recorded)  # a list keeps no more in memory than it reads
    return found


def _is_wanted(channel: Channel) -> bool:
    return True


def _is_near(channel: Channel) -> bool:
    return channel.topic in (messages.EVENT, messages.STEP)


class _SessionScanner:
    """One look at a session: what was read of it, and then what that means."""

    def __init__(self, path: Path, files: tuple[SegmentFile, ...], strangers: Mapping[str, str], depth: Depth) -> None:
        self._path = path
        self._files = files
        self._strangers = strangers
        self._depth = depth
        self._seen: list[ScannedSegment] = []
        self._recorded = Recorded()
        self._read_bytes = 0

    # Reading

    def read(self, report: Report) -> None:
        for file in self._files:
            if file.state is SegmentState.FINISHED:
                self._seen.append(
                    self._read_every_byte(file, report) if self._depth is Depth.BYTES else self._read_ends(file)
                )
        if self._depth is Depth.BYTES:
            return
        sound = [each for each in self._seen if not each.damages]
        self._read_telemetry([each for each in sound if each.file.series == TELEMETRY])
        if self._depth is not Depth.ENDS:
            for each in sound:
                if each.file.series == FRAMES:
                    with self._catch_damage(each):
                        self._recorded.metas.extend(place.meta for place in list_frame_places(each.file.path))

    def _read_ends(self, file: SegmentFile) -> ScannedSegment:
        seen = ScannedSegment(file)
        with self._catch_damage(seen):
            head = read_head(file.path)
            seen.session, seen.place, seen.salvage, seen.texts = (
                head.session,
                head.place,
                head.salvaged,
                head.attachments,
            )
            seen.messages, span, seen.rewritten = head.span.count, head.span, head.rewritten
            if span.count:
                seen.first_ns, seen.last_ns = span.first_ns, span.last_ns
        return seen

    def _catch_damage(self, seen: ScannedSegment) -> _DamageCatcher:
        return _DamageCatcher(self._path, seen)

    def _read_telemetry(self, telemetry: Sequence[ScannedSegment]) -> None:
        """All of it, or (ENDS) what the first segment and those of the last minutes say of the run and of UTC."""
        last_ns = max((each.last_ns for each in telemetry), default=0) - REPEATED_NS - NS_PER_S
        is_all, wants_all = self._depth is not Depth.ENDS, self._depth is Depth.TELEMETRY
        for index, each in enumerate(telemetry):
            if is_all or not index or each.last_ns >= last_ns or index >= len(telemetry) - _LAST:
                unseen = ScannedSegment(each.file)  # a list does not report what it only met by the way
                with self._catch_damage(each if is_all else unseen):
                    for message in read_telemetry_messages(each.file.path, _is_wanted if wants_all else _is_near):
                        self._recorded.receive(message)

    def _read_every_byte(self, file: SegmentFile, report: Report) -> ScannedSegment:
        unreadable: list[SegmentDamage] = []

        def receive(message: RecordedMessage) -> None:
            try:
                self._recorded.receive(message)
            except SessionError as error:
                unreadable.append(SegmentDamage(str(error), message.time_ns, message.time_ns))

        before_bytes = self._read_bytes
        check = check_segment(file.path, receive, lambda done_bytes: report(before_bytes + done_bytes, file.name))
        self._read_bytes += file.size_bytes
        for description in check.descriptions:
            try:
                self._recorded.metas.append(decode_frame_meta(description))
            except SessionError as error:
                unreadable.append(SegmentDamage(str(error), -inf, inf))
        strange = [name for name, text in check.texts.items() if not _is_utf_8(text)]
        unreadable += [SegmentDamage(f"{name}, which is attached, is not UTF-8") for name in strange]
        return ScannedSegment(
            file,
            session=check.metadata.get(SESSION_METADATA, {}),
            place=check.metadata.get(SEGMENT_METADATA, {}),
            salvage=check.metadata.get(SALVAGE_METADATA, {}),
            texts=check.texts,
            messages=check.messages,
            first_ns=check.first_ns,
            last_ns=check.last_ns,
            sha256=check.sha256,
            rewritten=check.rewritten,
            damages=[*check.damages, *unreadable],
        )

    # Judging

    def build_result(self) -> Scan:
        described = [each for each in self._seen if each.session]
        self._metadata, self._texts = self._find_opening(described)
        self._extent = parse_extent(self._metadata)
        self._journal = read_journal_facts(self._path)
        self._manifest = read_manifest(self._path)
        self._utc = collect_offsets(self._recorded.events)
        self._is_recording = any(file.state is SegmentState.RECORDING for file in self._files)
        self._lost_end = None if self._extent else self._find_lost_end()
        with_messages = [each for each in self._seen if each.messages]
        run = (
            self._extent.run
            if self._extent
            else determine_run_outcome(self._recorded.events, self._journal, is_recording=self._is_recording)
        )
        self._run = run
        return Scan(
            path=self._path,
            depth=self._depth,
            inventory=self._files,
            metadata=dict(self._metadata),
            attachments=dict(self._texts),
            segments=len(self._seen),
            messages=sum(each.messages for each in self._seen),
            frames=self._count_frames(),
            bytes=self._read_bytes,
            begin_ns=min((int(each.first_ns) for each in with_messages), default=None),
            end_ns=max((int(each.last_ns) for each in with_messages), default=None),
            findings=tuple(dict.fromkeys(self._iterate_findings())),
            holes=self._collect_holes(),
            utc=self._utc,
            run=run,
            has_camera_degC=self._has_camera_degC(),
            planned=self._find_planned_count(),
            recorded=self._recorded,
        )

    def _count_frames(self) -> int:
        if self._depth is Depth.BYTES:
            return len(self._recorded.metas)
        return sum(each.messages // 2 for each in self._select_series(FRAMES))

    def _select_series(self, series: str) -> list[ScannedSegment]:
        return [each for each in self._seen if each.file.series == series]

    def _find_opening(self, described: Sequence[ScannedSegment]) -> tuple[Mapping[str, str], Mapping[str, str]]:
        """Metadata `session` and the attachments: those that most finished segments have, else those of the first other
        segment that has them; empty when none has."""
        if described:
            most = dict(Counter(tuple(sorted(each.session.items())) for each in described).most_common(1)[0][0])
            texts = Counter(tuple(sorted(each.texts.items())) for each in described if not each.damages)
            own = next(each for each in described if dict(each.session) == most)
            return own.session, dict(texts.most_common(1)[0][0]) if texts else own.texts
        for file in self._files:
            with suppress(OSError), file.path.open("rb") as opened:
                found = scan_segment(Source(opened.fileno()), to_first_chunk=True)
                if found.session is not None:
                    texts = {name: each.data.decode(errors="replace") for name, each in found.attachments.items()}
                    return found.session, texts
        return {}, {}

    def _iterate_findings(self) -> Iterator[SessionFinding]:
        yield from _check_format(self._metadata)
        if self._extent is not None:
            yield _make_note(self._extent.text(self._utc))
        yield from self._find_unfinished()
        for name in list_strays(self._path):
            yield _make_note("is no segment by its name, or no file; it counts for nothing", name)
        for name, text in self._strangers.items():
            yield _make_note(text, name)
        yield from self._find_missing()
        for each in self._seen:
            for damage in each.damages:
                yield _make_error(f"is damaged: {damage.text}", each.file.name)
        yield from self._find_misfits()
        yield from self._find_changed_texts()
        yield from self._compare_manifest()
        if self._extent is None:
            yield from self._check_journal_and_end()
        yield from _check_notes(self._path)
        if self._depth is not Depth.ENDS and self._extent is None:
            yield from self._find_steps_without_frames()
        yield from self._find_silent_devices()
        if self._depth is Depth.BYTES:
            yield from _find_lost_frames(self._recorded, self._utc)
            times_ns = {name: channel.sorted_times_ns() for name, channel in self._recorded.channels.items()}
            for silence in find_silences(times_ns):
                yield _make_note(silence.text(self._utc))
            if self._has_camera_degC() is False:
                yield _make_note(f"{NO_TEMPERATURE}: no drift over temperature can be fitted to them")

    def _find_unfinished(self) -> Iterator[SessionFinding]:
        by_name = {each.file.name: each for each in self._seen}
        kept = Counter((file.series, file.number) for file in self._files if file.state is SegmentState.DAMAGED)
        for file in self._files:
            match file.state:
                case SegmentState.UNFINISHED:
                    yield _make_missing("is not finished; `stand session repair` recovers what is in it", file.name)
                case SegmentState.DAMAGED if _is_recovered(
                    file, by_name.get(f"{file.series}/{file.number:04d}{FINISHED}"), kept[file.series, file.number] == 1
                ):
                    yield _make_note(
                        "a repair recovered every message and kept the original because it was finished and damaged; "
                        "remove it when it is not needed",
                        file.name,
                    )
                case SegmentState.DAMAGED:
                    yield _make_error(
                        "is an original that a repair kept because it could not recover all of it", file.name
                    )
                case SegmentState.RECORDING:
                    yield _make_note("is being recorded now and was not read", file.name)
                case SegmentState.FINISHED:
                    pass

    def _find_missing(self) -> Iterator[SessionFinding]:
        """Segments are numbered from 0 without a gap; a copy of a session with gaps has them in its record."""
        for series in (TELEMETRY, FRAMES):
            numbers = {file.number for file in self._files if file.series == series}
            for number in sorted(find_foreign_numbers(numbers)):
                yield _make_error(
                    f"is foreign: no segment of this session has a number beyond {MOST_MISSING} missing ones",
                    f"{series}/{number:04d}.mcap",
                )
            for hole in self._list_gaps(series):
                text = "is missing"
                if hole.first != hole.last:
                    when = hole.format_time(self._utc)
                    text += f", and so are all up to {hole.last:04d}.mcap{f', {when}' if when else ''}"
                yield _make_missing(text, f"{series}/{hole.first or 0:04d}.mcap")
            if not any(file.series == TELEMETRY for file in self._files) and series == TELEMETRY:
                yield _make_missing("is missing", TELEMETRY)
        for hole in self._recorded_holes:
            found = _make_note if hole.excused else _make_missing
            yield found(f"missing in the session this was copied from: {hole.text(self._utc)}")

    @property
    def _recorded_holes(self) -> tuple[Hole, ...]:
        return parse_holes(self._metadata.get("holes", ""))

    def _list_gaps(self, series: str) -> list[Hole]:
        """The ranges of segments that are not there, with the instants around them."""
        read = sorted(
            (each for each in self._select_series(series) if each.messages), key=lambda each: each.file.number
        )
        found: list[Hole] = []
        for first, last in find_missing_numbers(file.number for file in self._files if file.series == series):
            before = [each.last_ns for each in read if each.file.number < first]
            after = [each.first_ns for each in read if each.file.number > last]
            begin_ns, end_ns = int(max(before)) if before else None, int(min(after)) if after else None
            found.append(Hole(series, first, last, begin_ns, end_ns))
        return found

    def _find_misfits(self) -> Iterator[SessionFinding]:
        """Every segment names the same session, and its own place in it."""
        for each in self._seen:
            file = each.file
            if not each.is_described and each.damages:
                continue  # a finding already
            if dict(each.session) != dict(self._metadata):
                yield _make_error("belongs to another session than the other segments", file.name)
            if is_misplaced(file.series, file.number, each.place, each.session):
                yield _make_error("records another place in the session than its name", file.name)
            if each.salvage:
                repairs = ", ".join(f"{key}: {text}" for key, text in each.salvage.items())
                yield _make_note(f"was repaired ({repairs})", file.name)

    def _find_changed_texts(self) -> Iterator[SessionFinding]:
        """Every segment has the same texts attached, and they are those that the recording began with."""
        sound = [each for each in self._seen if not each.damages and dict(each.session) == dict(self._metadata)]
        for each in sound:
            if dict(each.texts) != dict(self._texts):
                yield _make_error("has other texts attached than the other segments", each.file.name)
        if not sound:
            return
        reported: set[str] = set()
        stated = {JOURNAL_NAME: None if self._journal is None else self._journal.texts}
        stated[MANIFEST_NAME] = self._manifest.texts if isinstance(self._manifest, Manifest) else None
        for where, texts in stated.items():
            for name, known in (texts or {}).items():
                if name not in reported and hash_text(self._texts.get(name)) != known:
                    reported.add(name)
                    yield _make_error(f"{name} is not attached as the run began with it, by {where}")
        listed = stated[MANIFEST_NAME]
        for name in sorted(self._texts.keys() - (self._texts if listed is None else listed).keys()):
            yield _make_error(f"{name} is attached, and was not when the run began, by {MANIFEST_NAME}")

    def _compare_manifest(self) -> Iterator[SessionFinding]:
        """Return what the recorder stated, against what is there."""
        stated = self._manifest
        if isinstance(stated, NoManifest):
            remake = "; `stand session repair` makes one of what is there"
            if stated.is_missing and not self._is_recording:
                yield _make_missing(
                    f"{stated.text}: whether all segments are there is not known{remake}", MANIFEST_NAME
                )
            elif stated.is_newer:
                yield SessionFinding(Severity.ERROR, MANIFEST_NAME, stated.text, Files.UNKNOWN)
            elif not stated.is_missing:
                yield _make_error(f"{stated.text}{remake}", MANIFEST_NAME)
            return
        if stated.remade:
            yield _make_note(
                "was made by a repair of what was there; what was missing then is not known", MANIFEST_NAME
            )
        if self._metadata and dict(stated.session) != dict(self._metadata):
            yield _make_error("is of another session than the segments", MANIFEST_NAME)
            return
        for each in self._seen:
            if finding := self._compare_listed(stated, each):
                yield finding
        if self._extent is None and stated.journal is not None:
            yield from _check_journal(self._path, stated, self._journal)

    def _compare_listed(self, stated: Manifest, each: ScannedSegment) -> SessionFinding | None:
        """Return what `session.json` has against a finished segment that is there."""
        name, known = each.file.name, stated.segments.get(each.file.name)
        if each.damages or dict(each.session) != dict(self._metadata):
            return None  # a finding already
        if known is None and self._is_recording:
            return None
        is_same_size = known is not None and known.size_bytes == each.file.size_bytes  # a bit of the header is wrong
        if each.rewritten is not None and not is_same_size and (known is not None or not stated.ended):
            found = judge_rewritten(each.rewritten, known)
            severity = Severity.NOTE if found.files is Files.SOUND else Severity.ERROR
            return SessionFinding(severity, name, found.text, found.files)
        if known is not None and known.size_bytes == each.file.size_bytes and each.sha256 in ("", known.sha256):
            return None
        if each.salvage or (known is None and not stated.ended):
            why = "a repair" if each.salvage else "its recorder"
            return _make_note(f"{why} did not come to list it in {MANIFEST_NAME}; `stand session repair` does", name)
        if known is None:
            return _make_error(f"is none of the segments that {MANIFEST_NAME} lists", name)
        return _make_error(f"is not as it was recorded: {MANIFEST_NAME} lists another size or hash", name)

    def _find_unseen(self, series: str) -> list[int]:
        """The numbers of listed segments of which there is no file, behind the last one that there is."""
        if not isinstance(self._manifest, Manifest) or self._manifest.session != self._metadata:
            return []
        listed = [name.partition("/") for name in self._manifest.segments]
        present = {file.number for file in self._files if file.series == series}
        numbers = {int(name.partition(".")[0]) for of, _, name in listed if of == series and name[:4].isdigit()}
        return sorted(number for number in numbers if number > max(present, default=-1))

    def _check_journal_and_end(self) -> Iterator[SessionFinding]:
        """The journal by itself, and what it says that is not in the recording, nor in what is damaged of it."""
        journal = self._journal
        if journal is None and has_run(self._recorded.events, self._recorded.marks):
            yield _make_missing("is missing; what the recording itself says of the run counts", JOURNAL_NAME)
        if journal is not None and journal.damage:
            yield _make_error(journal.damage, JOURNAL_NAME)
        if journal is not None and journal.unended:
            yield _make_note(journal.unended, JOURNAL_NAME)
        if (lost := self._lost_end) is not None:
            yield _make_missing(f"is missing, with all that followed: {lost.why}", lost.where)
        unseen = self._find_unseen(FRAMES)
        if unseen:
            where = f"{FRAMES}/{unseen[0]:04d}.mcap"
            yield _make_missing(f"is missing: {MANIFEST_NAME} lists {_format_segments(len(unseen))} more", where)

    def _find_lost_end(self) -> _LostEnd | None:
        """Return whether the end of the telemetry is missing; None while something of it is unread, or damaged."""
        series = [file for file in self._files if file.series == TELEMETRY]
        seen = [each for each in self._select_series(TELEMETRY) if each.messages]
        if not seen or self._is_recording or series[-1].state is SegmentState.UNFINISHED:
            return None
        if any(each.damages for each in self._seen if each.file == series[-1]):
            return None
        end_ns, last = int(max(each.last_ns for each in seen)), seen[-1]
        has_gap = any(hole.series == TELEMETRY for hole in (*self._recorded_holes, *self._list_gaps(TELEMETRY)))
        has_gap |= any(each.damages for each in self._select_series(TELEMETRY)) or any(
            file.state is SegmentState.UNFINISHED for file in series
        )
        knows_steps = self._depth is not Depth.ENDS and not has_gap
        done = frozenset(mark.step_id for mark in self._recorded.marks if mark.state is StepState.DONE)
        why = _explain_lost_end(
            end_ns,
            bool(last.salvage),
            find_last_run_event(self._recorded.events),
            done if knows_steps else frozenset(),
            self._journal,
            self._utc,
        )
        if not why and (unseen := self._find_unseen(TELEMETRY)):
            why = f"{MANIFEST_NAME} lists {_format_segments(len(unseen))} more"
        if not why:
            return None
        journal = self._journal
        to_ns = None if journal is None or journal.last_ns <= end_ns else journal.last_ns
        hole = Hole(TELEMETRY, series[-1].number + 1, None, end_ns, to_ns)
        return _LostEnd(hole, why + format_planned_frames(self._find_planned_count(), self._count_frames()))

    def _find_planned_count(self) -> int | None:
        """Return how many frames the plan has, by the events, else by the manifest; None when neither says."""
        planned = [event.data.get("frames") for event in self._recorded.events if event.kind in TELL_PLAN]
        last = planned[-1] if planned else None
        if not isinstance(last, int) and isinstance(self._manifest, Manifest):
            last = self._manifest.plan.get("frames")
        return last if isinstance(last, int) else None

    def frames_short(self) -> bool:
        """Return whether there are fewer frames than planned."""
        return bool(format_planned_frames(self._find_planned_count(), self._count_frames()))

    def _all_frames_are_read(self) -> bool:
        """Return whether no frame may be in a segment that was not read."""
        unread = (SegmentState.UNFINISHED, SegmentState.RECORDING)
        return not any(file.series == FRAMES and file.state in unread for file in self._files)

    @cached_property
    def _shortages(self) -> list[Shortage]:
        """The captures that lack frames, where all frames that there may be were read."""
        if self._depth is Depth.ENDS or self._extent is not None or not self._all_frames_are_read():
            return []
        if any(hole.series == FRAMES for hole in self._recorded_holes):
            return []
        return find_shortages(self._recorded.marks, self._recorded.events, self._recorded.metas)

    def _count_not_begun(self) -> int:
        """Return how many frames of the plan of a complete run are not there, of whatever step; 0 when an operator has
        left out one, or something else is missing that may have them."""
        is_over = self._run is RunOutcome.COMPLETE and (
            (last := find_last_run_event(self._recorded.events)) is not None and last.kind == RUN_END
        )
        due, recorded = self._find_planned_count(), self._recorded
        if not is_over or due is None or any(mark.state is StepState.SKIPPED for mark in recorded.marks):
            return 0
        is_whole = self._all_frames_are_read() and not any(each.damages for each in self._seen)
        is_whole &= not self._recorded_holes and not any(map(self._list_gaps, (TELEMETRY, FRAMES)))
        is_whole &= self._depth is not Depth.ENDS and self._extent is None and not self._shortages
        if not is_whole or self._lost_end is not None:
            return 0
        most: dict[str, int] = {}
        for (step_id, _), count in Counter((meta.step_id, meta.channel) for meta in recorded.metas).items():
            most[step_id] = max(most.get(step_id, 0), count)
        return max(0, due - sum(most.values()) - sum(map(len, list_reported_blocks(recorded.events))))

    def _find_steps_without_frames(self) -> Iterator[SessionFinding]:
        """Every step that is done has its frames; what was not read may have them."""
        if missing := self._count_not_begun():
            yield _make_missing(f"{_format_frames(missing)} of the plan: missing, though the run is complete")
        is_damaged = any(each.damages for each in self._select_series(FRAMES))
        for short in self._shortages:
            steps = short.step_ids[0] if len(short.step_ids) == 1 else f"{short.step_ids[0]} to {short.step_ids[-1]}"
            span = f"{self._utc.date_time(short.begin_ns)} to {self._utc.local_text(short.end_ns)}"
            which = f"{_format_frames(short.missing)} of {steps}, {span}"
            if short.is_reported:
                yield _make_note(f"{which}: lost by the recorder, as its events say")
            elif not is_damaged:
                yield _make_missing(f"{which}: missing, though their steps are done")

    def _collect_holes(self) -> tuple[Hole, ...]:
        """The holes of the telemetry, then of the frames."""
        telemetry = self._list_gaps(TELEMETRY)
        if self._lost_end is not None:
            telemetry.append(replace(self._lost_end.hole, end_ns=None))
        found = (*self._recorded_holes, *telemetry, *self._list_frame_holes())
        missing = 0 if found else self._count_not_begun()
        return (Hole(FRAMES, None, None, None, None, missing),) if missing else found

    def _list_frame_holes(self) -> Iterator[Hole]:
        """The gaps with the number of frames that went with them, then what is missing without a missing number: behind
        the last segment, or in between."""
        gaps, unseen = self._list_gaps(FRAMES), self._find_unseen(FRAMES)
        read = [each for each in self._select_series(FRAMES) if each.messages]
        last_ns = max((int(each.last_ns) for each in read), default=None)
        number = max((each.file.number for each in self._select_series(FRAMES)), default=-1) + 1
        tail = Hole(FRAMES, number, None, last_ns, None)
        counts: Counter[Hole] = Counter()
        loose: list[Hole] = []
        for short in self._shortages:
            gap = next((gap for gap in gaps if gap.clip(short.begin_ns, short.end_ns + 1) is not None), None)
            if gap is None and tail.covers(short.begin_ns) and not short.is_reported:
                gap = tail
            if gap is None:
                loose.append(short.hole)
            else:
                counts[gap] += short.missing
        is_tail = bool(counts[tail] or (unseen and self._extent is None))
        yield from (replace(gap, frames=counts[gap]) for gap in (*gaps, *([tail] if is_tail else [])))
        yield from loose

    def _has_camera_degC(self) -> bool | None:
        """Return whether the camera states its temperature, by the descriptions up to the first that has one.

        None without any description.
        """
        found = None
        for meta in self._recorded.metas if self._depth is not Depth.ENDS else self._iterate_first_metas():
            if not math.isnan(meta.camera_degC):
                return True
            found = False
        return found

    def _iterate_first_metas(self) -> Iterator[FrameMeta]:
        for each in self._select_series(FRAMES):
            with suppress(SessionError):
                yield from (place.meta for place in list_frame_places(each.file.path))

    def _find_silent_devices(self) -> Iterator[SessionFinding]:
        """Devices of which a complete run has no reading though they were declared; where the readings were read, also
        channels of others. A device that is opened by what uses it, as a camera in a run without frames, may have none.
        What may have been in a part that is damaged or missing is not looked for: that is a finding already."""
        stated = self._manifest
        if not isinstance(stated, Manifest) or self._run is not RunOutcome.COMPLETE or self._extent is not None:
            return
        if self._list_gaps(TELEMETRY) or self._lost_end or any(each.damages for each in self._select_series(TELEMETRY)):
            return
        topics = {topic for each in stated.segments.values() for topic, count in each.messages.items() if count}
        for name, declared in sorted(stated.devices.items()):
            if f"{READINGS}{name}" not in topics:
                is_due = declared.get("is_opened", True) or name_frame_topics(f"{name}.image").image in topics
                found = _make_missing if is_due else _make_note
                yield found(f"{name}: no reading of this device is recorded, though it was declared")
                continue
            channels = declared.get("channels", {})
            known = channels if isinstance(channels, dict) and self._depth >= Depth.TELEMETRY else ()
            if silent := [channel for channel in known if channel not in self._recorded.channels]:
                yield _make_missing(f"{', '.join(silent)}: no reading of this is recorded, though it was declared")


def _is_utf_8(text: str) -> bool:
    """Return whether an attached text was; other bytes stand in it as surrogates."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


class _DamageCatcher:
    """What cannot be read inside becomes a damage of the segment."""

    def __init__(self, path: Path, seen: ScannedSegment) -> None:
        self._prefix = f"{seen.file.path}: "
        self._seen = seen

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        if not isinstance(error, SessionError):
            return False
        self._seen.damages.append(SegmentDamage(str(error).removeprefix(self._prefix)))
        return True


@dataclass(frozen=True, slots=True)
class _LostEnd:
    """The telemetry behind its last segment is missing; `why` gives the evidence."""

    hole: Hole
    why: str

    @property
    def where(self) -> str:
        return format_segments(TELEMETRY, self.hole.first or 0, None).partition(" ")[0]


@dataclass(frozen=True, slots=True)
class Shortage:
    """Captures that follow each other and are done with `missing` frames less than they say. begin_ns, end_ns: of the
    steps. is_reported: the recorder itself reported that it lost them."""

    step_ids: tuple[str, ...]
    missing: int
    begin_ns: int
    end_ns: int
    is_reported: bool

    @property
    def hole(self) -> Hole:
        """Return the shortage as a stretch of the frames."""
        return Hole(
            series=FRAMES,
            first=None,
            last=None,
            begin_ns=self.begin_ns - 1,
            end_ns=self.end_ns + 1,
            frames=self.missing,
            excused=self.is_reported,
        )


def find_shortages(marks: Iterable[StepMark], events: Sequence[Event], metas: Iterable[FrameMeta]) -> list[Shortage]:
    """Find shortages by the steps that are done, in order of time, and all the frames.

    A step's end is recorded when all its frames are on the disk, or counted as lost: so a capture that is done
    has as many of each camera as it says.
    """
    begins_ns = find_restart_times(events)
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
            is_reported = missing <= count_lost_frames(mark.step_id, events)
            begin_ns = begun_ns.get(mark.step_id, mark.time_ns)
            one = Shortage((mark.step_id,), missing, begin_ns, mark.time_ns, is_reported)
            is_one = follows and found[-1].is_reported == is_reported
            found.append(_join_shortages(found.pop(), one) if is_one else one)
        follows = missing > 0
    return found


def _join_shortages(one: Shortage, other: Shortage) -> Shortage:
    steps, missing = one.step_ids + other.step_ids, one.missing + other.missing
    return Shortage(steps, missing, one.begin_ns, other.end_ns, one.is_reported)


def format_planned_frames(planned: int | None, frames: int) -> str:
    """Return how many of the frames of the plan `frames` are, as the end of a sentence; "" when the number of planned
    frames is not known, or when there are as many."""
    return f"; {frames} of the {planned} frames of the plan are there" if planned and frames < planned else ""


def has_run(events: Iterable[Event], marks: Iterable[StepMark]) -> bool:
    """Return whether a run was recorded whose journal was begun: its first step comes after that."""
    return any(event.kind in RUN_BEGINS for event in events) and any(True for _ in marks)


def _explain_lost_end(
    end_ns: int,
    is_salvaged: bool,
    last: Event | None,
    done: frozenset[str],
    journal: JournalFacts | None,
    utc: UtcOffsets,
) -> str:
    """The evidence that more was recorded; "" when there is none. `done`: the steps that the telemetry has, empty when
    it was not read for them.

    Without a journal a run leaves either the event of its end or a segment that a repair has made; a recording with
    neither has lost its last segments, or was killed in the moment between two of them, and counts as incomplete.
    """
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


def _is_recovered(kept: SegmentFile, salvaged: ScannedSegment | None, is_first: bool) -> bool:
    """Return whether the repaired segment has every message of the original: as many as its recorder had listed (of the
    first repair that kept one: what was listed later had been repaired), or its repair lost no byte, and both have as
    many. The original must then reach the end of its data; of one that was cut short the number of messages is unknown.
    """
    if salvaged is None:
        return False
    if is_first and salvaged.salvage.get("listed") == str(salvaged.messages):
        return True
    if salvaged.salvage.get("lost_bytes") != "0":
        return False
    count = 0
    with suppress(*DAMAGE), kept.path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True, record_size_limit=kept.size_bytes).records:
            if isinstance(record, DataEnd):
                return count == salvaged.messages
            count += isinstance(record, StoredMessage)
    return False


def _check_journal(path: Path, stated: Manifest, journal: JournalFacts | None) -> Iterator[SessionFinding]:
    """Return whether the journal has the lines that it had when the recording ended."""
    due = stated.journal
    if due is None or (journal is not None and journal.damage):
        return  # damaged lines are a finding already
    data, file_path = b"", path / JOURNAL_NAME
    with suppress(OSError):
        if file_path.is_file():  # a pipe of that name might never give a byte
            with file_path.open("rb") as file:
                data = file.read(due.size_bytes)
    lines = data.count(b"\n")
    if lines < due.lines:
        yield _make_missing(f"has {lines} of the {due.lines} lines that {MANIFEST_NAME} states", JOURNAL_NAME)
    elif hashlib.sha256(data).hexdigest() != due.sha256:
        yield _make_error(
            f"is not as it was when the recording ended: {MANIFEST_NAME} states another hash", JOURNAL_NAME
        )


def _check_notes(path: Path) -> Iterator[SessionFinding]:
    """Check the notes that people wrote about the session."""
    by_operator = read_notes(path)
    if by_operator.damage:
        yield _make_error(by_operator.damage, NOTES_NAME)
    if by_operator.unended:
        yield _make_note(by_operator.unended, NOTES_NAME)


def _check_format(session: Mapping[str, str]) -> Iterator[SessionFinding]:
    """What another version of thermostand may have recorded is not known here."""
    if text := explain_unknown_format(session):
        yield SessionFinding(Severity.ERROR, "", f"{text}: what that format adds was not checked", Files.UNKNOWN)
    elif unknown := sorted(session.keys() - {each.name for each in fields(SessionInfo)}):
        names = ", ".join(name[:40] for name in unknown[:6])
        yield _make_note(
            f"the record of the session has fields that this version does not know: {names}; they were not checked"
        )


def _find_lost_frames(recorded: Recorded, utc: UtcOffsets) -> Iterator[SessionFinding]:
    """Return what the recorder, and what camera and wire lost, as recorded."""
    for event in recorded.events:
        if event.kind == FRAMES_DROPPED:
            yield _make_note(f"{utc.local_text(event.time_ns)}: {event.text}")
    dropped: Counter[str] = Counter()
    for meta in recorded.metas:
        dropped[meta.step_id] += meta.dropped
    steps = {mark.step_id: f"step {mark.index + 1} ({mark.kind})" for mark in recorded.marks}
    for step_id, count in dropped.items():
        if count:
            yield _make_note(
                f"{_format_frames(count)} of {steps.get(step_id, 'no step')} lost by the camera or its wire"
            )


def _make_error(text: str, where: str = "") -> SessionFinding:
    return SessionFinding(Severity.ERROR, where, text, Files.DAMAGED)


def _make_missing(text: str, where: str = "") -> SessionFinding:
    return SessionFinding(Severity.ERROR, where, text, Files.INCOMPLETE)


def _make_note(text: str, where: str = "") -> SessionFinding:
    return SessionFinding(Severity.NOTE, where, text)


def _format_frames(count: int) -> str:
    return "1 frame" if count == 1 else f"{count} frames"


def _format_segments(count: int) -> str:
    return "1 segment" if count == 1 else f"{count} segments"
