"""Deflate streams that consist of Huffman codes alone (RFC 1951), two or three codes at a time.

The recorder writes PNGs without matches, since noise has no repeats to find (recording/format/images.py). For such a
stream a look at the next `_INDEX_BITS` bits tells all the codes that end within them, so that it takes
three quarters of the time of a general decoder. A stream with matches or stored blocks, or a damaged one, ends with
UNFIT: libdeflate then reads it, or says what is wrong.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.compiled import compiled

Words = NDArray[np.uint64]
Bytes = NDArray[np.uint8]
Places = NDArray[np.int64]

UNFIT = -1
_LITERALS_OF_ENTRY = 4
_LOOKS = 5  # in a word of 64 bits, so that a code of 15 is left whole
MOST_AT_ONCE = _LOOKS * _LITERALS_OF_ENTRY + 1
"""Bytes that a word can give; what `inflate` writes to has room for so many beyond the wanted size."""

_INDEX_BITS = 10
_ENTRIES = 1 << _INDEX_BITS
_LONGEST_CODE = 15
_LITERALS, _END = 256, 256
_CODES = 288
_DYNAMIC, _FIXED = 2, 1
_EMPTY_STORED = 0xFFFF0000
"""Length and its complement (3.2.4)."""
_ORDER = np.array([16, 17, 18, 0, 8, 7, 9, 6, 10, 5, 11, 4, 12, 3, 13, 2, 14, 1, 15])
"""In which the lengths of the codes for code lengths are written (3.2.7)."""

_AT, _IN_BLOCK, _IS_LAST, _LONGEST, _FIRST_BEYOND, _PLACE_BEYOND = range(6)
_TURNED = np.array([int(f"{index:0{_INDEX_BITS}b}"[::-1], 2) for index in range(_ENTRIES)], np.uint32)

# An entry of the table: the bits that it uses (6), then up to 4 bytes from bit 8 on, and their number. Without bytes
# the next code is longer than the index, ends the block or begins a match.
_BITS_MASK, _COUNT_SHIFT = np.uint64(63), np.uint64(40)
_NONE, _ONE, _BYTE, _INDEX_MASK = np.uint64(0), np.uint64(1), np.uint64(255), np.uint64(_ENTRIES - 1)


class Stream(NamedTuple):
    """A deflate stream that is being read. words: its bytes, little endian, and at least two words more. state (6,):
    the next bit, whether it is within a block, whether that is the last one, the longest code; the first code longer
    than the index, and its place in `symbols`. table (1024,): see above. single (1024,): 16 * symbol + bits of the code
    that begins the index, 0 for a longer one. lengths (320,) of the codes of all symbols; symbols (288,) in the order
    of their codes; counts (16,) of the codes of each length."""

    words: Words
    end_bit: int
    state: NDArray[np.int64]
    table: Words
    single: NDArray[np.uint32]
    lengths: NDArray[np.int32]
    symbols: NDArray[np.int32]
    counts: NDArray[np.int32]


@compiled
def opened(words: Words, begin_bit: int, end_bit: int) -> Stream:
    """The stream of these bits of `words`."""
    state = np.zeros(6, np.int64)
    state[_AT] = begin_bit
    return Stream(
        words, end_bit, state, np.empty(_ENTRIES, np.uint64), np.empty(_ENTRIES, np.uint32),
        np.zeros(320, np.int32), np.zeros(_CODES, np.int32), np.zeros(_LONGEST_CODE + 1, np.int32),
    )  # fmt: skip


@compiled
def inflate(stream: Stream, out: Bytes, begin: int, wanted: int) -> int:
    """Write bytes into `out` from `begin` on until `wanted` of it are written, or a few more; the number that is
    written then, less at the end of the stream, UNFIT when it cannot be read here."""
    words, state, table = stream.words, stream.state, stream.table
    done, end = np.uint64(begin), np.uint64(wanted)  # unsigned: an index that may be negative is checked each time
    while done < end:
        if not state[_IN_BLOCK]:
            if state[_IS_LAST]:
                return int(done)
            if not _begin_block(stream):
                return UNFIT
        at = np.uint64(state[_AT])
        while done < end:
            if at > np.uint64(stream.end_bit):
                return UNFIT
            bits = _word(words, at)
            count = _ONE
            for _ in range(_LOOKS):
                entry = table[bits & _INDEX_MASK]
                bits >>= entry & _BITS_MASK
                at += entry & _BITS_MASK
                out[done] = (entry >> np.uint64(8)) & _BYTE
                out[done + _ONE] = (entry >> np.uint64(16)) & _BYTE
                out[done + np.uint64(2)] = (entry >> np.uint64(24)) & _BYTE
                out[done + np.uint64(3)] = (entry >> np.uint64(32)) & _BYTE
                count = entry >> _COUNT_SHIFT
                done += count
                if count == _NONE or done >= end:
                    break
            if count != _NONE:
                continue
            symbol, length = _symbol_beyond(stream, bits)
            at += np.uint64(length)
            if symbol < 0 or symbol > _END:
                return UNFIT
            if symbol == _END:
                state[_IN_BLOCK] = 0
                break
            out[done] = symbol
            done += _ONE
        state[_AT] = np.int64(at)
    return int(done)


@compiled
def inflate_two(one: Stream, other: Stream, out: Bytes, begins: Places, wanted: int) -> bool:
    """The same for two streams and the rows of `out` (2, ...), in place of `begins` (2,) the numbers that are written;
    False when one cannot be read here. What limits one is the chain from code to code, and two go on at once."""
    words, table, first = one.words, one.table, out[0]
    words_beside, table_beside, second = other.words, other.table, out[1]
    last, last_beside = np.uint64(one.end_bit), np.uint64(other.end_bit)
    done, beside, end = np.uint64(begins[0]), np.uint64(begins[1]), np.uint64(wanted)
    while done < end and beside < end:
        for stream in (one, other):
            if not stream.state[_IN_BLOCK] and (stream.state[_IS_LAST] or not _begin_block(stream)):
                return False
        at, at_beside = np.uint64(one.state[_AT]), np.uint64(other.state[_AT])
        symbol, symbol_beside = 0, 0
        while done < end and beside < end and symbol < _END and symbol_beside < _END:
            if at > last or at_beside > last_beside:
                return False
            bits, bits_beside = _word(words, at), _word(words_beside, at_beside)
            count = count_beside = _ONE
            for _ in range(_LOOKS):
                entry, entry_beside = table[bits & _INDEX_MASK], table_beside[bits_beside & _INDEX_MASK]
                bits >>= entry & _BITS_MASK
                bits_beside >>= entry_beside & _BITS_MASK
                at += entry & _BITS_MASK
                at_beside += entry_beside & _BITS_MASK
                _write(first, done, entry)
                _write(second, beside, entry_beside)
                count, count_beside = entry >> _COUNT_SHIFT, entry_beside >> _COUNT_SHIFT
                done += count
                beside += count_beside
                if count == _NONE or count_beside == _NONE:
                    break
            if count == _NONE:
                at, done, symbol = _look_beyond(one, first, at, done)
            if count_beside == _NONE:
                at_beside, beside, symbol_beside = _look_beyond(other, second, at_beside, beside)
        if symbol > _END or symbol_beside > _END:
            return False
        one.state[_AT], one.state[_IN_BLOCK] = np.int64(at), symbol != _END
        other.state[_AT], other.state[_IN_BLOCK] = np.int64(at_beside), symbol_beside != _END
    begins[0], begins[1] = inflate(one, first, int(done), wanted), inflate(other, second, int(beside), wanted)
    return min(begins[0], begins[1]) >= wanted


@compiled
def _write(out: Bytes, done: np.uint64, entry: np.uint64) -> None:
    out[done] = (entry >> np.uint64(8)) & _BYTE
    out[done + _ONE] = (entry >> np.uint64(16)) & _BYTE
    out[done + np.uint64(2)] = (entry >> np.uint64(24)) & _BYTE
    out[done + np.uint64(3)] = (entry >> np.uint64(32)) & _BYTE


@compiled
def _look_beyond(stream: Stream, out: Bytes, at: np.uint64, done: np.uint64) -> tuple[np.uint64, np.uint64, int]:
    """Write one literal whose code the table does not have: the next bit, the bytes written, and the symbol, greater
    than the end's where it cannot be read here."""
    if at > np.uint64(stream.end_bit):
        return at, done, _CODES
    symbol, length = _symbol_beyond(stream, _word(stream.words, at))
    if symbol < 0:
        return at, done, _CODES
    if symbol < _END:
        out[done] = symbol
        done += _ONE
    return at + np.uint64(length), done, symbol


@compiled
def ended(stream: Stream) -> bool:
    """Whether nothing but the end follows; the stream's next bit is then behind it."""
    state = stream.state
    while state[_IN_BLOCK] or not state[_IS_LAST]:
        if not state[_IN_BLOCK] and not _begin_block(stream):
            return False
        symbol, length = _next_symbol(stream, state[_AT])
        if symbol != _END:
            return False
        state[_AT] += length
        state[_IN_BLOCK] = 0
    return state[_AT] <= stream.end_bit


@compiled
def flushed(stream: Stream) -> bool:
    """Whether nothing but the end of the block and an empty stored one follows, as zlib's full flush writes it; what is
    behind that needs nothing that was before."""
    state = stream.state
    if state[_IN_BLOCK]:
        symbol, length = _next_symbol(stream, state[_AT])
        state[_AT] += length
        if symbol != _END:
            return False
    if state[_IS_LAST] or _taken(stream, 3) != 0:
        return False
    state[_AT] = 8 * next_byte(stream)
    return _taken(stream, 32) == _EMPTY_STORED and state[_AT] == stream.end_bit


@compiled
def next_byte(stream: Stream) -> int:
    """Where the first byte behind the last bit read is."""
    return (stream.state[_AT] + 7) // 8


@compiled
def _word(words: Words, at: np.uint64) -> np.uint64:
    """The 64 bits from bit `at` on."""
    place, shift = at >> np.uint64(6), at & np.uint64(63)
    # Shifted twice: a shift by 64 is not defined.
    return (words[place] >> shift) | ((words[place + _ONE] << (np.uint64(63) - shift)) << _ONE)


@compiled
def _taken(stream: Stream, bits: int) -> int:
    """The next so many bits as a number."""
    at = stream.state[_AT]
    stream.state[_AT] = at + bits
    if at > stream.end_bit:
        return 0  # zeros: what follows is found to be too short
    return int(_word(stream.words, np.uint64(at)) & ((_ONE << np.uint64(bits)) - _ONE))


@compiled
def _begin_block(stream: Stream) -> bool:
    """Read a block's header and make its table; False when it is stored, or its codes cannot be."""
    state, lengths = stream.state, stream.lengths
    if state[_AT] + 3 > stream.end_bit:
        return False
    state[_IS_LAST] = _taken(stream, 1)
    kind = _taken(stream, 2)
    if kind == _FIXED:
        for symbol in range(_CODES):
            lengths[symbol] = 8 if symbol < 144 else 9 if symbol < 256 else 7 if symbol < 280 else 8
    elif kind != _DYNAMIC or not _read_lengths(stream):
        return False
    state[_IN_BLOCK] = 1
    if not _order_codes(stream, _CODES):
        return False
    _fill_single(stream)
    _fill_table(stream)
    return True


@compiled
def _read_lengths(stream: Stream) -> bool:
    """The lengths of the codes of a dynamic block (3.2.7); False when they cannot be. Those of distances are read and
    not kept: there are no matches."""
    lengths = stream.lengths
    literals, distances, given = _taken(stream, 5) + 257, _taken(stream, 5) + 1, _taken(stream, 4) + 4
    for symbol in range(_CODES):
        lengths[symbol] = 0
    for place in range(given):
        lengths[_ORDER[place]] = _taken(stream, 3)
    if literals > 286 or not _order_codes(stream, 19):
        return False
    read, before = 0, 0
    while read < literals + distances:
        symbol, length = _next_symbol(stream, stream.state[_AT])
        stream.state[_AT] += length
        if symbol < 0 or stream.state[_AT] > stream.end_bit:
            return False
        if symbol < 16:
            before, times = symbol, 1
        elif symbol == 16:
            if read == 0:
                return False
            times = 3 + _taken(stream, 2)
        else:
            before, times = 0, 3 + _taken(stream, 3) if symbol == 17 else 11 + _taken(stream, 7)
        if read + times > literals + distances:
            return False
        for place in range(read, read + times):
            lengths[place] = before
        read += times
    for place in range(literals, 320):
        lengths[place] = 0
    return lengths[_END] > 0


@compiled
def _order_codes(stream: Stream, number: int) -> bool:
    """Symbols in the order of their codes (3.2.2), from the lengths of the first `number`; False when there are not
    exactly as many codes as there can be: libdeflate knows what is allowed then."""
    lengths, counts, symbols = stream.lengths, stream.counts, stream.symbols
    counts[:] = 0
    for symbol in range(number):
        counts[lengths[symbol]] += 1
    counts[0] = 0
    left, longest = 1, 0
    places = np.zeros(_LONGEST_CODE + 2, np.int32)
    for length in range(1, _LONGEST_CODE + 1):
        left = 2 * left - counts[length]
        if left < 0:
            return False
        places[length + 1] = places[length] + counts[length]
        if counts[length]:
            longest = length
    stream.state[_LONGEST] = longest
    for symbol in range(number):
        if lengths[symbol]:
            symbols[places[lengths[symbol]]] = symbol
            places[lengths[symbol]] += 1
    return left == 0


@compiled
def _next_symbol(stream: Stream, at: int) -> tuple[int, int]:
    """The symbol whose code begins at that bit, bit by bit, and the length of the code; -1 when there is none."""
    bits = _word(stream.words, np.uint64(at)) if at <= stream.end_bit else np.uint64(0)
    code, first, index = 0, 0, 0
    for length in range(1, stream.state[_LONGEST] + 1):
        code |= np.int64(bits & np.uint64(1))
        bits >>= np.uint64(1)
        count = stream.counts[length]
        if code - count < first:
            return int(stream.symbols[index + code - first]), length
        index += count
        first = (first + count) << 1
        code <<= 1
    return -1, 0


@compiled
def _symbol_beyond(stream: Stream, bits: np.uint64) -> tuple[int, int]:
    """The symbol whose code begins these bits, of which there are 15 or more, and its length, when the index does not
    give a literal; -1 when there is none."""
    index = bits & _INDEX_MASK
    one = stream.single[index]
    if one > 0:
        return int(one >> np.uint32(4)), int(one & np.uint32(15))
    state = stream.state
    code, first, place = np.int64(_TURNED[index]) << 1, state[_FIRST_BEYOND], state[_PLACE_BEYOND]
    bits >>= np.uint64(_INDEX_BITS)
    for length in range(_INDEX_BITS + 1, state[_LONGEST] + 1):
        code |= np.int64(bits & _ONE)
        bits >>= _ONE
        count = stream.counts[length]
        if code - count < first:
            return int(stream.symbols[place + code - first]), length
        place += count
        first = (first + count) << 1
        code <<= 1
    return -1, 0


@compiled
def _fill_single(stream: Stream) -> None:
    """16 * symbol + length at each index that begins with the symbol's code, whose first bit is the lowest one."""
    single, counts = stream.single, stream.counts
    for index in range(_ENTRIES):
        single[index] = 0
    code, place = 0, 0
    for length in range(1, _INDEX_BITS + 1):
        for _ in range(counts[length]):
            turned = np.int64(_TURNED[code]) >> (_INDEX_BITS - length)
            value = stream.symbols[place] << 4 | length
            for index in range(turned, _ENTRIES, 1 << length):
                single[index] = value
            code += 1
            place += 1
        code <<= 1
    stream.state[_FIRST_BEYOND], stream.state[_PLACE_BEYOND] = code, place


@compiled
def _fill_table(stream: Stream) -> None:
    """All the literals whose codes end within each index."""
    table, single = stream.table, stream.single
    for index in range(_ENTRIES):
        used, count, literals = np.uint32(0), np.uint32(0), np.uint64(0)
        for k in range(_LITERALS_OF_ENTRY):
            one = single[np.uint32(index) >> used]
            length = one & np.uint32(15)
            if length == 0 or used + length > _INDEX_BITS or one >= _LITERALS << 4:
                break
            literals |= np.uint64(one >> np.uint32(4)) << np.uint64(8 * k + 8)
            used += length
            count += np.uint32(1)
        table[index] = np.uint64(count) << _COUNT_SHIFT | literals | np.uint64(used)
