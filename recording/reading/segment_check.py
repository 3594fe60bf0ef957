"""One finished segment, every byte of it: what a CRC covers is checked by it, the rest against its second copy.

Only the index, the content of chunks and the attachments have CRCs. The rest stands in the file a second time: where
each record is and how long, a chunk's own fields and each metadata's name in the index, the message indexes in the
messages, the counts in the walk. Only text has no second copy: the name of the writer's library in the header,
which nothing reads, and what metadata says but for the record `session`, which has a CRC in the record `segment`;
recording/reading/scan.py compares them between segments.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from itertools import chain, pairwise
from math import inf
from pathlib import Path
from typing import BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Header,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from mcap.writer import MCAP0_MAGIC

from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.images import IMAGE_SCHEMA, META_SCHEMA
from thermostand.recording.format.layout import FRAME_TABLE, SEGMENT_METADATA, SESSION_METADATA, is_contradicting
from thermostand.recording.format.manifest import Sealed
from thermostand.recording.format.mcap_bytes import (
    CHUNK,
    CRC,
    LENGTH,
    MESSAGE,
    RECORD,
    RECORD_LIMIT_BYTES,
    ChunkHead,
    decompress_chunk,
    encode_record,
    iterate_records,
    make_stream,
)
from thermostand.recording.format.mcap_contents import McapContents, find_rewritten
from thermostand.recording.format.messages import encode_frame_table
from thermostand.recording.format.records import (
    RecordedMessage,
    find_batch_schema,
    iterate_rewritten,
    list_rewritten_frames,
)
from thermostand.recording.format.summary import Summary, read_summary
from thermostand.recording.reading.run_status import Files

_DATA_END_BYTES = RECORD.size + CRC.size
_PART_LIMIT_BYTES = RECORD_LIMIT_BYTES + (1 << 24)  # the indexes of its messages stand behind a chunk


class SegmentDamage(NamedTuple):
    """What is wrong, and the log times between which messages may be lost by it, ns; none are when begin > end."""

    text: str
    begin_ns: float = inf
    end_ns: float = -inf


@dataclass
class SegmentCheck:
    """What the walk through a segment found. texts: what is attached. descriptions: of its sound frames, as messages.
    `last_ns`: log time of its latest sound message. sha256: of all its bytes, "" when something is damaged. rewritten:
    the contents of one that another program has written, which no rule of ours is for."""

    path: Path
    damages: list[SegmentDamage] = field(default_factory=list[SegmentDamage])
    metadata: dict[str, dict[str, str]] = field(default_factory=dict[str, dict[str, str]])
    texts: dict[str, str] = field(default_factory=dict[str, str])
    descriptions: list[bytes] = field(default_factory=list[bytes])
    messages: int = 0
    first_ns: float = inf
    last_ns: float = -inf
    sha256: str = ""
    rewritten: McapContents | None = None


def check_segment(
    path: Path, receive: Callable[[RecordedMessage], None], report: Callable[[int], None]
) -> SegmentCheck:
    """Read the whole segment and hand each sound message but those of frames to `receive`; `report` gets the number of
    bytes read so far.
    Damage is not raised: it is listed, and the walk continues at the next place in the index."""
    check = SegmentCheck(path)
    try:
        check.rewritten = find_rewritten(path)
        if check.rewritten is not None:
            _take_rewritten(check, check.rewritten, receive)
            with path.open("rb") as file:
                check.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
            report(check.rewritten.size_bytes)
            return check
        with path.open("rb") as file:
            walk = _SegmentChecker(check, file, _read_index(read_summary(file, path.stat().st_size)), receive)
            walk.run(report)
            if not check.damages:
                file.seek(0)
                check.sha256 = hashlib.file_digest(file, "sha256").hexdigest()
    except DAMAGE as error:
        check.damages.append(SegmentDamage(_format_error(error), -inf, inf))
    return check


def _take_rewritten(check: SegmentCheck, found: McapContents, receive: Callable[[RecordedMessage], None]) -> None:
    """Take over what another program has written: all of it was read, and each CRC that it states is right."""
    check.metadata = dict(found.metadata)
    check.texts = {
        name: each.data.decode(errors="surrogateescape")
        for name, each in found.attachments.items()
        if name != FRAME_TABLE
    }
    check.messages = len(found)
    if check.messages:
        check.first_ns, check.last_ns = found.first_ns, found.last_ns
    metas = [number for number in found.channels if found.get_schema(number) == META_SCHEMA]
    check.descriptions = [bytes(message.data) for message in found.iterate_messages(metas)]
    for message in iterate_rewritten(found, lambda channel: True):
        receive(message)
    list_rewritten_frames(found)  # each has both halves


class RewrittenAs(NamedTuple):
    """What a rewritten segment is against what was recorded. text: as the part of a sentence."""

    files: Files
    text: str


def judge_rewritten(found: McapContents, known: Sealed | None) -> RewrittenAs:
    """Return whether a segment that another program has written still holds what was recorded, by what `session.json`
    lists of it (None: nothing)."""
    by = f"was rewritten by {found.program}"
    if known is None or not known.content:
        return RewrittenAs(Files.SOUND, f"{by}; whether it holds all that was recorded is not known")
    if found.digest == known.content:
        return RewrittenAs(Files.SOUND, f"{by}, complete: it holds each message as it was recorded")
    archive = "take the segment from an archive, or from before it was rewritten"
    fewer = {topic: count - found.counts.get(topic, 0) for topic, count in known.messages.items()}
    if lacks := [f"{count} of {known.messages[topic]} on {topic}" for topic, count in fewer.items() if count > 0]:
        return RewrittenAs(Files.INCOMPLETE, f"{by} and lacks messages: {', '.join(lacks)}; {archive}")
    return RewrittenAs(Files.CHANGED, f"{by}, and its content was changed: it holds other messages; {archive}")


def _format_error(error: Exception) -> str:
    """Our own sentences are ValueErrors; of the others the type says more than the text."""
    return str(error) if type(error) is ValueError else f"{type(error).__name__}: {error}"


@dataclass(frozen=True, slots=True)
class _Index:
    """The summary at `begin` near the end of the file: what stands before it, records by their place."""

    begin: int
    statistics: Statistics
    chunks: Mapping[int, ChunkIndex]
    attachments: Mapping[int, AttachmentIndex]
    metadata: Mapping[int, MetadataIndex]
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]


def _read_index(summary: Summary) -> _Index:
    """The records of the index; raises one of DAMAGE."""
    contents: dict[int, list[ReadDataStream]] = {}
    for opcode, content in iterate_records(summary.content):
        contents.setdefault(opcode, []).append(make_stream(content))
    schemas = [Schema.read(data) for data in contents.get(Opcode.SCHEMA, ())]
    channels = [Channel.read(data) for data in contents.get(Opcode.CHANNEL, ())]
    chunks = [ChunkIndex.read(data) for data in contents.get(Opcode.CHUNK_INDEX, ())]
    attachments = [AttachmentIndex.read(data) for data in contents.get(Opcode.ATTACHMENT_INDEX, ())]
    metadata = [MetadataIndex.read(data) for data in contents.get(Opcode.METADATA_INDEX, ())]
    (statistics,) = [Statistics.read(data) for data in contents.get(Opcode.STATISTICS, ())]
    return _Index(
        begin=summary.begin,
        statistics=statistics,
        chunks={chunk.chunk_start_offset: chunk for chunk in chunks},
        attachments={attachment.offset: attachment for attachment in attachments},
        metadata={entry.offset: entry for entry in metadata},
        schemas={schema.id: schema for schema in schemas},
        channels={channel.id: channel for channel in channels},
    )


class _SegmentChecker:
    """The walk from the header to the index, place by place."""

    def __init__(
        self, check: SegmentCheck, file: BinaryIO, index: _Index, receive: Callable[[RecordedMessage], None]
    ) -> None:
        self._check = check
        self._file = file
        self._index = index
        self._receive = receive
        self._counts: Counter[int] = Counter()  # of messages, by channel
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._table: bytes | None = None  # of frames

    def run(self, report: Callable[[int], None]) -> None:
        """Read everything; raises one of DAMAGE when the index does not cover the whole file."""
        places = self._list_places()
        self._read_part(0, places[0], self._check_header)
        for place, end in pairwise(places):
            self._read_part(place, end, self._check_record)
            report(end)
        self._read_part(places[-1], self._index.begin, self._check_data_end)
        metadata = self._check.metadata
        if is_contradicting(metadata.get(SEGMENT_METADATA, {}), metadata.get(SESSION_METADATA, {})):
            self._check.damages.append(SegmentDamage("the session's metadata do not fit their CRC"))
        if not self._check.damages:
            self._compare()

    def _list_places(self) -> list[int]:
        """Return where each indexed record begins, in order, and where the last one ends."""
        index = self._index
        ends = {place: place + entry.chunk_length + entry.message_index_length for place, entry in index.chunks.items()}
        ends.update(
            {place: place + entry.length for place, entry in chain(index.attachments.items(), index.metadata.items())}
        )
        places = sorted(ends)
        last = index.begin - _DATA_END_BYTES
        if [ends[place] for place in places] != [*places[1:], last]:
            raise ValueError("the records that its index lists do not follow each other")
        return [*places, last]

    def _read_part(self, place: int, end: int, read: Callable[[int, bytes], None]) -> None:
        """Read the bytes of one record; damage in it is noted."""
        try:
            if end - place > _PART_LIMIT_BYTES:
                raise ValueError(f"a record claims {end - place} bytes")
            self._file.seek(place)
            read(place, self._file.read(end - place))
        except DAMAGE as error:
            entry = self._index.chunks.get(place)
            times_ns = (entry.message_start_time, entry.message_end_time) if entry else (inf, -inf)
            self._check.damages.append(SegmentDamage(f"{_format_error(error)} (at byte {place})", *times_ns))

    def _check_header(self, place: int, data: bytes) -> None:
        content = data[len(MCAP0_MAGIC) + RECORD.size :]
        header = Header.read(make_stream(content))
        if data != MCAP0_MAGIC + encode_record(header) or header.profile:
            raise ValueError("its first bytes are not the header of one of our files")

    def _check_record(self, place: int, data: bytes) -> None:
        index = self._index
        content = data[RECORD.size :]
        if place in index.chunks:
            self._check_chunk(index.chunks[place], data)
        elif place in index.attachments:
            attachment = Attachment.read(make_stream(content))
            _check_same(encode_record(attachment), data, "an attachment")
            if attachment.name == FRAME_TABLE:
                self._table = attachment.data
            else:
                self._check.texts[attachment.name] = attachment.data.decode(errors="surrogateescape")
        else:
            metadata = Metadata.read(make_stream(content))
            _check_same(encode_record(metadata), data, "a metadata record")
            if metadata.name != index.metadata[place].name:
                raise ValueError("a metadata record has another name than in the index")
            self._check.metadata[metadata.name] = metadata.metadata

    def _check_chunk(self, entry: ChunkIndex, data: bytes) -> None:
        """A chunk and the message indexes behind it."""
        head, content = decompress_chunk(memoryview(data)[RECORD.size : entry.chunk_length])
        _check_same(_encode_head(head, entry), data[: RECORD.size + head.begin], "the head of a chunk")
        messages = self._read_contents(content)
        offsets, indexes = _encode_message_indexes(messages, entry.chunk_start_offset + entry.chunk_length)
        _check_same(indexes, data[entry.chunk_length :], "the index of a chunk's messages")
        times_ns = [message.time_ns for message in messages]
        rebuilt = ChunkIndex(
            chunk_length=entry.chunk_length,
            chunk_start_offset=entry.chunk_start_offset,
            compression=head.compression.decode(),
            compressed_size=entry.chunk_length - RECORD.size - head.begin,
            message_end_time=max(times_ns),
            message_index_length=len(indexes),
            message_index_offsets=offsets,
            message_start_time=min(times_ns),
            uncompressed_size=head.size_bytes,
        )
        if rebuilt != entry:
            raise ValueError("a chunk's size or times are not those in the index")
        for message in messages:
            self._count(message)

    def _read_contents(self, data: memoryview) -> list[_PlacedMessage]:
        """The messages of a chunk; its schemas and channels are learnt."""
        placed: list[_PlacedMessage] = []
        offset = 0
        for opcode, content in iterate_records(data):
            if opcode == Opcode.MESSAGE:
                number, sequence, time_ns, _ = MESSAGE.unpack_from(content)
                channel = self._index.channels[number]  # the first chunk, which has it too, may be damaged
                schema = self._index.schemas[channel.schema_id].name
                data_bytes = b"" if schema == IMAGE_SCHEMA else bytes(content[MESSAGE.size :])
                message = RecordedMessage(channel.topic, sequence, time_ns, data_bytes, find_batch_schema(channel))
                placed.append(_PlacedMessage(number, offset, time_ns, schema, message))
            elif opcode == Opcode.SCHEMA:
                schema = Schema.read(make_stream(content))
                self._schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                known = Channel.read(make_stream(content))
                self._channels[known.id] = known
            else:
                raise ValueError(f"a chunk holds a record of kind {opcode}")
            offset += RECORD.size + len(content)
        return placed

    def _count(self, placed: _PlacedMessage) -> None:
        check = self._check
        check.messages += 1
        check.first_ns = min(check.first_ns, placed.time_ns)
        check.last_ns = max(check.last_ns, placed.time_ns)
        self._counts[placed.channel] += 1
        if placed.schema == META_SCHEMA:
            check.descriptions.append(placed.message.data)
        elif placed.schema != IMAGE_SCHEMA:
            self._receive(placed.message)

    def _check_data_end(self, place: int, data: bytes) -> None:
        """Our writer makes no CRC of the whole data section (0): chunks and attachments have their own."""
        _check_same(RECORD.pack(Opcode.DATA_END, CRC.size) + CRC.pack(0), data, "the end of the data")

    def _compare(self) -> None:
        """Compare what the whole walk found with the index; ValueError when they differ."""
        check, index = self._check, self._index
        # Schemas and channels go into the first chunk; a segment without a message has none.
        if index.chunks and (self._schemas, self._channels) != (index.schemas, index.channels):
            raise ValueError("its schemas or channels are not those in its index")
        if (self._table or b"") != encode_frame_table(check.descriptions):
            raise ValueError("its table of frames is not that of its frames")
        found = Statistics(
            attachment_count=len(index.attachments),
            channel_count=len(index.channels),
            channel_message_counts=dict(self._counts),
            chunk_count=len(index.chunks),
            message_count=check.messages,
            message_end_time=int(check.last_ns) if check.messages else 0,
            message_start_time=int(check.first_ns) if check.messages else 0,
            metadata_count=len(index.metadata),
            schema_count=len(index.schemas),
        )
        if found != index.statistics:
            raise ValueError("it does not hold the messages that its index lists")


class _PlacedMessage(NamedTuple):
    """A message, its channel's number, where it begins in its chunk, and its schema's name."""

    channel: int
    offset: int
    time_ns: int
    schema: str
    message: RecordedMessage


def _encode_head(head: ChunkHead, entry: ChunkIndex) -> bytes:
    """Return what stands before the data of a chunk, by the index where that has it."""
    name = entry.compression.encode()
    times_ns = entry.message_start_time, entry.message_end_time
    return (
        RECORD.pack(Opcode.CHUNK, entry.chunk_length - RECORD.size)
        + CHUNK.pack(*times_ns, entry.uncompressed_size, head.crc, len(name))
        + name
        + LENGTH.pack(entry.compressed_size)
    )


def _encode_message_indexes(messages: list[_PlacedMessage], place: int) -> tuple[dict[int, int], bytes]:
    """The message indexes that belong behind a chunk, from `place` on: where each channel's is, and their bytes."""
    entries: dict[int, list[tuple[int, int]]] = {}
    for message in messages:
        entries.setdefault(message.channel, []).append((message.time_ns, message.offset))
    offsets: dict[int, int] = {}
    data = b""
    for channel, places in entries.items():
        offsets[channel] = place + len(data)
        data += encode_record(MessageIndex(channel, places))
    return offsets, data


def _check_same(expected: bytes, found: bytes, what: str) -> None:
    if expected != found:
        raise ValueError(f"{what} is damaged")
