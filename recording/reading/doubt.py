"""How far the heads of records in damaged bytes are believed, so that a salvage takes time in proportion to the file.

To find out whether a record proves itself all of it is read. Somebody can write a file full of heads of which each
claims all the rest. So when false claims have cost more than the file's size, the CRC that a head gives is compared
with that of its stretch first (range_crc.py), which reads nothing twice, and of what is compressed only
the begin is inflated. When even so false claims have cost many times the size, nothing more is believed: the damaged
place goes to the end of the file, and the salvage keeps the original.
"""

from __future__ import annotations

import zstandard
from mcap.opcode import Opcode

from thermostand.recording.format.mcap_bytes import CRC, RECORD, ChunkHead, Source
from thermostand.recording.format.proof import Claim
from thermostand.recording.format.range_crc import RangeCrcs

_FREE_BYTES = 1 << 24  # more than what any damage of a disk makes false in a small file
_LIMIT_BYTES, _LIMIT_FACTOR = 1 << 28, 16
_SMALL_BYTES = 1 << 13  # of a record that are read in any case, where no CRC can be compared


class Doubt:
    """About the claims in one file."""

    def __init__(self, source: Source) -> None:
        self._source = source
        self._false_bytes = 0
        self._crcs: RangeCrcs | None = None

    def note_false(self, size_bytes: int) -> None:
        """So many bytes were read, or inflated, for a claim that was false."""
        self._false_bytes += size_bytes

    def can_be_true(self, offset: int, claim: Claim, chunk: ChunkHead | None) -> bool:
        """Whether the record at `offset` is worth being read; `chunk` is its head when it is one."""
        if self._false_bytes <= self._source.size + _FREE_BYTES:
            return True
        if self._false_bytes > _LIMIT_FACTOR * self._source.size + _LIMIT_BYTES:
            return False
        begin, end = offset + RECORD.size, offset + RECORD.size + claim.length
        if chunk is not None and chunk.compression:
            return _begins_well(self._source.read(begin + chunk.begin, min(_SMALL_BYTES, end - begin - chunk.begin)))
        if chunk is not None:
            return self._crc(begin + chunk.begin, end) == chunk.crc
        if claim.opcode == Opcode.ATTACHMENT and claim.length >= CRC.size:
            crc = self._source.read(end - CRC.size, CRC.size)
            return CRC.pack(self._crc(begin, end - CRC.size)) == crc
        return claim.length <= _SMALL_BYTES

    def _crc(self, begin: int, end: int) -> int:
        if self._crcs is None:
            self._crcs = RangeCrcs(self._source, begin)
        return self._crcs.of(begin, end)


def _begins_well(data: bytes) -> bool:
    """Whether that can be the begin of a compressed chunk."""
    try:
        zstandard.ZstdDecompressor().decompressobj().decompress(data)
    except zstandard.ZstdError:
        return False
    return True
