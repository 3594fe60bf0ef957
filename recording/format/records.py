"""A segment's bytes back to messages: what recording/writing/segment.py wrote, read strictly.

Nothing that no CRC covers is used, unless the file has it twice: the index has a CRC and says where each
chunk is, how long, between which instants and how many messages of each channel there are; each chunk's content has
one, too. Anything wrong is a SessionError that names the file.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata
from mcap.writer import MCAP0_MAGIC

from thermostand.foundation.errors import SessionError
from thermostand.recording.format.batches import READINGS, BatchSchema, parse_batch_schema
from thermostand.recording.format.damage import DAMAGE, FileDamaged, convert_damage, name_file_in_errors
from thermostand.recording.format.images import IMAGE_SCHEMA, META_SCHEMA
from thermostand.recording.format.inventory import SegmentState, list_segments
from thermostand.recording.format.layout import (
    FRAME_TABLE,
    SALVAGE_METADATA,
    SEGMENT_METADATA,
    SEQUENCE_MASK,
    SESSION_METADATA,
    is_contradicting,
)
from thermostand.recording.format.mcap_bytes import (
    CHUNK_LIMIT_BYTES,
    MESSAGE,
    RECORD,
    ChunkHead,
    check_attachment,
    decompress_chunk,
    iterate_records,
    make_stream,
    parse_chunk_head,
)
from thermostand.recording.format.mcap_contents import McapContents, find_rewritten
from thermostand.recording.format.messages import CLASSES, FrameMeta, decode_frame_meta, decode_frame_table
from thermostand.recording.format.summary import ChunkPlace, Summary, read_summary

_CHUNK_HEAD_BYTES = 64
SCHEMAS = {topic: message.DESCRIPTOR.full_name for topic, message in CLASSES.items()}

_MESSAGE_START = struct.Struct("<BQH")  # opcode, length, channel id
_MESSAGE_REST = struct.Struct("<Iqq")  # sequence, log time, publish time; signed, as every instant of ours
_HEADER_BYTES = RECORD.size
_MESSAGE_OPCODE = int(Opcode.MESSAGE)
_MESSAGE_BYTES = _MESSAGE_START.size + _MESSAGE_REST.size  # with the record's header


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message as it is in the file; `data` is still encoded. form: of the readings of a device. published_ns: 0
    when it is the log time, or not asked for."""

    topic: str
    sequence: int
    time_ns: int
    data: bytes
    form: BatchSchema | None = None
    published_ns: int = 0


@dataclass(frozen=True, slots=True)
class MessageSpan:
    """How many messages a segment has, and the times of the first and the last."""

    count: int
    first_ns: int
    last_ns: int


@dataclass(frozen=True, slots=True)
class Head:
    """The first records of a segment. place: the record `segment`, its place in the session; salvaged: the record
    `repair`, empty for a segment that its recorder finished itself; span: by its index. rewritten: all that is in
    a segment which another program has written."""

    session: dict[str, str]
    attachments: dict[str, str]
    place: dict[str, str]
    salvaged: dict[str, str]
    span: MessageSpan
    rewritten: McapContents | None = None


class RewrittenFrame(NamedTuple):
    """Where the two messages of a frame are in a segment that another program has written: their numbers there."""

    contents: McapContents
    meta: int
    image: int


@dataclass(frozen=True, slots=True)
class FramePlace:
    """A frame by its identity: its segment, its chunk there, and its description. rewritten: where it is instead in a
    segment of another program, of which `chunk` only has the instants and the size."""

    path: Path
    chunk: ChunkPlace
    meta: FrameMeta
    rewritten: RewrittenFrame | None = None

    @property
    def time_ns(self) -> int:
        """The middle of the frame's exposure."""
        return self.meta.time_ns

    @property
    def sequence(self) -> int:
        """The low 32 bits of its block id, as its messages have them."""
        return self.meta.block_id & SEQUENCE_MASK


def read_head(path: Path) -> Head:
    """Metadata `session` and the attachments of a finished segment."""
    with convert_damage(path):
        if (rewritten := find_rewritten(path)) is not None:
            return _make_head(rewritten)
    with convert_damage(path), path.open("rb") as file:
        summary = _open(path, file)
        head = _read_head(path, file, summary)
        if len(head.attachments) != summary.statistics.attachment_count - (FRAME_TABLE in summary.parse_attachments()):
            raise ValueError("its attachments are not those that its index lists")
        return head


def _make_head(found: McapContents) -> Head:
    """The head of a segment that another program has written."""
    path, metadata = found.path, found.metadata
    if SESSION_METADATA not in metadata:
        raise SessionError(f"{path}: {explain_stranger(found)}")
    texts = {name: each.data.decode() for name, each in found.attachments.items() if name != FRAME_TABLE}
    return Head(
        session=metadata[SESSION_METADATA],
        attachments=texts,
        place=metadata.get(SEGMENT_METADATA, {}),
        salvaged=metadata.get(SALVAGE_METADATA, {}),
        span=MessageSpan(len(found), found.first_ns, found.last_ns),
        rewritten=found,
    )


def explain_stranger(found: McapContents) -> str:
    """Return what a valid MCAP file is that does not say of which session it is, as the part of a sentence."""
    return (
        f"is a valid MCAP file written by {found.program}, without the record {SESSION_METADATA!r} of a recording; it "
        "counts for nothing and is left alone"
    )


def find_strangers(directory: Path) -> dict[str, str]:
    """The valid MCAP files of other programs among a session's segments that say nothing of a session: name -> what
    they are, as the part of a sentence."""
    found: dict[str, str] = {}
    for file in list_segments(directory):
        if file.state is SegmentState.FINISHED:
            with suppress(*DAMAGE):
                contents = find_rewritten(file.path)
                if contents is not None and SESSION_METADATA not in contents.metadata:
                    found[file.name] = explain_stranger(contents)
    return found


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


def _read_head(path: Path, file: BinaryIO, summary: Summary) -> Head:
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
            attachment = Attachment.read(make_stream(content))
            attachments[attachment.name] = attachment.data.decode()
        elif opcode == Opcode.METADATA:
            name, values = _parse_metadata(content)
            found[name] = dict(values)
    session = found.get(SESSION_METADATA)
    if session is None:
        raise SessionError(f"{path}: not a segment of a thermostand session")
    if is_contradicting(found.get(SEGMENT_METADATA, {}), session):
        raise ValueError("the session's metadata do not fit their CRC")
    totals = summary.statistics
    span = MessageSpan(totals.message_count, totals.message_start_time, totals.message_end_time)
    return Head(session, attachments, found.get(SEGMENT_METADATA, {}), found.get(SALVAGE_METADATA, {}), span)


@lru_cache(16)  # each segment of a session has the session's
def _parse_metadata(content: bytes) -> tuple[str, Mapping[str, str]]:
    """Return the name of a metadata record, and what it says."""
    metadata = Metadata.read(make_stream(content))
    return metadata.name, metadata.metadata


def read_telemetry_messages(path: Path, wanted: Callable[[Channel], bool]) -> Iterator[RecordedMessage]:
    """The messages of the wanted channels of a telemetry segment, in the order of the file."""
    with convert_damage(path):
        if (rewritten := find_rewritten(path)) is not None:
            yield from iterate_rewritten(rewritten, wanted)
            return
    with convert_damage(path), path.open("rb") as file:
        summary = _open(path, file)
        topics = {
            number: (channel.topic, find_batch_schema(channel))
            for number, (channel, _) in _map_channels(summary).items()
            if wanted(channel)
        }
        counts = dict.fromkeys(topics, 0)
        for place in summary.iterate_chunks():
            if topics.keys().isdisjoint(place.channels):
                continue
            chunk = _read_chunk(file, place)
            for number, offset, end in _locate_messages(chunk, topics):
                counts[number] += 1
                yield _make_message(*topics[number], chunk, offset, end)
        if counts != {number: summary.statistics.channel_message_counts.get(number, 0) for number in topics}:
            raise ValueError("it does not hold the messages that its index lists")


def iterate_rewritten(found: McapContents, wanted: Callable[[Channel], bool]) -> Iterator[RecordedMessage]:
    """The same of a segment that another program has written, but for frames; one of DAMAGE where it is no telemetry of
    ours."""
    channels = _check_channels({number: (each, found.get_schema(number)) for number, each in found.channels.items()})
    forms = {
        number: (channel.topic, find_batch_schema(channel))
        for number, (channel, schema) in channels.items()
        if wanted(channel) and schema not in (META_SCHEMA, IMAGE_SCHEMA)
    }
    for message in found.iterate_messages(forms):
        topic, form = forms[message.channel]
        yield RecordedMessage(topic, message.sequence, message.log_time_ns, bytes(message.data), form)


def _map_channels(summary: Summary) -> dict[int, tuple[Channel, str]]:
    """Channel id -> channel and schema."""
    return _check_channels(summary.channels())


def _check_channels(channels: dict[int, tuple[Channel, str]]) -> dict[int, tuple[Channel, str]]:
    """The channels; ValueError when a topic of ours holds messages that are not."""
    for channel, schema in channels.values():
        form = find_batch_schema(channel)
        known = SCHEMAS.get(channel.topic) if form is None else form.message.DESCRIPTOR.full_name
        if known is not None and schema != known:
            raise ValueError(f"{channel.topic} holds {schema}, not {known}")
    return channels


def find_batch_schema(channel: Channel) -> BatchSchema | None:
    """Return how the readings of a device are recorded on a channel, None when it has no readings; ValueError when it
    does not say it."""
    return parse_batch_schema(channel.metadata) if channel.topic.startswith(READINGS) else None


def _read_chunk(file: BinaryIO, place: ChunkPlace) -> memoryview:
    """The records of the chunk at that place, their CRC checked."""
    data = memoryview(_read_exactly(file, place.offset, place.length))
    _check_place(data, place)
    head, content = decompress_chunk(data[RECORD.size :])
    _check_times(head, place)
    return content


def _read_exactly(file: BinaryIO, offset: int, length: int) -> bytes:
    """Read so many bytes from that place; ValueError when the file has fewer, before memory is taken for them."""
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


def _locate_messages(chunk: memoryview, wanted: Container[int]) -> list[tuple[int, int, int]]:
    """(channel id, offset, end) of each message record of the wanted channels in a chunk."""
    # Every record of a session passes here, so the loop has no call but one.
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


def _make_message(topic: str, form: BatchSchema | None, chunk: memoryview, offset: int, end: int) -> RecordedMessage:
    sequence, time_ns, _ = _MESSAGE_REST.unpack_from(chunk, offset + _MESSAGE_START.size)
    return RecordedMessage(topic, sequence, time_ns, bytes(chunk[offset + _MESSAGE_BYTES : end]), form)


def list_frame_places(path: Path) -> list[FramePlace]:
    """The frames of a segment in the order of the file, from its table of them; no image is decompressed unless
    another program has written the file."""
    with convert_damage(path):
        if (rewritten := find_rewritten(path)) is not None:
            return list_rewritten_frames(rewritten)
    with convert_damage(path), path.open("rb") as file:
        summary = _open(path, file)
        chunks = list(summary.iterate_chunks())
        table = summary.parse_attachments().get(FRAME_TABLE)
        with name_file_in_errors(path):
            if table is None:
                metas = [
                    decode_frame_meta(bytes(parse_frame_messages(_read_chunk(file, chunk))[0].data)) for chunk in chunks
                ]
            else:
                metas = decode_frame_table(_read_attachment(file, *table).data)
        if len(metas) != len(chunks) or summary.statistics.message_count != 2 * len(chunks):
            raise ValueError("its chunks are not one frame each, or its table does not list them")
        channels = _map_channels(summary)
        if any([channels[number][1] for number in chunk.channels] != [META_SCHEMA, IMAGE_SCHEMA] for chunk in chunks):
            raise ValueError("its chunks are not of a description and an image")
        places = [FramePlace(path, chunk, meta) for chunk, meta in zip(chunks, metas, strict=True)]
        if any((place.time_ns,) * 2 != (place.chunk.first_ns, place.chunk.last_ns) for place in places):
            raise ValueError("its table lists other frames")
        return places


def list_rewritten_frames(found: McapContents) -> list[FramePlace]:
    """The frames of a segment that another program has written; ValueError when it has one without its other half."""
    topics = {
        number: (channel.topic.rpartition("/")[0], schema)
        for number, channel in found.channels.items()
        if (schema := found.get_schema(number)) in (META_SCHEMA, IMAGE_SCHEMA)
    }
    halves: dict[tuple[str, str, int, int], list[int]] = {}
    for index, channel in enumerate(found.channel_of):
        if channel in topics:
            sequence = found.read_message(index).sequence
            halves.setdefault((*topics[channel], found.time_ns_of[index], sequence), []).append(index)
    places: list[tuple[int, FramePlace]] = []
    for (camera, schema, time_ns, sequence), metas in halves.items():
        other = IMAGE_SCHEMA if schema == META_SCHEMA else META_SCHEMA
        images = halves.get((camera, other, time_ns, sequence), [])
        if len(metas) != len(images):
            raise ValueError(f"a frame of {camera} has no {'image' if schema == META_SCHEMA else 'description'}")
        for meta, image in zip(metas, images, strict=True) if schema == META_SCHEMA else ():
            description = decode_frame_meta(bytes(found.read_message(meta).data))
            channels = found.channel_of[meta], found.channel_of[image]
            chunk = ChunkPlace(time_ns, time_ns, found.place_of[meta], found.length_of[image], channels)
            places.append(
                (min(meta, image), FramePlace(found.path, chunk, description, RewrittenFrame(found, meta, image)))
            )
    return [place for _, place in sorted(places, key=itemgetter(0))]


def _read_attachment(file: BinaryIO, offset: int, length: int) -> Attachment:
    data = _read_exactly(file, offset, length)
    if RECORD.unpack_from(data) != (Opcode.ATTACHMENT, length - RECORD.size):
        raise ValueError("the index does not point to an attachment")
    check_attachment(data[RECORD.size :])
    return Attachment.read(make_stream(data[RECORD.size :]))


def read_frame_crcs(path: Path, places: Sequence[FramePlace]) -> list[int]:
    """Read the CRCs that the heads of their chunks state for frames of one segment; no frame is read, but those that
    another program has written."""
    with convert_damage(path), path.open("rb", buffering=0) as file:
        return [
            zlib.crc32(read_frame(place).image) if place.rewritten else _read_frame_head(file, place.chunk).crc
            for place in places
        ]


def _read_frame_head(file: BinaryIO, chunk: ChunkPlace) -> ChunkHead:
    data = _read_exactly(file, chunk.offset, min(chunk.length, _CHUNK_HEAD_BYTES))
    _check_place(data, chunk)
    head = parse_chunk_head(memoryview(data)[RECORD.size :], chunk.length - RECORD.size)
    _check_times(head, chunk)
    return head


class StoredFrame(NamedTuple):
    """The two messages of a frame, encoded. `image` is part of the memory that the chunk was read into."""

    meta: bytes
    image: memoryview


def read_frame(place: FramePlace) -> StoredFrame:
    """The messages of the frame at that place, the CRC of its chunk checked."""
    with convert_damage(place.path), place.path.open("rb", buffering=0) as file:
        meta, image = (
            _read_rewritten(place.rewritten)
            if place.rewritten
            else parse_frame_messages(_read_chunk(file, place.chunk))
        )
        with name_file_in_errors(place.path):
            stored = decode_frame_meta(bytes(meta.data))
        if repr(stored) != repr(place.meta):  # NaN is not equal to itself
            raise ValueError("the table of frames lists another frame")
        stated = (place.time_ns, place.sequence)
        if any((message.time_ns, message.sequence) != stated for message in (meta, image)):
            raise ValueError("a frame's messages are not of one frame")
        return StoredFrame(bytes(meta.data), image.data)


def _read_rewritten(place: RewrittenFrame) -> tuple[FrameMessage, FrameMessage]:
    found = (place.contents.read_message(index) for index in (place.meta, place.image))
    meta, image = (FrameMessage(each.sequence, each.log_time_ns, memoryview(each.data)) for each in found)
    return meta, image


class FrameMessage(NamedTuple):
    """A message of a frame's chunk, where it was read."""

    sequence: int
    time_ns: int
    data: memoryview


def parse_frame_messages(chunk: memoryview) -> tuple[FrameMessage, FrameMessage]:
    """The description and the image in a frame's chunk; ValueError when it holds something else."""
    found: list[FrameMessage] = []
    for opcode, record in iterate_records(chunk):
        if opcode == Opcode.MESSAGE:
            sequence, time_ns, _ = _MESSAGE_REST.unpack_from(record, 2)
            found.append(FrameMessage(sequence, time_ns, record[MESSAGE.size :]))
    if len(found) != 2:
        raise ValueError("a chunk of the frames does not hold one frame")
    return found[0], found[1]
