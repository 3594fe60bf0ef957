"""A segment's bytes, also damaged ones: which records are proven sound, and where none are.

Read by place from the front; what counts as a proof is in recording/format/proof.py, what as a block that was being
written in recording/reading/torn.py. Behind a damaged place the walk continues at the next bytes that look like a
record and prove to be one. Inside sound records nothing is searched, so an MCAP file that is attached is an attachment.
Chunks that a disk has put into the wrong place count as damage (recording/reading/misplaced.py).

Memory is flat: one record at a time. Only OSError is raised, when the disk does not give a byte.
"""

from __future__ import annotations

import errno
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.layout import FRAME_TABLE, SEGMENT_METADATA, SESSION_METADATA, contradicts
from thermostand.recording.format.mcap_bytes import (
    MESSAGE,
    RECORD,
    ChunkHead,
    Source,
    chunk_content,
    chunk_head,
    records,
    stream,
)
from thermostand.recording.format.proof import Contents, claim_of, proven
from thermostand.recording.format.summary import read_summary
from thermostand.recording.reading.doubt import Doubt
from thermostand.recording.reading.misplaced import PlacedChunk, Span, find_misplaced_chunks
from thermostand.recording.reading.torn import Blocks

WINDOW_BYTES = 4 << 20

# Heads of records, little endian: lengths below 2**29, compression "" or "zstd".
_CHUNK_HEAD = (
    rb"\x06(?=.{3}[\x00-\x1f]\x00{4}"  # length
    rb".{16}.{3}[\x00-\x10]\x00{4}.{4}"  # times, uncompressed size, CRC
    rb"(?:\x00{4}|\x04\x00{3}zstd))"
)
_ATTACHMENT_HEAD = rb"\x09(?=.{3}[\x00-\x1f]\x00{4}.{16}[\x01-\xff]\x00{3})"
_SESSION_HEAD = rb"\x0c(?=.{8}\x07\x00{3}session)"
_IN_OPENING = re.compile(_CHUNK_HEAD + b"|" + _ATTACHMENT_HEAD + b"|" + _SESSION_HEAD, re.DOTALL)
_AFTER_OPENING = re.compile(_CHUNK_HEAD, re.DOTALL)
_TABLE_HEAD = b"\x09" + len(FRAME_TABLE).to_bytes(4, "little") + FRAME_TABLE.encode()  # between them two times
_HEAD_BYTES = 64  # more than any of the patterns looks at


class SoundChunk(NamedTuple):
    """Where the content of a sound chunk is."""

    offset: int
    length: int


class StoredMessage(NamedTuple):
    """A message as it is in a chunk; `data` is still encoded."""

    channel: int
    sequence: int
    log_time_ns: int
    publish_time_ns: int
    data: bytes


@dataclass
class Survey:
    """What of a segment proves itself.

    `session`: the metadata record of that name, None when it is gone or (`is_session_wrong`) does not fit its CRC.
    `is_opening_whole`: nothing is damaged before the first chunk. `messages`: how many there are, by channel number.
    `damages`: the places that are damaged; neither `torn_bytes` at the end of the file, where a block was being
    written, nor a damaged index is among them.
    """

    session: dict[str, str] | None = None
    is_session_wrong: bool = False
    attachments: dict[str, Attachment] = field(default_factory=dict[str, Attachment])
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    chunks: list[SoundChunk] = field(default_factory=list[SoundChunk])
    messages: Counter[int] = field(default_factory=Counter[int])
    damages: list[Span] = field(default_factory=list[Span])
    torn_bytes: int = 0
    is_opening_whole: bool = False

    @property
    def lost_bytes(self) -> int:
        """The size of all damaged places."""
        return sum(gap.end - gap.begin for gap in self.damages)


def _no_report(read_bytes: int) -> None:
    """No progress is shown."""


def survey(source: Source, to_first_chunk: bool = False, report: Callable[[int], None] = _no_report) -> Survey:
    """Walk through the file, or only until its first sound chunk; `report` gets the number of bytes read so far."""
    walk = _Walk(source, report)
    walk.run(to_first_chunk)
    return walk.found


def stored_messages(source: Source, place: SoundChunk) -> Iterator[StoredMessage]:
    """The messages of a sound chunk in their order; OSError when the disk does not give the same bytes again."""
    try:
        _, content = chunk_content(memoryview(source.read(*place)))
    except DAMAGE as error:
        raise OSError(errno.EIO, f"{os.strerror(errno.EIO)}: it reads differently each time") from error
    for opcode, record in records(content):
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(record)
            yield StoredMessage(channel, sequence, log_time_ns, publish_time_ns, bytes(record[MESSAGE.size :]))


class _Proven(NamedTuple):
    """A record that proved itself; `content` where it matters to the survey, `chunk` of a chunk."""

    begin: int
    end: int
    content: Contents | Metadata | Attachment | DataEnd | None
    chunk: ChunkHead | None = None


class _Walk:
    """The walk through one file."""

    def __init__(self, source: Source, report: Callable[[int], None]) -> None:
        self.found = Survey()
        self._source = source
        self._report = report
        self._doubt = Doubt(source)
        self._blocks = Blocks()
        self._index_begin: int | None = None
        self._sound_attachments: dict[str, Attachment] = {}  # those before the first damage
        self._placed: list[PlacedChunk] = []
        self._indexes: set[bytes] = set()  # those that belong behind the last chunk

    def run(self, to_first_chunk: bool) -> None:
        offset = 0
        while offset < self._source.size and not (to_first_chunk and self.found.chunks):
            record = self._record_at(offset)
            if record is None:
                record = self._next_record(offset)
                self._note_gap(Span(offset, record.begin if record else self._source.size))
                if record is None:
                    break
            self._take(record)
            offset = record.end
            self._report(offset)
            if self._index_begin == offset and self._take_index(offset):
                break
        if not self.found.chunks:
            self.found.is_opening_whole = self.found.session is not None and not self.found.damages
        self._forget_misplaced()

    def _forget_misplaced(self) -> None:
        found, size = self.found, self._source.size
        torn = [Span(size - found.torn_bytes, size)] if found.torn_bytes else []
        for wrong in find_misplaced_chunks(self._placed, [*found.damages, *torn]):
            for chunk in self._placed:
                if wrong.begin <= chunk.begin < wrong.end:
                    found.messages = found.messages - chunk.messages
            found.chunks = [chunk for chunk in found.chunks if not wrong.begin <= chunk.offset < wrong.end]
            begin = min([wrong.begin, *(gap.begin for gap in found.damages if wrong.begin <= gap.end <= wrong.end)])
            found.damages = [gap for gap in found.damages if not begin <= gap.begin < wrong.end]
            found.damages.append(Span(begin, wrong.end))
            found.damages.sort()
            found.torn_bytes = 0 if wrong.end == size else found.torn_bytes

    def _record_at(self, offset: int) -> _Proven | None:
        """The record that begins there, None when nothing there proves itself."""
        if offset == 0:
            is_magic = self._source.read(0, len(MCAP0_MAGIC)) == MCAP0_MAGIC
            return _Proven(0, len(MCAP0_MAGIC), None) if is_magic else None
        head = self._source.read(offset, _HEAD_BYTES)
        claim = claim_of(head)
        if claim is None or offset + RECORD.size + claim.length > self._source.size:
            return None
        cost_bytes = 0
        try:
            chunk = chunk_head(head[RECORD.size :], claim.length) if claim.opcode == Opcode.CHUNK else None
            if not self._doubt.can_be_true(offset, claim, chunk):
                return None
            cost_bytes = max(claim.length, chunk.size_bytes if chunk else 0)
            data = self._source.read(offset + RECORD.size, claim.length)
            content = proven(claim.opcode, data)
            if claim.opcode == Opcode.MESSAGE_INDEX and data not in self._indexes:
                raise ValueError("a message index is not that of its chunk")
        except DAMAGE as error:
            if isinstance(error, OSError):
                raise
            self._doubt.note_false(cost_bytes)
            return None
        return _Proven(offset, offset + RECORD.size + claim.length, content, chunk)

    def _next_record(self, offset: int) -> _Proven | None:
        """The first sound record behind the damaged one at `offset`."""
        pattern = _AFTER_OPENING if self.found.is_opening_whole else _IN_OPENING
        candidates = self._candidates(offset + 1, pattern)
        return next((record for place in candidates if (record := self._record_at(place))), None)

    def _candidates(self, begin: int, pattern: re.Pattern[bytes]) -> Iterator[int]:
        """Places from `begin` on that look like the head of a record."""
        window = begin
        while (window := self._source.next_data(window)) < self._source.size:
            self._report(window)
            data = self._source.read(window, WINDOW_BYTES + _HEAD_BYTES)
            for match in pattern.finditer(data):
                if match.start() < WINDOW_BYTES:
                    yield window + match.start()
            window += WINDOW_BYTES

    def _note_gap(self, gap: Span) -> None:
        if gap.end == self._source.size and (gap.begin == self._index_begin or self._is_table(gap.begin)):
            return
        if gap.end == self._source.size and self._blocks.is_torn(self._source, gap.begin):
            self.found.torn_bytes = gap.end - gap.begin
        else:
            if not self.found.damages:
                self._sound_attachments = dict(self.found.attachments)
            self.found.damages.append(gap)

    def _is_table(self, begin: int) -> bool:
        """Whether the table of frames begins there, behind the last of them, which is made anew."""
        head = self._source.read(begin, len(_TABLE_HEAD) + RECORD.size)
        return head[:1] == _TABLE_HEAD[:1] and head[RECORD.size + 16 :].startswith(_TABLE_HEAD[1:])

    def _take(self, record: _Proven) -> None:
        found = self.found
        match record.content:
            case Contents(schemas, channels, messages) as contents:
                self._indexes = contents.indexes()
                if not found.chunks:
                    found.is_opening_whole = found.session is not None and not found.damages
                found.schemas.update({schema.id: schema for schema in schemas})
                found.channels.update({channel.id: channel for channel in channels})
                found.messages.update(messages)
                if record.chunk is not None:
                    self._placed.append(PlacedChunk(record.begin, record.chunk, messages))
                self._blocks.note(record.begin, record.end, messages)
                found.chunks.append(SoundChunk(record.begin + RECORD.size, record.end - record.begin - RECORD.size))
            case Metadata(name=name, metadata=entries) if name == SESSION_METADATA:
                if found.chunks and not found.is_opening_whole:
                    self._forget_attached()
                found.session = entries
            case Metadata(name=name, metadata=entries) if name == SEGMENT_METADATA:
                if found.session is not None and contradicts(entries, found.session):
                    found.session, found.is_session_wrong = None, True
            case Attachment(name=name) if name == FRAME_TABLE:
                pass  # what it says stands in the chunks
            case Attachment() as attachment:
                found.attachments[attachment.name] = attachment
            case DataEnd():
                self._index_begin = record.end
            case _:
                pass

    def _forget_attached(self) -> None:
        """The session's metadata stands before the first chunk: the chunks so far lay in a damaged attachment."""
        self.found.attachments = dict(self._sound_attachments)
        self.found.schemas, self.found.channels = {}, {}
        self.found.chunks, self.found.messages, self._placed = [], Counter(), []

    def _take_index(self, begin: int) -> bool:
        """Learn from the index at `begin` when all of it is sound, to the end of the file."""
        try:
            with self._source.file() as file:
                summary = read_summary(file, self._source.size)
            if summary.begin != begin:
                raise ValueError("the index does not begin behind the data")
            for opcode, record in records(summary.content):
                if opcode == Opcode.SCHEMA:
                    schema = Schema.read(stream(record))
                    self.found.schemas[schema.id] = schema
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(stream(record))
                    self.found.channels[channel.id] = channel
        except DAMAGE:
            return False
        return True
