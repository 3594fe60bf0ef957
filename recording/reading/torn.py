"""Whether the damaged end of a file is the one block that was being written when the power went, or more than that.

A block is what is written at once and acknowledged when it is on the disk: the opening of a segment, or a chunk and
the message indexes behind it. What an interrupted write leaves is the beginning of a block, then zeros or nothing. A
whole block was acknowledged, so damage that is longer than a block is a loss. Of a block of which nothing was written
the length is not known: it may be a quarter longer than any before.
"""

from __future__ import annotations

from collections import Counter

from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

from thermostand.recording.format.mcap_bytes import MESSAGE_INDEX, MESSAGE_INDEX_ENTRY, RECORD, Source
from thermostand.recording.format.proof import OPCODES, Claim, claim_of

FIRST_BLOCK_BYTES = 1 << 14  # more than an opening, or a second's telemetry with its schemas, usually is
_WINDOW_BYTES = 4 << 20


class Blocks:
    """How long the blocks of a segment are, as far as it has been read."""

    def __init__(self) -> None:
        self._count = 0
        self._end = 0  # of the last one
        self._largest_bytes = FIRST_BLOCK_BYTES
        self._largest_index_bytes = _index_bytes(Counter((0,)))

    def note(self, begin: int, chunk_end: int, messages: Counter[int]) -> None:
        """The block of the sound chunk [begin, chunk_end), with so many messages of each channel."""
        self._count += 1
        index_bytes = _index_bytes(messages)
        self._end = chunk_end + index_bytes
        known_bytes = self._largest_bytes if self._count > 2 else 0  # the first is longer, for it holds the schemas
        self._largest_bytes = max(known_bytes, self._end - begin)
        self._largest_index_bytes = max(self._largest_index_bytes, index_bytes)

    def is_torn(self, source: Source, begin: int) -> bool:
        """Whether the bytes from `begin` to the end of the file, which prove nothing, were never acknowledged."""
        written_end = _last_written(source, begin)
        head = source.read(begin, RECORD.size)
        return _is_begun(head, begin, written_end) and source.size <= self._latest_end(head, begin, written_end)

    def _latest_end(self, head: bytes, begin: int, written_end: int) -> int:
        """Where the block with the damage at `begin` ends at the latest."""
        if begin < self._end:  # in the message indexes of the last one
            return self._end
        claim = claim_of(head)
        claimed_bytes = 0 if claim is None else self._claimed_bytes(claim)
        if written_end < begin + RECORD.size:  # the zeros may be the length's own
            return begin + max(claimed_bytes, self._largest_bytes * 5 // 4)  # frames are of almost one size
        return begin + claimed_bytes

    def _claimed_bytes(self, claim: Claim) -> int:
        """The size of the block that begins with that record."""
        rest_bytes = self._largest_index_bytes if claim.opcode == Opcode.CHUNK else FIRST_BLOCK_BYTES
        return RECORD.size + claim.length + rest_bytes


def _is_begun(head: bytes, begin: int, written_end: int) -> bool:
    """Whether a record begins there and is cut where the zeros begin."""
    written = head[: written_end - begin]
    if begin == 0:
        return MCAP0_MAGIC.startswith(written)
    if len(written) < RECORD.size:
        return not written or written[0] in OPCODES
    claim = claim_of(head)
    return claim is not None and written_end < begin + RECORD.size + claim.length


def _index_bytes(messages: Counter[int]) -> int:
    """The size of the message indexes behind a chunk."""
    head_bytes = RECORD.size + MESSAGE_INDEX.size
    return sum(head_bytes + MESSAGE_INDEX_ENTRY.size * count for count in messages.values())


def _last_written(source: Source, begin: int) -> int:
    """Where the zeros begin that fill the end of the file."""
    end = source.size
    while end > begin:
        window = max(begin, end - _WINDOW_BYTES)
        if source.next_data(window) < end and (data := source.read(window, end - window).rstrip(b"\0")):
            return window + len(data)
        end = window
    return begin
