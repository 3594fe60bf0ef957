"""The process that touches the disk for a daemon, see foundation/worker_process.py.

A thread that waits for a disk in the kernel cannot be killed, and keeps its whole process from ending. So a daemon that
has to leave while the disk hangs leaves this process behind. Until that has ended it holds its locks, which show that a
process still writes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import SessionError
from thermostand.foundation.worker_process import WorkerProcess
from thermostand.foundation.workers import WorkerThread

MODULE = "thermostand.recording.writing.disk"
LEFT_NAME = "stand-disk-left"  # of a process whose daemon has gone
FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE = "frames", "telemetry", "journal", "files"
QUEUE_LINE = "queue"  # which another program may have locked
NOTES_LINE, REPAIR_LINE = "notes", "repair"  # a repair may take minutes
LATCH_LINE = "latch"  # which waits for nothing else
_LINES = (FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE, QUEUE_LINE, NOTES_LINE, REPAIR_LINE, LATCH_LINE)


class DiskProcess(WorkerProcess):
    """The process, with a line for each file that may hang by itself."""

    def __init__(self) -> None:
        super().__init__(MODULE, _LINES, "the process that writes the session to the disk has ended")


class DiskCalls:
    """Calls in that process, one after the other on one of its lines, waited for in a thread: who waits may leave at
    once. Without a process, as in virtual time, they are made here."""

    def __init__(self, disk: DiskProcess | None, line: str, clock: Clock) -> None:
        self._line = None if disk is None else disk.line(line)
        self._lane = WorkerThread(f"disk-{line}", clock, patient=False)

    async def call(self, function: Callable[..., Any], *args: object) -> Any:
        """Return what `function(*args)` returns or raises, which can be pickled; SessionError when the process is gone,
        and for an OSError."""
        try:
            if self._line is None:
                return await self._lane.call(function, *args)
            return await self._lane.call(self._line.run, function, *args)
        except OSError as error:
            raise SessionError(str(error.strerror or error)) from error

    async def keep(self, name: str, function: Callable[..., object], *args: object) -> None:
        """What `function(*args)` returns stays in the process, under this name, until that ends. As `call`; ValueError
        without a process."""
        if self._line is None:
            raise ValueError("there is no process that could keep it")
        try:
            await self._lane.call(self._line.make, name, function, *args)
        except OSError as error:
            raise SessionError(str(error.strerror or error)) from error

    def close(self) -> None:
        """Close the worker, as a lane is closed."""
        self._lane.close()
