"""What an MCAP Writer has written since somebody last took it: whole chunks, with nothing copied."""

from __future__ import annotations

from typing import IO, cast

from mcap.writer import CompressionType, Writer

CHUNK_BYTES = 1024 * 1024


class Block:
    """The Writer's stream; it keeps the bytes it is given. `tell` is the place in the file."""

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
