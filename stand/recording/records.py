"""A segment's bytes back to messages: what stand/recording/segment.py wrote, read strictly.

Telemetry is walked front to back by its record headers, each chunk's CRC checked (the mcap package's own walk costs
several times as much); frames are found through the chunk index. Anything wrong is a SessionError that names the file.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Attachment, Channel, ChunkIndex, Metadata, Schema, Statistics
from mcap.summary import Summary
from mcap.writer import MCAP0_MAGIC

from drivers.interface import SessionError
from stand.recording.images import CAMERA_IMAGE, IMAGE_CLASS
from stand.recording.layout import SESSION_METADATA
from stand.recording.messages import CLASSES

# What reading damaged bytes raises; CRC and Unicode errors are ValueErrors.
DAMAGE = (McapError, OSError, struct.error, zstandard.ZstdError, ValueError, LookupError, EOFError, MemoryError)
CHUNK_LIMIT_BYTES = 1 << 28  # a chunk is 1 MiB or one image; whoever claims more is damaged
SCHEMAS = {
    CAMERA_IMAGE: {image.DESCRIPTOR.full_name for image in IMAGE_CLASS.values()},
    **{topic: {message.DESCRIPTOR.full_name} for topic, message in CLASSES.items()},
}

_RECORD = struct.Struct("<BQ")  # opcode, length
_CHUNK = struct.Struct("<QQQII")  # first and last log time, uncompressed size, CRC, length of the compression's name
_DATA_LENGTH = struct.Struct("<Q")
_MESSAGE = struct.Struct("<HIQQ")  # channel id, sequence, log time, publish time
_FOOTER = struct.Struct("<BQQQ")  # opcode, length, begin of the summary, begin of its offsets; a CRC follows
_CRC = struct.Struct("<I")


@dataclass(frozen=True, slots=True)
class Message:
    """One message as it is in the file; `data` is still encoded."""

    topic: str
    sequence: int
    time_ns: int
    data: bytes


@dataclass(frozen=True, slots=True)
class Head:
    """The first records of a segment."""

    session: dict[str, str]
    attachments: dict[str, str]


@dataclass(frozen=True, slots=True)
class FramePlace:
    """Where a frame is: its segment, its chunk there, and the schema of its message."""

    time_ns: int
    path: Path
    offset: int
    length: int
    schema: str


@contextmanager
def _reading(path: Path) -> Generator[None]:
    """Whatever damage raises inside becomes a SessionError that names the file."""
    try:
        yield
    except DAMAGE as error:
        raise SessionError(f"{path}: damaged or not readable ({type(error).__name__}: {error})") from error


def read_head(path: Path) -> Head:
    """Metadata `session` and the attachments of a finished segment."""
    with _reading(path), path.open("rb") as file:
        size = path.stat().st_size
        _check_ends(path, file, size)
        return _head(path, file, size)


def _check_ends(path: Path, file: BinaryIO, size: int) -> None:
    """Magic bytes at both ends; the file is left behind the first."""
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise SessionError(f"{path}: not an MCAP file")
    file.seek(max(len(MCAP0_MAGIC), size - len(MCAP0_MAGIC)))
    if file.read() != MCAP0_MAGIC:
        raise SessionError(f"{path}: ends in the middle")
    file.seek(len(MCAP0_MAGIC))


def _head(path: Path, file: BinaryIO, size: int) -> Head:
    session: dict[str, str] | None = None
    attachments: dict[str, str] = {}
    while True:
        opcode, length = _RECORD.unpack(file.read(_RECORD.size))
        if opcode not in (Opcode.HEADER, Opcode.ATTACHMENT, Opcode.METADATA):
            break
        content = file.read(min(length, size))
        if opcode == Opcode.ATTACHMENT:
            _check_crc(content[: -_CRC.size], *_CRC.unpack(content[-_CRC.size :]))
            attachment = Attachment.read(_stream(content))
            attachments[attachment.name] = attachment.data.decode()
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(_stream(content))
            session = metadata.metadata if metadata.name == SESSION_METADATA else session
    if session is None:
        raise SessionError(f"{path}: not a segment of a thermostand session")
    return Head(session, attachments)


def _check_crc(data: bytes | memoryview, crc: int) -> None:
    if zlib.crc32(data) != crc:
        raise ValueError("a CRC is wrong")


def _stream(data: bytes | memoryview) -> ReadDataStream:
    return ReadDataStream(io.BytesIO(data))


class _Walk:
    """The walk through one telemetry segment, which learns its schemas and channels on the way."""

    def __init__(self, wanted: Callable[[Channel], bool]) -> None:
        self._wanted = wanted
        self._schemas: dict[int, str] = {}
        self._topics: dict[int, str] = {}  # of the wanted channels
        self.message_count = 0  # wanted or not

    def messages(self, chunk: memoryview) -> Iterator[Message]:
        """The wanted messages of a chunk."""
        for opcode, record in _records(_uncompressed(chunk)):
            if opcode == Opcode.MESSAGE:
                self.message_count += 1
                number, sequence, time_ns, _ = _MESSAGE.unpack_from(record)
                if number in self._topics:
                    yield Message(self._topics[number], sequence, time_ns, bytes(record[_MESSAGE.size :]))
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(_stream(record))
                self._schemas[schema.id] = schema.name
            elif opcode == Opcode.CHANNEL:
                self._learn(Channel.read(_stream(record)))

    def _learn(self, channel: Channel) -> None:
        _check_schema(channel.topic, self._schemas[channel.schema_id])
        if self._wanted(channel):
            self._topics[channel.id] = channel.topic


def telemetry_messages(path: Path, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
    """The messages of the wanted channels of a telemetry segment, in the order of the file."""
    with _reading(path):
        walk = _Walk(wanted)
        for opcode, content in _records(memoryview(path.read_bytes())[len(MCAP0_MAGIC) : -len(MCAP0_MAGIC)]):
            if opcode == Opcode.CHUNK:
                yield from walk.messages(content)
            elif opcode == Opcode.STATISTICS:
                if Statistics.read(_stream(content)).message_count != walk.message_count:
                    break
                return
        raise SessionError(f"{path}: does not hold the messages its index tells of")


def _check_schema(topic: str, schema: str) -> None:
    """ValueError when a topic of ours holds messages that are not."""
    if topic in SCHEMAS and schema not in SCHEMAS[topic]:
        raise ValueError(f"{topic} holds {schema}, not {' or '.join(sorted(SCHEMAS[topic]))}")


def _records(data: memoryview) -> Iterator[tuple[int, memoryview]]:
    """(opcode, content) of each record; struct.error when the last one is cut."""
    offset = 0
    while offset < len(data):
        opcode, length = _RECORD.unpack_from(data, offset)
        offset += _RECORD.size
        if length > len(data) - offset:
            raise struct.error("a record is cut short")
        yield opcode, data[offset : offset + length]
        offset += length


def _uncompressed(chunk: memoryview) -> memoryview:
    """The records of a chunk, its CRC checked."""
    _, _, size, crc, name_length = _CHUNK.unpack_from(chunk)
    if size > CHUNK_LIMIT_BYTES:
        raise ValueError(f"a chunk of {size} bytes")
    name_end = _CHUNK.size + name_length
    compression = bytes(chunk[_CHUNK.size : name_end])
    data = chunk[name_end + _DATA_LENGTH.size :]
    if compression == b"zstd":
        if zstandard.frame_content_size(data) != size:  # else a damaged size would be allocated as told
            raise ValueError("a chunk's size is wrong")
        data = memoryview(zstandard.decompress(data))
    elif compression:
        raise ValueError(f"a chunk compressed with {compression!r}")
    if len(data) != size:
        raise ValueError("a chunk's size is wrong")
    _check_crc(data, crc)
    return data


def frame_places(path: Path) -> list[FramePlace]:
    """The frames of a segment, from its chunk index alone."""
    with _reading(path), path.open("rb") as file:
        _check_summary(file, path.stat().st_size)
        file.seek(0)
        summary = SeekingReader(file, record_size_limit=path.stat().st_size).get_summary()
        if summary is None or summary.statistics is None:
            raise SessionError(f"{path}: has no index")
        if summary.statistics.message_count != len(summary.chunk_indexes):
            raise SessionError(f"{path}: its chunks are not one frame each")
        return [_place(path, summary, index) for index in summary.chunk_indexes]


def _check_summary(file: BinaryIO, size: int) -> None:
    """ValueError when the index at the end of the file is damaged: its CRC covers it and the footer before the CRC."""
    footer_bytes = _FOOTER.size + _CRC.size + len(MCAP0_MAGIC)
    file.seek(max(0, size - footer_bytes))
    _, _, begin, _ = _FOOTER.unpack(file.read(_FOOTER.size))
    (crc,) = _CRC.unpack(file.read(_CRC.size))
    if not len(MCAP0_MAGIC) <= begin <= size - footer_bytes:
        raise ValueError("the index is not in the file")
    file.seek(begin)
    _check_crc(file.read(size - footer_bytes + _FOOTER.size - begin), crc)


def _place(path: Path, summary: Summary, index: ChunkIndex) -> FramePlace:
    (number,) = index.message_index_offsets
    channel = summary.channels[number]
    schema = summary.schemas[channel.schema_id].name
    _check_schema(CAMERA_IMAGE, schema)
    return FramePlace(index.message_start_time, path, index.chunk_start_offset, index.chunk_length, schema)


def read_frame(place: FramePlace) -> Message:
    """The image message at its place."""
    with _reading(place.path), place.path.open("rb") as file:
        if place.length > CHUNK_LIMIT_BYTES:
            raise ValueError(f"a chunk of {place.length} bytes")
        file.seek(place.offset)
        ((opcode, chunk),) = _records(memoryview(file.read(place.length)))
        if opcode != Opcode.CHUNK:
            raise ValueError("the index does not point to a chunk")
        (record,) = (record for opcode, record in _records(_uncompressed(chunk)) if opcode == Opcode.MESSAGE)
        _, sequence, time_ns, _ = _MESSAGE.unpack_from(record)
        return Message(CAMERA_IMAGE, sequence, time_ns, bytes(record[_MESSAGE.size :]))
