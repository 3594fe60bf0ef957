"""Everything the hub publishes, on the disk: two series of segments; losses are counted and reported.

Telemetry is committed on ticks of the stand's clock, each frame by itself; encoding and disk work run in a lane per
series, off the loop and with virtual time held. A slow disk fills the bounded queue of frames and then drops frames;
a nearly full one is left to the telemetry, which waits in memory until it is on the disk. Log times are the items'
own, so the same items at the same instants of a virtual clock give the same bytes.

Heat is only justified by what is recorded: `waiting_since_ns` and `folder_lost` are what a guard needs to know.
"""

from __future__ import annotations

import asyncio
import math
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import AsyncExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import cv2  # noqa: F401  # pyright: ignore[reportUnusedImport] - here, so that no frame waits for it
import numpy as np

from foundation.clock import Clock, seconds_ns
from foundation.errors import SessionError
from foundation.hub import Hub
from foundation.items import Batch, Event, Item
from foundation.lane import Lane
from foundation.patience import Patience
from foundation.readings import Frame
from recording.format.decoded_items import Description
from recording.format.images import encode_image
from recording.format.layout import FRAMES, TELEMETRY
from recording.format.restarts import restarted_step
from recording.writing.disk import Disk
from recording.writing.forms import SessionForm
from recording.writing.homes import Beside, Homes, Kept
from recording.writing.notices import DroppedReadings, Losses, Notice, telemetry_notice
from recording.writing.recorder_settings import USUAL, RecordingSettings, SessionInfo
from recording.writing.waiting import Waiting
from recording.writing.writers import DiskSeries, Fate, ImageWriter, TelemetryEncoder, TelemetryWriter, open_series

NO_IMAGE = np.empty((0, 0), np.uint8)
FINISH_WITHIN_S, COMPLETE_WITHIN_S = 2.0, 60.0  # real seconds that a disk may take for the end of a run: stopped, whole


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
    default each by itself. `disk` is the process that touches the disk; without one this process does.
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
        disk: Disk | None = None,
    ) -> None:
        self.directory = directory
        self.disk = disk
        self._form = SessionForm(info.metadata(), dict(attachments), dict(devices), settings)
        self._hub = hub
        self._clock = clock
        self._settings = settings
        self._encode = encode or self._encode_alone
        self._encoder = TelemetryEncoder(devices)
        self._frames: asyncio.Queue[Frame] = asyncio.Queue(settings.queue_frames)
        self._frames_taken = 0
        self._items: list[Item | Description] = []  # telemetry since the last commit
        self._items_taken = 0
        self._losses = Losses()
        self._dropped = DroppedReadings()
        self._waiting = Waiting()
        self._notices: deque[Notice] = deque()  # from any thread
        self._homes = Homes(directory, self._notices.append)
        self._telemetry_failing = False
        self._progress = asyncio.Event()  # set, and replaced, when something has been saved or lost
        self._taking = self._taking_frames = False
        self._finishing: asyncio.Future[None] | None = None

    @property
    def frames_lost(self) -> int:
        """Frames published but not in the session."""
        return self._losses.total

    def lost_of(self, step_id: str) -> int:
        """Frames of this step published but not in the session."""
        return self._losses.of(step_id)

    @property
    def saved(self) -> Saved:
        """What has been acknowledged since `start`: it is on the disk and stays there."""
        return Saved(self._image_writer.saved, self._telemetry_writer.messages_saved, self._losses.total)

    @property
    def waiting_since_ns(self) -> int | None:
        """When the oldest reading, event or frame was published that is not yet durable in this session's own folder;
        None when nothing is due. A frame that the disk refused waits until frames can be written again."""
        return self._waiting.since_ns

    @property
    def folder_lost(self) -> str:
        """Why the session's folder has gone, as a sentence; "" while it is there, or is being made again."""
        return self._homes.lost

    @property
    def writer_ended(self) -> str:
        """Why the process that touches the disk has ended, as a sentence; "" while it has not."""
        return "" if self.disk is None else self.disk.ended

    @property
    def disk_free_bytes(self) -> int:
        """As it was found at the last commit; does not wait for the disk."""
        return self._image_series.space.last.free_bytes

    def beside(self, file: Beside) -> None:
        """From now on this file counts as part of the session's folder: `folder_lost` and `refound` know of it."""
        self._homes.beside.append(file)

    def refound(self) -> None:
        """An operator has cleared the loss of the folder: continue in it, or in a new one at its place, with continued
        numbers. Returns at once."""
        self._homes.refind()

    def start(self, earlier: Iterable[Item] = ()) -> None:
        """Make the folders, begin the telemetry and listen to the hub; SessionError when the disk refuses. `earlier`:
        what was published before, in its order, and belongs to the session."""
        self._take(self._opened(), earlier)

    async def begin(self, earlier: Callable[[], Iterable[Item]]) -> None:
        """As `start`, off the loop."""
        lane = Lane("record-begin", self._clock, patient=False)
        try:
            series = await lane.call(self._opened)
        finally:
            lane.close()
        self._take(series, earlier())

    def _opened(self) -> tuple[DiskSeries, DiskSeries]:
        try:
            return open_series(self.disk, self.directory, self._form, self._clock.now_ns(), self._notices.append)
        except OSError as error:
            raise SessionError(f"{self.directory}: no session can be recorded here ({error})") from error

    def _take(self, series: tuple[DiskSeries, DiskSeries], earlier: Iterable[Item]) -> None:
        self._image_series, self._telemetry_series = series
        self._image_writer = ImageWriter(self._image_series, self._encode, self._losses)
        self._telemetry_writer = TelemetryWriter(self._telemetry_series, self._encoder)
        self._frame_lane = Lane("record-frames", self._clock, patient=False)
        self._telemetry_lane = Lane("record-telemetry", self._clock, patient=False)
        self._begun_ns = self._clock.now_ns()
        self._frames_kept = self._telemetry_kept = Kept(self._begun_ns, 0)
        self._taking = self._taking_frames = True
        for item in earlier:
            self._receive(item)
        self._hub.subscribe(self._receive)

    def _encode_alone(self, frame: Frame) -> bytes:
        return encode_image(frame, self._settings.frame_encoding)

    async def run(self) -> None:
        """Record until cancelled."""
        async with asyncio.TaskGroup() as tasks:
            tasks.create_task(self._report_on_ticks())  # by itself: it has to report a disk that holds up the others
            tasks.create_task(self._save_telemetry_on_ticks())
            tasks.create_task(self._record_frames())
            tasks.create_task(self._tend_frames_on_ticks())
            tasks.create_task(self._refound_when_asked())

    async def flushed(self) -> None:
        """Return when everything published before the call is on the disk or counted as lost. Only while `run` runs;
        telemetry the disk refuses is waited for."""
        frames, items = self._frames_taken, self._items_taken
        await self._save_telemetry()
        while self._taking and (self._image_writer.done < frames or self._telemetry_writer.items_saved < items):
            await self._progress.wait()

    async def finish(self, within_s: float = math.inf, patience: Patience | None = None) -> None:
        """Put what still waits on the disk and complete the segments; SessionError when telemetry was not saved or its
        segment stays unfinished, or when the disk has not done all that within so many real seconds, or so long as
        `patience` lasts: it is then left to itself. Items published later are not recorded. It runs to its end also
        when the caller is cancelled. May be called twice."""
        patience = patience or Patience()
        if self._finishing is None:
            if not self._taking:
                return
            self._finishing = asyncio.ensure_future(self._finish())
        try:
            await patience.wait(self._finishing, within_s)
        except asyncio.CancelledError:
            await patience.wait(self._finishing, within_s)
            await self._left()
            raise
        await self._left()
        self._hub.unsubscribe(self._receive)
        await self._finishing

    async def _left(self) -> None:
        """Wait for nothing any more that `_finish` has not done."""
        if self._finishing is not None and not self._finishing.done():
            self._telemetry_lane.abandon()
            self._frame_lane.abandon()
            await asyncio.wait([self._finishing])

    async def _finish(self) -> None:
        try:
            async with AsyncExitStack() as stack:  # each of these is done, also when one before it fails
                stack.callback(self._telemetry_lane.close)
                stack.callback(self._frame_lane.close)
                stack.push_async_callback(self._telemetry_lane.call, self._telemetry_series.close)
                stack.push_async_callback(self._frame_lane.call, self._image_series.close)
                stack.push_async_callback(self._finish_telemetry)
                stack.push_async_callback(self._frame_lane.call, self._image_series.finish)
                await self._finish_frames()
                self._taking_frames = False
        except TimeoutError as error:
            frames, messages = self._frames.qsize(), len(self._items) + self._telemetry_writer.waiting
            raise SessionError(
                f"{self.directory}: the disk has not answered in time; the session is unfinished, {frames} frames and "
                f"{messages} messages waited to be saved; `stand session salvage` completes it when the disk answers"
            ) from error

    async def _finish_frames(self) -> None:
        """Those that wait; the first may be one that found its folder gone when the recording was ended."""
        frame = await self._frame_lane.call(lambda: self._image_writer.homeless)
        while frame is not None or not self._frames.empty():
            frame = frame or self._frames.get_nowait()
            fate, reason = await self._frame_lane.call(self._image_writer.save, frame)
            if fate is Fate.HOMELESS:
                self._image_writer.give_up(frame, reason)
            frame = None

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

    def keep_description(self, description: Description) -> None:
        """A frame's description without its image, as the copy of a session that lost that image has it."""
        if self._taking:
            self._items.append(description)
            self._items_taken += 1
            self._waiting.item_published(self._clock.now_ns())

    def _receive(self, item: Item) -> None:
        """The hub's subscriber: enqueue, or count what does not fit."""
        if not self._taking:
            return
        self._encoder.check(item)
        now_ns = self._clock.now_ns()
        if isinstance(item, Event) and (step_id := restarted_step(item)):
            self._losses.supersede(step_id, item.time_ns)
        if isinstance(item, Frame):
            if not self._taking_frames:
                return
            self._enqueue(item, now_ns)
            item = replace(item, image=NO_IMAGE)  # the image itself waits in one place only
        if isinstance(item, Batch) and self._is_full():
            self._dropped.count(item, self._notices.append)
            return
        self._items.append(item)
        self._items_taken += 1
        self._waiting.item_published(now_ns)

    def _is_full(self) -> bool:
        """Whether more waits for the disk than may: readings are the first to go, nothing else is."""
        return len(self._items) + self._telemetry_writer.waiting >= self._settings.waiting_messages

    def _enqueue(self, frame: Frame, now_ns: int) -> None:
        try:
            self._frames.put_nowait(frame)
        except asyncio.QueueFull:
            self._losses.count(frame, "the disk is too slow")
            self._waiting.frame_refused(now_ns)
        else:
            self._frames_taken += 1
            self._waiting.frame_published(now_ns)

    async def _record_frames(self) -> None:
        while True:
            await self._homes.there.wait()
            frame = self._image_writer.homeless or await self._frames.get()
            fate, reason = await self._frame_lane.call(self._image_writer.save, frame)
            if fate is Fate.HOMELESS:
                self._homes.follow(FRAMES, reason, self._frames_kept)
                continue
            published_ns = self._waiting.frame_done()
            if fate is Fate.REFUSED:
                self._waiting.frame_refused(published_ns)
            elif fate is Fate.SAVED:
                self._waiting.frames_work()
                self._frames_kept = Kept(published_ns, self._image_writer.saved)
            self._tell_progress()

    async def _save_telemetry_on_ticks(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            due_ns = await self._next_tick(due_ns)
            await self._save_telemetry()
            self._report()  # a disk that is nearly full: frames are lost until this is reported

    async def _tend_frames_on_ticks(self) -> None:
        """A soak is long: its last frames are not left unfinished, nor their reserve taken, until the next ones. Nor
        does anybody take a frame while the disk is thought to refuse them: whether it still does is tried."""
        due_ns = self._clock.now_ns()
        while True:
            due_ns = await self._next_tick(due_ns)
            failure = await self._frame_lane.call(self._image_writer.tend, due_ns, self._waiting.frames_refused)
            if failure is None:
                self._waiting.frames_work()
            self._homes.follow(FRAMES, failure, self._frames_kept)

    async def _report_on_ticks(self) -> None:
        due_ns = self._clock.now_ns()
        while True:
            due_ns = await self._next_tick(due_ns)
            self._report()

    async def _next_tick(self, last_ns: int) -> int:
        due_ns = last_ns + seconds_ns(self._settings.telemetry_commit_s)
        await self._clock.sleep_until(due_ns)
        return due_ns

    async def _refound_when_asked(self) -> None:
        """After `refound`: the folders are found or made again, and the loss is an event."""
        while True:
            await self._homes.refinding.wait()
            anew = await self._homes.refound(
                lambda: self._telemetry_lane.call(self._telemetry_series.refound),
                lambda: self._frame_lane.call(self._image_series.refound),
            )
            if anew:
                self._notices.append(self._homes.loss(anew, self._begun_ns))
            await self._save_telemetry()
            self._report()

    async def _save_telemetry(self) -> OSError | None:
        """Commit what was published since the last time and what failed before; the error when the disk refuses."""
        items, self._items = self._items, []
        commit, now_ns = self._waiting.items_taken(), self._clock.now_ns()
        failure = await self._telemetry_lane.call(self._telemetry_writer.save, items, now_ns)
        if failure is None:
            self._waiting.items_saved(commit)
            self._telemetry_kept = Kept(now_ns, self._telemetry_writer.messages_saved)
            self._dropped.end(self._notices.append)
        self._homes.follow(TELEMETRY, failure, self._telemetry_kept)
        self._tell_progress()
        if (failure is not None) != self._telemetry_failing:
            self._telemetry_failing = failure is not None
            self._notices.append(telemetry_notice(failure))
        return failure

    def _tell_progress(self) -> None:
        self._progress.set()
        self._progress = asyncio.Event()

    def _report(self) -> None:
        """Publish what was lost, overcome or noticed since the last time."""
        for series in (self._image_series, self._telemetry_series):
            while series.troubles:
                self._notices.append(Notice("warning", "segment_given_up", series.troubles.popleft()))
        self._notices.extend(self._losses.take())
        while self._notices:
            notice = self._notices.popleft()
            self._hub.publish(Event(self._clock.now_ns(), notice.level, notice.kind, notice.text, notice.data))
