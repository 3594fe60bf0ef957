"""What a recording reports of itself: frames and readings that are lost, and a disk that is nearly full.

Events of instant 0: who publishes them says when."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from thermostand.foundation.events import (
    DISK_NEARLY_FULL,
    FRAMES_DROPPED,
    FRAMES_RESUMED,
    FRAMES_STOPPED,
    READINGS_DROPPED,
    READINGS_LOST,
)
from thermostand.foundation.items import Batch, Event
from thermostand.foundation.readings import Frame


class Space(NamedTuple):
    """The space of a folder's file system: what an ordinary user may still write, and all of it."""

    free_bytes: int
    total_bytes: int


def read_disk_space(folder: Path) -> Space:
    """The space now; raises OSError."""
    found = os.statvfs(folder)
    return Space(found.f_bavail * found.f_frsize, found.f_blocks * found.f_frsize)


class SpaceWatch:
    """Decides whether frames may be written, and reports each change once; `check` is called from several threads.

    Below `stop_below_bytes` no frames are written, so that telemetry can continue; below `alert_fraction` of the disk
    there is a warning. `reserved_bytes()` is what the frames have reserved and not yet used: it counts as free.
    `tell` takes each event.
    """

    def __init__(
        self,
        folder: Path,
        stop_below_bytes: int,
        alert_fraction: float,
        reserved_bytes: Callable[[], int],
        tell: Callable[[Event], None],
    ) -> None:
        self._folder = folder
        self._stop_below_bytes = stop_below_bytes
        self._alert_fraction = alert_fraction
        self._reserved_bytes = reserved_bytes
        self._tell = tell
        self._lock = Lock()
        self._alerted = False
        self.frames_stopped = False
        self.free_bytes = 0  # when it was looked at last
        self.stop_reason = f"less than {stop_below_bytes / 1e9:.1f} GB free on the disk"

    def check(self) -> None:
        """Look at the disk; when it cannot be asked, nothing changes: the next write will find out why."""
        with self._lock:
            reserved_bytes = self._reserved_bytes()  # first: a reserve given back meanwhile must not look like a loss
            try:
                space = read_disk_space(self._folder)
            except OSError:
                return
            self.free_bytes = space.free_bytes
            self._judge(space.free_bytes + reserved_bytes, space.total_bytes)

    def _judge(self, free_bytes: int, total_bytes: int) -> None:
        nearly_full = free_bytes < self._alert_fraction * total_bytes
        if nearly_full and not self._alerted:
            self._tell(DISK_NEARLY_FULL.at(0, free_bytes=free_bytes, total_bytes=total_bytes))
        self._alerted = nearly_full
        stopped = free_bytes < self._stop_below_bytes
        if stopped and not self.frames_stopped:
            self._tell(FRAMES_STOPPED.at(0, reason=self.stop_reason))
        if self.frames_stopped and not stopped:
            self._tell(FRAMES_RESUMED.at(0))
        self.frames_stopped = stopped


class FrameLosses:
    """What is lost; `count` is called from any thread, `take` from one."""

    def __init__(self) -> None:
        self._reported = 0
        self._lost_ns: deque[tuple[str, int]] = deque()  # step, instant
        self._begins_ns: dict[str, int] = {}  # of captures that were restarted, by step
        self._new: deque[tuple[str, str, int]] = deque()  # reason, step, block

    @property
    def total(self) -> int:
        """Frames lost since the beginning, without those of captures that were restarted after them."""
        return sum(time_ns >= self._begins_ns.get(step_id, time_ns) for step_id, time_ns in tuple(self._lost_ns))

    def of(self, step_id: str) -> int:
        """Return how many frames of this step were lost."""
        begin_ns = self._begins_ns.get(step_id, 0)
        return sum(lost == step_id and time_ns >= begin_ns for lost, time_ns in tuple(self._lost_ns))

    def count(self, frame: Frame, reason: str) -> None:
        """One frame lost."""
        self._lost_ns.append((frame.step_id, frame.time_ns))
        self._new.append((reason, frame.step_id, frame.block_id))

    def supersede(self, step_id: str, time_ns: int) -> None:
        """The capture was restarted: frames it lost before that instant are not missing."""
        self._begins_ns[step_id] = time_ns

    def take(self) -> list[Event]:
        """An event for each reason since the last time, which names every block: `blocks` in its data are pairs of the
        first and the last."""
        reasons: dict[str, dict[str, list[int]]] = {}
        while self._new:
            reason, step_id, block_id = self._new.popleft()
            reasons.setdefault(reason, {}).setdefault(step_id, []).append(block_id)
            self._reported += 1
        return [self._make_notice(reason, steps) for reason, steps in reasons.items()]

    def _make_notice(self, reason: str, steps: dict[str, list[int]]) -> Event:
        blocks = [run for blocks in steps.values() for run in group_runs(blocks)]
        data = {"blocks": blocks, "steps": list(steps), "total": self._reported, "reason": reason}
        return FRAMES_DROPPED.at(0, _format_by_step(steps), **data)


class DroppedReadings:
    """Readings that did not fit into memory while the disk took nothing: reported when that begins, and when it is over
    with their number and span."""

    def __init__(self) -> None:
        self._readings = 0
        self._from_ns = self._to_ns = 0

    def count(self, batch: Batch, tell: Callable[[Event], None]) -> None:
        """One batch that will not be in the session."""
        if not self._readings:
            self._from_ns = batch.time_ns
            tell(READINGS_DROPPED.at(0))
        self._readings += len(batch.readings)
        self._to_ns = batch.time_ns

    def end(self, tell: Callable[[Event], None]) -> None:
        """Everything that was kept is on the disk."""
        if self._readings:
            tell(READINGS_LOST.at(0, readings=self._readings, from_ns=self._from_ns, to_ns=self._to_ns))
            self._readings = 0


def _format_by_step(steps: dict[str, list[int]]) -> str:
    """`4 (blocks 12 to 14, 17 of step capture-1)`, with "and" between steps."""
    count = sum(len(blocks) for blocks in steps.values())
    places = [f"{format_ranges(blocks)}{f' of step {step_id}' if step_id else ''}" for step_id, blocks in steps.items()]
    return f"{count} ({' and '.join(places)})"


def group_runs(blocks: Iterable[int]) -> list[list[int]]:
    """The first and the last of each run of neighbours, in the order given."""
    found: list[list[int]] = []
    for block in blocks:
        if found and block == found[-1][1] + 1:
            found[-1][1] = block
        else:
            found.append([block, block])
    return found


def format_ranges(blocks: Iterable[int]) -> str:
    """`block 3`, `blocks 12 to 14, 17`: every block id in the order given, neighbours as a range."""
    found = group_runs(blocks)
    texts = [f"{first}" if first == last else f"{first} to {last}" for first, last in found]
    is_one = len(found) == 1 and found[0][0] == found[0][1]
    return f"block{'' if is_one else 's'} {', '.join(texts)}"
