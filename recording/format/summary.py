"""The index at a segment's end: what is in the segment and where, checked by the CRC that covers it.

mcap's own reader makes an object of every record of it, which costs milliseconds per GB; here the statistics alone are
read, and the rest when somebody asks for it.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Channel, Schema
from mcap.writer import MCAP0_MAGIC

from thermostand.recording.format.mcap_bytes import (
    CRC,
    RECORD,
    RECORD_LIMIT_BYTES,
    check_crc,
    iterate_records,
    make_stream,
)

_FOOTER = struct.Struct("<BQQQ")  # opcode, length, begin of the summary, begin of its offsets; a CRC follows
_FOOTER_BYTES = _FOOTER.size + CRC.size + len(MCAP0_MAGIC)
_TAIL_BYTES = 1 << 16  # read at once from the end: the whole summary of most segments
# Messages, schemas, channels, attachments, metadata, chunks, first and last log time, length of the map behind them
_STATISTICS = struct.Struct("<QHIIIIqqI")
_CHUNK_INDEX = struct.Struct("<qqQQI")  # first and last log time, offset, length, length of the map behind them
_ATTACHMENT_INDEX = struct.Struct("<QQQQQI")  # offset, length, log and create time, size of the data, that of the name
_MAP_ENTRY = struct.Struct("<HQ")  # channel id; count of its messages or offset of its message index


class ChunkPlace(NamedTuple):
    """Where a chunk is, between which log times its messages are, and their channels."""

    first_ns: int
    last_ns: int
    offset: int
    length: int
    channels: tuple[int, ...]


class Statistics(NamedTuple):
    """What a segment holds, in the format's own names: the counts of a channel's messages are by its id, the times are
    log times in ns, 0 when there is no message."""

    message_count: int
    attachment_count: int
    message_start_time: int
    message_end_time: int
    channel_message_counts: dict[int, int]


@dataclass(frozen=True, slots=True)
class Summary:
    """A segment's index; `begin`: where it begins in the file, behind the data. `content`: its records."""

    statistics: Statistics
    begin: int
    content: memoryview

    def channels(self) -> dict[int, tuple[Channel, str]]:
        """Channel id -> the channel and its schema's name; ValueError or LookupError when they do not fit together."""
        schemas: dict[int, str] = {}
        channels: list[Channel] = []
        for opcode, record in iterate_records(self.content):
            if opcode == Opcode.SCHEMA:
                number, name = _parse_schema(bytes(record))
                schemas[number] = name
            elif opcode == Opcode.CHANNEL:
                channels.append(_parse_channel(bytes(record)))
            elif opcode == Opcode.CHUNK_INDEX:
                break  # of these there may be thousands, and no more channels behind them
        return {channel.id: (channel, schemas[channel.schema_id]) for channel in channels}

    def parse_attachments(self) -> dict[str, tuple[int, int]]:
        """Name -> where its record is, and how long; of one name the last."""
        found: dict[str, tuple[int, int]] = {}
        for opcode, record in iterate_records(self.content):
            if opcode == Opcode.ATTACHMENT_INDEX:
                offset, length, _, _, _, name_bytes = _ATTACHMENT_INDEX.unpack_from(record)
                begin = _ATTACHMENT_INDEX.size
                found[bytes(record[begin : begin + name_bytes]).decode()] = offset, length
        return found

    def iterate_chunks(self) -> Iterator[ChunkPlace]:
        """The chunks in the order of the file."""
        for opcode, record in iterate_records(self.content):
            if opcode == Opcode.CHUNK_INDEX:
                first_ns, last_ns, offset, length, map_bytes = _CHUNK_INDEX.unpack_from(record)
                yield ChunkPlace(
                    first_ns, last_ns, offset, length, tuple(_parse_map(record, _CHUNK_INDEX.size, map_bytes))
                )


# Segments of one session, and mostly of all, have the same schemas and channels: a list of sessions decodes them once.
@lru_cache(256)
def _parse_schema(record: bytes) -> tuple[int, str]:
    """Return the number and the name of a schema record."""
    schema = Schema.read(make_stream(record))
    return schema.id, schema.name


@lru_cache(1024)
def _parse_channel(record: bytes) -> Channel:
    """Shared by all that ask, so not to be changed."""
    return Channel.read(make_stream(record))


def read_summary(file: BinaryIO, size_bytes: int) -> Summary:
    """The summary of a finished segment of that size; ValueError, struct.error or EOFError when it is damaged."""
    begin, content = _read_summary_bytes(file, size_bytes)
    record = next((record for opcode, record in iterate_records(content) if opcode == Opcode.STATISTICS), None)
    if record is None:
        raise ValueError("the index has no statistics")
    count, _, _, attachments, _, _, first_ns, last_ns, map_bytes = _STATISTICS.unpack_from(record)
    counts = _parse_map(record, _STATISTICS.size, map_bytes)
    return Summary(Statistics(count, attachments, first_ns, last_ns, counts), begin, content)


def _parse_map(record: memoryview, begin: int, size_bytes: int) -> dict[int, int]:
    return dict(_MAP_ENTRY.iter_unpack(record[begin : begin + size_bytes]))


def _read_summary_bytes(file: BinaryIO, size_bytes: int) -> tuple[int, memoryview]:
    """Return where the summary begins, and its records, their CRC checked, which covers the footer before the CRC,
    too."""
    tail_begin = max(0, size_bytes - _TAIL_BYTES)
    file.seek(tail_begin)
    tail = file.read(size_bytes - tail_begin)
    if not tail.endswith(MCAP0_MAGIC):
        raise ValueError("it ends in the middle")
    footer_begin = len(tail) - _FOOTER_BYTES
    opcode, length, begin, _ = _FOOTER.unpack_from(tail, max(0, footer_begin))
    if opcode != Opcode.FOOTER or length != _FOOTER_BYTES - RECORD.size - len(MCAP0_MAGIC):
        raise ValueError("the footer is damaged")
    if not len(MCAP0_MAGIC) <= begin <= tail_begin + footer_begin or size_bytes - begin > RECORD_LIMIT_BYTES:
        raise ValueError("the index is not in the file")
    if begin < tail_begin:
        file.seek(begin)
        tail = file.read(tail_begin - begin) + tail
        tail_begin = begin
    content = memoryview(tail)[begin - tail_begin :]
    (crc,) = CRC.unpack_from(content, len(content) - CRC.size - len(MCAP0_MAGIC))
    check_crc(content[: -CRC.size - len(MCAP0_MAGIC)], crc, "its index")
    return begin, content[:-_FOOTER_BYTES]
