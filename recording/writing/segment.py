"""One MCAP segment of a series (frames or telemetry) of a session, written so that what is acknowledged survives.

`NNNN.mcap.part` grows by whole blocks of records: one write, one fdatasync, then it is acknowledged. Its share of the
disk is reserved when it is opened, so that a full disk refuses a new segment and not a frame. A finished segment gets
its index, is synced and renamed to `NNNN.mcap`; one of many small chunks is rewritten with large ones first.
Metadata (`session`, `segment`) and attachments are the first records of every segment, so each is readable alone.
Chunks have a CRC; a commit ends the chunk, so the frames series has one frame per chunk and the chunk index is its
frame index.

After any OSError the file is cut back to its last whole block and left as `.part`; its writer is never used again,
because its index would name chunks that were not written.
"""

from __future__ import annotations

import ctypes
import errno
import fcntl
import hashlib
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

from google.protobuf.message import Message
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.well_known import MessageEncoding, SchemaEncoding
from mcap.writer import MCAP0_MAGIC, CompressionType
from mcap_protobuf.schema import build_file_descriptor_set

from thermostand.foundation.files import sync_folder
from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.images import META_SCHEMA
from thermostand.recording.format.layout import (
    FINISHED,
    FRAME_TABLE,
    SEGMENT_METADATA,
    SESSION_METADATA,
    TEMPORARY,
    UNFINISHED,
    make_segment_metadata,
)
from thermostand.recording.format.manifest import Sealed
from thermostand.recording.format.mcap_bytes import (
    MESSAGE,
    RECORD,
    check_attachment,
    decompress_chunk,
    iterate_records,
    make_stream,
)
from thermostand.recording.format.mcap_contents import ContentDigest
from thermostand.recording.format.messages import encode_frame_table
from thermostand.recording.writing.mcap_writer import McapWriter
from thermostand.recording.writing.notices import read_disk_space

# A telemetry segment of ten minutes has 600 chunks of a second's commit each; merged it is read three times as fast.
MANY_CHUNKS = 32  # opening a chunk takes a reader as long as a dozen messages
FILE_SYSTEM_BYTES = 1_000_000  # never reserved: the file system needs blocks of its own to hold a reserve
CHUNK_BYTES = 1024 * 1024  # of a rewritten telemetry segment; a frame is a chunk of its own
_KEEP_SIZE = 1  # FALLOC_FL_KEEP_SIZE, linux/falloc.h
_NO_RESERVE = (errno.EOPNOTSUPP, errno.ENOSYS)  # a file system that cannot reserve is written to without
_PARTS_AT_ONCE = 1024  # IOV_MAX
# With it a raw frame takes 2.9 ms, in one write 3.6, the bare system calls 2.9. Written with its CRC behind the data, a
# killed write would leave a hole in front, which counts as damage and not as an unfinished block.
_PIECE_BYTES = 1 << 19  # of 128 KiB to 8 MiB the fastest for frames of 5 MB
_BEGIN_WRITING = 2  # SYNC_FILE_RANGE_WRITE, linux/fs.h: the disk is given what is there, and nobody waits for it

_libc = ctypes.CDLL(None, use_errno=True)
_libc.fallocate64.argtypes = (ctypes.c_int, ctypes.c_int, ctypes.c_int64, ctypes.c_int64)
_libc.sync_file_range.argtypes = (ctypes.c_int, ctypes.c_int64, ctypes.c_int64, ctypes.c_uint)


class MessageRecord(NamedTuple):
    """One encoded message; time_ns is its log time, and its publish time unless that is given."""

    topic: str
    time_ns: int
    data: bytes | memoryview
    sequence: int = 0
    published_ns: int = 0


@dataclass(frozen=True, slots=True)
class Topic:
    """A topic of a series, the class of its messages and what its channel record has to say."""

    name: str
    message: type[Message]
    metadata: Mapping[str, str] = field(default_factory=dict[str, str])


@dataclass(frozen=True, slots=True)
class SeriesSpec:
    """What every segment of a series has in common.

    A segment is full at `segment_bytes` or `segment_ns`. `reserve_bytes` of the disk are allocated when it is opened,
    less where that would leave less than `keep_free_bytes`. `merge_chunks`: a finished segment of many small chunks
    is rewritten with large ones. topic_of: gives the topic of a name that is not among `topics`. level: of zstd.
    """

    name: str
    topics: tuple[Topic, ...]
    compression: CompressionType
    session: Mapping[str, str]
    attachments: Mapping[str, str]
    segment_bytes: int
    segment_ns: int
    reserve_bytes: int = 0
    keep_free_bytes: int = 0
    merge_chunks: bool = False
    topic_of: Callable[[str], Topic] | None = None
    level: int = 3


class CommitSink:
    """A new file that grows by whole blocks; a block is on the disk when `append` returns.

    While it is open it is locked (flock), which marks a living recording, and `reserve_bytes` of the
    disk are its own without being part of its size. After an OSError only `settle` and `close` are left.
    """

    def __init__(self, path: Path, reserve_bytes: int = 0) -> None:
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o644)
        self._reserve_bytes = reserve_bytes
        self.committed_bytes = 0
        self._sha256 = hashlib.sha256()
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX)  # a reader that looks at the new file meanwhile lets go at once
            _reserve(self._fd, reserve_bytes)
        except OSError:
            self.close()
            with suppress(OSError):
                path.unlink()  # some file systems keep what they could reserve before they refused the rest
            raise

    @property
    def reserved_bytes(self) -> int:
        """What is still reserved behind the committed blocks."""
        return max(0, self._reserve_bytes - self.committed_bytes)

    def append(self, parts: Sequence[bytes | memoryview]) -> None:
        """Write and sync one block, given in parts; on OSError it is cut off again, if the disk allows that much, and
        the error raised."""
        try:
            end_bytes = _write(self._fd, parts, self.committed_bytes)
            for part in parts:  # while the disk works; a sink that fails is not used again
                self._sha256.update(part)
            os.fdatasync(self._fd)
            if not os.fstat(self._fd).st_nlink:
                raise FileNotFoundError(errno.ENOENT, "the file was removed while it was written")
        except OSError:
            with suppress(OSError):
                self.settle()
            raise
        self.committed_bytes = end_bytes

    def seal(self, digest: ContentDigest) -> Sealed:
        """Return what has been committed, as a whole file with these messages."""
        return Sealed(self.committed_bytes, self._sha256.hexdigest(), dict(digest.counts), digest.hexdigest())

    def settle(self) -> None:
        """Cut the file to its committed blocks and give back the reserve, durably. Until that has succeeded a block
        that `append` refused may still be read from the file, so it must not be written to another one."""
        self._reserve_bytes = 0
        os.ftruncate(self._fd, self.committed_bytes)  # frees the reserve also when the size stays the same
        os.fsync(self._fd)

    def close(self) -> None:
        """Unlock and close; may be called twice."""
        if self._fd >= 0:
            fd, self._fd = self._fd, -1  # the number may belong to another file by the next call
            with suppress(OSError):  # everything that counts has been synced
                os.close(fd)


class FrameTable:
    """The descriptions of a segment's frames once more, behind the last one: who lists them decompresses no image."""

    def __init__(self, writer: McapWriter) -> None:
        self._writer = writer
        self._channels: set[int] = set()
        self._descriptions: list[bytes] = []

    def know(self, channel: int, schema: str) -> None:
        """A channel with messages of that schema."""
        if schema == META_SCHEMA:
            self._channels.add(channel)

    def note(self, channel: int, data: bytes | memoryview) -> None:
        """A message, of which those that describe a frame are kept."""
        if channel in self._channels:
            self._descriptions.append(bytes(data))

    def write(self, time_ns: int) -> None:
        """The table, when there is a frame: nothing is added any more."""
        if self._descriptions:
            self._writer.end_chunk()
            table = encode_frame_table(self._descriptions)
            self._writer.add_attachment(Attachment(0, time_ns, FRAME_TABLE, "application/x-protobuf", table))


class Segment:
    """One file of a series, from creation to finish; after an OSError of any method only `abandon` is left."""

    def __init__(self, folder: Path, number: int, form: SeriesSpec, time_ns: int) -> None:
        self.begun_ns = time_ns
        self.number = number
        self._form = form
        self._schemas: dict[str, int] = {}  # number by name
        self._part = folder / f"{number:04d}{UNFINISHED}"
        self._finished = folder / f"{number:04d}{FINISHED}"
        self._writer = McapWriter(form.compression, CHUNK_BYTES, form.level)
        self._table = FrameTable(self._writer)
        self._chunk_count = 0
        self._sink = CommitSink(self._part, _compute_affordable_bytes(folder, form))
        try:
            sync_folder(folder)
            self._channels = self._begin(number)
            self._sink.append(self._writer.take())
        except OSError:
            self._remove()
            raise
        self._opening_bytes = self._sink.committed_bytes  # what stands before the first message

    def _begin(self, number: int) -> dict[str, int]:
        """Header, attachments, metadata; schemas and channels go into the first chunk. Returns topic -> channel id."""
        for name, text in self._form.attachments.items():
            media_type = "application/yaml" if name.endswith(".yaml") else "text/plain"
            self._writer.add_attachment(Attachment(0, self.begun_ns, name, media_type, text.encode()))
        session = self._form.session
        self._writer.add_metadata(SESSION_METADATA, session)
        self._writer.add_metadata(SEGMENT_METADATA, make_segment_metadata(self._form.name, number, session))
        return {topic.name: self._register(topic) for topic in self._form.topics}

    def _register(self, topic: Topic) -> int:
        name = topic.message.DESCRIPTOR.full_name
        if name not in self._schemas:
            files = build_file_descriptor_set(topic.message).SerializeToString()
            self._schemas[name] = self._writer.add_schema(name, SchemaEncoding.Protobuf, files)
        schema = self._schemas[name]
        channel = self._writer.add_channel(topic.name, MessageEncoding.Protobuf, schema, topic.metadata)
        self._table.know(channel, name)
        return channel

    def _add_late_topic(self, name: str) -> int:
        """A topic that is first written to now; KeyError when the series has none of that name."""
        if self._form.topic_of is None:
            raise KeyError(name)
        return self._register(self._form.topic_of(name))

    def commit(self, records: Iterable[MessageRecord]) -> None:
        """All of `records` on the disk when this returns."""
        for record in records:
            time_ns, published_ns = record.time_ns, record.published_ns or record.time_ns
            channel = self._channels.get(record.topic)
            if channel is None:
                channel = self._channels[record.topic] = self._add_late_topic(record.topic)
            self._writer.add_message(channel, time_ns, published_ns, record.sequence, record.data)
            self._table.note(channel, record.data)
        self._writer.end_chunk()
        self._sink.append(self._writer.take())
        self._chunk_count += 1

    @property
    def committed_bytes(self) -> int:
        """Size of the file."""
        return self._sink.committed_bytes

    @property
    def is_empty(self) -> bool:
        """Whether no message has been committed."""
        return self._sink.committed_bytes <= self._opening_bytes

    @property
    def reserved_bytes(self) -> int:
        """What of the reserve is not used yet."""
        return self._sink.reserved_bytes

    @property
    def name(self) -> str:
        """The name within the session, as it is called when it is finished."""
        return f"{self._form.name}/{self._finished.name}"

    def finish(self) -> Sealed:
        """Index, sync, rename: the segment is complete and stays so. It is locked until it has its final name."""
        self._table.write(self.begun_ns)
        self._writer.end_data()
        # By itself: an index of which a power cut has left zeros is then behind the end of the data, and no loss.
        self._sink.append(self._writer.take())
        self._writer.finish()
        self._sink.append(self._writer.take())
        self._sink.settle()
        sealed = self._merge() if self._form.merge_chunks and self._chunk_count >= MANY_CHUNKS else None
        if sealed is None:
            os.replace(self._part, self._finished)
            sync_folder(self._part.parent)
            sealed = self._sink.seal(self._writer.digest)
        self._sink.close()
        return sealed

    def _merge(self) -> Sealed | None:
        """The finished segment when it is now the copy with large chunks; None when the disk has no space for it, or
        gives back other bytes than it took: the file stays as it was committed."""
        try:
            sealed = merge_chunks(self._part, self._finished, self._form.compression)
        except DAMAGE:
            return None
        with suppress(OSError):  # the finished one counts where both are
            self._part.unlink()
        return sealed

    def abandon(self) -> None:
        """Let go after an error: what was committed stays as `.part`; a file without a message is removed. OSError
        when the file cannot be cut back: as long as that lasts the block that failed may be in it."""
        self._sink.settle()
        if self.is_empty:
            self._remove()
        else:
            self.close()

    def close(self) -> None:
        """Let go of the file as it is; may be called twice."""
        self._sink.close()

    def _remove(self) -> None:
        with suppress(OSError):
            self._part.unlink()
        self.close()


def _compute_affordable_bytes(folder: Path, form: SeriesSpec) -> int:
    """Return what a segment may reserve here and now."""
    if not form.reserve_bytes:
        return 0
    spare_bytes = read_disk_space(folder).free_bytes - max(form.keep_free_bytes, FILE_SYSTEM_BYTES)
    return min(form.reserve_bytes, max(0, spare_bytes))


def merge_chunks(source: Path, target: Path, compression: CompressionType) -> Sealed:
    """Copy the complete segment `source` to `target`, durably, with large chunks: a reader pays for every chunk.
    Returns what the copy is.

    Telemetry is committed each second, so ten minutes are 600 chunks of a few messages each. The copy has the same
    header, attachments, metadata, schemas, channels and messages in the same order, and the same input gives the same
    bytes. It is made under a temporary name, which counts for nothing when it is found later; one chunk is in memory at
    a time.

    On an error the temporary file is removed and `source` is as it was; OSError from the disk, others when the source
    does not read as it was written.
    """
    temporary = target.with_name(target.name.removesuffix(FINISHED) + TEMPORARY)
    sink = CommitSink(temporary)
    try:
        digest = _copy(source, sink, compression)
        sink.settle()
        os.replace(temporary, target)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    finally:
        sink.close()
    sync_folder(target.parent)
    return sink.seal(digest)


def _copy(source: Path, sink: CommitSink, compression: CompressionType) -> ContentDigest:
    writer = McapWriter(compression, CHUNK_BYTES)
    size_bytes = source.stat().st_size
    with source.open("rb") as file:
        if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            raise ValueError(f"{source}: not an MCAP file")
        opcode = 0
        while opcode != Opcode.DATA_END:  # behind it is the index
            opcode, length = RECORD.unpack(file.read(RECORD.size))
            if length > size_bytes:
                raise ValueError("a record is longer than the file")
            _add(writer, opcode, memoryview(file.read(length)))
            if parts := writer.take():
                sink.append(parts)
    writer.finish()
    sink.append(writer.take())
    return writer.digest


def _add(writer: McapWriter, opcode: int, content: memoryview) -> None:
    """One record of the source; schemas and channels get the numbers they had, because their order is the same."""
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(content)
        writer.add_message(channel, log_time_ns, publish_time_ns, sequence, bytes(content[MESSAGE.size :]))
    elif opcode == Opcode.CHUNK:
        for each in iterate_records(decompress_chunk(content)[1]):
            _add(writer, *each)
    elif opcode == Opcode.CHANNEL:
        channel = Channel.read(make_stream(content))
        writer.add_channel(channel.topic, channel.message_encoding, channel.schema_id, channel.metadata)
    elif opcode == Opcode.SCHEMA:
        schema = Schema.read(make_stream(content))
        writer.add_schema(schema.name, schema.encoding, schema.data)
    elif opcode == Opcode.METADATA:
        metadata = Metadata.read(make_stream(content))
        writer.add_metadata(metadata.name, metadata.metadata)
    elif opcode == Opcode.ATTACHMENT:
        check_attachment(bytes(content))
        writer.add_attachment(Attachment.read(make_stream(content)))


def _reserve(fd: int, size_bytes: int) -> None:
    """Allocate the first `size_bytes` of an empty file without changing its size; OSError when they do not fit."""
    while size_bytes > 0 and _libc.fallocate64(fd, _KEEP_SIZE, 0, size_bytes):
        number = ctypes.get_errno()
        if number in _NO_RESERVE:
            return
        if number != errno.EINTR:
            raise OSError(number, f"{os.strerror(number)} (to reserve {size_bytes / 1e6:.0f} MB)")


def _write(fd: int, parts: Sequence[bytes | memoryview], offset: int) -> int:
    """Write all parts, one behind the other, from `offset`; returns where they end. The disk begins with a piece while
    the next one is copied: a frame that is handed over at once waits for the copy of all of it first."""
    for piece in _split_into_pieces(parts):
        begin = offset
        while piece:  # a nearly full disk takes a part of the piece before it refuses
            written = os.pwritev(fd, piece, offset)
            offset += written
            while piece and written >= len(piece[0]):
                written -= len(piece.pop(0))
            if written:
                piece[0] = piece[0][written:]
        if offset - begin >= _PIECE_BYTES:
            _libc.sync_file_range(fd, begin, offset - begin, _BEGIN_WRITING)  # an error is fdatasync's to report
    return offset


def _split_into_pieces(parts: Sequence[bytes | memoryview]) -> Iterator[list[memoryview]]:
    """The parts' bytes in their order, in pieces of at most _PIECE_BYTES and _PARTS_AT_ONCE parts."""
    piece: list[memoryview] = []
    left_bytes = _PIECE_BYTES
    for part in parts:
        rest = memoryview(part)
        while rest:
            piece.append(rest[:left_bytes])
            left_bytes -= len(piece[-1])
            rest = rest[len(piece[-1]) :]
            if not left_bytes or len(piece) == _PARTS_AT_ONCE:
                yield piece
                piece, left_bytes = [], _PIECE_BYTES
    if piece:
        yield piece
