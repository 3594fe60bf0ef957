"""Items and frames as records, and what the recorder's two threads do: put them onto the disk, here or by the process
that touches it. Each writer is used from its own thread; its counts may be read from any."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from enum import Enum
from functools import partial
from pathlib import Path
from typing import Any

from foundation.items import Batch, Event, Item, Original, StepMark
from foundation.readings import Frame, Quality
from recording.format import messages
from recording.format.decoded_items import Description, UndescribedFrame
from recording.format.images import CAMERA_IMAGE
from recording.format.layout import FRAMES, TELEMETRY
from recording.writing.disk import FRAMES_LINE, TELEMETRY_LINE, Disk
from recording.writing.forms import SessionForm
from recording.writing.home import FolderLost
from recording.writing.notices import Losses, Notice
from recording.writing.segment import Record
from recording.writing.series import Done, SessionSeries, SpaceFound

PORTION_RECORDS = 5000  # committed at once; a disk that refuses is not offered hours of telemetry each second
_OPENING_BYTES = 100_000  # more than what stands before the first frame of a segment
_KEPT = "series"  # the name of the SessionSeries in the disk process
SEQUENCE_MASK = 0xFFFF_FFFF  # MCAP has 32 bits for the block id; FrameMeta has all 64


class DiskSpace:
    """What the last look at the disk found, whichever series asked; `tell` takes its notices."""

    def __init__(self, tell: Callable[[Notice], None]) -> None:
        self.last = SpaceFound()
        self._tell = tell

    def found(self, space: SpaceFound) -> None:
        """As of now."""
        self.last = space
        for notice in space.notices:
            self._tell(notice)


class DiskSeries:
    """One series of a session, in the disk process or in this one: a line for each, so that one that hangs leaves the
    other. Its methods are those of Series. `ask` calls a method of the SessionSeries."""

    def __init__(self, name: str, ask: Callable[..., Any], space: DiskSpace) -> None:
        self.is_open = False
        self.troubles: deque[str] = deque()
        self.space = space
        self._name = name
        self._ask = ask

    def check_space(self) -> None:
        """See SpaceWatch.check."""
        self.space.found(self._ask("check_space"))

    def check(self) -> None:
        """As in Series, like all below."""
        self._do("check")

    def commit(self, records: Sequence[Record], time_ns: int) -> None:
        """All of `records` on the disk."""
        self._do("commit", list(records), time_ns)

    def probe(self, size_bytes: int, time_ns: int) -> None:
        """OSError while the disk would refuse a block."""
        self._do("probe", size_bytes, time_ns)

    def refound(self) -> bool:
        """Whether the folder is back."""
        return bool(self._do("refound"))

    def finish_full(self, time_ns: int) -> None:
        """Close a segment that has its size or age."""
        if self.is_open:
            self._do("finish_full", time_ns)

    def finish(self) -> bool:
        """Close the open segment; False, and a trouble, also when the process has ended."""
        try:
            return bool(self._do("finish"))
        except OSError as error:
            self.is_open = False
            self.troubles.append(f"a segment of {self._name} stays unfinished ({error})")
            return False

    def close(self) -> None:
        """Let go of the folder; a process that has ended has."""
        with suppress(OSError):
            self._do("close")

    def _do(self, method: str, *args: object) -> object:
        done: Done = self._ask("do", self._name, method, *args)
        self.is_open = done.is_open
        self.troubles.extend(done.troubles)
        if done.error is not None:
            raise done.error
        return done.result


def open_series(
    disk: Disk | None, directory: Path, form: SessionForm, time_ns: int, tell: Callable[[Notice], None]
) -> tuple[DiskSeries, DiskSeries]:
    """Frames and telemetry of a session, made or continued; raises OSError. disk: the process that has them, None: this
    one."""
    space = DiskSpace(tell)
    if disk is None:
        both = SessionSeries(directory, form, time_ns)
        asks: list[Callable[..., Any]] = [partial(_called, both)] * 2
    else:
        lines = disk.line(FRAMES_LINE), disk.line(TELEMETRY_LINE)
        lines[1].make(_KEPT, SessionSeries, directory.absolute(), form, time_ns)
        asks = [partial(line.call, _KEPT) for line in lines]
    return DiskSeries(FRAMES, asks[0], space), DiskSeries(TELEMETRY, asks[1], space)


def _called(series: SessionSeries, method: str, *args: object) -> Any:
    return getattr(series, method)(*args)


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

    def check(self, item: Item) -> None:
        """ValueError when the item is a batch of a device that was not declared."""
        if isinstance(item, Batch) and item.device not in self._encoders:
            raise ValueError(f"{item.device} is not among the recorded devices {', '.join(self._encoders)}")

    def encode(self, item: Item | Description) -> Iterator[Record]:
        """The item's records, most often one."""
        match item:
            case Batch():
                encoder = self._encoders[item.device]
                yield Record(encoder.topic, item.time_ns, encoder.encode(item))
                if self._devices[item.device] == "axis":
                    yield from self._pose(item)
            case Description():
                yield Record(messages.CAMERA_META, item.time_ns, item.data, item.sequence)
            case UndescribedFrame():
                pass  # a description is never invented
            case Frame():
                yield Record(
                    messages.CAMERA_META, item.time_ns, messages.encode_frame_meta(item), item.block_id & SEQUENCE_MASK
                )
            case Original():
                yield Record(messages.ORIGINAL, item.time_ns, messages.encode_original(item))
            case StepMark():
                yield Record(messages.STEP, item.time_ns, messages.encode_step(item))
            case Event():
                yield Record(messages.EVENT, item.time_ns, messages.encode_event(item))
                yield Record(messages.LOG, item.time_ns, messages.encode_log(item))

    def _pose(self, batch: Batch) -> Iterator[Record]:
        """The table's pose for viewers, once both axes have reported their positions; none while one has none."""
        for reading in batch.readings:
            if reading.channel == f"{batch.device}.position":
                self._table.pop(reading.unit, None)
                if reading.quality is not Quality.BAD:
                    self._table[reading.unit] = reading.value
        if "mm" in self._table and "deg" in self._table:
            pose = messages.encode_table_pose(batch.time_ns, self._table["mm"], self._table["deg"])
            yield Record(messages.TABLE_POSE, batch.time_ns, pose)


class Fate(Enum):
    """What became of a frame. LOST: for a reason that is not the disk's, or on a nearly full one, which is reported by
    itself. REFUSED: lost because the disk refuses it. HOMELESS: its folder is gone, and it may be saved later."""

    SAVED = "saved"
    LOST = "lost"
    REFUSED = "refused"
    HOMELESS = "homeless"


class ImageWriter:
    """Encodes and commits frames one by one. `done` frames are `saved` or counted as lost."""

    def __init__(self, series: DiskSeries, encode: Callable[[Frame], bytes], losses: Losses) -> None:
        self._series = series
        self._encode = encode
        self._losses = losses
        self._block_bytes = 0  # of the last frame that was offered to the disk
        self.homeless: Frame | None = None  # found its folder gone; it is the first to be saved again
        self.saved = 0
        self.done = 0

    def save(self, frame: Frame) -> tuple[Fate, str]:
        """The frame on the disk; or why it is not, and it is counted as lost: the disk refuses it twice, it is nearly
        full, or the frame cannot be encoded. One whose folder is gone is not lost."""
        fate, reason = self._fate(frame)
        self.homeless = frame if fate is Fate.HOMELESS else None
        if self.homeless is not None:
            return fate, reason
        if fate is Fate.SAVED:
            self.saved += 1
        else:
            self._losses.count(frame, reason)
        self.done += 1
        return fate, reason

    def give_up(self, frame: Frame, reason: str) -> None:
        """A frame that found no folder to the end."""
        self.homeless = None
        self._losses.count(frame, reason)
        self.done += 1

    def _fate(self, frame: Frame) -> tuple[Fate, str]:
        try:
            self._series.finish_full(frame.time_ns)
            if not self._series.is_open:
                self._series.check_space()
            if (space := self._series.space.last).frames_stopped:
                self._series.finish()  # for as long as that takes nothing is left open, or reserved
                return Fate.LOST, space.stop_reason
            data = self._encode(frame)
            self._block_bytes = len(data)
            self._series.commit(
                [Record(CAMERA_IMAGE, frame.time_ns, data, frame.block_id & SEQUENCE_MASK)], frame.time_ns
            )
        except FolderLost as error:
            return Fate.HOMELESS, str(error.strerror)
        except OSError as error:
            return Fate.REFUSED, str(error)
        except Exception as error:  # noqa: BLE001 - an encoder that fails on one frame must not end the run
            return Fate.LOST, f"{type(error).__name__}: {error}"
        return Fate.SAVED, ""

    def tend(self, now_ns: int, refused: bool) -> OSError | None:
        """Without a frame: close the segment when it is old, and say whether frames could be written; `refused`: the
        last one could not, and so a block as large is tried."""
        try:
            self._series.check()
            self._series.finish_full(now_ns)
            if refused:
                self._series.probe(self._block_bytes + _OPENING_BYTES, now_ns)
        except OSError as error:
            return error
        return None


class TelemetryWriter:
    """Encodes and commits items; what the disk refuses waits in memory and goes first the next time."""

    def __init__(self, series: DiskSeries, encoder: TelemetryEncoder) -> None:
        self._series = series
        self._encoder = encoder
        self._backlog: list[Record] = []
        self._items_encoded = 0
        self.items_saved = 0
        self.messages_saved = 0

    @property
    def waiting(self) -> int:
        """Messages that are not on the disk yet."""
        return len(self._backlog)

    def save(self, items: Sequence[Item | Description], now_ns: int) -> OSError | None:
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
