"""A segment's bytes back to messages: what recording/writing/segment.py wrote, read strictly.

Nothing that no CRC covers is used, unless the file has it twice: the index has a CRC and says where each
chunk is, how long, between which instants and how many messages of each channel there are; each chunk's content has
one, too. Anything wrong is a SessionError that names the file.
"""

from __future__ import annotations

import os
import struct
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata
from mcap.writer import MCAP0_MAGIC

from thermostand.foundation.errors import SessionError
from thermostand.recording.format.damage import FileDamaged, reading
from thermostand.recording.format.images import CAMERA_IMAGE, IMAGE_CLASS
from thermostand.recording.format.layout import SALVAGE_METADATA, SEGMENT_METADATA, SESSION_METADATA, contradicts
from thermostand.recording.format.mcap_bytes import (
    CHUNK_LIMIT_BYTES,
    RECORD,
    ChunkHead,
    check_attachment,
    check_crc,
    chunk_content,
    chunk_head,
    stream,
)
from thermostand.recording.format.messages import CLASSES
from thermostand.recording.format.summary import ChunkPlace, Summary, read_summary

_CHUNK_HEAD_BYTES = 64
_FRAME_HEAD_BYTES = 1 << 14  # schema, channel and what precedes the image; 3 KiB in the first chunk, 90 bytes in others
SCHEMAS = {
    CAMERA_IMAGE: {image.DESCRIPTOR.full_name for image in IMAGE_CLASS.values()},
    **{topic: {message.DESCRIPTOR.full_name} for topic, message in CLASSES.items()},
}

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
    """The first records of a segment. place: the record `segment`, its place in the session; salvaged: the record
    `salvage`, empty for a segment that its recorder finished itself."""

    session: dict[str, str]
    attachments: dict[str, str]
    place: dict[str, str]
    salvaged: dict[str, str]


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


def read_head(path: Path) -> Head:
    """Metadata `session` and the attachments of a finished segment."""
    with reading(path), path.open("rb") as file:
        summary = _open(path, file)
        head = _head(path, file)
        if len(head.attachments) != summary.statistics.attachment_count:
            raise ValueError("its attachments are not those that its index lists")
        return head


def _open(path: Path, file: BinaryIO) -> Summary:
    """The summary of a finished segment; the file is left behind the magic bytes at its begin."""
    if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
        raise FileDamaged(f"{path}: not an MCAP file")
    size = path.stat().st_size
    file.seek(max(len(MCAP0_MAGIC), size - len(MCAP0_MAGIC)))
    if file.read() != MCAP0_MAGIC:
        raise FileDamaged(f"{path}: ends in the middle")
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
            check_attachment(content)
            attachment = Attachment.read(stream(content))
            attachments[attachment.name] = attachment.data.decode()
        elif opcode == Opcode.METADATA:
            name, values = _metadata(content)
            found[name] = dict(values)
    session = found.get(SESSION_METADATA)
    if session is None:
        raise SessionError(f"{path}: not a segment of a thermostand session")
    if contradicts(found.get(SEGMENT_METADATA, {}), session):
        raise ValueError("the session's metadata do not fit their CRC")
    return Head(session, attachments, found.get(SEGMENT_METADATA, {}), found.get(SALVAGE_METADATA, {}))


@lru_cache(16)  # each segment of a session has the session's
def _metadata(content: bytes) -> tuple[str, Mapping[str, str]]:
    """Its name, and what it says."""
    metadata = Metadata.read(stream(content))
    return metadata.name, metadata.metadata


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
            raise ValueError("it does not hold the messages that its index lists")


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
    _check_place(data, place)
    head, content = chunk_content(data[RECORD.size :])
    _check_times(head, place)
    return content


def _read(file: BinaryIO, offset: int, length: int) -> bytes:
    """So many bytes from there; ValueError when there are fewer, before memory is taken for them."""
    if length > CHUNK_LIMIT_BYTES or offset + length > os.fstat(file.fileno()).st_size:
        raise ValueError(f"{length} bytes at {offset} are not in the file")
    file.seek(offset)
    return file.read(length)


def _check_place(data: bytes | memoryview, place: ChunkPlace) -> None:
    """ValueError unless a chunk of the indexed length begins there."""
    opcode, length = RECORD.unpack_from(data)
    if opcode != Opcode.CHUNK or length != place.length - RECORD.size:
        raise ValueError("the index does not point to a chunk")


def _check_times(head: ChunkHead, place: ChunkPlace) -> None:
    if (head.first_ns, head.last_ns) != (place.first_ns, place.last_ns):
        raise ValueError("the index points to another chunk")


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


def frame_crcs(path: Path, places: Sequence[FramePlace]) -> list[int]:
    """The CRCs that frames of one segment are said to have, by the heads of their chunks; no frame is read."""
    with reading(path), path.open("rb", buffering=0) as file:
        return [_frame_chunk(file, place.chunk, _CHUNK_HEAD_BYTES)[1].crc for place in places]


def _frame_chunk(file: BinaryIO, chunk: ChunkPlace, size: int) -> tuple[bytes, ChunkHead]:
    """The first bytes of a frame's chunk, and its head."""
    data = _read(file, chunk.offset, min(chunk.length, size))
    _check_place(data, chunk)
    head = chunk_head(memoryview(data)[RECORD.size :], chunk.length - RECORD.size)
    _check_times(head, chunk)
    if head.compression:
        raise ValueError("a frame's chunk is compressed")
    return data, head


def read_frame(place: FramePlace) -> Message:
    """The image message at its place: the last record of its chunk, behind at most its schema and channel.

    It is read by itself, because new memory for 5 MB costs more than all else that is done here.
    """
    chunk = place.chunk
    with reading(place.path), place.path.open("rb", buffering=0) as file:
        data, head = _frame_chunk(file, chunk, _FRAME_HEAD_BYTES)
        content_begin = RECORD.size + head.begin
        begin = _image_record(data, content_begin)
        _, length, number = _MESSAGE_START.unpack_from(data, begin)
        sequence, time_ns, _ = _MESSAGE_REST.unpack_from(data, begin + _MESSAGE_START.size)
        begin += _MESSAGE_BYTES
        if length != chunk.length - begin + _MESSAGE_BYTES - RECORD.size:
            raise ValueError("a frame's chunk holds more than the frame")
        image = _read(file, chunk.offset + begin, chunk.length - begin)
        check_crc(image, head.crc, "a chunk", data[content_begin:begin])
        if (number, time_ns) != (place.channel, place.time_ns):
            raise ValueError("the index lists another frame")
        return Message(CAMERA_IMAGE, sequence, time_ns, image)


def _image_record(data: bytes, offset: int) -> int:
    """Where the first message record is, of the records from `offset` on."""
    opcode, length = RECORD.unpack_from(data, offset)
    while opcode != Opcode.MESSAGE:
        offset += RECORD.size + length
        opcode, length = RECORD.unpack_from(data, offset)
    return offset
