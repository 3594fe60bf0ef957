"""What a recorded session is, as far as it can be read: a glance from the ends of its files, an overview from all of
its telemetry. Damage and unfinished segments are part of the answer, not a reason to give none.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from drivers.clock import NS_PER_S
from drivers.interface import SessionError
from stand.hub import Event, StepMark, StepState
from stand.recording import messages
from stand.recording.contents import RUN_END, Channel, Contents
from stand.recording.damage import reading
from stand.recording.gaps import Silence, silences, told_blocks
from stand.recording.images import decode_image
from stand.recording.inventory import SegmentFile, State, inventory
from stand.recording.items import event_of
from stand.recording.layout import FRAMES, TELEMETRY
from stand.recording.records import FramePlace, frame_places, read_frame, read_head, telemetry_messages
from stand.recording.summary import Summary, read_summary
from stand.recording.utc_offsets import REPEATED_NS, UtcOffsets, offsets_of
from stand.recording.walk import survey
from stand.recording.wire import Source


@dataclass(frozen=True, slots=True)
class Glance:
    """What names, sizes, heads and indexes tell. begin_ns and end_ns: log times of the first and the last message of
    the finished segments, None when they hold none; `frames` are theirs, too. `troubles`: a sentence for each segment
    that cannot be read. utc: to UTC near both ends; the steps of the system clock between them are not looked for."""

    path: Path
    files: tuple[SegmentFile, ...]
    metadata: dict[str, str]
    attachments: dict[str, str]
    frames: int
    begin_ns: int | None
    end_ns: int | None
    troubles: tuple[str, ...]
    utc: UtcOffsets

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
    def state(self) -> str:
        """`complete`, or what it is instead."""
        if self.troubles:
            return f"damaged: {self.troubles[0]}"
        told = {State.UNFINISHED: "unfinished", State.RECORDING: "being recorded", State.DAMAGED: "kept damaged"}
        has_telemetry = any(file.series == TELEMETRY and file.state is not State.DAMAGED for file in self.files)
        parts = [] if has_telemetry else ["telemetry missing"]
        parts += [f"{count} {text}" for state, text in told.items() if (count := self.count(state))]
        return ", ".join(parts) or "complete"


def glance(path: Path) -> Glance:
    """The session in `path` at a glance; SessionError when there is none. Costs a look at both ends of each segment."""
    files = inventory(path)
    if not files:
        raise SessionError(f"{path}: not a session: there is no segment in its folders {TELEMETRY} and {FRAMES}")
    troubles: list[str] = []
    summaries: list[tuple[SegmentFile, Summary]] = []
    for file in files:
        if file.state is State.FINISHED:
            try:
                summaries.append((file, _summary(file.path)))
            except SessionError as error:
                troubles.append(_within(path, error))
    metadata, attachments = _opening(files)
    told = [summary.statistics for _, summary in summaries if summary.statistics.message_count]
    return Glance(
        path,
        files,
        metadata,
        attachments,
        sum(summary.statistics.message_count for file, summary in summaries if file.series == FRAMES),
        min((statistics.message_start_time for statistics in told), default=None),
        max((statistics.message_end_time for statistics in told), default=None),
        tuple(troubles),
        _utc([(file.path, summary) for file, summary in summaries if file.series == TELEMETRY]),
    )


def _utc(segments: list[tuple[Path, Summary]]) -> UtcOffsets:
    """What the first segment of the telemetry and those of the last minutes say of UTC, as far as they can be read."""
    ends_ns = [summary.statistics.message_end_time for _, summary in segments]
    last_ns = max(ends_ns, default=0) - REPEATED_NS - NS_PER_S
    events: list[Event] = []
    for (path, _), end_ns in zip(segments, ends_ns, strict=True):
        if path != segments[0][0] and end_ns < last_ns:
            continue
        with suppress(SessionError):
            events += map(event_of, telemetry_messages(path, lambda channel: channel.topic == messages.EVENT))
    return offsets_of(events)


def _within(directory: Path, error: SessionError) -> str:
    """Its sentence, with the file's name as it is within the session."""
    return str(error).removeprefix(f"{directory}/")


def _summary(path: Path) -> Summary:
    with reading(path), path.open("rb") as file:
        return read_summary(file, path.stat().st_size)


def _opening(files: tuple[SegmentFile, ...]) -> tuple[dict[str, str], dict[str, str]]:
    """Metadata `session` and the attachments, of the first segment that can tell them; empty when none can."""
    for file in sorted(files, key=lambda file: file.state is not State.FINISHED):
        try:
            if file.state is State.FINISHED:
                head = read_head(file.path)
                return head.session, head.attachments
            with file.path.open("rb") as opened:
                found = survey(Source(opened.fileno()), to_first_chunk=True)
        except (SessionError, OSError):
            continue
        if found.session is not None:
            return found.session, {
                name: entry.data.decode(errors="replace") for name, entry in found.attachments.items()
            }
    return {}, {}


@dataclass(frozen=True, slots=True)
class Step:
    """A step of the plan as it went; end_ns None and state STARTED: the recording has no end of it."""

    index: int
    step_id: str
    kind: str
    parameters: dict[str, object]
    state: StepState
    begin_ns: int
    end_ns: int | None
    frames: int


@dataclass(frozen=True, slots=True)
class Temperature:
    """One channel in degC; min, mean and max are NaN when every reading was BAD."""

    channel: str
    count: int
    bad: int
    min_degC: float
    mean_degC: float
    max_degC: float


@dataclass(frozen=True, slots=True)
class Frames:
    """The images. `pixels`: those of the first, as in `2448 x 2048 px, 8 bit`; schema and pixels are "" without any.
    described: descriptions in the telemetry. dropped: frames that the camera or its wire lost, as the descriptions say.
    lost_by_recorder: frames of which its events say so."""

    count: int
    size_bytes: int
    schema: str
    pixels: str
    first_ns: int | None
    last_ns: int | None
    described: int
    dropped: int
    lost_by_recorder: int


@dataclass(frozen=True, slots=True)
class Overview:
    """All that `stand session info` shows. `troubles` are the glance's and what reading the telemetry added."""

    glance: Glance
    troubles: tuple[str, ...]
    steps: tuple[Step, ...]
    frames: Frames
    temperatures: tuple[Temperature, ...]
    gaps: tuple[Silence, ...]
    events: tuple[Event, ...]

    @property
    def ending(self) -> Event | None:
        """How the run ended, None when the recording does not tell."""
        return next((event for event in reversed(self.events) if event.kind == RUN_END), None)

    @property
    def utc(self) -> UtcOffsets:
        """From its instants to UTC as the host's system clock had it."""
        return offsets_of(self.events)


@dataclass
class _Reading:
    """What has been read of the segments so far."""

    directory: Path
    contents: Contents = field(default_factory=Contents)
    places: list[FramePlace] = field(default_factory=list[FramePlace])
    troubles: list[str] = field(default_factory=list[str])

    def read(self, file: SegmentFile) -> None:
        """A finished segment, as far as it goes."""
        try:
            if file.series == FRAMES:
                self.places.extend(frame_places(file.path))
                return
            for message in telemetry_messages(file.path, lambda channel: True):
                self.contents.receive(message)
        except SessionError as error:
            self.troubles.append(_within(self.directory, error))


def overview(path: Path) -> Overview:
    """The session in `path`, all its telemetry read; SessionError when there is none."""
    seen = glance(path)
    read = _Reading(path)
    for file in seen.files:
        if file.state is State.FINISHED:
            read.read(file)
    contents = read.contents
    frames = _frames(seen, read)  # before the troubles are told, which it may add to
    times_ns = {name: channel.sorted_times_ns() for name, channel in contents.channels.items()}
    return Overview(
        seen,
        tuple(dict.fromkeys((*seen.troubles, *read.troubles))),
        tuple(_steps(contents)),
        frames,
        tuple(_temperature(name, channel) for name, channel in sorted(contents.channels.items()) if channel.is_degC),
        tuple(silences(times_ns)),
        tuple(sorted(contents.events, key=lambda event: event.time_ns)),
    )


def _steps(contents: Contents) -> Iterator[Step]:
    """The steps in order of their index; of one that was begun again the last time counts."""
    frames = Counter(meta.step_id for _, meta in contents.metas)
    last: dict[str, list[StepMark]] = {}
    for mark in sorted(contents.marks, key=lambda mark: mark.time_ns):
        if mark.state is StepState.STARTED or mark.step_id not in last:
            last[mark.step_id] = []
        last[mark.step_id].append(mark)
    for step_id, marks in sorted(last.items(), key=lambda item: item[1][0].index):
        first, end = marks[0], marks[-1]
        end_ns = None if end.state is StepState.STARTED else end.time_ns
        yield Step(
            first.index, step_id, first.kind, first.parameters, end.state, first.time_ns, end_ns, frames[step_id]
        )


def _frames(seen: Glance, read: _Reading) -> Frames:
    size_bytes = sum(file.size_bytes for file in seen.files if file.series == FRAMES)
    times_ns = [place.time_ns for place in read.places]
    contents = read.contents
    return Frames(
        len(times_ns),
        size_bytes,
        read.places[0].schema if read.places else "",
        _pixels(read),
        min(times_ns, default=None),
        max(times_ns, default=None),
        len(contents.metas),
        sum(meta.dropped for _, meta in contents.metas),
        sum(map(len, told_blocks(contents.events))),
    )


def _pixels(read: _Reading) -> str:
    """Of the first image; a damaged one is a trouble."""
    if not read.places:
        return ""
    try:
        place = read.places[0]
        pixels = decode_image(place.schema, read_frame(place).data).pixels
    except SessionError as error:
        read.troubles.append(_within(read.directory, error))
        return ""
    height, width = pixels.shape
    return f"{width} x {height} px, {8 * pixels.itemsize} bit"


def _temperature(name: str, channel: Channel) -> Temperature:
    values = np.array(channel.values, np.float64)
    good = values[~np.isnan(values)]
    bad = len(values) - len(good)
    if not len(good):
        return Temperature(name, len(values), bad, np.nan, np.nan, np.nan)
    return Temperature(name, len(values), bad, float(good.min()), float(good.mean()), float(good.max()))
