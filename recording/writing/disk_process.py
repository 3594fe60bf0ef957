"""The process that touches the disk for a daemon: `python -m recording.writing.disk_process DAEMON FD ...`.

A thread that waits for a disk in the kernel cannot be killed, and keeps its whole process from ending. So a daemon that
has to leave while the disk hangs leaves this process behind. DAEMON is the daemon's process id, each FD a line to it
(see helper_process.py): one file that hangs does not stop the others. Until the process has ended it holds
its locks, which show that a process still writes.
"""

from __future__ import annotations

import sys

from foundation.helper_process import serve

MODULE = "recording.writing.disk_process"
LEFT_NAME = "stand-disk-left"  # of a process whose daemon has gone

if __name__ == "__main__":
    serve([int(number) for number in sys.argv[2:]], LEFT_NAME)
