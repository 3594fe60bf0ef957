"""The journal's file: lines behind lines, each on the disk before it counts."""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from pathlib import Path

from foundation.sink import sync_folder
from recording.writing.home import FolderLost
from recording.writing.locks import lock


class JournalFile:
    """The open, locked file `path`, of which `size_bytes` are acknowledged. Blocking; used from one thread."""

    def __init__(self, path: Path, fd: int, size_bytes: int) -> None:
        self._path = path
        self._fd = fd
        self._size_bytes = size_bytes

    def append(self, data: bytes) -> None:
        """The lines on the disk; on OSError the file is as it was, FolderLost when it is not at its place any more."""
        if not self._is_there():
            raise FolderLost(errno.ENOENT, f"the file {self._path} was removed or renamed while it was written")
        try:
            if os.pwrite(self._fd, data, self._size_bytes) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))  # a part of it fitted
            os.fdatasync(self._fd)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, self._size_bytes)
            raise
        self._size_bytes += len(data)

    def refound(self, data: bytes) -> bool:
        """Whether the file is at its place again; else one with all the lines, `data`, is made there."""
        if self._is_there():
            return True
        part = self._path.with_name(f".{self._path.name}.{os.getpid()}.part")
        fd = os.open(part, os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o644)
        try:
            lock(fd)
            if os.pwrite(fd, data, 0) < len(data):
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            os.fsync(fd)
            os.replace(part, self._path)
            sync_folder(self._path.parent)
        except OSError:
            os.close(fd)
            with suppress(OSError):
                part.unlink()
            raise
        self.close()
        self._fd, self._size_bytes = fd, len(data)
        return False

    def close(self) -> None:
        """Unlock and close; may be called twice."""
        fd, self._fd = self._fd, -1
        if fd >= 0:
            os.close(fd)

    def _is_there(self) -> bool:
        try:
            return os.path.samestat(self._path.stat(), os.fstat(self._fd))
        except (FileNotFoundError, NotADirectoryError):
            return False


def taken_over(path: Path, size_bytes: int) -> JournalFile:
    """The journal that another process has begun or read, and has just unlocked; OSError."""
    fd = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    try:
        lock(fd)
    except OSError:
        os.close(fd)
        raise
    return JournalFile(path, fd, size_bytes)
