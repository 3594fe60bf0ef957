"""Everything the hub publishes, on the disk: two series of segments, and what is lost is counted and said.

Telemetry is committed on ticks of the stand's clock, each frame by itself; encoding and disk work run in a lane per
series, off the loop and with virtual time held. A slow disk fills the bounded queue of frames and then drops frames;
a nearly full one is left to the telemetry, which waits in memory until it is on the disk. Log times are the items'
own, so the same items at the same instants of a virtual clock give the same bytes.
"""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from mcap.writer import CompressionType

from drivers.clock import Clock, seconds_ns
from drivers.interface import Frame, SessionError
from drivers.lane import Lane
from stand.hub import Event, Hub, Item
from stand.recording.images import CAMERA_IMAGE, IMAGE_CLASS, encode_image
from stand.recording.layout import FRAMES, TELEMETRY
from stand.recording.losses import Losses
from stand.recording.segment import SeriesForm, Topic
from stand.recording.series import Series
from stand.recording.settings import USUAL, RecordingSettings, SessionInfo
from stand.recording.sink import sync_folder
from stand.recording.space import Notice, SpaceWatch
from stand.recording.telemetry import TelemetryEncoder
from stand.recording.writers import ImageWriter, TelemetryWriter

TELEMETRY_RESERVE_BYTES = 16_000_000  # hours of it, so that it goes on when frames or others fill the disk
NO_IMAGE = np.empty((0, 0), np.uint8)


@dataclass(frozen=True, slots=True)
class Saved:
    """What is known to be on the disk since the start: frames, and messages of telemetry. Frames published are either
    saved, lost or still waiting."""

    frames: int
    telemetry: int
    frames_lost: int


class Recorder:
    """Records from `start` to `finish`; `run` does the work between and is cancelled before `finish`.

    `directory` gets the folders `frames` and `telemetry`; a directory with segments of an earlier run is continued.
    `encode` makes an image message of the settings' encoding, in a thread of its own and in order of the frames; by
    default each by itself.
    """

    def __init__(
        self,
        directory: Path,
        info: SessionInfo,
        attachments: Mapping[str, str],
        devices: Mapping[str, str],
        hub: Hub,
        clock: Clock,
        settings: RecordingSettings = USUAL,
        encode: Callable[[Frame], bytes] | None = None,
    ) -> None:
        self.directory = directory
        self._info = info
        self._attachments = dict(attachments)
        self._hub = hub
        self._clock = clock
        self._settings = settings
        self._encode = encode or self._encode_alone
        self._encoder = TelemetryEncoder(devices)
        self._frames: asyncio.Queue[Frame] = asyncio.Queue(settings.queue_frames)
        self._frames_taken = 0
        self._items: list[Item] = []  # telemetry since the last commit
        self._items_taken = 0
        self._losses = Losses()
        self._notices: deque[Notice] = deque()  # from any thread
        self._telemetry_failing = False
        self._progress = asyncio.Event()  # set, and replaced, when something has been saved or lost
        self._taking = self._taking_frames = False
        self._finishing: asyncio.Future[None] | None = None

    @property
    def frames_lost(self) -> int:
        """Frames published but not in the session."""
        return self._losses.total

    @property
    def saved(self) -> Saved:
        """What has been acknowledged since `start`: it is on the disk and stays there."""
        return Saved(self._image_writer.saved, self._telemetry_writer.messages_saved, self._losses.total)

    def start(self, earlier: Iterable[Item] = ()) -> None:
        """Make the folders, begin the telemetry and listen to the hub; SessionError when the disk refuses. `earlier`:
        what was published before, in its order, and belongs to the session."""
        try:
            for name in (FRAMES, TELEMETRY):
                (self.directory / name).mkdir(parents=True, exist_ok=True)
            sync_folder(self.directory)
            sync_folder(self.directory.parent)
            self._open_series()
        except OSError as error:
            raise SessionError(f"{self.directory}: no session can be recorded here ({error})") from error
        self._frame_lane = Lane("record-frames", self._clock)
        self._telemetry_lane = Lane("record-telemetry", self._clock)
        self._taking = self._taking_frames = True
        for item in earlier:
            self._receive(item)
        self._hub.subscribe(self._receive)

    def _open_series(self) -> None:
        settings = self._settings
        common = (self._info.metadata(), self._attachments, settings.segment_bytes, seconds_ns(settings.segment_s))
        frames = SeriesForm(
            FRAMES,
            (Topic(CAMERA_IMAGE, IMAGE_CLASS[settings.frame_encoding]),),
            CompressionType.NONE,  # PNG does not shrink further, and raw frames are chosen for speed
            *common,
            reserve_bytes=settings.segment_bytes,
            keep_free_bytes=settings.stop_frames_below_bytes,
        )
        telemetry = SeriesForm(
            TELEMETRY,
            self._encoder.topics(),
            CompressionType.ZSTD,
            *common,
            reserve_bytes=TELEMETRY_RESERVE_BYTES,
            merge_chunks=True,
        )
        self._image_series = Series(self.directory / FRAMES, frames)
        self._telemetry_series = Series(self.directory / TELEMETRY, telemetry)
        space = SpaceWatch(
            self.directory,
            settings.stop_frames_below_bytes,
            settings.alert_below_fraction,
            lambda: self._image_series.reserved_bytes,
            self._notices.append,
        )
        self._image_writer = ImageWriter(self._image_series, self._encode, space, self._losses)
        self._telemetry_writer = TelemetryWriter(self._telemetry_series, self._encoder, space)
        self._telemetry_series.open(self._clock.now_ns())

    def _encode_alone(self, frame: Frame) -> bytes:
        return encode_image(frame, self._settings.frame_encoding)

    async def run(self) -> None:
        """Record until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._report_on_ticks())  # by itself: it has to tell of a disk that holds up the others
            tasks.create_task(self._save_telemetry_on_ticks())
            tasks.create_task(self._record_frames())
            tasks.create_task(self._close_old_frames_on_ticks())

    async def flushed(self) -> None:
        """Return when everything published before the call is on the disk or counted as lost. Only while `run` runs;
        telemetry the disk refuses is waited for."""
        frames, items = self._frames_taken, self._items_taken
        await self._save_telemetry()
        while self._taking and (self._image_writer.done < frames or self._telemetry_writer.items_saved < items):
            await self._progress.wait()

    async def finish(self) -> None:
        """Put what still waits on the disk and complete the segments; SessionError when telemetry was not saved or its
        segment stays unfinished. Items published later are not recorded. It goes on to its end also when the caller is
        cancelled. May be called twice."""
        if self._finishing is None:
            if not self._taking:
                return
            self._finishing = asyncio.ensure_future(self._finish())
        try:
            await asyncio.shield(self._finishing)
        except asyncio.CancelledError:
            await asyncio.wait([self._finishing])
            raise

    async def _finish(self) -> None:
        async with AsyncExitStack() as stack:  # each of these is done, whatever happens to those before it
            stack.callback(self._telemetry_lane.close)
            stack.callback(self._frame_lane.close)
            stack.push_async_callback(self._finish_telemetry)
            stack.push_async_callback(self._frame_lane.call, self._image_series.finish)
            while not self._frames.empty():
                await self._frame_lane.call(self._image_writer.save, self._frames.get_nowait())
            self._taking_frames = False

    async def _finish_telemetry(self) -> None:
        self._report()
        self._taking = False
        failure = await self._save_telemetry()
        is_complete = await self._telemetry_lane.call(self._telemetry_series.finish)
        if failure is not None:
            count = self._telemetry_writer.waiting
            raise SessionError(f"{self.directory}: {count} messages were not saved ({failure})")
        if not is_complete:
            raise SessionError(f"{self.directory}: {self._telemetry_series.troubles.pop()}")

    def warn(self, kind: str, text: str) -> None:
        """An event of this kind with the next report; from any thread."""
        self._notices.append(Notice("warning", kind, text))

    def _receive(self, item: Item) -> None:
        """The hub's subscriber: enqueue, or count what does not fit."""
        if not self._taking:
            return
        self._encoder.check(item)
        if isinstance(item, Frame):
            if not self._taking_frames:
                return
            self._enqueue(item)
            item = replace(item, image=NO_IMAGE)  # the image itself waits in one place only
        self._items.append(item)
        self._items_taken += 1

    def _enqueue(self, frame: Frame) -> None:
        try:
            self._frames.put_nowait(frame)
        except asyncio.QueueFull:
            self._losses.count(frame, "the disk is too slow")
        else:
            self._frames_taken += 1

    async def _record_frames(self) -> None:
        while True:
            frame = await self._frames.get()
            await self._frame_lane.call(self._image_writer.save, frame)
            self._tell_progress()

    async def _save_telemetry_on_ticks(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            due_ns = await self._next_tick(due_ns)
            await self._save_telemetry()
            self._report()  # a disk that is nearly full: each frame until somebody knows of it is lost

    async def _close_old_frames_on_ticks(self) -> None:
        """A soak is long: its last frames are not left unfinished, nor their reserve taken, until the next ones."""
        due_ns = self._clock.now_ns()
        while True:
            due_ns = await self._next_tick(due_ns)
            await self._frame_lane.call(self._image_series.finish_full, due_ns)

    async def _report_on_ticks(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            due_ns = await self._next_tick(due_ns)
            self._report()

    async def _next_tick(self, last_ns: int) -> int:
        due_ns = last_ns + seconds_ns(self._settings.telemetry_commit_s)
        await self._clock.sleep_until(due_ns)
        return due_ns

    async def _save_telemetry(self) -> OSError | None:
        """Commit what was published since the last time and what failed before; the error when the disk refuses."""
        items, self._items = self._items, []
        failure = await self._telemetry_lane.call(self._telemetry_writer.save, items, self._clock.now_ns())
        self._tell_progress()
        if (failure is not None) != self._telemetry_failing:
            self._telemetry_failing = failure is not None
            self._notices.append(_telemetry_notice(failure))
        return failure

    def _tell_progress(self) -> None:
        self._progress.set()
        self._progress = asyncio.Event()

    def _report(self) -> None:
        """Publish what was lost, overcome or noticed since the last time."""
        for series in (self._image_series, self._telemetry_series):
            while series.troubles:
                self._notices.append(Notice("warning", "segment_given_up", series.troubles.popleft()))
        self._notices.extend(Notice("error", "frames_dropped", text) for text in self._losses.take())
        while self._notices:
            self._hub.publish(Event(self._clock.now_ns(), *self._notices.popleft()))


def _telemetry_notice(failure: OSError | None) -> Notice:
    if failure is None:
        return Notice("info", "telemetry_saved_again", "the disk takes telemetry again")
    return Notice("error", "telemetry_not_saved", f"telemetry is kept in memory: {failure}")
