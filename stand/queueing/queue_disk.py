"""Where the queue is read and written for who guards a stand: in the process that touches the disk."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from foundation.clock import Clock
from foundation.errors import SessionError
from foundation.lane import Lane
from recording.writing.disk import QUEUE_LINE, Disk


class QueueDisk:
    """The queue's calls in that process, one after the other, waited for in a thread: who waits may leave at once."""

    def __init__(self, disk: Disk, clock: Clock) -> None:
        self._line = disk.line(QUEUE_LINE)
        self._lane = Lane("queue", clock, patient=False)

    async def call(self, function: Callable[..., Any], *args: object) -> Any:
        """What `function(*args)` returns or raises, which can be pickled; SessionError when the process is gone."""
        try:
            return await self._lane.call(self._line.run, function, *args)
        except OSError as error:
            raise SessionError(str(error.strerror)) from error

    def close(self) -> None:
        """As a lane."""
        self._lane.close()
