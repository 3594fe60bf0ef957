"""A file that is locked (flock) as long as the process that took it lives, and says who that is."""

from __future__ import annotations

import fcntl
import os
from contextlib import suppress
from pathlib import Path


def take_lock(path: Path, content: bytes, mode: int = 0o600) -> int | None:
    """The descriptor of the file at `path`, locked and with this content; None when a living process has it locked.
    What a dead one left is taken over. mode: of a file that is made. Raises OSError."""
    while True:
        file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC | os.O_NOFOLLOW, mode)
        try:
            if os.fstat(file).st_uid == os.geteuid():
                os.fchmod(file, mode)  # whatever the umask
            if not try_lock(file):
                os.close(file)
                return None
            if is_at(file, path):
                os.ftruncate(file, 0)
                os.pwrite(file, content, 0)
                return file
        except BaseException:
            os.close(file)
            raise
        os.close(file)  # it was removed between opening and locking


def release_lock(path: Path, file: int) -> None:
    """Remove and unlock what `take` has given, unless another process has the name by now."""
    with suppress(OSError):
        if is_at(file, path):
            path.unlink()
    os.close(file)


def try_lock(file: int, *, shared: bool = False) -> bool:
    """Return whether the lock was free; does not wait. Raises OSError."""
    try:
        fcntl.flock(file, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def is_at(file: int, path: Path) -> bool:
    """Return whether `path` is still a name of the opened file."""
    try:
        named = os.lstat(path)
    except FileNotFoundError:
        return False
    opened = os.fstat(file)
    return (named.st_dev, named.st_ino) == (opened.st_dev, opened.st_ino)
