"""The bytes of a segment on their way to the disk: what a Writer makes, and a file that grows by whole blocks of it."""

from __future__ import annotations

import ctypes
import errno
import fcntl
import os
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, cast

from mcap.writer import CompressionType, Writer

CHUNK_BYTES = 1024 * 1024
_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE, linux/falloc.h
_NO_RESERVE = (errno.EOPNOTSUPP, errno.ENOSYS)  # a file system that cannot reserve is written to without
_PARTS_AT_ONCE = 1024  # IOV_MAX

_libc = ctypes.CDLL(None, use_errno=True)
_libc.fallocate64.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)


class Block:
    """The stream of an MCAP Writer: what it has written since it was last taken, whole chunks with nothing copied.
    `tell` is the place in the file."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []
        self._written_bytes = 0

    def write(self, data: bytes) -> int:
        """Keep `data`, which is not to be changed any more."""
        self._parts.append(data)
        self._written_bytes += len(data)
        return len(data)

    def tell(self) -> int:
        """How many bytes were ever written."""
        return self._written_bytes

    def flush(self) -> None:
        """Nothing waits anywhere."""

    def take(self) -> list[bytes]:
        """The parts since the last time, one behind the other."""
        parts, self._parts = self._parts, []
        return parts


def chunk_writer(block: Block, compression: CompressionType) -> Writer:
    """A Writer into `block`; a chunk ends at its flush, or when it has CHUNK_BYTES."""
    return Writer(cast(IO[bytes], block), chunk_size=CHUNK_BYTES, compression=compression)


class CommitSink:
    """A new file that grows by whole blocks; a block is on the disk when `append` returns.

    While it is open it is locked (flock), which marks a living recording, and `reserve_bytes` of the
    disk are its own without being part of its size. After an OSError only `settle` and `close` are left.
    """

    def __init__(self, path: Path, reserve_bytes: int = 0) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._reserve_bytes = reserve_bytes
        self.committed_bytes = 0
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX)  # a reader that looks at the new file meanwhile lets go at once
            _reserve(self._fd, reserve_bytes)
        except OSError:
            self.close()
            with suppress(OSError):
                path.unlink()  # some file systems keep what they could reserve before they refused the rest
            raise

    @property
    def reserved_bytes(self) -> int:
        """What is still reserved behind the committed blocks."""
        return max(0, self._reserve_bytes - self.committed_bytes)

    def append(self, parts: Sequence[bytes]) -> None:
        """Write and sync one block, given in parts; on OSError it is cut off again, if the disk allows that much, and
        the error raised."""
        try:
            end_bytes = _write(self._fd, parts, self.committed_bytes)
            os.fdatasync(self._fd)
            if not os.fstat(self._fd).st_nlink:
                raise FileNotFoundError(errno.ENOENT, "the file was removed while it was written")
        except OSError:
            with suppress(OSError):
                self.settle()
            raise
        self.committed_bytes = end_bytes

    def settle(self) -> None:
        """Cut the file to its committed blocks and give back the reserve, durably. Until that has succeeded a block
        that `append` refused may still be read from the file, so it must not be written to another one."""
        self._reserve_bytes = 0
        os.ftruncate(self._fd, self.committed_bytes)  # frees the reserve also when the size stays the same
        os.fsync(self._fd)

    def close(self) -> None:
        """Unlock and close; may be called twice."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1  # the number may belong to another file by the next call
            with suppress(OSError):  # everything that counts has been synced
                os.close(fd)


def _reserve(fd: int, size_bytes: int) -> None:
    """Allocate the first `size_bytes` of an empty file without changing its size; OSError when they do not fit."""
    while size_bytes > 0 and _libc.fallocate64(fd, _KEEP_SIZE, 0, size_bytes):
        number = ctypes.get_errno()
        if number in _NO_RESERVE:
            return
        if number != errno.EINTR:
            raise OSError(number, f"{os.strerror(number)} (to reserve {size_bytes / 1e6:.0f} MB)")


def _write(fd: int, parts: Sequence[bytes], offset: int) -> int:
    """Write all parts, one behind the other, from `offset`; returns where they end."""
    rest = [memoryview(part) for part in parts if part]
    while rest:  # a nearly full disk takes a part of the block before it refuses
        written = os.pwritev(fd, rest[:_PARTS_AT_ONCE], offset)
        offset += written
        while rest and written >= len(rest[0]):
            written -= len(rest.pop(0))
        if written:
            rest[0] = rest[0][written:]
    return offset
