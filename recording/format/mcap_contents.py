"""What is in any valid MCAP file, whichever program wrote it: as the specification has it, and not only as our recorder
writes it (format/records.py reads that, strictly).

The format's own tools rewrite files: with other compression, in one large chunk or in none, without CRCs or index, with
attachments and metadata in another place. A CRC of 0 means there that none is stated. Such a file is walked once from
its begin to its end; of each message is kept where it is, so that memory stays small.

The digest of the contents is the sum of the SHA-256 of all messages, with their channels, modulo 2**256: it is the same
in whatever order and in whichever chunks they are, and those of several files add up.
"""

from __future__ import annotations

import hashlib
import json
import zlib
from array import array
from collections import Counter
from collections.abc import Container, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from pathlib import Path
from threading import Lock
from typing import Any, NamedTuple

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Footer, Header, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.mcap_bytes import (
    CHUNK,
    CRC,
    LENGTH,
    MESSAGE,
    RECORD,
    Source,
    check_crc,
    iterate_records,
    make_stream,
)

LIBRARY = "thermostand"  # in the header of a segment: who wrote it
EXPORT_LIBRARY = "thermostand export"
_LIMIT_BYTES = 1 << 30  # of a record, and of a chunk decompressed: both have to fit into memory
_IN_FILE = -1  # in place of a chunk's number: the message is in none
_FOOTER_BYTES = RECORD.size + 20 + len(MCAP0_MAGIC)
_MODULUS = 1 << 256
_SHOWN = 60  # characters of the name of a program


class StoredMessage(NamedTuple):
    """A message as it is in a file; `data` is still encoded."""

    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes | memoryview


class ContentDigest:
    """The digest of messages, in any order; `counts`: how many there are of each topic."""

    def __init__(self) -> None:
        self._sum = 0
        self._begun: dict[int, Any] = {}  # by channel number, the hash of what the channel says
        self._topics: dict[int, str] = {}
        self.counts: Counter[str] = Counter()

    def know(self, channel: Channel, schema: Schema | None) -> None:
        """A channel, before its first message; its numbers do not count, for every writer gives its own."""
        names = ("", "") if schema is None else (schema.name, schema.encoding)
        described = [channel.topic, channel.message_encoding, *names, sorted(channel.metadata.items())]
        begun = hashlib.sha256(json.dumps(described).encode())
        begun.update(hashlib.sha256(b"" if schema is None else schema.data).digest())
        self._begun[channel.id], self._topics[channel.id] = begun, channel.topic

    def add(
        self, channel: int, log_time_ns: int, publish_time_ns: int, sequence: int, data: bytes | memoryview
    ) -> None:
        """One message."""
        found = self._begun[channel].copy()
        found.update(MESSAGE.pack(0, sequence, log_time_ns, publish_time_ns))
        found.update(data)
        self._sum += int.from_bytes(found.digest())
        self.counts[self._topics[channel]] += 1

    def hexdigest(self) -> str:
        """The digest of all messages so far."""
        return format_digest(self._sum)


def format_digest(number: int) -> str:
    """The digest as text; the sum of the numbers of several files is that of all of them."""
    return f"{number % _MODULUS:064x}"


@dataclass(frozen=True)
class McapContents:
    """A valid MCAP file. library: the program that wrote it. chunks: where the content of each chunk's record is, and
    its length. The columns below have an entry for each message, in the order of the file: its channel, its log time,
    the number of its chunk (-1: in none) and where its record is, in the chunk's data or in the file, and its length.
    counts: messages by topic. digest: of all messages."""

    path: Path
    size_bytes: int
    changed_ns: int
    library: str
    schemas: Mapping[int, Schema]
    channels: Mapping[int, Channel]
    metadata: Mapping[str, dict[str, str]]
    attachments: Mapping[str, Attachment]
    counts: Mapping[str, int]
    digest: str
    chunks: list[tuple[int, int]] = field(repr=False)
    channel_of: array[int] = field(repr=False)
    time_ns_of: array[int] = field(repr=False)
    chunk_of: array[int] = field(repr=False)
    place_of: array[int] = field(repr=False)
    length_of: array[int] = field(repr=False)

    @property
    def program(self) -> str:
        """Who wrote the file, as a part of a sentence."""
        name = "".join(char for char in self.library if char.isprintable()).strip()
        return name[:_SHOWN] or "a program that gives no name"

    @cached_property
    def first_ns(self) -> int:
        """The first of the log times; 0 without a message."""
        return min(self.time_ns_of, default=0)

    @cached_property
    def last_ns(self) -> int:
        """The last of the log times; 0 without a message."""
        return max(self.time_ns_of, default=0)

    def __len__(self) -> int:
        return len(self.channel_of)

    def get_schema(self, channel: int) -> str:
        """The name of a channel's schema, "" when it has none."""
        schema = self.schemas.get(self.channels[channel].schema_id)
        return "" if schema is None else schema.name

    def iterate_messages(self, wanted: Container[int]) -> Iterator[StoredMessage]:
        """The messages of the wanted channels, in the order of the file."""
        return (self.read_message(index) for index, channel in enumerate(self.channel_of) if channel in wanted)

    def read_message(self, index: int) -> StoredMessage:
        """One message; one of DAMAGE when the file is not what it was."""
        begin, length, chunk = self.place_of[index], self.length_of[index], self.chunk_of[index]
        if chunk == _IN_FILE:
            with self.path.open("rb", buffering=0) as file:
                record = memoryview(Source(file.fileno()).read(begin, length))
        else:
            data = _keep_chunk(self.path, self.changed_ns, *self.chunks[chunk])
            record = data[begin : begin + length]
        channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(record)
        return StoredMessage(channel, sequence, log_time_ns, publish_time_ns, record[MESSAGE.size :])


_reading = Lock()  # else two threads would decompress one large chunk twice


def _keep_chunk(path: Path, changed_ns: int, begin: int, length: int) -> memoryview:
    with _reading:
        return _read_chunk(path, changed_ns, begin, length)


@lru_cache(1)  # one at a time: it may be as large as the file
def _read_chunk(path: Path, changed_ns: int, begin: int, length: int) -> memoryview:
    with path.open("rb", buffering=0) as file:
        return decompress(memoryview(Source(file.fileno()).read(begin, length)))


def find_rewritten(path: Path) -> McapContents | None:
    """Return what is in a segment that another program wrote; None for one of ours, and for what is no MCAP file at
    all. One of DAMAGE when it is not valid."""
    with path.open("rb", buffering=0) as file:
        begin = file.read(len(MCAP0_MAGIC) + RECORD.size + 2 * 4 + 256)
        status = path.stat()
    try:
        library = _read_library(begin)
    except DAMAGE:
        return None
    if library == LIBRARY:
        return None
    return _read_once(path, status.st_mtime_ns, status.st_size, status.st_ino)


def _read_library(begin: bytes) -> str:
    """The name of the program in the header, of at most 256 bytes; one of DAMAGE when there is none."""
    opcode, length = RECORD.unpack_from(begin, len(MCAP0_MAGIC))
    if not begin.startswith(MCAP0_MAGIC) or opcode != Opcode.HEADER:
        raise ValueError("no header")
    content = begin[len(MCAP0_MAGIC) + RECORD.size :][:length]
    return Header.read(make_stream(content)).library


@lru_cache(64)
def _read_once(path: Path, changed_ns: int, size_bytes: int, inode: int) -> McapContents:
    return read_contents(path)


def read_contents(path: Path) -> McapContents:
    """Walk through an MCAP file of any writer; one of DAMAGE when it is not valid, or a CRC that it states is wrong."""
    with path.open("rb", buffering=0) as file:
        changed_ns = path.stat().st_mtime_ns
        walk = _Walk(Source(file.fileno()))
        walk.run()
    return McapContents(
        path=path,
        size_bytes=walk.source.size,
        changed_ns=changed_ns,
        library=walk.library,
        schemas=walk.schemas,
        channels=walk.channels,
        metadata=walk.metadata,
        attachments=walk.attachments,
        counts=dict(walk.digest.counts),
        digest=walk.digest.hexdigest(),
        chunks=walk.chunks,
        channel_of=walk.channel_of,
        time_ns_of=walk.time_ns_of,
        chunk_of=walk.chunk_of,
        place_of=walk.place_of,
        length_of=walk.length_of,
    )


class _Walk:
    """From the begin of a file to its end."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.library = ""
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.attachments: dict[str, Attachment] = {}
        self.digest = ContentDigest()
        self.chunks: list[tuple[int, int]] = []
        self.channel_of, self.chunk_of = array("H"), array("l")
        self.time_ns_of, self.place_of, self.length_of = array("q"), array("q"), array("q")

    def run(self) -> None:
        magic = self.source.read(0, len(MCAP0_MAGIC))
        if magic != MCAP0_MAGIC:
            raise ValueError("it is no MCAP file")
        offset, crc = len(magic), _Crc(magic)
        while True:
            head = self.source.read(offset, RECORD.size)
            if len(head) < RECORD.size:
                raise EOFError("it ends in the middle")
            opcode, length = RECORD.unpack(head)
            offset += len(head)
            content = self._read(offset, length)
            if opcode == Opcode.DATA_END:
                crc.check(*CRC.unpack(content))
                break
            crc.add(head, content)
            self._take(opcode, memoryview(content), offset)
            offset += length
        self._check_summary(offset + length)

    def _read(self, offset: int, length: int) -> bytes:
        if length > self.source.size - offset:
            raise EOFError("it ends in the middle")
        _check_size(length, "record")
        return self.source.read(offset, length)

    def _take(self, opcode: int, content: memoryview, offset: int) -> None:
        match opcode:
            case Opcode.HEADER:
                self.library = Header.read(make_stream(content)).library
            case Opcode.CHUNK:
                self.chunks.append((offset, len(content)))
                place, data = 0, decompress(content)
                for inner, record in iterate_records(data):
                    place += RECORD.size
                    self._take_record(inner, record, len(self.chunks) - 1, place)
                    place += len(record)
            case Opcode.ATTACHMENT:
                if any(content[-CRC.size :]):
                    check_crc(content[: -CRC.size], CRC.unpack(content[-CRC.size :])[0], "an attachment")
                attachment = Attachment.read(make_stream(content))
                self.attachments[attachment.name] = attachment
            case Opcode.METADATA:
                metadata = Metadata.read(make_stream(content))
                self.metadata[metadata.name] = metadata.metadata
            case Opcode.FOOTER:
                raise ValueError("its data have no end")
            case _:
                self._take_record(opcode, content, _IN_FILE, offset)

    def _take_record(self, opcode: int, record: memoryview, chunk: int, place: int) -> None:
        """A record that may be in a chunk or not; kinds that are not known do not count, as the format wants it."""
        match opcode:
            case Opcode.MESSAGE:
                number, sequence, time_ns, publish_ns = MESSAGE.unpack_from(record)
                if time_ns >> 63:
                    raise ValueError(f"a message has the instant {time_ns}, which no clock gives")
                self.digest.add(number, time_ns, publish_ns, sequence, record[MESSAGE.size :])
                self.channel_of.append(number)
                self.time_ns_of.append(time_ns)
                self.chunk_of.append(chunk)
                self.place_of.append(place)
                self.length_of.append(len(record))
            case Opcode.SCHEMA:
                schema = Schema.read(make_stream(record))
                self.schemas[schema.id] = schema
            case Opcode.CHANNEL:
                channel = Channel.read(make_stream(record))
                if channel.id not in self.channels:  # tools repeat them in every chunk
                    self.digest.know(channel, self.schemas.get(channel.schema_id))
                self.channels[channel.id] = channel
            case _:
                pass

    def _check_summary(self, begin: int) -> None:
        """The end of the file; a summary is not needed, but one with a CRC has to fit it."""
        footer_begin = self.source.size - _FOOTER_BYTES
        data = self.source.read(max(begin, footer_begin), _FOOTER_BYTES)
        if len(data) < _FOOTER_BYTES or data[-len(MCAP0_MAGIC) :] != MCAP0_MAGIC or data[0] != Opcode.FOOTER:
            raise EOFError("it ends in the middle")
        footer = Footer.read(make_stream(data[RECORD.size :]))
        if footer.summary_crc:
            summary = self._read(begin, footer_begin - begin)
            check_crc(summary + data[: -len(MCAP0_MAGIC) - CRC.size], footer.summary_crc, "its index")


class _Crc:
    """That of the data section."""

    def __init__(self, begin: bytes) -> None:
        self._crc = zlib.crc32(begin)

    def add(self, *parts: bytes) -> None:
        for part in parts:
            self._crc = zlib.crc32(part, self._crc)

    def check(self, stated: int) -> None:
        if stated not in (0, self._crc):
            raise ValueError("the CRC of its data is wrong")


def _check_size(size_bytes: int, what: str) -> None:
    if size_bytes > _LIMIT_BYTES:
        raise ValueError(
            f"a {what} of {size_bytes / 1e6:.0f} MB does not fit into memory; write the file again with chunks of at "
            "most 256 MB"
        )


def decompress(content: memoryview) -> memoryview:
    """The records in a chunk, of the content of its record; ValueError, struct.error or an error of zstd or lz4 when it
    is damaged."""
    _, _, size_bytes, crc, name_bytes = CHUNK.unpack_from(content)
    name = bytes(content[CHUNK.size : CHUNK.size + min(name_bytes, 16)])
    begin = CHUNK.size + name_bytes + LENGTH.size
    (data_bytes,) = LENGTH.unpack_from(content, begin - LENGTH.size)
    stored = content[begin : begin + data_bytes]
    _check_size(size_bytes, "chunk")
    match name:
        case b"":
            data = stored
        case b"zstd":
            reader = zstandard.ZstdDecompressor().stream_reader(stored, read_across_frames=True)
            data = memoryview(reader.read(size_bytes))
        case b"lz4":
            data = memoryview(_decompress_lz4(stored, size_bytes))
        case _:
            raise ValueError(f"a chunk is compressed with {name!r}")
    if len(data) != size_bytes or len(stored) != data_bytes:
        raise ValueError("a chunk's size is wrong")
    if crc:
        check_crc(data, crc, "a chunk")
    return data


def _decompress_lz4(stored: memoryview, size_bytes: int) -> bytes:
    import lz4.frame  # no segment of ours needs it

    try:
        return lz4.frame.LZ4FrameDecompressor().decompress(stored, max_length=size_bytes)
    except RuntimeError as error:  # what lz4 raises
        raise ValueError(f"a chunk is damaged ({error})") from error
