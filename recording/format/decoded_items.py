"""Recorded messages back to the items that were published, one by one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mcap.records import Channel

from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, Event, Original, StepMark
from thermostand.foundation.readings import Frame
from thermostand.recording.format import messages
from thermostand.recording.format.batches import READINGS
from thermostand.recording.format.damage import name_file_in_errors
from thermostand.recording.format.images import decode_image, decode_windows
from thermostand.recording.format.records import FramePlace, RecordedMessage, read_frame


@dataclass(frozen=True, slots=True)
class RecordedImage:
    """A frame as it was recorded: its description, as a message and what that says, its image as a message, for
    decode_image, and the segment they were read from, with what they take there."""

    meta: messages.FrameMeta
    description: bytes
    data: memoryview
    path: Path
    stored_bytes: int

    @property
    def time_ns(self) -> int:
        """The middle of the exposure."""
        return self.meta.time_ns


def read_recorded_image(place: FramePlace) -> RecordedImage:
    """The frame at that place; SessionError when it is damaged."""
    description, image = read_frame(place)
    return RecordedImage(place.meta, description, image, place.path, place.chunk.length)


def decode_step_item(message: RecordedMessage) -> StepMark:
    """The step mark in a message; SessionError when it is none."""
    return messages.decode_step(message.data, message.time_ns)


def decode_event_item(message: RecordedMessage) -> Event:
    """The event in a message; SessionError when it is none."""
    return messages.decode_event(message.data, message.time_ns)


def is_item_channel(channel: Channel) -> bool:
    """Return whether each message of a channel is an item; not so the log and the table's pose, which the recorder
    derives."""
    return channel.topic.startswith(READINGS) or channel.topic in (messages.STEP, messages.EVENT, messages.ORIGINAL)


def decode_item(message: RecordedMessage) -> Batch | StepMark | Event | Original:
    """The item that a message stands for."""
    if message.form is not None:
        return message.form.decode(message.data, message.time_ns)
    match message.topic:
        case messages.STEP:
            return decode_step_item(message)
        case messages.EVENT:
            return decode_event_item(message)
        case _:
            return messages.decode_original(message.data, message.time_ns)


def decode_frame(recorded: RecordedImage) -> Frame:
    """The frame of a recorded image. SessionError when it is damaged."""
    meta = recorded.meta
    with name_file_in_errors(recorded.path):
        image, windows = decode_image(recorded.data), decode_windows(meta)
        if image.shape != (meta.height, meta.width):
            raise SessionError(f"an image of {image.shape} px is described as one of {(meta.height, meta.width)}")
    return Frame(
        channel=meta.channel,
        image=image,
        time_ns=meta.time_ns,
        exposure_s=meta.exposure_s,
        gain_dB=meta.gain_dB,
        camera_degC=meta.camera_degC,
        block_id=meta.block_id,
        camera_ticks=meta.camera_ticks,
        dropped=meta.dropped,
        step_id=meta.step_id,
        windows=windows,
        flags=meta.flags,
        significant_bits=meta.significant_bits,
        described=recorded.description,
    )
