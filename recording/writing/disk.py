"""The process that touches the disk for a daemon, see foundation/helper.py.

A thread that waits for a disk in the kernel cannot be killed, and keeps its whole process from ending. So a daemon that
has to leave while the disk hangs leaves this process behind. Until that has ended it holds its locks, which show that a
process still writes.
"""

from __future__ import annotations

from foundation.helper import Helper

MODULE = "recording.writing.disk"
LEFT_NAME = "stand-disk-left"  # of a process whose daemon has gone
FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE = "frames", "telemetry", "journal", "files"
QUEUE_LINE = "queue"  # which another program may have locked
_LINES = (FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE, QUEUE_LINE)


class Disk(Helper):
    """The process, with a line for each file that may hang by itself."""

    def __init__(self) -> None:
        super().__init__(MODULE, _LINES, "the process that writes the session to the disk has ended")
