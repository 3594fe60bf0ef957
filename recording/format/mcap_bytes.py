"""The records of an MCAP file as bytes: how they are framed, what a chunk holds, which sizes are believed.

Reader, salvage and verification all read through here, so that what one of them accepts the others accept, too.
"""

from __future__ import annotations

import errno
import io
import os
import struct
import zlib
from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.records import McapRecord

RECORD = struct.Struct("<BQ")  # opcode, length
CRC = struct.Struct("<I")
LENGTH = struct.Struct("<Q")
MESSAGE = struct.Struct("<HIQQ")  # channel id, sequence, log time, publish time
CHUNK = struct.Struct("<qqQII")  # first and last log time, uncompressed size, CRC, length of the compression's name
MESSAGE_INDEX = struct.Struct("<HI")  # channel id, length of the entries
MESSAGE_INDEX_ENTRY = struct.Struct("<QQ")  # log time, place in the chunk

CHUNK_LIMIT_BYTES = 1 << 28  # a chunk is 1 MiB or one image; one that claims more is damaged
RECORD_LIMIT_BYTES = CHUNK_LIMIT_BYTES + 1024

_NAME_BYTES = {b"": 0, b"zstd": 4}


class Source:
    """An open file, read by place."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self.size = os.fstat(fd).st_size

    def read(self, offset: int, length: int) -> bytes:
        """The bytes there, fewer at the end of the file; raises OSError."""
        return os.pread(self._fd, length, offset)

    def next_data(self, offset: int) -> int:
        """The first place from `offset` on that is not in a hole of a sparse file, which reads as zeros; the size when
        there is none."""
        if offset >= self.size:
            return self.size
        try:
            return min(self.size, os.lseek(self._fd, offset, os.SEEK_DATA))
        except OSError as error:
            return self.size if error.errno == errno.ENXIO else offset  # a disk that knows of no holes has none

    def file(self) -> BinaryIO:
        """The same file for those who seek in it; it stays open when that is closed."""
        return os.fdopen(self._fd, "rb", closefd=False)


class ChunkHead(NamedTuple):
    """What a chunk's record says of it; its data begins at `begin`. The times are log times, the CRC is that of the
    uncompressed data."""

    first_ns: int
    last_ns: int
    size_bytes: int
    crc: int
    compression: bytes
    begin: int


def iterate_records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of each record; struct.error when the last one is cut."""
    offset = 0
    while offset < len(data):
        opcode, length = RECORD.unpack_from(data, offset)
        offset += RECORD.size
        if length > len(data) - offset:
            raise struct.error("a record is cut short")
        yield opcode, data[offset : offset + length]
        offset += length


def make_stream(data: bytes | memoryview) -> ReadDataStream:
    """The content of a record, for the mcap package's record readers."""
    return ReadDataStream(io.BytesIO(data))


def encode_record(record: McapRecord) -> bytes:
    """The record as the writer writes it."""
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def check_crc(data: bytes | memoryview, crc: int, what: str, before: bytes = b"") -> None:
    """ValueError when `before` and `data` are not what the CRC was made of."""
    if zlib.crc32(data, zlib.crc32(before)) != crc:
        raise ValueError(f"the CRC of {what} is wrong")


def check_attachment(content: bytes) -> None:
    """ValueError when an attachment's record does not fit its CRC, struct.error when it has none."""
    (crc,) = CRC.unpack(content[-CRC.size :])
    check_crc(content[: -CRC.size], crc, "an attachment")


def parse_chunk_head(content: bytes | memoryview, length: int) -> ChunkHead:
    """The head of a chunk, from the begin of its record's content, which has that length; ValueError when its sizes
    are not those of a chunk of ours, struct.error when it is cut."""
    first_ns, last_ns, size_bytes, crc, name_bytes = CHUNK.unpack_from(content)
    name = bytes(content[CHUNK.size : CHUNK.size + min(name_bytes, 16)])
    if _NAME_BYTES.get(name) != name_bytes:
        raise ValueError(f"a chunk is compressed with {name!r}")
    if size_bytes > CHUNK_LIMIT_BYTES:
        raise ValueError(f"a chunk claims {size_bytes} bytes")
    (data_bytes,) = LENGTH.unpack_from(content, CHUNK.size + name_bytes)
    begin = CHUNK.size + name_bytes + LENGTH.size
    if begin + data_bytes != length or (not name and data_bytes != size_bytes):
        raise ValueError("a chunk's size is wrong")
    return ChunkHead(first_ns, last_ns, size_bytes, crc, name, begin)


def decompress_chunk(content: memoryview) -> tuple[ChunkHead, memoryview]:
    """Head and records of a chunk, from the whole content of its record, the CRC checked; ValueError, struct.error or
    ZstdError when it is damaged."""
    head = parse_chunk_head(content, len(content))
    data = content[head.begin :]
    if head.compression:
        data = _decompress(data, head.size_bytes)
    check_crc(data, head.crc, "a chunk")
    return head, data


def _decompress(data: memoryview, size_bytes: int) -> memoryview:
    """Return what zstd has made of so many bytes, in memory that may be written to; ValueError when it is another
    number."""
    # As much memory is taken as the chunk says: so both have to say the same.
    if zstandard.frame_content_size(data) != size_bytes:
        raise ValueError("a chunk's size is wrong")
    buffer = np.empty(size_bytes, np.uint8).data  # not cleared first, as a bytearray would be
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        done = 0
        while done < size_bytes and (read := stream.readinto(buffer[done:])):
            done += read
    if done != size_bytes:
        raise ValueError("a chunk's size is wrong")
    return buffer
