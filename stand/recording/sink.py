"""A file that grows by whole blocks, each on the disk before it counts."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


class CommitSink:
    """A new file that grows by whole blocks; a block is on the disk when `append` returns."""

    def __init__(self, path: Path) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self.committed_bytes = 0

    def append(self, block: bytes) -> None:
        """Write and sync; on OSError the file is cut back to the blocks before and the error raised."""
        try:
            rest = memoryview(block)
            while rest:  # a nearly full disk takes a part of the block before it refuses
                rest = rest[os.pwrite(self._fd, rest, self.committed_bytes + len(block) - len(rest)) :]
            os.fdatasync(self._fd)
        except OSError:
            with suppress(OSError):
                os.ftruncate(self._fd, self.committed_bytes)
            raise
        self.committed_bytes += len(block)

    def close(self) -> None:
        """Sync size and times, too, and close; raises OSError, also when it is closed already."""
        fd, self._fd = self._fd, -1  # the number may belong to another file by the next call
        try:
            os.fsync(fd)
        finally:
            os.close(fd)


def sync_folder(folder: Path) -> None:
    """Make the folder's names durable."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
