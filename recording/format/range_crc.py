"""The CRC-32 of any stretch of a file, without reading the stretch each time.

CRC-32 is a remainder of polynomials, so that of a stretch follows from those of the file up to its begin and up to its
end: crc(AB) = crc(A) x^(8 |B|) + crc(B) modulo the generator (zlib's crc32_combine). Those up to every 4 KiB are kept;
the file is read once, however many stretches are asked for.
"""

from __future__ import annotations

import zlib
from array import array
from functools import cache

from thermostand.recording.format.mcap_bytes import Source

_STEP_BYTES = 1 << 12
_READ_BYTES = 1 << 20
_GENERATOR = 0xEDB88320  # of CRC-32, the lowest bit is the highest power
_ONE = 1 << 31


class RangeCrcs:
    """Of the stretches of `source` behind `begin`. Raises OSError when the disk does not give a byte."""

    def __init__(self, source: Source, begin: int) -> None:
        self._source = source
        self._begin = begin
        self._crcs = array("I", [0])  # of the bytes from `begin` on, up to each step

    def of(self, begin: int, end: int) -> int:
        """The CRC-32 of the bytes [begin, end) of the file."""
        return self._up_to(end) ^ _times(_power_of_bytes(end - begin), self._up_to(begin))

    def _up_to(self, place: int) -> int:
        step, rest_bytes = divmod(place - self._begin, _STEP_BYTES)
        while len(self._crcs) <= step:
            self._read_on()
        return zlib.crc32(self._source.read(place - rest_bytes, rest_bytes), self._crcs[step])

    def _read_on(self) -> None:
        place = self._begin + (len(self._crcs) - 1) * _STEP_BYTES
        data = memoryview(self._source.read(place, _READ_BYTES))
        for step in range(0, max(1, len(data)), _STEP_BYTES):
            self._crcs.append(zlib.crc32(data[step : step + _STEP_BYTES], self._crcs[-1]))


def _power_of_bytes(count: int) -> int:
    """x to the power of 8 `count`, modulo the generator."""
    power, place = _ONE, 0
    while count:
        power = _times(_power(place, count & 0xFF), power)
        count, place = count >> 8, place + 1
    return power


@cache
def _power(place: int, digit: int) -> int:
    """x to the power of 8 `digit` 256**place."""
    power = _ONE >> 8 if place == 0 else _power(place - 1, 128)  # of one
    power = power if place == 0 else _times(power, power)
    product = _ONE
    while digit:
        if digit & 1:
            product = _times(power, product)
        power, digit = _times(power, power), digit >> 1
    return product


def _times(one: int, other: int) -> int:
    """The product of two polynomials, modulo the generator."""
    product = 0
    while one:
        if one & _ONE:
            product ^= other
        one = one << 1 & 0xFFFFFFFF
        other = other >> 1 ^ _GENERATOR if other & 1 else other >> 1
    return product
