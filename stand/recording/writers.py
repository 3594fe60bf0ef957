"""What the recorder's two threads do: frames, and telemetry, onto the disk. Each writer is used from its own thread;
its counts may be read from any."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from drivers.interface import Frame
from stand.hub import Item
from stand.recording.images import CAMERA_IMAGE
from stand.recording.losses import Losses
from stand.recording.segment import Record
from stand.recording.series import Series
from stand.recording.space import SpaceWatch
from stand.recording.telemetry import SEQUENCE_MASK, TelemetryEncoder


class ImageWriter:
    """Encodes and commits frames one by one. `done` frames are `saved` or counted as lost."""

    def __init__(self, series: Series, encode: Callable[[Frame], bytes], space: SpaceWatch, losses: Losses) -> None:
        self._series = series
        self._encode = encode
        self._space = space
        self._losses = losses
        self.saved = 0
        self.done = 0

    def save(self, frame: Frame) -> None:
        """The frame on the disk, or counted as lost: the disk refuses it twice, it is nearly full, or the frame cannot
        be encoded."""
        reason = self._refusal(frame)
        if reason is None:
            self.saved += 1
        else:
            self._losses.count(frame, reason)
        self.done += 1

    def _refusal(self, frame: Frame) -> str | None:
        """Why the frame is lost; None when it has been saved."""
        self._series.finish_full(frame.time_ns)
        if not self._series.is_open:
            self._space.check()
        if self._space.frames_stopped:
            self._series.finish()  # for as long as that takes nothing is left open, or reserved
            return self._space.stop_reason
        try:
            record = Record(CAMERA_IMAGE, frame.time_ns, self._encode(frame), frame.block_id & SEQUENCE_MASK)
            self._series.commit([record], frame.time_ns)
        except OSError as error:
            return str(error)
        except Exception as error:  # noqa: BLE001 - whatever an encoder makes of one frame, the night goes on
            return f"{type(error).__name__}: {error}"
        return None


class TelemetryWriter:
    """Encodes and commits items; what the disk refuses waits in memory and goes first the next time."""

    def __init__(self, series: Series, encoder: TelemetryEncoder, space: SpaceWatch) -> None:
        self._series = series
        self._encoder = encoder
        self._space = space
        self._backlog: list[Record] = []
        self._items_encoded = 0
        self.items_saved = 0
        self.messages_saved = 0

    @property
    def waiting(self) -> int:
        """Messages that are not on the disk yet."""
        return len(self._backlog)

    def save(self, items: Sequence[Item], now_ns: int) -> OSError | None:
        """All items so far on the disk, or why they are not."""
        self._space.check()
        for item in items:
            self._backlog.extend(self._encoder.encode(item))
            self._items_encoded += 1
        if self._backlog:
            try:
                self._series.commit(self._backlog, now_ns)
            except OSError as error:
                return error
        self.messages_saved += len(self._backlog)
        self._backlog.clear()
        self.items_saved = self._items_encoded
        return None
