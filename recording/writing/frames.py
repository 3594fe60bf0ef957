"""Frames, from the hub to the disk: each by itself, in order, through a bounded queue.

They are encoded and committed by a lane's thread, off the loop. A slow disk fills the queue and then loses frames; one
that is nearly full is left to the telemetry. A frame whose folder has gone waits for it.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from enum import Enum
from typing import NamedTuple

from thermostand.foundation.clock import Clock
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.format.capture_restarts import find_restarted_step
from thermostand.recording.format.images import (
    FrameContext,
    encode_image,
    encode_meta,
    name_frame_topics,
    select_frame_readings,
)
from thermostand.recording.format.layout import FRAMES, SEQUENCE_MASK
from thermostand.recording.format.messages import decode_frame_meta
from thermostand.recording.writing.folder_watch import FolderContents, FolderLost, FolderWatch
from thermostand.recording.writing.notices import FrameLosses
from thermostand.recording.writing.pending_items import PendingItems
from thermostand.recording.writing.recorder_settings import RecordingSettings
from thermostand.recording.writing.segment import MessageRecord
from thermostand.recording.writing.series import DiskSeries

_OPENING_BYTES = 100_000  # more than what stands before the first frame of a segment


class PublishedFrame(NamedTuple):
    """A frame, and what was known then."""

    frame: Frame
    known: FrameContext


def encode_frame(published: PublishedFrame) -> list[MessageRecord]:
    """The two messages of a frame; one that was recorded before keeps its description. ValueError when its image is
    none, or a window is not within it."""
    frame, published_ns = published.frame, published.known.published_ns
    description = frame.described or encode_meta(frame, published.known)
    if frame.described:
        published_ns = decode_frame_meta(description).published_ns
    meta, image = name_frame_topics(frame.channel)
    stamps = frame.block_id & SEQUENCE_MASK, published_ns
    return [
        MessageRecord(meta, frame.time_ns, description, *stamps),
        MessageRecord(image, frame.time_ns, encode_image(frame), *stamps),
    ]


class StandSnapshot:
    """What is known of the stand when a frame is published: its step, and its last temperatures and positions."""

    def __init__(self) -> None:
        self._steps: dict[str, StepMark] = {}
        self._readings: dict[str, Reading] = {}

    def receive(self, item: Item) -> None:
        """One more item of the hub."""
        if isinstance(item, Batch):
            self._readings |= {
                f"{reading.channel} {reading.unit}": reading for reading in select_frame_readings(item.readings)
            }
        elif isinstance(item, StepMark) and item.state is StepState.STARTED:
            self._steps = {item.step_id: item}

    def of(self, frame: Frame, now_ns: int) -> FrameContext:
        """Describe a frame that is published now."""
        mark = self._steps.get(frame.step_id)
        parameters = {} if mark is None else mark.parameters
        degC = parameters.get("chamber_degC")
        set_point_degC = float(degC) if isinstance(degC, int | float) else math.nan
        return FrameContext(
            now_ns,
            str(parameters.get("role") or ""),
            set_point_degC,
            tuple(self._readings.values()),
        )


class FrameRecorder:
    """The frames of one session; `receive` is the hub's subscriber from `begin` on. kept: what their folder holds of
    this run. `prepare` gives what of a frame is recorded, in a thread of its own and in order of the frames."""

    def __init__(
        self,
        settings: RecordingSettings,
        prepare: Callable[[Frame], Frame] | None,
        clock: Clock,
        waiting: PendingItems,
        homes: FolderWatch,
    ) -> None:
        self._prepare = prepare or _keep_frame
        self._surroundings = StandSnapshot()
        self._clock = clock
        self._waiting = waiting
        self._homes = homes
        self._queue: asyncio.Queue[PublishedFrame] = asyncio.Queue(settings.queue_frames)
        self._taking = False
        self.losses = FrameLosses()
        self.taken = 0

    def begin(self, series: DiskSeries) -> None:
        """Take what is published, into this series."""
        self.series = series
        self.lane = WorkerThread("record-frames", self._clock, patient=False)
        self._writer = FrameWriter(series, self._prepare, self.losses)
        self.kept = FolderContents(self._clock.now_ns(), 0)
        self._taking = True

    @property
    def saved(self) -> int:
        """The number of frames that are on the disk."""
        return self._writer.saved

    @property
    def done(self) -> int:
        """The number of frames taken that are on the disk, or lost."""
        return self._writer.done

    @property
    def waiting(self) -> int:
        """The number of frames in the queue."""
        return self._queue.qsize()

    def receive(self, item: Item) -> None:
        """Queue a frame, or count it as lost when the queue is full."""
        if not self._taking:
            return
        self._surroundings.receive(item)
        if isinstance(item, Event) and (step_id := find_restarted_step(item)):
            self.losses.supersede(step_id, item.time_ns)
        if isinstance(item, Frame):
            now_ns = self._clock.now_ns()
            try:
                self._queue.put_nowait(PublishedFrame(item, self._surroundings.of(item, now_ns)))
            except asyncio.QueueFull:
                self.losses.count(item, "the disk did not take them in time")
                self._waiting.frame_refused(now_ns)
            else:
                self.taken += 1
                self._waiting.frame_published(now_ns)

    async def record(self) -> None:
        """One after the other, until cancelled."""
        while True:
            await self._homes.frames_folder_present.wait()
            frame = self._writer.homeless or await self._queue.get()
            fate, reason = await self.lane.call(self._writer.save, frame)
            if fate is FrameOutcome.HOMELESS:
                self._homes.follow(FRAMES, reason, self.kept)
                continue
            published_ns = self._waiting.frame_done()
            if fate is FrameOutcome.REFUSED:
                self._waiting.frame_refused(published_ns)
            elif fate is FrameOutcome.SAVED:
                self._waiting.frames_work()
                self.kept = FolderContents(published_ns, self._writer.saved)
            self._waiting.changed()

    async def tend(self, now_ns: int) -> None:
        """A soak is long: its last frames are not left unfinished, nor their reserve taken, until the next ones. Nor
        does anybody take a frame while the disk is thought to refuse them: whether it still does is tried."""
        failure = await self.lane.call(self._writer.tend, now_ns, self._waiting.frames_refused)
        if failure is None:
            self._waiting.frames_work()
        self._homes.follow(FRAMES, failure, self.kept)

    async def finish(self) -> None:
        """Save the frames that wait; the first may be one that found its folder gone when the recording was ended. None
        is taken from then on."""
        frame = await self.lane.call(lambda: self._writer.homeless)
        while frame is not None or not self._queue.empty():
            frame = frame or self._queue.get_nowait()
            fate, reason = await self.lane.call(self._writer.save, frame)
            if fate is FrameOutcome.HOMELESS:
                self._writer.give_up(frame, reason)
            frame = None
        self._taking = False


class FrameOutcome(Enum):
    """What became of a frame. LOST: for a reason that is not the disk's, or on a nearly full one, which is reported by
    itself. REFUSED: lost because the disk refuses it. HOMELESS: its folder is gone, and it may be saved later."""

    SAVED = "saved"
    LOST = "lost"
    REFUSED = "refused"
    HOMELESS = "homeless"


def _keep_frame(frame: Frame) -> Frame:
    return frame


class FrameWriter:
    """Encodes and commits frames one by one. `done` frames are `saved` or counted as lost."""

    def __init__(self, series: DiskSeries, prepare: Callable[[Frame], Frame], losses: FrameLosses) -> None:
        self._series = series
        self._prepare = prepare
        self._losses = losses
        self._block_bytes = 0  # of the last frame that was offered to the disk
        self.homeless: PublishedFrame | None = None  # found its folder gone; it is the first to be saved again
        self.saved = 0
        self.done = 0

    def save(self, published: PublishedFrame) -> tuple[FrameOutcome, str]:
        """The frame on the disk; or why it is not, and it is counted as lost: the disk refuses it twice, it is nearly
        full, or the frame cannot be encoded. One whose folder is gone is not lost."""
        fate, reason = self._try_save(published)
        self.homeless = published if fate is FrameOutcome.HOMELESS else None
        if self.homeless is not None:
            return fate, reason
        if fate is FrameOutcome.SAVED:
            self.saved += 1
        else:
            self._losses.count(published.frame, reason)
        self.done += 1
        return fate, reason

    def give_up(self, published: PublishedFrame, reason: str) -> None:
        """A frame that found no folder to the end."""
        self.homeless = None
        self._losses.count(published.frame, reason)
        self.done += 1

    def _try_save(self, published: PublishedFrame) -> tuple[FrameOutcome, str]:
        frame = published.frame
        try:
            self._series.finish_full(frame.time_ns)
            if not self._series.is_open:
                self._series.check_space()
            if (space := self._series.space.last).frames_stopped:
                self._series.finish()  # for as long as that takes nothing is left open, or reserved
                return FrameOutcome.LOST, space.stop_reason
            records = encode_frame(published._replace(frame=self._prepare(frame)))
            self._block_bytes = sum(len(record.data) for record in records)
            self._series.commit(records, frame.time_ns)
        except FolderLost as error:
            return FrameOutcome.HOMELESS, str(error.strerror)
        except OSError as error:
            return FrameOutcome.REFUSED, str(error)
        except Exception as error:  # noqa: BLE001 - an encoder that fails on one frame must not end the run
            return FrameOutcome.LOST, f"{type(error).__name__}: {error}"
        return FrameOutcome.SAVED, ""

    def tend(self, now_ns: int, refused: bool) -> OSError | None:
        """Close the segment when it is old, without a frame, and return whether frames could be written; `refused`: the
        last one could not, and so a block as large is tried."""
        try:
            self._series.check()
            self._series.finish_full(now_ns)
            if refused:
                self._series.probe(self._block_bytes + _OPENING_BYTES, now_ns)
        except OSError as error:
            return error
        return None
