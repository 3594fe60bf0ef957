"""Everything the hub publishes, on the disk: two series of segments, and what is lost is counted and said.

Telemetry is committed on ticks of the stand's clock, each frame by itself; encoding and disk work run in a lane per
series, off the loop and with virtual time held. A slow disk fills the bounded queue of frames and then drops frames;
telemetry waits in memory until it is on the disk. Log times are the items' own, so the same items at the same
instants of a virtual clock give the same bytes.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal

from mcap.writer import CompressionType

from drivers.clock import Clock, seconds_ns
from drivers.interface import Frame, Quality, SessionError
from drivers.lane import Lane
from stand.hub import Batch, Event, Hub, Item, StepMark
from stand.recording import messages
from stand.recording.images import CAMERA_IMAGE, IMAGE_CLASS, ImageEncoding, encode_image
from stand.recording.layout import FRAMES, TELEMETRY
from stand.recording.segment import Record, SeriesForm, Topic
from stand.recording.series import Series
from stand.recording.sink import sync_folder

SEQUENCE_MASK = 0xFFFF_FFFF  # MCAP has 32 bits for the block id; FrameMeta has all 64


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """Who recorded what with which; the metadata record `session` of every segment.

    simulated: the devices were fakes, in whatever time. On a virtual clock `host` is not recorded: the same run on
    another machine is the same session.
    """

    session_id: str
    recipe: str
    camera_serial: str
    operator: str
    software_version: str
    clock_source: Literal["wall", "virtual"]
    simulated: bool = False
    host: str = ""

    def metadata(self) -> dict[str, str]:
        """The fields as MCAP metadata."""
        fields: dict[str, str] = {**asdict(self), "simulated": str(self.simulated).lower()}
        if self.clock_source == "virtual":
            del fields["host"]
        return fields


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """How to record. `telemetry_commit_s` is on the stand's clock: on a virtual one a long period (60) costs nothing
    that a real night would lose and spares tens of thousands of disk syncs. A segment is closed at the first commit
    after it has `segment_bytes` or `segment_s`, whichever is first."""

    frame_encoding: ImageEncoding = "png"
    telemetry_commit_s: float = 1.0
    segment_bytes: int = 1_000_000_000
    segment_s: float = 600.0
    queue_frames: int = 20


class TelemetryEncoder:
    """Items of the hub to records of the telemetry series; `devices` maps a device's name to its kind."""

    def __init__(self, devices: Mapping[str, str]) -> None:
        unknown = sorted({kind for kind in devices.values() if kind not in messages.KINDS})
        if unknown:
            raise ValueError(f"no device kind {', '.join(unknown)}; there are {', '.join(messages.KINDS)}")
        self._devices = dict(devices)
        self._encoders = {
            name: messages.BatchEncoder(name, messages.KINDS[kind]) for name, kind in self._devices.items()
        }
        self._table: dict[str, float] = {}  # unit -> last position of the axis in that unit

    def topics(self) -> tuple[Topic, ...]:
        """The topics these devices need, and those every session has."""
        names = [kind.topic for name, kind in messages.KINDS.items() if name in self._devices.values()]
        if "axis" in self._devices.values():
            names.append(messages.TABLE_POSE)
        names += [messages.CAMERA_META, messages.STEP, messages.EVENT, messages.LOG]
        return tuple(Topic(name, messages.CLASSES[name], self._devices_on(name)) for name in names)

    def _devices_on(self, topic: str) -> tuple[str, ...]:
        return tuple(name for name, encoder in self._encoders.items() if encoder.topic == topic)

    def check(self, item: Item) -> None:
        """ValueError when the item is a batch of a device that was not declared."""
        if isinstance(item, Batch) and item.device not in self._encoders:
            raise ValueError(f"{item.device} is not among the recorded devices {', '.join(self._encoders)}")

    def encode(self, item: Item) -> Iterator[Record]:
        """The item's records, most often one."""
        match item:
            case Batch():
                encoder = self._encoders[item.device]
                yield Record(encoder.topic, item.time_ns, encoder.encode(item))
                if self._devices[item.device] == "axis":
                    yield from self._pose(item)
            case Frame():
                yield Record(
                    messages.CAMERA_META, item.time_ns, messages.encode_frame_meta(item), item.block_id & SEQUENCE_MASK
                )
            case StepMark():
                yield Record(messages.STEP, item.time_ns, messages.encode_step(item))
            case Event():
                yield Record(messages.EVENT, item.time_ns, messages.encode_event(item))
                yield Record(messages.LOG, item.time_ns, messages.encode_log(item))

    def _pose(self, batch: Batch) -> Iterator[Record]:
        """The table's pose for viewers, once both axes have told where they are; none while one does not know."""
        for reading in batch.readings:
            if reading.channel == f"{batch.device}.position":
                self._table.pop(reading.unit, None)
                if reading.quality is not Quality.BAD:
                    self._table[reading.unit] = reading.value
        if "mm" in self._table and "deg" in self._table:
            pose = messages.encode_table_pose(batch.time_ns, self._table["mm"], self._table["deg"])
            yield Record(messages.TABLE_POSE, batch.time_ns, pose)


class Recorder:
    """Records from `start` to `finish`; `run` does the work between and is cancelled before `finish`.

    `directory` gets the folders `frames` and `telemetry`; a directory with segments of an earlier run is continued.
    """

    def __init__(
        self,
        directory: Path,
        info: SessionInfo,
        attachments: Mapping[str, str],
        devices: Mapping[str, str],
        hub: Hub,
        clock: Clock,
        settings: RecordingSettings = RecordingSettings(),
    ) -> None:
        self.directory = directory
        self._info = info
        self._attachments = dict(attachments)
        self._hub = hub
        self._clock = clock
        self._settings = settings
        self._encoder = TelemetryEncoder(devices)
        self._frames: asyncio.Queue[Frame] = asyncio.Queue(settings.queue_frames)
        self._items: list[Item] = []  # telemetry since the last tick
        self._backlog: list[Record] = []  # encoded, not yet on the disk; the telemetry lane's own
        self._losses = Losses()
        self._telemetry_failing = False
        self._open = False

    @property
    def frames_lost(self) -> int:
        """Frames published but not in the session."""
        return self._losses.total

    def start(self) -> None:
        """Make the folders, begin the telemetry and listen to the hub; SessionError when the disk refuses."""
        try:
            for name in (FRAMES, TELEMETRY):
                (self.directory / name).mkdir(parents=True, exist_ok=True)
            sync_folder(self.directory)
            sync_folder(self.directory.parent)
            image_topic = Topic(CAMERA_IMAGE, IMAGE_CLASS[self._settings.frame_encoding])
            # PNG does not shrink further, and raw frames are chosen for speed.
            self._image_series = self._series(FRAMES, (image_topic,), CompressionType.NONE)
            self._telemetry_series = self._series(TELEMETRY, self._encoder.topics(), CompressionType.ZSTD)
            self._telemetry_series.open(self._clock.now_ns())
        except OSError as error:
            raise SessionError(f"{self.directory}: no session can be recorded here ({error})") from error
        self._frame_lane = Lane("record-frames", self._clock)
        self._telemetry_lane = Lane("record-telemetry", self._clock)
        self._open = True
        self._hub.subscribe(self._receive)

    def _series(self, name: str, topics: tuple[Topic, ...], compression: CompressionType) -> Series:
        form = SeriesForm(
            name,
            topics,
            compression,
            self._info.metadata(),
            self._attachments,
            self._settings.segment_bytes,
            seconds_ns(self._settings.segment_s),
        )
        return Series(self.directory / name, form)

    async def run(self) -> None:
        """Record until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._record_telemetry())
            tasks.create_task(self._record_frames())

    async def finish(self) -> None:
        """Put what still waits on the disk and complete the segments; SessionError when telemetry was not saved or its
        segment stays unfinished. Items published later are not recorded. May be called twice."""
        if not self._open:
            return
        while not self._frames.empty():
            await self._frame_lane.call(self._save_frame, self._frames.get_nowait())
        await self._frame_lane.call(self._image_series.finish)
        self._report()
        self._open = False
        failure = await self._save_telemetry()
        is_complete = await self._telemetry_lane.call(self._telemetry_series.finish)
        self._frame_lane.close()
        self._telemetry_lane.close()
        if failure is not None:
            raise SessionError(f"{self.directory}: {len(self._backlog)} messages were not saved ({failure})")
        if not is_complete:
            raise SessionError(f"{self.directory}: {self._telemetry_series.troubles.pop()}")

    def _receive(self, item: Item) -> None:
        """The hub's subscriber: enqueue, or count what does not fit."""
        if not self._open:
            return
        self._encoder.check(item)
        if isinstance(item, Frame):
            try:
                self._frames.put_nowait(item)
            except asyncio.QueueFull:
                self._losses.count(item, "the disk is too slow")
                return
        self._items.append(item)

    async def _record_frames(self) -> None:
        while True:
            frame = await self._frames.get()
            await self._frame_lane.call(self._save_frame, frame)

    def _save_frame(self, frame: Frame) -> None:
        """Encode and commit one frame; a frame the disk refuses twice is lost, and counted."""
        data = encode_image(frame, self._settings.frame_encoding)
        record = Record(CAMERA_IMAGE, frame.time_ns, data, frame.block_id & SEQUENCE_MASK)
        try:
            self._image_series.commit([record], frame.time_ns)
        except OSError as error:
            self._losses.count(frame, str(error))

    async def _record_telemetry(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            due_ns += seconds_ns(self._settings.telemetry_commit_s)
            await self._clock.sleep_until(due_ns)
            self._report()
            failure = await self._save_telemetry()
            if (failure is not None) != self._telemetry_failing:
                self._telemetry_failing = failure is not None
                self._publish_telemetry_state(failure)

    async def _save_telemetry(self) -> OSError | None:
        """Commit what was published since the last time and what failed before; the error when the disk refuses."""
        items, self._items = self._items, []
        return await self._telemetry_lane.call(self._commit_telemetry, items, self._clock.now_ns())

    def _commit_telemetry(self, items: list[Item], now_ns: int) -> OSError | None:
        for item in items:
            self._backlog.extend(self._encoder.encode(item))
        if not self._backlog:
            return None
        try:
            self._telemetry_series.commit(self._backlog, now_ns)
        except OSError as error:
            return error
        self._backlog.clear()
        return None

    def _publish_telemetry_state(self, failure: OSError | None) -> None:
        if failure is None:
            event = Event(self._clock.now_ns(), "info", "telemetry_saved_again", "the disk takes telemetry again")
        else:
            event = Event(
                self._clock.now_ns(), "error", "telemetry_not_saved", f"telemetry is kept in memory: {failure}"
            )
        self._hub.publish(event)

    def _report(self) -> None:
        """Publish what was lost or overcome since the last time."""
        now_ns = self._clock.now_ns()
        for series in (self._image_series, self._telemetry_series):
            while series.troubles:
                self._hub.publish(Event(now_ns, "warning", "segment_given_up", series.troubles.popleft()))
        for text in self._losses.take():
            self._hub.publish(Event(now_ns, "error", "frames_dropped", text))


class Losses:
    """Frames that will not be in the session: counted, and told by reason."""

    def __init__(self) -> None:
        self.total = 0
        self._new: deque[tuple[str, int]] = deque()  # counted in the frames' lane, too, hence a deque

    def count(self, frame: Frame, reason: str) -> None:
        """One frame lost."""
        self._new.append((reason, frame.block_id))

    def take(self) -> list[str]:
        """A sentence for each reason since the last time."""
        blocks: dict[str, list[int]] = {}
        while self._new:
            reason, block_id = self._new.popleft()
            blocks.setdefault(reason, []).append(block_id)
            self.total += 1
        return [
            f"frames lost: {len(ids)} (blocks {ids[0]} to {ids[-1]}), {self.total} in all; {reason}"
            for reason, ids in blocks.items()
        ]
