"""Reads a recorded session: metadata, readings, frames, steps, events. It needs no device and changes nothing.

A topic of the telemetry is read only when asked for, and then kept; frames are decoded one at a time. Whatever is
wrong with a session is a SessionError with a sentence.
"""

from __future__ import annotations

from array import array
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from operator import attrgetter
from pathlib import Path
from types import MappingProxyType

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from drivers.interface import Frame, SessionError
from stand.hub import Batch, Event, Item, StepMark
from stand.recording import messages
from stand.recording.images import decode_image
from stand.recording.layout import DEVICES, FINISHED, FRAMES, TELEMETRY, UNFINISHED
from stand.recording.records import FramePlace, Message, frame_places, read_frame, read_head, telemetry_messages

Column = tuple[NDArray[np.int64], NDArray[np.float64]]

DAMAGED = FINISHED + ".damaged"  # the original of a segment from which a salvage could not take everything


@dataclass(frozen=True, slots=True)
class RecordedImage:
    """An image as it was recorded: `data` is a message of `schema`, for decode_image; `meta` is the frame's
    description, None when it did not reach the disk. `sequence` is the low 32 bits of the frame's block id."""

    schema: str
    data: bytes
    sequence: int
    time_ns: int
    meta: messages.FrameMeta | None


class Session:
    """A session directory. Of its segments those in `incomplete` were not finished, those in `damaged` were replaced
    by what could be salvaged from them; both are not read."""

    def __init__(self, path: Path, telemetry: list[Path], frames: list[Path]) -> None:
        self.path = path
        self.incomplete = _files_of(path, UNFINISHED)
        self.damaged = _files_of(path, DAMAGED)
        self._telemetry = telemetry
        self._frames = frames
        heads = [read_head(segment) for segment in telemetry + frames]
        self.metadata = heads[0].session
        self._attachments = heads[0].attachments
        for segment, head in zip(telemetry + frames, heads, strict=True):
            if head.session != self.metadata:
                raise SessionError(f"{segment}: belongs to another session than {telemetry[0]}")
        self._readings: dict[str, dict[str, Column]] = {}  # topic -> channel -> column

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
    def segments(self) -> tuple[Path, ...]:
        """The finished segments, those of the telemetry first."""
        return (*self._telemetry, *self._frames)

    @property
    def attachments(self) -> Mapping[str, str]:
        """The attached files: name -> text."""
        return MappingProxyType(self._attachments)

    def attachment(self, name: str) -> str | None:
        """The text of an attached file (`config.yaml`), None when there is none of that name."""
        return self._attachments.get(name)

    def channels(self) -> list[str]:
        """The channels that have readings, sorted."""
        self._load(lambda channel: channel.topic in messages.KIND_OF_TOPIC)
        return sorted({name for topic in self._readings.values() for name in topic})

    def readings(self, channel: str) -> Column:
        """(time_ns, value), both of shape (n,), in order of time; NaN where the reading was BAD. SessionError when the
        session has no such channel."""
        if (found := self._read_before(channel)) is not None:
            return found
        device = channel.partition(".")[0]
        self._load(lambda known: device in known.metadata.get(DEVICES, "").split(","))
        if (found := self._read_before(channel)) is not None:
            return found
        raise SessionError(f"{self.path}: has no channel {channel}; there are {', '.join(self.channels())}")

    def _read_before(self, channel: str) -> Column | None:
        return next((topic[channel] for topic in self._readings.values() if channel in topic), None)

    def _load(self, wanted: Callable[[Channel], bool]) -> None:
        """Read the wanted topics that have not been read yet."""
        columns: dict[str, dict[str, tuple[array[int], array[float]]]] = {}
        known = set(self._readings)

        def is_new(channel: Channel) -> bool:
            return channel.topic in messages.KIND_OF_TOPIC and channel.topic not in known and wanted(channel)

        for message in self._messages(is_new):
            topic = columns.setdefault(message.topic, {})
            for reading in messages.decode_batch(message.topic, message.data, message.time_ns).readings:
                times_ns, values = topic.setdefault(reading.channel, (array("q"), array("d")))
                times_ns.append(reading.time_ns)
                values.append(reading.value)
        for name, topic in columns.items():
            self._readings[name] = {channel: _sorted(*column) for channel, column in topic.items()}

    def steps(self) -> list[StepMark]:
        """Every step mark, in order of time."""
        found = self._messages(lambda channel: channel.topic == messages.STEP)
        return sorted(map(_step, found), key=attrgetter("time_ns"))

    def events(self) -> list[Event]:
        """Every event, in order of time."""
        found = self._messages(lambda channel: channel.topic == messages.EVENT)
        return sorted(map(_event, found), key=attrgetter("time_ns"))

    @property
    def frame_count(self) -> int:
        """How many frames were recorded."""
        return len(self._places)

    @property
    def frame_times_ns(self) -> NDArray[np.int64]:
        """Middle of the exposure of each frame, shape (frame_count,), ascending."""
        return np.array([place.time_ns for place in self._places], np.int64)

    def frame(self, index: int) -> Frame:
        """The frame of that index, counted from 0 in order of time; SessionError when there is none."""
        if not 0 <= index < self.frame_count:
            raise SessionError(f"{self.path}: has no frame {index}; it has {self.frame_count}, counted from 0")
        return _frame(self._image(self._places[index]))

    def frames(self) -> Iterator[Frame]:
        """The frames in order of time, each read and decoded when asked for. A frame whose description did not reach
        the disk has NaN for exposure, gain and temperature."""
        return map(_frame, self.images())

    def images(self) -> Iterator[RecordedImage]:
        """The images in order of time as they were recorded, each read when asked for and not decoded."""
        return map(self._image, self._places)

    def items(self) -> Iterator[Item]:
        """Every batch, frame, step mark and event in the order of their publication, each read when asked for.

        A frame's place in that order is that of its description; a frame whose description is lost comes in order of
        time. Publishing the items to a recorder gives the same messages again.
        """
        images = _ImagesToCome(self._places, self._descriptions, self._image)
        for message in self._messages(_stands_for_item):
            yield from map(_frame, images.undescribed_before(message.time_ns))
            if message.topic == messages.CAMERA_META:
                yield from map(_frame, images.described_by(message))
            else:
                yield ITEM_OF_TOPIC[message.topic](message)
        yield from map(_frame, images.undescribed_before(None))

    def _image(self, place: FramePlace) -> RecordedImage:
        message = read_frame(place)
        meta = self._metas.get((message.time_ns, message.sequence))
        return RecordedImage(place.schema, message.data, message.sequence, message.time_ns, meta)

    @cached_property
    def _places(self) -> list[FramePlace]:
        places = [place for path in self._frames for place in frame_places(path)]
        return sorted(places, key=attrgetter("time_ns"))

    @property
    def frame_metas(self) -> list[tuple[int, messages.FrameMeta]]:
        """(time_ns, description) of every frame in order of publication, also of those whose image was lost."""
        return [(description.time_ns, description.meta) for description in self._descriptions]

    @cached_property
    def _descriptions(self) -> list[_Description]:
        found = self._messages(lambda channel: channel.topic == messages.CAMERA_META)
        return [_Description(m.time_ns, m.sequence, messages.decode_frame_meta(m.data)) for m in found]

    @cached_property
    def _metas(self) -> dict[tuple[int, int], messages.FrameMeta]:
        return {(known.time_ns, known.sequence): known.meta for known in self._descriptions}

    def _messages(self, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
        """The telemetry of the wanted channels in the order of the files."""
        for path in self._telemetry:
            yield from telemetry_messages(path, wanted)


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


def _batch(message: Message) -> Batch:
    return messages.decode_batch(message.topic, message.data, message.time_ns)


def _step(message: Message) -> StepMark:
    return messages.decode_step(message.data, message.time_ns)


def _event(message: Message) -> Event:
    return messages.decode_event(message.data, message.time_ns)


# The topics that stand for items of their own; the recorder derives the log and the table's pose from these.
ITEM_OF_TOPIC: Mapping[str, Callable[[Message], Item]] = {
    **dict.fromkeys(messages.KIND_OF_TOPIC, _batch),
    messages.STEP: _step,
    messages.EVENT: _event,
}


def _stands_for_item(channel: Channel) -> bool:
    return channel.topic in ITEM_OF_TOPIC or channel.topic == messages.CAMERA_META


def _frame(recorded: RecordedImage) -> Frame:
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


def _sorted(times_ns: array[int], values: array[float]) -> Column:
    times = np.array(times_ns, np.int64)
    order = np.argsort(times, kind="stable")
    return times[order], np.array(values, np.float64)[order]


def _files_of(path: Path, suffix: str) -> tuple[Path, ...]:
    return (*_segments(path / TELEMETRY, suffix), *_segments(path / FRAMES, suffix))


def _segments(folder: Path, suffix: str) -> list[Path]:
    """The files in `folder` that end so, in order of their numbers; none when there is no such folder."""
    try:
        paths = [path for path in folder.iterdir() if path.name.endswith(suffix)]
    except OSError:
        return []
    return sorted(paths, key=lambda path: (len(path.name), path.name))
