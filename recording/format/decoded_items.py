"""Recorded messages back to the items that were published, one by one."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from mcap.records import Channel

from thermostand.foundation.items import Batch, Event, Original, StepMark
from thermostand.foundation.readings import Frame
from thermostand.recording.format import messages
from thermostand.recording.format.damage import naming
from thermostand.recording.format.images import decode_image
from thermostand.recording.format.records import FramePlace, Message


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


@dataclass(frozen=True, slots=True)
class Description:
    """A frame's description whose image is missing: the message as it was recorded."""

    time_ns: int
    sequence: int
    data: bytes


class UndescribedFrame(Frame):
    """A frame whose description is missing: NaN and zeros stand for what only that would give, and are not recorded
    again."""


class ImagesToCome:
    """The images that `items` has not given yet, found by the descriptions that stand for them."""

    def __init__(
        self,
        places: Iterable[FramePlace],
        described_ns: Iterable[int],
        read: Callable[[FramePlace], RecordedImage],
    ) -> None:
        self._read = read
        self._places: dict[int, list[FramePlace]] = {}
        for place in places:
            self._places.setdefault(place.time_ns, []).append(place)
        self._descriptions = Counter(described_ns)  # time -> how many are to come
        self._undescribed = deque(time_ns for time_ns in self._places if time_ns not in self._descriptions)

    def undescribed_before(self, time_ns: int | None) -> Iterator[RecordedImage]:
        """The images before `time_ns` (None: all) whose time no description has."""
        while self._undescribed and (time_ns is None or self._undescribed[0] < time_ns):
            yield from map(self._read, self._places.pop(self._undescribed.popleft()))

    def described_by(self, message: Message) -> Iterator[Frame | Description]:
        """The image that the description in `message` stands for, the description alone when it is missing; behind the
        last description of that time everything else that was recorded then."""
        places = self._places.get(message.time_ns, [])
        for place in places:
            image = self._read(place)
            if image.sequence == message.sequence:
                places.remove(place)
                yield frame_of(image)
                break
        else:
            yield Description(message.time_ns, message.sequence, message.data)
        self._descriptions[message.time_ns] -= 1
        if not self._descriptions[message.time_ns]:
            yield from map(frame_of, map(self._read, self._places.pop(message.time_ns, [])))


def step_of(message: Message) -> StepMark:
    """The step mark in a message; SessionError when it is none."""
    return messages.decode_step(message.data, message.time_ns)


def event_of(message: Message) -> Event:
    """The event in a message; SessionError when it is none."""
    return messages.decode_event(message.data, message.time_ns)


def describes_frame(channel: Channel) -> bool:
    """Whether the messages of a channel describe frames."""
    return channel.topic == messages.CAMERA_META


def description_of(message: Message) -> tuple[int, messages.FrameMeta]:
    """Time and content of a frame's description; SessionError when it is none."""
    return message.time_ns, messages.decode_frame_meta(message.data)


def stands_for_item(channel: Channel) -> bool:
    """Whether each message of a channel is an item; not so the log and the table's pose, which the recorder derives."""
    return channel.topic in {
        *messages.KIND_OF_TOPIC,
        messages.STEP,
        messages.EVENT,
        messages.CAMERA_META,
        messages.ORIGINAL,
    }


def item_of(message: Message) -> Batch | StepMark | Event | Original | None:
    """The item that a message stands for; None when that is a frame."""
    match message.topic:
        case messages.STEP:
            return step_of(message)
        case messages.EVENT:
            return event_of(message)
        case messages.CAMERA_META:
            return None
        case messages.ORIGINAL:
            return messages.decode_original(message.data, message.time_ns)
        case topic:
            return messages.decode_batch(topic, message.data, message.time_ns)


def frame_of(recorded: RecordedImage) -> Frame:
    """The frame of a recorded image, an UndescribedFrame when its description is missing. SessionError when it is
    damaged."""
    with naming(recorded.path):
        image = decode_image(recorded.schema, recorded.data)
    meta = recorded.meta or _unknown(image.channel, recorded.sequence)
    return (UndescribedFrame if recorded.meta is None else Frame)(
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
        flags=meta.flags,
    )


def _unknown(channel: str, block_id: int) -> messages.FrameMeta:
    return messages.FrameMeta(channel, "", block_id, 0, np.nan, np.nan, np.nan, 0)
