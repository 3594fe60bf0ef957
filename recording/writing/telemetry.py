"""Readings, steps and events: from the hub to the disk, committed on ticks.

What is published waits in memory until it is on the disk; when that holds too much, readings are the first to go. They
are encoded and committed by a lane's thread, off the loop.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import TELEMETRY_NOT_SAVED, TELEMETRY_SAVED_AGAIN
from thermostand.foundation.items import Batch, Event, Item, Original, StepMark
from thermostand.foundation.readings import Frame, Quality
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.format import messages
from thermostand.recording.format.batches import RecordedDevice, make_batch_schema
from thermostand.recording.format.layout import TELEMETRY
from thermostand.recording.writing.folder_watch import FolderContents, FolderWatch
from thermostand.recording.writing.notices import DroppedReadings
from thermostand.recording.writing.pending_items import PendingItems
from thermostand.recording.writing.recorder_settings import RecordingSettings
from thermostand.recording.writing.segment import MessageRecord
from thermostand.recording.writing.series import DiskSeries
from thermostand.recording.writing.session_spec import list_stages

PORTION_RECORDS = 5000  # committed at once; a disk that refuses is not offered hours of telemetry each second


class TelemetryRecorder:
    """The telemetry of one session; `receive` is the hub's subscriber from `begin` on. taking: until the
    end of the recording. kept: what its folder holds of this run."""

    def __init__(
        self,
        directory: Path,
        devices: Mapping[str, RecordedDevice],
        *,
        settings: RecordingSettings,
        clock: Clock,
        waiting: PendingItems,
        homes: FolderWatch,
        tell: Callable[[Event], None],
    ) -> None:
        self._directory = directory
        self._encoder = TelemetryEncoder(devices)
        self._most_waiting = settings.waiting_messages
        self._clock = clock
        self._waiting = waiting
        self._homes = homes
        self._tell = tell
        self._items: list[Item] = []  # since the last commit
        self._dropped = DroppedReadings()
        self._is_failing = self.taking = False
        self.items_taken = 0

    def begin(self, series: DiskSeries) -> None:
        """Take what is published, into this series."""
        self.series = series
        self.lane = WorkerThread("record-telemetry", self._clock, patient=False)
        self._writer = TelemetryWriter(series, self._encoder)
        self.kept = FolderContents(self._clock.now_ns(), 0)
        self.taking = True

    @property
    def items_saved(self) -> int:
        """The number of items taken that are on the disk."""
        return self._writer.items_saved

    @property
    def messages_saved(self) -> int:
        """The number of messages that are on the disk."""
        return self._writer.messages_saved

    @property
    def messages_waiting(self) -> int:
        """Published, and not on the disk."""
        return len(self._items) + self._writer.waiting

    def receive(self, item: Item) -> None:
        """Keep the item for the next commit, or count what does not fit; ValueError for a batch of a device that was
        not declared."""
        if not self.taking or isinstance(item, Frame):
            return
        self._encoder.check(item)
        if isinstance(item, Batch) and self.messages_waiting >= self._most_waiting:
            self._dropped.count(item, self._tell)
            return
        self._items.append(item)
        self.items_taken += 1
        self._waiting.item_published(self._clock.now_ns())

    async def save(self) -> OSError | None:
        """Commit what was published since the last time and what failed before; the error when the disk refuses."""
        items, self._items = self._items, []
        commit, now_ns = self._waiting.items_taken(), self._clock.now_ns()
        failure = await self.lane.call(self._writer.save, items, now_ns)
        if failure is None:
            self._waiting.items_saved(commit)
            self.kept = FolderContents(now_ns, self._writer.messages_saved)
            self._dropped.end(self._tell)
        self._homes.follow(TELEMETRY, failure, self.kept)
        self._waiting.changed()
        if (failure is not None) != self._is_failing:
            self._is_failing = failure is not None
            self._tell(TELEMETRY_SAVED_AGAIN.at(0) if failure is None else TELEMETRY_NOT_SAVED.at(0, str(failure)))
        return failure

    async def finish(self) -> None:
        """Take nothing that is published from now on, save the rest and complete the segment. SessionError when one of
        them fails."""
        self.taking = False
        failure = await self.save()
        is_complete = await self.lane.call(self.series.finish)
        if failure is not None:
            raise SessionError(f"{self._directory}: {self._writer.waiting} messages were not saved ({failure})")
        if not is_complete:
            raise SessionError(f"{self._directory}: {self.series.troubles.pop()}")


class TelemetryEncoder:
    """Items of the hub to records of the telemetry series; devices: by name."""

    def __init__(self, devices: Mapping[str, RecordedDevice]) -> None:
        self._forms = {name: make_batch_schema(name, device) for name, device in devices.items()}
        self._stages = list_stages(devices)
        self._table: dict[str, float] = {}  # unit -> last position of the stage in that unit

    def check(self, item: Item) -> None:
        """ValueError when the item is a batch of a device that was not declared."""
        if isinstance(item, Batch) and item.device not in self._forms:
            raise ValueError(f"{item.device} is not among the recorded devices {', '.join(self._forms)}")

    def encode(self, item: Item) -> Iterator[MessageRecord]:
        """The item's records, most often one; a frame has none."""
        match item:
            case Batch():
                form = self._forms[item.device]
                yield MessageRecord(form.topic, item.time_ns, form.encode(item))
                if item.device in self._stages:
                    yield from self._encode_pose(item)
            case Frame():
                pass
            case Original():
                yield MessageRecord(messages.ORIGINAL, item.time_ns, messages.encode_original(item))
            case StepMark():
                yield MessageRecord(messages.STEP, item.time_ns, messages.encode_step(item))
            case Event():
                yield MessageRecord(messages.EVENT, item.time_ns, messages.encode_event(item))
                yield MessageRecord(messages.LOG, item.time_ns, messages.encode_log(item))

    def _encode_pose(self, batch: Batch) -> Iterator[MessageRecord]:
        """The table's pose for viewers, once both stages have reported their positions; none while one has none."""
        for reading in batch.readings:
            if reading.channel == self._stages[batch.device]:
                self._table.pop(reading.unit, None)
                if reading.quality is not Quality.BAD:
                    self._table[reading.unit] = reading.value
        if "mm" in self._table and "deg" in self._table:
            pose = messages.encode_table_pose(batch.time_ns, self._table["mm"], self._table["deg"])
            yield MessageRecord(messages.TABLE_POSE, batch.time_ns, pose)


class TelemetryWriter:
    """Encodes and commits items; what the disk refuses waits in memory and goes first the next time."""

    def __init__(self, series: DiskSeries, encoder: TelemetryEncoder) -> None:
        self._series = series
        self._encoder = encoder
        self._backlog: list[MessageRecord] = []
        self._items_encoded = 0
        self.items_saved = 0
        self.messages_saved = 0

    @property
    def waiting(self) -> int:
        """Messages that are not on the disk yet."""
        return len(self._backlog)

    def save(self, items: Sequence[Item], now_ns: int) -> OSError | None:
        """All items so far on the disk, or why they are not; FolderLost also when there was nothing to write."""
        for item in items:
            self._backlog.extend(self._encoder.encode(item))
            self._items_encoded += 1
        try:
            self._series.check_space()
            self._series.check()
            while portion := self._backlog[:PORTION_RECORDS]:
                self._series.commit(portion, now_ns)
                del self._backlog[: len(portion)]
                self.messages_saved += len(portion)
        except OSError as error:
            return error
        self.items_saved = self._items_encoded
        return None
