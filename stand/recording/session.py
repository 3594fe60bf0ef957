"""Reads a recorded session: metadata, readings, frames, steps, events. It needs no device and changes nothing.

A topic of the telemetry is read only when asked for, and then kept; frames are decoded one at a time. Whatever is
wrong with a session is a SessionError with a sentence.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, chain, pairwise
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType
from typing import TypeVar

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from drivers.interface import Frame, SessionError
from stand.hub import Batch, Event, Item, StepMark
from stand.recording import messages
from stand.recording.columns import Column, TopicColumns
from stand.recording.images import decode_image
from stand.recording.layout import DEVICES, FINISHED, FRAMES, TELEMETRY, UNFINISHED
from stand.recording.records import (
    FramePlace,
    FrameSpan,
    Message,
    frame_places,
    frame_span,
    naming,
    read_frame,
    read_head,
    telemetry_messages,
)

T = TypeVar("T")

DAMAGED = FINISHED + ".damaged"  # the original of a segment from which a salvage could not take everything


@dataclass(frozen=True, slots=True)
class RecordedImage:
    """An image as it was recorded: `data` is a message of `schema`, for decode_image; `meta` is the frame's
    description, None when it did not reach the disk. `sequence` is the low 32 bits of the frame's block id, `path` the
    segment it was read from."""

    schema: str
    data: bytes
    sequence: int
    time_ns: int
    meta: messages.FrameMeta | None
    path: Path


class Session:
    """A session directory. Of its segments those in `incomplete` were not finished, those in `damaged` were replaced
    by what could be salvaged from them; both are not read."""

    def __init__(self, path: Path, telemetry: list[Path], frames: list[Path]) -> None:
        self.path = path
        self.incomplete = _files_of(path, UNFINISHED)
        self.damaged = _files_of(path, DAMAGED)
        self._telemetry = telemetry
        self._frames = frames
        head = read_head(telemetry[0])
        self.metadata = head.session
        self._attachments = head.attachments
        self._checked = {telemetry[0]}  # the segments known to belong to this session
        for segment in frames[:1]:
            self._check(segment)  # metadata has no CRC, but a second copy there
        self._columns: dict[str, dict[str, Column]] = {}  # device -> channel -> column
        self._all_columns_read = False
        self._places_of: dict[Path, list[FramePlace]] = {}

    @classmethod
    def open(cls, path: Path) -> Session:
        """The session in `path`, the directory that holds `telemetry` and `frames`; SessionError when there is none."""
        telemetry, frames = (_segments(path / name, FINISHED) for name in (TELEMETRY, FRAMES))
        if not telemetry:
            count = len(_files_of(path, UNFINISHED))
            unfinished = f", only {count} unfinished ones" if count else ""
            raise SessionError(f"{path}: not a session: there is no finished segment in {path / TELEMETRY}{unfinished}")
        return cls(path, telemetry, frames)

    @property
    def attachments(self) -> Mapping[str, str]:
        """The attached files: name -> text."""
        return MappingProxyType(self._attachments)

    def attachment(self, name: str) -> str | None:
        """The text of an attached file (`config.yaml`), None when there is none of that name."""
        return self._attachments.get(name)

    @property
    def segments(self) -> tuple[Path, ...]:
        """The finished segments, those of the telemetry first."""
        return (*self._telemetry, *self._frames)

    def channels(self) -> list[str]:
        """The channels that have readings, sorted."""
        return sorted(self._all_columns())

    def readings(self, channel: str) -> Column:
        """(time_ns, value), both of shape (n,), in order of time; NaN where the reading was BAD. SessionError when the
        session has no such channel."""
        device = channel.partition(".")[0]
        if device not in self._columns and not self._all_columns_read:
            self._columns[device] = self._read_columns(device).get(device, {})
        found = self._columns.get(device, {}).get(channel) or self._all_columns().get(channel)
        if found is None:
            raise SessionError(f"{self.path}: has no channel {channel}; there are {', '.join(self.channels())}")
        return found

    def _all_columns(self) -> dict[str, Column]:
        if not self._all_columns_read:
            self._columns = self._read_columns(None)
            self._all_columns_read = True
        return {channel: column for columns in self._columns.values() for channel, column in columns.items()}

    def _read_columns(self, device: str | None) -> dict[str, dict[str, Column]]:
        """Device -> channel -> column of the topics that `device` publishes on (None: of all); whoever shares them is
        among the devices, but only where it shares them."""
        topics: dict[str, TopicColumns] = {}

        def is_wanted(channel: Channel) -> bool:
            devices = channel.metadata.get(DEVICES, "").split(",")
            return channel.topic in messages.KIND_OF_TOPIC and (device is None or device in devices)

        def add(message: Message) -> None:
            if message.topic not in topics:
                topics[message.topic] = TopicColumns(message.topic)
            topics[message.topic].add(message.data, message.time_ns)

        for _ in self._decoded(is_wanted, add):
            pass
        columns: dict[str, dict[str, Column]] = {}
        for topic in topics.values():
            with naming(self.path / TELEMETRY):
                for name, of_device in topic.columns().items():
                    columns.setdefault(name, {}).update(of_device)
        return columns

    def steps(self) -> list[StepMark]:
        """Every step mark, in order of time."""
        found = self._decoded(lambda channel: channel.topic == messages.STEP, _step)
        return sorted(found, key=attrgetter("time_ns"))

    def events(self) -> list[Event]:
        """Every event, in order of time."""
        found = self._decoded(lambda channel: channel.topic == messages.EVENT, _event)
        return sorted(found, key=attrgetter("time_ns"))

    @property
    def frame_count(self) -> int:
        """How many frames were recorded."""
        return sum(span.count for span in self._spans)

    @property
    def frame_times_ns(self) -> NDArray[np.int64]:
        """Middle of the exposure of each frame, shape (frame_count,), ascending."""
        return np.array([place.time_ns for place in self._places()], np.int64)

    def frame(self, index: int) -> Frame:
        """The frame of that index, counted from 0 in order of time; SessionError when there is none."""
        if not 0 <= index < self.frame_count:
            raise SessionError(f"{self.path}: has no frame {index}; it has {self.frame_count}, counted from 0")
        if not self._is_in_order:
            return _frame(self._image(self._sorted_places[index]))
        ends = list(accumulate(span.count for span in self._spans))
        number = bisect_right(ends, index)
        places = self._places_in(self._frames[number])
        return _frame(self._image(places[index - ends[number]]))  # counted from the segment's end

    def frames(self) -> Iterator[Frame]:
        """The frames in order of time, each read and decoded when asked for. A frame whose description did not reach
        the disk has NaN for exposure, gain and temperature."""
        return map(_frame, self.images())

    def images(self) -> Iterator[RecordedImage]:
        """The images in order of time as they were recorded, each read when asked for and not decoded."""
        return map(self._image, self._places())

    def items(self) -> Iterator[Item]:
        """Every batch, frame, step mark and event in the order of their publication, each read when asked for.

        A frame's place in that order is that of its description; a frame whose description is lost comes in order of
        time. Publishing the items to a recorder gives the same messages again.
        """
        images = _ImagesToCome(self._places(), self._descriptions, self._image)
        for message, item in self._decoded(_stands_for_item, lambda message: (message, _item(message))):
            yield from map(_frame, images.undescribed_before(message.time_ns))
            if item is None:
                yield from map(_frame, images.described_by(message))
            else:
                yield item
        yield from map(_frame, images.undescribed_before(None))

    def _image(self, place: FramePlace) -> RecordedImage:
        message = read_frame(place)
        meta = self._metas.get((message.time_ns, message.sequence))
        return RecordedImage(place.schema, message.data, message.sequence, message.time_ns, meta, place.path)

    @cached_property
    def _spans(self) -> list[FrameSpan]:
        return [frame_span(path) for path in self._frames]

    @cached_property
    def _is_in_order(self) -> bool:
        """Whether each segment's frames are all later than those before: then one frame needs one segment's index."""
        spans = [span for span in self._spans if span.count]
        return all(earlier.last_ns <= later.first_ns for earlier, later in pairwise(spans))

    def _places(self) -> Iterator[FramePlace]:
        """The frames in order of time."""
        if self._is_in_order:
            return chain.from_iterable(map(self._places_in, self._frames))
        return iter(self._sorted_places)

    @cached_property
    def _sorted_places(self) -> list[FramePlace]:
        return sorted(chain.from_iterable(map(self._places_in, self._frames)), key=attrgetter("time_ns"))

    def _places_in(self, segment: Path) -> list[FramePlace]:
        """The frames of one segment in order of time."""
        if segment not in self._places_of:
            self._check(segment)
            self._places_of[segment] = sorted(frame_places(segment), key=attrgetter("time_ns"))
        return self._places_of[segment]

    @property
    def frame_metas(self) -> list[tuple[int, messages.FrameMeta]]:
        """(time_ns, description) of every frame in order of publication, also of those whose image was lost."""
        return [(description.time_ns, description.meta) for description in self._descriptions]

    @cached_property
    def _descriptions(self) -> list[_Description]:
        return list(self._decoded(lambda channel: channel.topic == messages.CAMERA_META, _description))

    @cached_property
    def _metas(self) -> dict[tuple[int, int], messages.FrameMeta]:
        return {(known.time_ns, known.sequence): known.meta for known in self._descriptions}

    def _decoded(self, wanted: Callable[[Channel], bool], decode: Callable[[Message], T]) -> Iterator[T]:
        """The telemetry of the wanted channels in the order of the files, each message decoded."""
        for path in self._telemetry:
            self._check(path)
            for message in telemetry_messages(path, wanted):
                try:
                    item = decode(message)
                except SessionError as error:
                    raise SessionError(f"{path}: {error}") from error
                yield item

    def _check(self, segment: Path) -> None:
        """SessionError when the segment is not of this session."""
        if segment not in self._checked:
            if read_head(segment).session != self.metadata:
                raise SessionError(f"{segment}: belongs to another session than {self._telemetry[0]}")
            self._checked.add(segment)


@dataclass(frozen=True, slots=True)
class _Description:
    """A frame's description and where its image is found."""

    time_ns: int
    sequence: int
    meta: messages.FrameMeta


class _ImagesToCome:
    """The images that `items` has not given yet, found by the descriptions that stand for them."""

    def __init__(
        self,
        places: Iterable[FramePlace],
        descriptions: Iterable[_Description],
        read: Callable[[FramePlace], RecordedImage],
    ) -> None:
        self._read = read
        self._places: dict[int, list[FramePlace]] = {}
        for place in places:
            self._places.setdefault(place.time_ns, []).append(place)
        self._descriptions = Counter(description.time_ns for description in descriptions)  # to come, by their time
        self._undescribed = deque(time_ns for time_ns in self._places if time_ns not in self._descriptions)

    def undescribed_before(self, time_ns: int | None) -> Iterator[RecordedImage]:
        """The images before `time_ns` (None: all) whose time no description has."""
        while self._undescribed and (time_ns is None or self._undescribed[0] < time_ns):
            yield from map(self._read, self._places.pop(self._undescribed.popleft()))

    def described_by(self, message: Message) -> Iterator[RecordedImage]:
        """The image that the description in `message` stands for, none when it is lost; behind the last description
        of that time whatever else was recorded then."""
        places = self._places.get(message.time_ns, [])
        for place in places:
            image = self._read(place)
            if image.sequence == message.sequence:
                places.remove(place)
                yield image
                break
        self._descriptions[message.time_ns] -= 1
        if not self._descriptions[message.time_ns]:
            yield from map(self._read, self._places.pop(message.time_ns, []))


def _step(message: Message) -> StepMark:
    return messages.decode_step(message.data, message.time_ns)


def _event(message: Message) -> Event:
    return messages.decode_event(message.data, message.time_ns)


def _description(message: Message) -> _Description:
    return _Description(message.time_ns, message.sequence, messages.decode_frame_meta(message.data))


def _stands_for_item(channel: Channel) -> bool:
    """The log and the table's pose do not: the recorder derives them from events and batches."""
    return channel.topic in {*messages.KIND_OF_TOPIC, messages.STEP, messages.EVENT, messages.CAMERA_META}


def _item(message: Message) -> Batch | StepMark | Event | None:
    """The item that a message stands for; None when that is a frame."""
    match message.topic:
        case messages.STEP:
            return _step(message)
        case messages.EVENT:
            return _event(message)
        case messages.CAMERA_META:
            return None
        case topic:
            return messages.decode_batch(topic, message.data, message.time_ns)


def _frame(recorded: RecordedImage) -> Frame:
    with naming(recorded.path):
        image = decode_image(recorded.schema, recorded.data)
    meta = recorded.meta or _unknown(image.channel, recorded.sequence)
    return Frame(
        channel=image.channel,
        image=image.pixels,
        time_ns=recorded.time_ns,
        exposure_s=meta.exposure_s,
        gain_dB=meta.gain_dB,
        camera_degC=meta.camera_degC,
        block_id=meta.block_id,
        camera_ticks=meta.camera_ticks,
        dropped=meta.dropped,
        step_id=meta.step_id,
        windows=image.windows,
    )


def _unknown(channel: str, block_id: int) -> messages.FrameMeta:
    return messages.FrameMeta(channel, "", block_id, 0, np.nan, np.nan, np.nan, 0)


def _files_of(path: Path, suffix: str) -> tuple[Path, ...]:
    return (*_segments(path / TELEMETRY, suffix), *_segments(path / FRAMES, suffix))


def _segments(folder: Path, suffix: str) -> list[Path]:
    """The files in `folder` that end so, in order of their numbers; none when there is no such folder."""
    try:
        paths = [path for path in folder.iterdir() if path.name.endswith(suffix)]
    except OSError:
        return []
    return sorted(paths, key=lambda path: (len(path.name), path.name))
