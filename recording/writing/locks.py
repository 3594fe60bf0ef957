"""Who holds the lock of a recording's file: a daemon, or what a daemon that has gone has left behind.

The disk process of a daemon that was killed ends within milliseconds; while the disk hangs it cannot, and its locks
rightly show that a block may still be written.
"""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

from thermostand.recording.writing.disk import MODULE

# Round number; nothing was measured.
_LEFT_WITHIN_S = 2.0
_AGAIN_S = 0.02  # round number; nothing was measured


def lock(fd: int) -> None:
    """Lock the file (flock); BlockingIOError, which names the holder, when another has it. A disk process whose daemon
    has gone is waited for for 2 s: it may just have been killed."""
    deadline_s = time.monotonic() + _LEFT_WITHIN_S
    pid = 0
    while True:
        try:
            fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            pid = find_holder(fd) or pid
            if not _may_end(pid) or time.monotonic() > deadline_s:
                raise BlockingIOError(error.errno, _describe_holder(pid)) from None
            time.sleep(_AGAIN_S)  # noqa: TID251 - as above
        else:
            return


def find_holder(fd: int) -> int:
    """The process that has locked this file, 0 when it is unknown: the kernel lists its locks page by page, and
    leaves some out when others come and go meanwhile."""
    found = os.fstat(fd)
    return _find_in_list(Path("/proc/locks").read_text(), found.st_dev, found.st_ino)


def _find_in_list(locks: str, device: int, inode: int) -> int:
    """The process that has locked this file, 0 when the kernel's list does not have it."""
    lines = (line.split() for line in locks.splitlines())
    pids = {fields[5]: int(fields[4]) for fields in lines if fields[1] == "FLOCK"}
    exactly = pids.get(f"{os.major(device):02x}:{os.minor(device):02x}:{inode}", 0)
    if exactly or os.major(device):
        return exactly  # files of two disks have the same numbers
    # File systems without a disk of their own may give their files another device than they lock them under.
    alike = (pids[place] for place in pids if place.startswith("00:") and place.endswith(f":{inode}"))
    return next(alike, 0)


def _may_end(pid: int) -> bool:
    """Return whether the holder is no daemon and none's: a disk process that was left behind, or one that is just
    ending."""
    return _is_orphan(pid) or not _read_command(pid)


def _is_orphan(pid: int) -> bool:
    """Return whether this is a disk process whose daemon has gone."""
    command = _read_command(pid)
    if MODULE.encode() not in command:
        return False
    try:
        parent = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1]
    except OSError:
        return True
    return command[command.index(MODULE.encode()) + 1] != parent.encode()


def _read_command(pid: int) -> list[bytes]:
    """Empty for a process that has ended, or is ending."""
    try:
        return Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0")[:-1]
    except OSError:
        return []


def _describe_holder(pid: int) -> str:
    if _is_orphan(pid):
        return f"its daemon has ended, but process {pid} still waits for the disk; try again when the disk answers"
    return "a daemon is running this session already"
