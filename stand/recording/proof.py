"""Whether the bytes of one record prove that they are what the writer wrote.

A chunk and an attachment prove themselves by their CRC (our writer always makes one, so a CRC of 0 is a CRC), the
records without one by being, byte for byte, what the writer makes of what they say.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections import Counter
from collections.abc import Iterator
from typing import NamedTuple

import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Header, McapRecord, Metadata, Schema

from stand.recording.records import CHUNK_LIMIT_BYTES

RECORD_LIMIT_BYTES = CHUNK_LIMIT_BYTES + 1024
RECORD = struct.Struct("<BQ")  # opcode, length
MESSAGE = struct.Struct("<HIQQ")  # channel id, sequence, log time, publish time
CRC = struct.Struct("<I")

_CHUNK = struct.Struct("<QQQII")  # first and last log time, uncompressed size, CRC, length of the compression's name
_LENGTH = struct.Struct("<Q")
_INDEX = struct.Struct("<HI")  # channel id, length of the entries of 16 bytes


class Contents(NamedTuple):
    """What a chunk holds."""

    schemas: list[Schema]
    channels: list[Channel]
    messages: Counter[int]


class Claim(NamedTuple):
    """What a record's head says; the length is that of its content."""

    opcode: int
    length: int


def claim_of(head: bytes) -> Claim | None:
    """What a record's head says it is; None when that is no record of the data section."""
    if len(head) < RECORD.size:
        return None
    opcode, length = RECORD.unpack_from(head)
    return Claim(opcode, length) if opcode in OPCODES and length <= RECORD_LIMIT_BYTES else None


_EXACT: dict[int, type[Header | Metadata | DataEnd]] = {
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
OPCODES = {*_EXACT, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT}


def proven(opcode: int, content: bytes) -> Contents | Metadata | Attachment | DataEnd | None:
    """What the record says; one of DAMAGE when it does not prove itself."""
    if opcode == Opcode.CHUNK:
        return _contents(uncompressed(memoryview(content)))
    if opcode == Opcode.ATTACHMENT:
        check_crc(content[: -CRC.size], *CRC.unpack(content[-CRC.size :]))
        return Attachment.read(stream_of(content))
    if opcode == Opcode.MESSAGE_INDEX:
        _, entries_bytes = _INDEX.unpack_from(content)
        if len(content) != _INDEX.size + entries_bytes or entries_bytes % 16:
            raise ValueError("a message index is damaged")
        return None
    record = _EXACT[opcode].read(stream_of(content))
    if _bytes_of(record)[RECORD.size :] != content or not _is_text(record):
        raise ValueError("a record is damaged")
    return None if isinstance(record, Header) else record


def _is_text(record: Header | Metadata | DataEnd) -> bool:
    """Nobody writes NUL into a text; a lost block of the disk reads as zeros."""
    if isinstance(record, Metadata):
        texts = [record.name, *record.metadata.keys(), *record.metadata.values()]
        return not any("\0" in text for text in texts)
    return True


def _contents(data: memoryview) -> Contents:
    contents = Contents([], [], Counter())
    for opcode, record in records_of(data):
        if opcode == Opcode.MESSAGE:
            channel, *_ = MESSAGE.unpack_from(record)
            contents.messages[channel] += 1
        elif opcode == Opcode.SCHEMA:
            contents.schemas.append(Schema.read(stream_of(record)))
        elif opcode == Opcode.CHANNEL:
            contents.channels.append(Channel.read(stream_of(record)))
        else:
            raise ValueError(f"a chunk holds a record of kind {opcode}")
    return contents


def check_chunk_lengths(head: bytes, length: int) -> None:
    """ValueError when the lengths in a chunk's head contradict each other; struct.error when it is cut."""
    *_, size, _, name_bytes = _CHUNK.unpack_from(head)
    name_end = _CHUNK.size + name_bytes
    (data_bytes,) = _LENGTH.unpack_from(head, name_end)
    name = head[_CHUNK.size : name_end]
    if name not in (b"", b"zstd") or size > CHUNK_LIMIT_BYTES or (not name and size != data_bytes):
        raise ValueError("no chunk of ours")
    if length != name_end + _LENGTH.size + data_bytes:
        raise ValueError("a chunk's lengths contradict each other")


def uncompressed(content: memoryview) -> memoryview:
    """The records of a chunk, its CRC checked."""
    _, _, size, crc, name_bytes = _CHUNK.unpack_from(content)
    data = content[_CHUNK.size + name_bytes + _LENGTH.size :]
    if name_bytes:
        if zstandard.frame_content_size(data) != size:  # else a damaged size would be allocated as told
            raise ValueError("a chunk's size is wrong")
        data = memoryview(zstandard.decompress(data))
    if len(data) != size:
        raise ValueError("a chunk's size is wrong")
    check_crc(data, crc)
    return data


def records_of(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of each record; struct.error when the last one is cut."""
    offset = 0
    while offset < len(data):
        opcode, length = RECORD.unpack_from(data, offset)
        offset += RECORD.size
        if length > len(data) - offset:
            raise struct.error("a record is cut short")
        yield opcode, data[offset : offset + length]
        offset += length


def _bytes_of(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()


def check_crc(data: bytes | memoryview, crc: int) -> None:
    """ValueError when it is not the CRC of `data`."""
    if zlib.crc32(data) != crc:
        raise ValueError("a CRC is wrong")


def stream_of(data: bytes | memoryview) -> ReadDataStream:
    """The content of a record, for the mcap package's readers."""
    return ReadDataStream(io.BytesIO(data))
