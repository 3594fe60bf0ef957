"""A segment's bytes, also damaged ones: which records are proven sound, and where none are.

Read by place from the front; what counts as a proof is in `check_record`, what as a block that was being
written in Blocks. Behind a damaged place the walk continues at the next bytes that look like a
record and prove to be one. Inside sound records nothing is searched, so an MCAP file that is attached is an attachment.
Chunks that a disk has put into the wrong place count as damage (find_misplaced_chunks).

Memory is flat: one record at a time. Only OSError is raised, when the disk does not give a byte.
"""

from __future__ import annotations

import errno
import os
import re
import zlib
from array import array
from bisect import bisect
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import accumulate, pairwise
from math import inf
from typing import NamedTuple

import zstandard
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, DataEnd, Header, MessageIndex, Metadata, Schema
from mcap.writer import MCAP0_MAGIC

from thermostand.foundation.clock import NS_PER_S
from thermostand.recording.format.damage import DAMAGE
from thermostand.recording.format.layout import FRAME_TABLE, SEGMENT_METADATA, SESSION_METADATA, is_contradicting
from thermostand.recording.format.mcap_bytes import (
    CRC,
    MESSAGE,
    MESSAGE_INDEX,
    MESSAGE_INDEX_ENTRY,
    RECORD,
    RECORD_LIMIT_BYTES,
    ChunkHead,
    Source,
    check_attachment,
    decompress_chunk,
    encode_record,
    iterate_records,
    make_stream,
    parse_chunk_head,
)
from thermostand.recording.format.mcap_contents import StoredMessage
from thermostand.recording.format.summary import read_summary

# Whether the bytes of one record prove that they are what the writer wrote.
#
# A chunk and an attachment prove themselves by their CRC (our writer always makes one, so a CRC of 0 is a CRC), the
# records without one by being, byte for byte, what the writer makes of what they say; a message index by its chunk.


class ChunkContents(NamedTuple):
    """What a chunk holds. places: log time and offset of each message, by channel."""

    schemas: list[Schema]
    channels: list[Channel]
    messages: Counter[int]
    places: dict[int, list[tuple[int, int]]]

    def indexes(self) -> set[bytes]:
        """Return what the message indexes behind the chunk say."""
        return {encode_record(MessageIndex(*each))[RECORD.size :] for each in self.places.items()}


class RecordHead(NamedTuple):
    """What a record's head says; the length is that of its content."""

    opcode: int
    length: int


def parse_record_head(head: bytes) -> RecordHead | None:
    """Return what a record's head says it is; None when that is no record of the data section."""
    if len(head) < RECORD.size:
        return None
    opcode, length = RECORD.unpack_from(head)
    return RecordHead(opcode, length) if opcode in OPCODES and length <= RECORD_LIMIT_BYTES else None


_EXACT: dict[int, type[Header | Metadata | DataEnd]] = {
    Opcode.HEADER: Header,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
OPCODES = {*_EXACT, Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT}


def check_record(opcode: int, content: bytes) -> ChunkContents | Metadata | Attachment | DataEnd | None:
    """Return what the record says; one of DAMAGE when it does not prove itself."""
    if opcode == Opcode.CHUNK:
        _, data = decompress_chunk(memoryview(content))
        return _read_chunk_contents(data)
    if opcode == Opcode.ATTACHMENT:
        check_attachment(content)
        return Attachment.read(make_stream(content))
    if opcode == Opcode.MESSAGE_INDEX:
        _, entries_bytes = MESSAGE_INDEX.unpack_from(content)
        if len(content) != MESSAGE_INDEX.size + entries_bytes or entries_bytes % MESSAGE_INDEX_ENTRY.size:
            raise ValueError("a message index is damaged")
        return None
    record = _EXACT[opcode].read(make_stream(content))
    if encode_record(record)[RECORD.size :] != content or not _is_text(record):
        raise ValueError("a record is damaged")
    return None if isinstance(record, Header) else record


def _is_text(record: Header | Metadata | DataEnd) -> bool:
    """Return whether bytes can be a text: no text has a NUL, and a lost block of the disk reads as zeros."""
    if isinstance(record, Metadata):
        texts = [record.name, *record.metadata.keys(), *record.metadata.values()]
        return not any("\0" in text for text in texts)
    return True


def _read_chunk_contents(data: memoryview) -> ChunkContents:
    contents, offset = ChunkContents([], [], Counter(), {}), 0
    for opcode, record in iterate_records(data):
        if opcode == Opcode.MESSAGE:
            channel, _, time_ns, _ = MESSAGE.unpack_from(record)
            if time_ns >> 63:  # a chunk's head has signed instants, so none agrees with it: readers refuse it, too
                raise ValueError(f"a message has the instant {time_ns}, which no clock gives")
            contents.messages[channel] += 1
            contents.places.setdefault(channel, []).append((time_ns, offset))
        elif opcode == Opcode.SCHEMA:
            contents.schemas.append(Schema.read(make_stream(record)))
        elif opcode == Opcode.CHANNEL:
            contents.channels.append(Channel.read(make_stream(record)))
        else:
            raise ValueError(f"a chunk holds a record of kind {opcode}")
        offset += RECORD.size + len(record)
    return contents


# The CRC-32 of any stretch of a file, without reading the stretch each time.
#
# CRC-32 is a remainder of polynomials, so that of a stretch follows from those of the file up to its begin and up to
# its end: crc(AB) = crc(A) x^(8 |B|) + crc(B) modulo the generator (zlib's crc32_combine). Those up to every 4 KiB are
# kept; the file is read once, however many stretches are asked for.

_STEP_BYTES = 1 << 12  # a sector of today's disks
_READ_BYTES = 1 << 20  # round number; nothing was measured
_GENERATOR = 0xEDB88320  # of CRC-32, the lowest bit is the highest power
_ONE = 1 << 31


class RangeCrcs:
    """The CRCs of the stretches of `source` behind `begin`. Raises OSError when the disk does not give a byte."""

    def __init__(self, source: Source, begin: int) -> None:
        self._source = source
        self._begin = begin
        self._crcs = array("I", [0])  # of the bytes from `begin` on, up to each step

    def of(self, begin: int, end: int) -> int:
        """The CRC-32 of the bytes [begin, end) of the file."""
        return self._compute_up_to(end) ^ _multiply(_compute_power_of_bytes(end - begin), self._compute_up_to(begin))

    def _compute_up_to(self, place: int) -> int:
        step, rest_bytes = divmod(place - self._begin, _STEP_BYTES)
        while len(self._crcs) <= step:
            self._read_on()
        return zlib.crc32(self._source.read(place - rest_bytes, rest_bytes), self._crcs[step])

    def _read_on(self) -> None:
        place = self._begin + (len(self._crcs) - 1) * _STEP_BYTES
        data = memoryview(self._source.read(place, _READ_BYTES))
        for step in range(0, max(1, len(data)), _STEP_BYTES):
            self._crcs.append(zlib.crc32(data[step : step + _STEP_BYTES], self._crcs[-1]))


def _compute_power_of_bytes(count: int) -> int:
    """x to the power of 8 `count`, modulo the generator."""
    power, place = _ONE, 0
    while count:
        power = _multiply(_compute_power(place, count & 0xFF), power)
        count, place = count >> 8, place + 1
    return power


@cache
def _compute_power(place: int, digit: int) -> int:
    """x to the power of 8 `digit` 256**place."""
    power = _ONE >> 8 if place == 0 else _compute_power(place - 1, 128)  # of one
    power = power if place == 0 else _multiply(power, power)
    product = _ONE
    while digit:
        if digit & 1:
            product = _multiply(power, product)
        power, digit = _multiply(power, power), digit >> 1
    return product


def _multiply(one: int, other: int) -> int:
    """The product of two polynomials, modulo the generator."""
    product = 0
    while one:
        if one & _ONE:
            product ^= other
        one = one << 1 & 0xFFFFFFFF
        other = other >> 1 ^ _GENERATOR if other & 1 else other >> 1
    return product


# How far the heads of records in damaged bytes are believed, so that a repair takes time in proportion to the file.
#
# To find out whether a record proves itself all of it is read. Somebody can write a file full of heads of which each
# claims all the rest. So when false claims have cost more than the file's size, the CRC that a head gives is compared
# with that of its stretch first (RangeCrcs), which reads nothing twice, and of what is compressed only
# the begin is inflated. When even so false claims have cost many times the size, nothing more is believed: the damaged
# place goes to the end of the file, and the repair keeps the original.

# Beyond it and the size of the file a claim is believed only where a CRC or a good begin speaks for it, so that a file
# made to claim many records takes time in proportion to its size.
_FREE_BYTES = 1 << 24  # more than what any damage of a disk makes false in a small file
_LIMIT_BYTES, _LIMIT_FACTOR = 1 << 28, 16
_SMALL_BYTES = 1 << 13  # of a record that are read in any case, where no CRC can be compared


class ScanBudget:
    """About the claims in one file."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._false_bytes = 0
        self._crcs: RangeCrcs | None = None

    def charge(self, size_bytes: int) -> None:
        """Charge the budget with bytes that were read, or inflated, for a claim that was false."""
        self._false_bytes += size_bytes

    def allows(self, offset: int, claim: RecordHead, chunk: ChunkHead | None) -> bool:
        """Return whether the record at `offset` may be read within the scan budget; `chunk` is its head when it is
        one."""
        if self._false_bytes <= self._source.size + _FREE_BYTES:
            return True
        if self._false_bytes > _LIMIT_FACTOR * self._source.size + _LIMIT_BYTES:
            return False
        begin, end = offset + RECORD.size, offset + RECORD.size + claim.length
        if chunk is not None and chunk.compression:
            return _is_compressed_start(
                self._source.read(begin + chunk.begin, min(_SMALL_BYTES, end - begin - chunk.begin))
            )
        if chunk is not None:
            return self._compute_crc(begin + chunk.begin, end) == chunk.crc
        if claim.opcode == Opcode.ATTACHMENT and claim.length >= CRC.size:
            crc = self._source.read(end - CRC.size, CRC.size)
            return CRC.pack(self._compute_crc(begin, end - CRC.size)) == crc
        return claim.length <= _SMALL_BYTES

    def _compute_crc(self, begin: int, end: int) -> int:
        if self._crcs is None:
            self._crcs = RangeCrcs(self._source, begin)
        return self._crcs.of(begin, end)


def _is_compressed_start(data: bytes) -> bool:
    """Return whether that can be the begin of a compressed chunk."""
    try:
        zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except zstandard.ZstdError:
        return False
    return True


# Sound chunks that are not of their place: a disk has written a sector to the wrong one, with whole chunks in it.
#
# Such a sector begins and ends somewhere in other chunks, so it stands between two damages. What it holds stands in the
# file once more, or is of another session, and so of another time than what is around it.

SECTOR_BYTES = 4096  # the largest of today's disks
APART_NS = 10 * NS_PER_S
"""Chunks are in the order in which they were published, but for what was seconds late. Sessions that lie closer
together than this, as those in virtual time may, are not distinguished."""


class Span(NamedTuple):
    """Bytes [begin, end) of a file."""

    begin: int
    end: int


class PlacedChunk(NamedTuple):
    """A sound chunk, where it begins, and how many messages of each channel it has."""

    begin: int
    head: ChunkHead
    messages: Counter[int]


def find_misplaced_chunks(chunks: Sequence[PlacedChunk], damages: Sequence[Span]) -> list[Span]:
    """Find where such sectors are: from the begin of the damage before to the end of the one behind."""
    near = [pair for pair in pairwise(damages) if pair[1].begin - pair[0].end <= SECTOR_BYTES]
    if not near:
        return []
    ends = [before.end for before, _ in near]
    inside: list[list[PlacedChunk]] = [[] for _ in near]
    trusted: list[PlacedChunk] = []
    for chunk in chunks:
        index = bisect(ends, chunk.begin) - 1
        is_between = index >= 0 and chunk.begin < near[index][1].begin
        (inside[index] if is_between else trusted).append(chunk)
    begins = [chunk.begin for chunk in trusted]
    since_ns = [-inf, *accumulate((chunk.head.first_ns for chunk in trusted), max)]
    until_ns = [inf, *accumulate((chunk.head.last_ns for chunk in reversed(trusted)), min)][::-1]
    copies = Counter(chunk.head for chunk in chunks)

    def is_misplaced(chunk: PlacedChunk) -> bool:
        place, head = bisect(begins, chunk.begin), chunk.head
        is_late, is_early = head.first_ns > until_ns[place] + APART_NS, head.last_ns < since_ns[place] - APART_NS
        return copies[head] > 1 or is_late or is_early

    return [
        Span(before.begin, after.end)
        for (before, after), found in zip(near, inside, strict=True)
        if any(map(is_misplaced, found))
    ]


# Whether the damaged end of a file is the one block that was being written when the power went, or more than that.
#
# A block is what is written at once and acknowledged when it is on the disk: the opening of a segment, or a chunk and
# the message indexes behind it. What an interrupted write leaves is the beginning of a block, then zeros or nothing. A
# whole block was acknowledged, so damage that is longer than a block is a loss. Of a block of which nothing was written
# the length is not known: it may be a quarter longer than any before.

# Too small, the end of a power cut counts as a loss; too large, a loss of up to so many bytes counts as an unfinished
# write.
FIRST_BLOCK_BYTES = 1 << 14  # more than an opening, or a second's telemetry with its schemas, usually is


class BlockLengths:
    """How long the blocks of a segment are, as far as it has been read."""

    def __init__(self) -> None:
        self._count = 0
        self._end = 0  # of the last one
        self._largest_bytes = FIRST_BLOCK_BYTES
        self._largest_index_bytes = 0

    def note(self, begin: int, chunk_end: int, messages: Counter[int]) -> None:
        """The block of the sound chunk [begin, chunk_end), with so many messages of each channel."""
        self._count += 1
        index_bytes = _compute_index_bytes(messages)
        self._end = chunk_end + index_bytes
        known_bytes = self._largest_bytes if self._count > 2 else 0  # the first is longer, for it holds the schemas
        self._largest_bytes = max(known_bytes, self._end - begin)
        self._largest_index_bytes = max(self._largest_index_bytes, index_bytes)

    def is_partial_write(self, source: Source, begin: int) -> bool:
        """Return whether the bytes from `begin` to the end of the file, which prove nothing, were never
        acknowledged."""
        written_end = _find_last_written(source, begin)
        head = source.read(begin, RECORD.size)
        return _is_begun(head, begin, written_end) and source.size <= self._find_latest_end(head, begin, written_end)

    def _find_latest_end(self, head: bytes, begin: int, written_end: int) -> int:
        """Return where the block with the damage at `begin` ends at the latest."""
        if begin < self._end:  # in the message indexes of the last one
            return self._end
        claim = parse_record_head(head)
        claimed_bytes = 0 if claim is None else self._compute_block_bytes(claim)
        if written_end < begin + RECORD.size:  # the zeros may be the length's own
            return begin + max(claimed_bytes, self._largest_bytes * 5 // 4)  # frames are of almost one size
        return begin + claimed_bytes

    def _compute_block_bytes(self, claim: RecordHead) -> int:
        """The size of the block that begins with that record."""
        is_known = claim.opcode == Opcode.CHUNK and self._count > 0
        rest_bytes = self._largest_index_bytes if is_known else FIRST_BLOCK_BYTES
        return RECORD.size + claim.length + rest_bytes


def _is_begun(head: bytes, begin: int, written_end: int) -> bool:
    """Return whether a record begins there and is cut where the zeros begin."""
    written = head[: written_end - begin]
    if begin == 0:
        return MCAP0_MAGIC.startswith(written)
    if len(written) < RECORD.size:
        return not written or written[0] in OPCODES
    claim = parse_record_head(head)
    return claim is not None and written_end < begin + RECORD.size + claim.length


def _compute_index_bytes(messages: Counter[int]) -> int:
    """The size of the message indexes behind a chunk."""
    head_bytes = RECORD.size + MESSAGE_INDEX.size
    return sum(head_bytes + MESSAGE_INDEX_ENTRY.size * count for count in messages.values())


def _find_last_written(source: Source, begin: int) -> int:
    """Return where the zeros begin that fill the end of the file."""
    end = source.size
    while end > begin:
        window = max(begin, end - WINDOW_BYTES)
        if source.next_data(window) < end and (data := source.read(window, end - window).rstrip(b"\0")):
            return window + len(data)
        end = window
    return begin


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


@dataclass
class SegmentScan:
    """What of a segment proves itself.

    `session`: the metadata record of that name, None when it is gone or (`is_session_wrong`) does not fit its CRC.
    `is_opening_whole`: nothing is damaged before the first chunk. `messages`: how many there are, by channel number.
    `damages`: the places that are damaged; neither `partial_write_bytes` at the end of the file, where a block was
    being written, nor a damaged index is among them.
    """

    session: dict[str, str] | None = None
    is_session_wrong: bool = False
    attachments: dict[str, Attachment] = field(default_factory=dict[str, Attachment])
    schemas: dict[int, Schema] = field(default_factory=dict[int, Schema])
    channels: dict[int, Channel] = field(default_factory=dict[int, Channel])
    chunks: list[SoundChunk] = field(default_factory=list[SoundChunk])
    messages: Counter[int] = field(default_factory=Counter[int])
    damages: list[Span] = field(default_factory=list[Span])
    partial_write_bytes: int = 0
    is_opening_whole: bool = False

    @property
    def lost_bytes(self) -> int:
        """The size of all damaged places."""
        return sum(gap.end - gap.begin for gap in self.damages)


def _no_report(read_bytes: int) -> None:
    """Show no progress."""


def scan_segment(
    source: Source, to_first_chunk: bool = False, report: Callable[[int], None] = _no_report
) -> SegmentScan:
    """Walk through the file, or only until its first sound chunk; `report` gets the number of bytes read so far."""
    walk = _SegmentScanner(source, report)
    walk.run(to_first_chunk)
    return walk.found


def read_stored_messages(source: Source, place: SoundChunk) -> Iterator[StoredMessage]:
    """The messages of a sound chunk in their order; OSError when the disk does not give the same bytes again."""
    try:
        _, content = decompress_chunk(memoryview(source.read(*place)))
    except DAMAGE as error:
        raise OSError(errno.EIO, f"{os.strerror(errno.EIO)}: it reads differently each time") from error
    for opcode, record in iterate_records(content):
        if opcode == Opcode.MESSAGE:
            channel, sequence, log_time_ns, publish_time_ns = MESSAGE.unpack_from(record)
            yield StoredMessage(channel, sequence, log_time_ns, publish_time_ns, bytes(record[MESSAGE.size :]))


class _CheckedRecord(NamedTuple):
    """A record that proved itself; `content` where it matters to the survey, `chunk` of a chunk."""

    begin: int
    end: int
    content: ChunkContents | Metadata | Attachment | DataEnd | None
    chunk: ChunkHead | None = None


class _SegmentScanner:
    """The walk through one file."""

    def __init__(self, source: Source, report: Callable[[int], None]) -> None:
        self.found = SegmentScan()
        self._source = source
        self._report = report
        self._budget = ScanBudget(source)
        self._blocks = BlockLengths()
        self._index_begin: int | None = None
        self._sound_attachments: dict[str, Attachment] = {}  # those before the first damage
        self._placed: list[PlacedChunk] = []
        self._indexes: set[bytes] = set()  # those that belong behind the last chunk

    def run(self, to_first_chunk: bool) -> None:
        offset = 0
        while offset < self._source.size and not (to_first_chunk and self.found.chunks):
            record = self._read_record(offset)
            if record is None:
                record = self._find_next_record(offset)
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
        partial = [Span(size - found.partial_write_bytes, size)] if found.partial_write_bytes else []
        for wrong in find_misplaced_chunks(self._placed, [*found.damages, *partial]):
            for chunk in self._placed:
                if wrong.begin <= chunk.begin < wrong.end:
                    found.messages = found.messages - chunk.messages
            found.chunks = [chunk for chunk in found.chunks if not wrong.begin <= chunk.offset < wrong.end]
            begin = min([wrong.begin, *(gap.begin for gap in found.damages if wrong.begin <= gap.end <= wrong.end)])
            found.damages = [gap for gap in found.damages if not begin <= gap.begin < wrong.end]
            found.damages.append(Span(begin, wrong.end))
            found.damages.sort()
            found.partial_write_bytes = 0 if wrong.end == size else found.partial_write_bytes

    def _read_record(self, offset: int) -> _CheckedRecord | None:
        """The record that begins there, None when nothing there proves itself."""
        if offset == 0:
            is_magic = self._source.read(0, len(MCAP0_MAGIC)) == MCAP0_MAGIC
            return _CheckedRecord(0, len(MCAP0_MAGIC), None) if is_magic else None
        head = self._source.read(offset, _HEAD_BYTES)
        claim = parse_record_head(head)
        if claim is None or offset + RECORD.size + claim.length > self._source.size:
            return None
        cost_bytes = 0
        try:
            chunk = parse_chunk_head(head[RECORD.size :], claim.length) if claim.opcode == Opcode.CHUNK else None
            if not self._budget.allows(offset, claim, chunk):
                return None
            cost_bytes = max(claim.length, chunk.size_bytes if chunk else 0)
            data = self._source.read(offset + RECORD.size, claim.length)
            content = check_record(claim.opcode, data)
            if claim.opcode == Opcode.MESSAGE_INDEX and data not in self._indexes:
                raise ValueError("a message index is not that of its chunk")
        except DAMAGE as error:
            if isinstance(error, OSError):
                raise
            self._budget.charge(cost_bytes)
            return None
        return _CheckedRecord(offset, offset + RECORD.size + claim.length, content, chunk)

    def _find_next_record(self, offset: int) -> _CheckedRecord | None:
        """The first sound record behind the damaged one at `offset`."""
        pattern = _AFTER_OPENING if self.found.is_opening_whole else _IN_OPENING
        candidates = self._iterate_candidates(offset + 1, pattern)
        return next((record for place in candidates if (record := self._read_record(place))), None)

    def _iterate_candidates(self, begin: int, pattern: re.Pattern[bytes]) -> Iterator[int]:
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
        if gap.end == self._source.size and self._blocks.is_partial_write(self._source, gap.begin):
            self.found.partial_write_bytes = gap.end - gap.begin
        else:
            if not self.found.damages:
                self._sound_attachments = dict(self.found.attachments)
            self.found.damages.append(gap)

    def _is_table(self, begin: int) -> bool:
        """Return whether the table of frames begins there, behind the last of them, which is made again."""
        head = self._source.read(begin, len(_TABLE_HEAD) + RECORD.size)
        return head[:1] == _TABLE_HEAD[:1] and head[RECORD.size + 16 :].startswith(_TABLE_HEAD[1:])

    def _take(self, record: _CheckedRecord) -> None:
        found = self.found
        match record.content:
            case ChunkContents(schemas, channels, messages) as contents:
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
                if found.session is not None and is_contradicting(entries, found.session):
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
            for opcode, record in iterate_records(summary.content):
                if opcode == Opcode.SCHEMA:
                    schema = Schema.read(make_stream(record))
                    self.found.schemas[schema.id] = schema
                elif opcode == Opcode.CHANNEL:
                    channel = Channel.read(make_stream(record))
                    self.found.channels[channel.id] = channel
        except DAMAGE:
            return False
        return True
