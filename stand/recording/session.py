"""Reads a recorded session: metadata, readings, frames, steps, events. It needs no device and changes nothing.

A topic of the telemetry is read only when asked for, and then kept; frames are decoded one at a time. Whatever is
wrong with a session is a SessionError with a sentence.
"""

from __future__ import annotations

from array import array
from collections.abc import Callable, Iterator
from functools import cached_property
from operator import attrgetter
from pathlib import Path

import numpy as np
from mcap.records import Channel
from numpy.typing import NDArray

from drivers.interface import Frame, SessionError
from stand.hub import Event, StepMark
from stand.recording import messages
from stand.recording.images import decode_image
from stand.recording.layout import DEVICES, FINISHED, FRAMES, TELEMETRY, UNFINISHED
from stand.recording.records import FramePlace, Message, frame_places, read_frame, read_head, telemetry_messages

Column = tuple[NDArray[np.int64], NDArray[np.float64]]


class Session:
    """A session directory; `incomplete` are the segments that were not finished and are not read."""

    def __init__(self, path: Path, telemetry: list[Path], frames: list[Path], incomplete: tuple[Path, ...]) -> None:
        self.path = path
        self.incomplete = incomplete
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
        incomplete = tuple(_segments(path / TELEMETRY, UNFINISHED) + _segments(path / FRAMES, UNFINISHED))
        if not telemetry:
            unfinished = f", only {len(incomplete)} unfinished ones" if incomplete else ""
            raise SessionError(f"{path}: not a session: there is no finished segment in {path / TELEMETRY}{unfinished}")
        return cls(path, telemetry, frames, incomplete)

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
            for reading in messages.decode_batch(message.topic, message.data, message.time_ns):
                times_ns, values = topic.setdefault(reading.channel, (array("q"), array("d")))
                times_ns.append(reading.time_ns)
                values.append(reading.value)
        for name, topic in columns.items():
            self._readings[name] = {channel: _sorted(*column) for channel, column in topic.items()}

    def steps(self) -> list[StepMark]:
        """Every step mark, in order of time."""
        found = self._messages(lambda channel: channel.topic == messages.STEP)
        return sorted((messages.decode_step(m.data, m.time_ns) for m in found), key=attrgetter("time_ns"))

    def events(self) -> list[Event]:
        """Every event, in order of time."""
        found = self._messages(lambda channel: channel.topic == messages.EVENT)
        return sorted((messages.decode_event(m.data, m.time_ns) for m in found), key=attrgetter("time_ns"))

    @property
    def frame_count(self) -> int:
        """How many frames were recorded."""
        return len(self._places)

    @property
    def frame_times_ns(self) -> NDArray[np.int64]:
        """Middle of the exposure of each frame, shape (frame_count,), ascending."""
        return np.array([place.time_ns for place in self._places], np.int64)

    def frames(self) -> Iterator[Frame]:
        """The frames in order of time, each read and decoded when asked for. A frame whose description did not reach
        the disk has NaN for exposure, gain and temperature."""
        metas = self._frame_metas
        for place in self._places:
            message = read_frame(place)
            image = decode_image(place.schema, message.data)
            meta = metas.get((message.time_ns, message.sequence), _unknown(image.channel, message.sequence))
            yield Frame(
                channel=image.channel,
                image=image.pixels,
                time_ns=message.time_ns,
                exposure_s=meta.exposure_s,
                gain_dB=meta.gain_dB,
                camera_degC=meta.camera_degC,
                block_id=meta.block_id,
                camera_ticks=meta.camera_ticks,
                dropped=meta.dropped,
                step_id=meta.step_id,
                windows=image.windows,
            )

    @cached_property
    def _places(self) -> list[FramePlace]:
        places = [place for path in self._frames for place in frame_places(path)]
        return sorted(places, key=attrgetter("time_ns"))

    @cached_property
    def _frame_metas(self) -> dict[tuple[int, int], messages.FrameMeta]:
        found = self._messages(lambda channel: channel.topic == messages.CAMERA_META)
        return {(m.time_ns, m.sequence): messages.decode_frame_meta(m.data) for m in found}

    def _messages(self, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
        """The telemetry of the wanted channels in the order of the files."""
        for path in self._telemetry:
            yield from telemetry_messages(path, wanted)


def _unknown(channel: str, block_id: int) -> messages.FrameMeta:
    return messages.FrameMeta(channel, "", block_id, 0, np.nan, np.nan, np.nan, 0)


def _sorted(times_ns: array[int], values: array[float]) -> Column:
    times = np.array(times_ns, np.int64)
    order = np.argsort(times, kind="stable")
    return times[order], np.array(values, np.float64)[order]


def _segments(folder: Path, suffix: str) -> list[Path]:
    """The files in `folder` that end so, in order of their numbers; none when there is no such folder."""
    try:
        paths = [path for path in folder.iterdir() if path.name.endswith(suffix)]
    except OSError:
        return []
    return sorted(paths, key=lambda path: (len(path.name), path.name))
