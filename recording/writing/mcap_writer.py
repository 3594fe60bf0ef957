"""The records of one MCAP file, byte for byte as mcap's own Writer makes them, without its copies of what they hold.

That one copies a message three times on its way, for 5 MB into fresh memory each time, which costs more than to write
them to the disk. Here a message stays the object it is, one part of a block of parts.
"""

from __future__ import annotations

import zlib
from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import chain
from struct import Struct, pack

import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from mcap.writer import MCAP0_MAGIC, CompressionType

from thermostand.recording.format.mcap_bytes import CHUNK, CRC, LENGTH, MESSAGE, RECORD, encode_record
from thermostand.recording.format.mcap_contents import LIBRARY, ContentDigest

_MESSAGE = int(Opcode.MESSAGE)
# Tested against mcap's own writer, byte for byte: of 11 to 15 ms for a raw frame more than half were its three copies.
_MESSAGE_HEAD = Struct("<BQHIQQ")  # as RECORD and MESSAGE
_COMPRESSION_NAMES = {CompressionType.NONE: "", CompressionType.ZSTD: "zstd"}


@dataclass(slots=True)
class _Chunk:
    """The chunk in progress. places: of its messages, (log time, offset) by channel."""

    parts: list[bytes | memoryview] = field(default_factory=list[bytes | memoryview])
    size_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    places: dict[int, list[tuple[int, int]]] = field(default_factory=dict[int, list[tuple[int, int]]])

    def note(self, channel: int, time_ns: int) -> None:
        """A message that begins here."""
        self.first_ns = min(self.first_ns, time_ns) if self.places else time_ns
        self.last_ns = max(self.last_ns, time_ns)
        self.places.setdefault(channel, []).append((time_ns, self.size_bytes))


class McapWriter:
    """The records of one file, in blocks that `take` hands over. A chunk ends at `end_chunk`, or when it has more than
    `chunk_bytes`; one without a message is not written. level: of zstd. digest: of the messages that were added."""

    def __init__(self, compression: CompressionType, chunk_bytes: int, level: int = 3) -> None:
        self._compression = compression
        self._level = level
        self._chunk_bytes = chunk_bytes
        self._parts: list[bytes | memoryview] = []
        self._written_bytes = 0
        self._is_ended = False
        self._chunk = _Chunk()
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunk_indexes: list[ChunkIndex] = []
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._first_ns = self._last_ns = 0
        self._counts: defaultdict[int, int] = defaultdict(int)
        self.digest = ContentDigest()
        self._write(MCAP0_MAGIC)
        self._write(encode_record(Header("", LIBRARY)))

    def take(self) -> list[bytes | memoryview]:
        """The parts since the last time, one behind the other; the chunk in progress is not among them."""
        parts, self._parts = self._parts, []
        return parts

    def add_attachment(self, attachment: Attachment) -> None:
        """Write an attachment in front of the chunk in progress."""
        begin, length = self._write(encode_record(attachment))
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=begin,
                length=length,
                create_time=attachment.create_time,
                log_time=attachment.log_time,
                data_size=len(attachment.data),
                name=attachment.name,
                media_type=attachment.media_type,
            )
        )

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write metadata in front of the chunk in progress."""
        begin, length = self._write(encode_record(Metadata(name=name, metadata=dict(entries))))
        self._metadata_indexes.append(MetadataIndex(offset=begin, length=length, name=name))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Add a schema and return its number."""
        self._schemas.append(Schema(id=len(self._schemas) + 1, name=name, encoding=encoding, data=data))
        self._add(encode_record(self._schemas[-1]))
        return len(self._schemas)

    def add_channel(self, topic: str, encoding: str, schema: int, entries: Mapping[str, str]) -> int:
        """Add a channel and return its number."""
        number = len(self._channels) + 1
        self._channels.append(
            Channel(id=number, topic=topic, message_encoding=encoding, schema_id=schema, metadata=dict(entries))
        )
        self.digest.know(self._channels[-1], self._schemas[schema - 1] if schema else None)
        self._add(encode_record(self._channels[-1]))
        return number

    def add_message(
        self, channel: int, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes | memoryview
    ) -> None:
        """`data` is not to be changed any more."""
        self._first_ns = min(self._first_ns, log_time_ns) if self._counts else log_time_ns
        self._last_ns = max(self._last_ns, log_time_ns)
        self._counts[channel] += 1
        self.digest.add(channel, log_time_ns, publish_time_ns, sequence, data)
        self._chunk.note(channel, log_time_ns)
        length = MESSAGE.size + len(data)
        self._add(_MESSAGE_HEAD.pack(_MESSAGE, length, channel, sequence, log_time_ns, publish_time_ns), data)

    def end_chunk(self) -> None:
        """What was added so far is in whole chunks."""
        chunk = self._chunk
        if not chunk.places:
            return
        self._chunk = _Chunk()
        name = _COMPRESSION_NAMES[self._compression]
        parts, crc = chunk.parts, 0
        for part in parts:
            crc = zlib.crc32(part, crc)
        if name:
            parts = [zstandard.compress(b"".join(parts), self._level)]
        stored_bytes = sum(map(len, parts))
        head = CHUNK.pack(chunk.first_ns, chunk.last_ns, chunk.size_bytes, crc, len(name)) + name.encode()
        head += LENGTH.pack(stored_bytes)
        begin, length = self._write(RECORD.pack(Opcode.CHUNK, len(head) + stored_bytes) + head, *parts)
        places: dict[int, int] = {}
        for channel, entries in chunk.places.items():
            places[channel], _ = self._write(_encode_message_index(channel, entries))
        self._chunk_indexes.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=begin,
                compression=name,
                compressed_size=stored_bytes,
                message_end_time=chunk.last_ns,
                message_index_length=self._written_bytes - begin - length,
                message_index_offsets=places,
                message_start_time=chunk.first_ns,
                uncompressed_size=chunk.size_bytes,
            )
        )

    def end_data(self) -> None:
        """The end of the data, behind which is the index: nothing is added any more."""
        if not self._is_ended:
            self._is_ended = True
            self.end_chunk()
            self._write(encode_record(DataEnd(0)))

    def finish(self) -> None:
        """The index, behind the end of the data."""
        self.end_data()
        begin = self._written_bytes
        summary = RecordBuilder()
        offsets: list[SummaryOffset] = []
        for opcode, group in self._build_groups():
            start = summary.count
            for record in group:
                record.write(summary)
            offsets.append(SummaryOffset(opcode, begin + start, summary.count - start))
        offsets_begin = begin + summary.count
        for offset in offsets:
            offset.write(summary)
        content = summary.end()
        footer = encode_record(Footer(summary_start=begin, summary_offset_start=offsets_begin, summary_crc=0))[
            : -CRC.size
        ]
        self._write(content, footer, CRC.pack(zlib.crc32(footer, zlib.crc32(content))), MCAP0_MAGIC)

    def _build_groups(self) -> list[tuple[Opcode, list[McapRecord]]]:
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunk_indexes),
            message_count=sum(self._counts.values()),
            metadata_count=len(self._metadata_indexes),
            message_start_time=self._first_ns,
            message_end_time=self._last_ns,
            schema_count=len(self._schemas),
        )
        return [
            (Opcode.SCHEMA, [*self._schemas]),
            (Opcode.CHANNEL, [*self._channels]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, [*self._chunk_indexes]),
            (Opcode.ATTACHMENT_INDEX, [*self._attachment_indexes]),
            (Opcode.METADATA_INDEX, [*self._metadata_indexes]),
        ]

    def _add(self, *parts: bytes | memoryview) -> None:
        chunk = self._chunk
        chunk.parts += parts
        chunk.size_bytes += sum(map(len, parts))
        if chunk.size_bytes > self._chunk_bytes:
            self.end_chunk()

    def _write(self, *parts: bytes | memoryview) -> tuple[int, int]:
        """Write bytes, and return where they begin and their length."""
        begin = self._written_bytes
        self._parts += parts
        self._written_bytes += sum(map(len, parts))
        return begin, self._written_bytes - begin


def _encode_message_index(channel: int, places: list[tuple[int, int]]) -> bytes:
    """The record that says where in its chunk the messages of a channel are, by their log times."""
    entries = pack(f"<HI{2 * len(places)}Q", channel, 16 * len(places), *chain.from_iterable(places))
    return RECORD.pack(Opcode.MESSAGE_INDEX, len(entries)) + entries
