"""A segment's bytes back to messages: what stand/recording/segment.py wrote, read strictly.

Nothing is taken from where no CRC covers it, unless the file tells it twice: the index has a CRC and says where each
chunk is, how long, between which instants and how many messages of each channel there are; each chunk's content has
one, too. Anything wrong is a SessionError that names the file.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Container, Generator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, NamedTuple

import zstandard
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata
from mcap.writer import MCAP0_MAGIC

from drivers.interface import SessionError
from stand.recording.images import CAMERA_IMAGE, IMAGE_CLASS
from stand.recording.layout import SEGMENT_METADATA, SESSION_METADATA, contradicts
from stand.recording.messages import CLASSES
from stand.recording.summary import CRC, RECORD, ChunkPlace, Summary, check_crc, read_summary, stream

# What reading damaged bytes raises; CRC and Unicode errors are ValueErrors.
DAMAGE = (
    McapError,
    OSError,
    struct.error,
    zstandard.ZstdError,
    ValueError,
    LookupError,
    EOFError,
    OverflowError,
    MemoryError,
)
CHUNK_LIMIT_BYTES = 1 << 28  # a chunk is 1 MiB or one image; whoever claims more is damaged
_FRAME_HEAD_BYTES = 1 << 14  # schema, channel and what precedes the image; 3 KiB in the first chunk, 90 bytes in others
INFLATED_LIMIT_BYTES = 1 << 26  # only telemetry is compressed, and its chunks are 1 MiB and a message
SCHEMAS = {
    CAMERA_IMAGE: {image.DESCRIPTOR.full_name for image in IMAGE_CLASS.values()},
    **{topic: {message.DESCRIPTOR.full_name} for topic, message in CLASSES.items()},
}

_CHUNK = struct.Struct("<qqQII")  # first and last log time, uncompressed size, CRC, length of the compression's name
_DATA_LENGTH = struct.Struct("<Q")
_MESSAGE_START = struct.Struct("<BQH")  # opcode, length, channel id
_MESSAGE_REST = struct.Struct("<Iqq")  # sequence, log time, publish time; signed, as every instant of ours
_HEADER_BYTES = RECORD.size
_MESSAGE_OPCODE = int(Opcode.MESSAGE)
_MESSAGE_BYTES = _MESSAGE_START.size + _MESSAGE_REST.size  # with the record's header


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
    """Where a frame is: its segment, its chunk there, and number and schema of its channel."""

    path: Path
    chunk: ChunkPlace
    channel: int
    schema: str

    @property
    def time_ns(self) -> int:
        """Middle of the frame's exposure."""
        return self.chunk.first_ns


@dataclass(frozen=True, slots=True)
class MessageSpan:
    """How many messages a segment has, and the times of the first and the last."""

    count: int
    first_ns: int
    last_ns: int


@contextmanager
def reading(path: Path) -> Generator[None]:
    """Whatever damage raises inside becomes a SessionError that names the file."""
    try:
        yield
    except DAMAGE as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise SessionError(f"{path}: damaged or not readable ({text})") from error


@contextmanager
def naming(path: Path) -> Generator[None]:
    """A SessionError from inside gets the file's name in front."""
    try:
        yield
    except SessionError as error:
        raise SessionError(f"{path}: {error}") from error


def read_head(path: Path) -> Head:
    """Metadata `session` and the attachments of a finished segment."""
    with reading(path), path.open("rb") as file:
        summary = _open(path, file)
        head = _head(path, file)
        if len(head.attachments) != summary.statistics.attachment_count:
            raise ValueError("its attachments are not those its index tells of")
        return head


def _open(path: Path, file: BinaryIO) -> Summary:
    """The summary of a finished segment; the file is left behind the magic bytes at its begin."""
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise SessionError(f"{path}: not an MCAP file")
    size = path.stat().st_size
    file.seek(max(len(MCAP0_MAGIC), size - len(MCAP0_MAGIC)))
    if file.read() != MCAP0_MAGIC:
        raise SessionError(f"{path}: ends in the middle")
    summary = read_summary(file, size)
    file.seek(len(MCAP0_MAGIC))
    return summary


def _head(path: Path, file: BinaryIO) -> Head:
    size = path.stat().st_size
    found: dict[str, dict[str, str]] = {}
    attachments: dict[str, str] = {}
    while True:
        opcode, length = RECORD.unpack(file.read(RECORD.size))
        if opcode not in (Opcode.HEADER, Opcode.ATTACHMENT, Opcode.METADATA):
            break
        content = file.read(min(length, size))
        if opcode == Opcode.ATTACHMENT:
            check_crc(content[: -CRC.size], *CRC.unpack(content[-CRC.size :]))
            attachment = Attachment.read(stream(content))
            attachments[attachment.name] = attachment.data.decode()
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream(content))
            found[metadata.name] = metadata.metadata
    session = found.get(SESSION_METADATA)
    if session is None:
        raise SessionError(f"{path}: not a segment of a thermostand session")
    if contradicts(found.get(SEGMENT_METADATA, {}), session):
        raise ValueError("the session's metadata do not fit their CRC")
    return Head(session, attachments)


def telemetry_messages(path: Path, wanted: Callable[[Channel], bool]) -> Iterator[Message]:
    """The messages of the wanted channels of a telemetry segment, in the order of the file."""
    with reading(path), path.open("rb") as file:
        summary = _open(path, file)
        topics = {number: channel.topic for number, (channel, _) in _channels(summary).items() if wanted(channel)}
        counts = dict.fromkeys(topics, 0)
        for place in summary.chunks():
            if topics.keys().isdisjoint(place.channels):
                continue
            chunk = _chunk(file, place)
            for number, offset, end in _message_places(chunk, topics):
                counts[number] += 1
                yield _message(topics[number], chunk, offset, end)
        if counts != {number: summary.statistics.channel_message_counts.get(number, 0) for number in topics}:
            raise ValueError("it does not hold the messages its index tells of")


def _channels(summary: Summary) -> dict[int, tuple[Channel, str]]:
    """Channel id -> channel and schema; ValueError when a topic of ours holds messages that are not."""
    channels = summary.channels()
    for channel, schema in channels.values():
        known = SCHEMAS.get(channel.topic)
        if known is not None and schema not in known:
            raise ValueError(f"{channel.topic} holds {schema}, not {' or '.join(sorted(known))}")
    return channels


def _chunk(file: BinaryIO, place: ChunkPlace) -> memoryview:
    """The records of the chunk at that place, their CRC checked."""
    data = memoryview(_read(file, place.offset, place.length))
    head = _chunk_head(data, place)
    content = _uncompressed(head.compression, data[head.end :], head.size_bytes)
    check_crc(content, head.crc)
    return content


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    """So many bytes from there; ValueError when there are fewer, before memory is taken for them."""
    if length > CHUNK_LIMIT_BYTES or offset + length > os.fstat(file.fileno()).st_size:
        raise ValueError(f"{length} bytes at {offset} are not in the file")
    file.seek(offset)
    return file.read(length)


class _ChunkHead(NamedTuple):
    """A chunk's record before its content: what it says of it, and where it ends."""

    size_bytes: int
    crc: int
    compression: bytes
    end: int


def _chunk_head(data: bytes | memoryview, place: ChunkPlace) -> _ChunkHead:
    """The head of the chunk that begins `data`; ValueError when it is not the one that the index tells of."""
    opcode, length = RECORD.unpack_from(data)
    if opcode != Opcode.CHUNK or length != place.length - RECORD.size:
        raise ValueError("the index does not point to a chunk")
    first_ns, last_ns, size_bytes, crc, name_bytes = _CHUNK.unpack_from(data, RECORD.size)
    if (first_ns, last_ns) != (place.first_ns, place.last_ns):
        raise ValueError("the index points to another chunk")
    name_begin = RECORD.size + _CHUNK.size
    name = bytes(data[name_begin : name_begin + name_bytes])
    return _ChunkHead(size_bytes, crc, name, name_begin + name_bytes + _DATA_LENGTH.size)


def _uncompressed(compression: bytes, data: memoryview, size: int) -> memoryview:
    """The content of a chunk that says it has that size."""
    if compression == b"zstd":
        # As much memory is taken as the frame says: so both have to say the same, and not too much.
        if size > INFLATED_LIMIT_BYTES or zstandard.frame_content_size(data) != size:
            raise ValueError("a chunk's size is wrong")
        data = memoryview(zstandard.decompress(data))
    elif compression:
        raise ValueError(f"a chunk compressed with {compression!r}")
    if len(data) != size:
        raise ValueError("a chunk's size is wrong")
    return data


def _message_places(chunk: memoryview, wanted: Container[int]) -> list[tuple[int, int, int]]:
    """(channel id, offset, end) of each message record of the wanted channels in a chunk."""
    # Every record of a night passes here, so the loop has no call but one.
    unpack = _MESSAGE_START.unpack_from
    found: list[tuple[int, int, int]] = []
    offset, size = 0, len(chunk)
    while offset < size:
        opcode, length, number = unpack(chunk, offset)
        end = offset + _HEADER_BYTES + length
        if number in wanted and opcode == _MESSAGE_OPCODE:
            found.append((number, offset, end))
        offset = end
    if offset != size:
        raise struct.error("a record is cut short")
    return found


def _message(topic: str, chunk: memoryview, offset: int, end: int) -> Message:
    sequence, time_ns, _ = _MESSAGE_REST.unpack_from(chunk, offset + _MESSAGE_START.size)
    return Message(topic, sequence, time_ns, bytes(chunk[offset + _MESSAGE_BYTES : end]))


def message_span(path: Path) -> MessageSpan:
    """How many messages a segment has and when, from its statistics alone."""
    with reading(path), path.open("rb") as file:
        statistics = _open(path, file).statistics
        return MessageSpan(statistics.message_count, statistics.message_start_time, statistics.message_end_time)


def frame_places(path: Path) -> list[FramePlace]:
    """The frames of a segment, from its index alone."""
    with reading(path), path.open("rb") as file:
        summary = _open(path, file)
        channels = _channels(summary)
        places: list[FramePlace] = []
        for chunk in summary.chunks():
            (number,) = chunk.channels
            places.append(FramePlace(path, chunk, number, channels[number][1]))
        if summary.statistics.message_count != len(places):
            raise ValueError("its chunks are not one frame each")
        return places


def read_frame(place: FramePlace) -> Message:
    """The image message at its place: the last record of its chunk, behind at most its schema and channel.

    It is read by itself, because new memory for 5 MB costs more than all else that is done here.
    """
    chunk = place.chunk
    with reading(place.path), place.path.open("rb", buffering=0) as file:
        data = _read(file, chunk.offset, min(chunk.length, _FRAME_HEAD_BYTES))
        head = _chunk_head(data, chunk)
        if head.compression or head.end + head.size_bytes != chunk.length:
            raise ValueError("a frame's chunk is compressed or has another size")
        begin = _image_record(data, head.end)
        _, length, number = _MESSAGE_START.unpack_from(data, begin)
        sequence, time_ns, _ = _MESSAGE_REST.unpack_from(data, begin + _MESSAGE_START.size)
        begin += _MESSAGE_BYTES
        if length != chunk.length - begin + _MESSAGE_BYTES - RECORD.size:
            raise ValueError("a frame's chunk holds more than the frame")
        image = _read(file, chunk.offset + begin, chunk.length - begin)
        check_crc(image, head.crc, data[head.end : begin])
        if (number, time_ns) != (place.channel, place.time_ns):
            raise ValueError("the index tells of another frame")
        return Message(CAMERA_IMAGE, sequence, time_ns, image)


def _image_record(data: bytes, offset: int) -> int:
    """Where the first message record is, of the records from `offset` on."""
    opcode, length = RECORD.unpack_from(data, offset)
    while opcode != Opcode.MESSAGE:
        offset += RECORD.size + length
        opcode, length = RECORD.unpack_from(data, offset)
    return offset
