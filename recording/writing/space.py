"""How much of the disk is free, and what follows from it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from threading import Lock
from typing import NamedTuple


class Space(NamedTuple):
    """Of the file system of a folder: what an ordinary user may still write, and all of it."""

    free_bytes: int
    total_bytes: int


def disk_space(folder: Path) -> Space:
    """The space now; raises OSError."""
    found = os.statvfs(folder)
    return Space(found.f_bavail * found.f_frsize, found.f_blocks * found.f_frsize)


@dataclass(frozen=True, slots=True)
class Notice:
    """An event that has no time yet; see foundation.hub.Event."""

    level: str
    kind: str
    text: str
    data: Mapping[str, object] = field(default_factory=dict[str, object])


class SpaceWatch:
    """Decides whether frames may be written, and tells each change once; `check` is called from several threads.

    Below `stop_below_bytes` no frames are written, so that telemetry can go on; below `alert_fraction` of the disk
    there is a warning. `reserved_bytes()` is what the frames have reserved and not yet used: it counts as free.
    `tell` takes what there is to say.
    """

    def __init__(
        self,
        folder: Path,
        stop_below_bytes: int,
        alert_fraction: float,
        reserved_bytes: Callable[[], int],
        tell: Callable[[Notice], None],
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
        """Look at the disk; when it cannot be asked, nothing changes: whoever writes to it will find out why."""
        with self._lock:
            reserved_bytes = self._reserved_bytes()  # first: a reserve given back meanwhile must not look like a loss
            try:
                space = disk_space(self._folder)
            except OSError:
                return
            self.free_bytes = space.free_bytes
            self._judge(space.free_bytes + reserved_bytes, space.total_bytes)

    def _judge(self, free_bytes: int, total_bytes: int) -> None:
        nearly_full = free_bytes < self._alert_fraction * total_bytes
        if nearly_full and not self._alerted:
            text = f"{free_bytes / 1e9:.1f} of {total_bytes / 1e9:.1f} GB are free on the disk"
            self._tell(Notice("warning", "disk_nearly_full", text))
        self._alerted = nearly_full
        stopped = free_bytes < self._stop_below_bytes
        if stopped and not self.frames_stopped:
            text = f"frames are not recorded any more: {self.stop_reason}"
            self._tell(Notice("error", "frames_stopped", text))
        if self.frames_stopped and not stopped:
            self._tell(Notice("info", "frames_resumed", "frames are recorded again"))
        self.frames_stopped = stopped
