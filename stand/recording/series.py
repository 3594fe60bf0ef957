"""The segments of one folder, one after the other."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Sequence
from pathlib import Path

from stand.recording.segment import Record, Segment, SeriesForm


class Series:
    """The segments of one folder, one open at a time. Blocking; used from one thread."""

    def __init__(self, folder: Path, form: SeriesForm) -> None:
        self._folder = folder
        self._form = form
        self._segment: Segment | None = None
        self.troubles: deque[str] = deque()  # errors that were overcome, as sentences; another thread may take them

    def open(self, time_ns: int) -> Segment:
        """The open segment, begun when there is none; raises OSError."""
        if self._segment is None:
            self._segment = Segment(self._folder, next_number(self._folder), self._form, time_ns)
        return self._segment

    def commit(self, records: Sequence[Record], time_ns: int) -> None:
        """All of `records` on the disk when this returns, in a new segment when the present one is full or fails;
        OSError when the new one fails, too. `time_ns` (now) decides whether a segment is old enough to be closed."""
        if self._is_full(time_ns):
            self.finish()
        try:
            self._commit(records, time_ns)
        except OSError as error:
            self.troubles.append(f"a segment of {self._form.name} was given up ({error}); the next one was begun")
            self._commit(records, time_ns)

    def _commit(self, records: Sequence[Record], time_ns: int) -> None:
        segment = self.open(time_ns)
        try:
            segment.commit(records)
        except OSError:
            segment.abandon()
            self._segment = None
            raise

    def _is_full(self, time_ns: int) -> bool:
        segment = self._segment
        return segment is not None and (
            segment.committed_bytes >= self._form.segment_bytes or time_ns - segment.begun_ns >= self._form.segment_ns
        )

    def finish(self) -> bool:
        """Close the open segment, if any; False when it cannot be finished: it stays `.part`, and that is a trouble."""
        segment, self._segment = self._segment, None
        if segment is None:
            return True
        try:
            segment.finish()
        except OSError as error:
            segment.abandon()
            self.troubles.append(f"a segment of {self._form.name} stays unfinished ({error})")
            return False
        return True


def next_number(folder: Path) -> int:
    """The number after the highest segment in `folder`, finished or not; 0 in an empty one."""
    numbers = [
        int(match[1]) for path in folder.iterdir() if (match := re.fullmatch(r"(\d{4,})\.mcap(\.part)?", path.name))
    ]
    return max(numbers, default=-1) + 1
