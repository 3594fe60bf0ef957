"""The index at a segment's end: what is in the segment and where, checked by the CRC that covers it.

mcap's own reader makes an object of every chunk index, which costs milliseconds per GB; here they are walked when
somebody asks for them, and everything else stands before them.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

RECORD = struct.Struct("<BQ")  # opcode, length
CRC = struct.Struct("<I")

_FOOTER = struct.Struct("<BQQQ")  # opcode, length, begin of the summary, begin of its offsets; a CRC follows
_FOOTER_BYTES = _FOOTER.size + CRC.size + len(MCAP0_MAGIC)
_TAIL_BYTES = 1 << 16  # read at once from the end: the whole summary of most segments
_CHUNK_INDEX = struct.Struct("<qqQQI")  # first and last log time, offset, length, length of the map behind it
_MAP_ENTRY = struct.Struct("<HQ")  # channel id, offset of its message index


class ChunkPlace(NamedTuple):
    """Where a chunk is, between which log times its messages are, and their channels."""

    first_ns: int
    last_ns: int
    offset: int
    length: int
    channels: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Summary:
    """What a segment's index tells; `schemas` are id -> name, `message_counts` channel id -> messages."""

    statistics: Statistics
    channels: dict[int, Channel]
    schemas: dict[int, str]
    _chunk_indexes: memoryview

    @property
    def message_counts(self) -> dict[int, int]:
        """Channel id -> how many messages it has."""
        return self.statistics.channel_message_counts

    def chunks(self) -> Iterator[ChunkPlace]:
        """The chunks in the order of the file."""
        for opcode, record in records(self._chunk_indexes):
            if opcode == Opcode.CHUNK_INDEX:
                first_ns, last_ns, offset, length, map_bytes = _CHUNK_INDEX.unpack_from(record)
                entries = record[_CHUNK_INDEX.size : _CHUNK_INDEX.size + map_bytes]
                channels = tuple(number for number, _ in _MAP_ENTRY.iter_unpack(entries))
                yield ChunkPlace(first_ns, last_ns, offset, length, channels)


def read_summary(file: BinaryIO, size_bytes: int) -> Summary:
    """The summary of a finished segment of that size; ValueError, struct.error or EOFError when it is damaged."""
    content = _summary_bytes(file, size_bytes)
    statistics: Statistics | None = None
    channels: dict[int, Channel] = {}
    schemas: dict[int, str] = {}
    begin = 0
    for opcode, record in records(content):
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream(record))
            schemas[schema.id] = schema.name
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream(record))
            channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            statistics = Statistics.read(stream(record))
        elif opcode == Opcode.CHUNK_INDEX:
            break  # whatever is behind the first one is left for `chunks`
        begin += RECORD.size + len(record)
    if statistics is None:
        raise ValueError("the index has no statistics")
    return Summary(statistics, channels, schemas, content[begin:])


def _summary_bytes(file: BinaryIO, size_bytes: int) -> memoryview:
    """The records of the summary, their CRC checked, which covers the footer before the CRC, too."""
    tail_begin = max(0, size_bytes - _TAIL_BYTES)
    file.seek(tail_begin)
    tail = file.read(size_bytes - tail_begin)
    footer_begin = len(tail) - _FOOTER_BYTES
    opcode, length, begin, _ = _FOOTER.unpack_from(tail, max(0, footer_begin))
    if opcode != Opcode.FOOTER or length != _FOOTER_BYTES - RECORD.size - len(MCAP0_MAGIC):
        raise ValueError("the footer is damaged")
    if not len(MCAP0_MAGIC) <= begin <= tail_begin + footer_begin:
        raise ValueError("the index is not in the file")
    if begin < tail_begin:
        file.seek(begin)
        tail = file.read(tail_begin - begin) + tail
        tail_begin = begin
    content = memoryview(tail)[begin - tail_begin :]
    (crc,) = CRC.unpack_from(content, len(content) - CRC.size - len(MCAP0_MAGIC))
    check_crc(content[: -CRC.size - len(MCAP0_MAGIC)], crc)
    return content[:-_FOOTER_BYTES]


def records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of each record; struct.error when the last one is cut."""
    offset = 0
    while offset < len(data):
        opcode, length = RECORD.unpack_from(data, offset)
        offset += RECORD.size
        if length > len(data) - offset:
            raise struct.error("a record is cut short")
        yield opcode, data[offset : offset + length]
        offset += length


def check_crc(data: bytes | memoryview, crc: int) -> None:
    """ValueError when `data` is not what the CRC was made of."""
    if zlib.crc32(data) != crc:
        raise ValueError("a CRC is wrong")


def stream(data: bytes | memoryview) -> ReadDataStream:
    """`data` for the mcap package's record readers."""
    return ReadDataStream(io.BytesIO(data))
