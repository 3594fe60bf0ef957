"""The daemon's end of the process that touches the disk for it, see disk_process.py."""

from __future__ import annotations

from foundation.helper import Helper
from recording.writing.disk_process import MODULE

FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE = "frames", "telemetry", "journal", "files"
_LINES = (FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE)


class Disk(Helper):
    """The process, with a line for each file that may hang by itself."""

    def __init__(self) -> None:
        super().__init__(MODULE, _LINES, "the process that writes the session to the disk has ended")
