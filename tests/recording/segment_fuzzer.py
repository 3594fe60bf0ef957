"""Segments broken in every way: as bytes, and record by record with offsets, sizes and CRCs made right again."""

import struct
import zlib
from dataclasses import dataclass
from random import Random

import zstandard
from mcap.opcode import Opcode
from mcap.writer import MCAP0_MAGIC

OPCODES = tuple(Opcode)
EXTREMES = (0, 1, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, 2**63, 2**64 - 1)
RECORD = struct.Struct("<BQ")
CHUNK = struct.Struct("<QQQII")  # first and last log time, uncompressed size, CRC, length of the compression's name
CHUNK_PLACE = struct.Struct("<QQ")  # offset, length; in a chunk index behind the two log times
CODECS = {b"": (bytes, bytes), b"zstd": (zstandard.compress, zstandard.decompress)}


@dataclass
class Record:
    """A record; of a chunk `content` is the part before its records."""

    opcode: int
    content: bytes
    inner: list["Record"] | None = None


def flip_bit(rng, data):
    index = rng.randrange(len(data))
    data[index] ^= 1 << rng.randrange(8)


def set_byte(rng, data):
    data[rng.randrange(len(data))] = rng.choice((0, 1, 0x7F, 0x80, 0xFF, rng.randrange(256)))


def set_number(rng, data):
    """Four or eight bytes become an extreme number, as a length, offset or time would be."""
    number = rng.choice(EXTREMES)
    encoded = number.to_bytes(8, "little")[: rng.choice((4, 8))]
    index = rng.randrange(len(data))
    data[index : index + len(encoded)] = encoded[: len(data) - index]


def cut(rng, data):
    del data[rng.randrange(len(data)) :]


def remove_range(rng, data):
    begin, end = sorted(rng.randrange(len(data) + 1) for _ in range(2))
    del data[begin : min(end, begin + rng.choice((1, 8, 64, len(data))))]


def repeat_range(rng, data):
    begin = rng.randrange(len(data))
    part = data[begin : begin + rng.choice((1, 8, 64, len(data)))]
    index = rng.choice((begin, rng.randrange(len(data))))
    data[index:index] = part


def overwrite_range(rng, data):
    begin, index = rng.randrange(len(data)), rng.randrange(len(data))
    part = data[begin : begin + rng.choice((8, 64, 512))]
    data[index : index + len(part)] = part


def zero_range(rng, data):
    begin = rng.randrange(len(data))
    length = min(rng.choice((8, 64, 512, 4096)), len(data) - begin)
    data[begin : begin + length] = bytes(length)


BYTE_MUTATIONS = (
    flip_bit,
    flip_bit,
    set_byte,
    set_number,
    set_number,
    cut,
    remove_range,
    repeat_range,
    overwrite_range,
    zero_range,
)


def mutate_bytes(rng, data):
    """`data` with one to three mutations."""
    mutated = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 3))):
        if mutated:
            rng.choice(BYTE_MUTATIONS)(rng, mutated)
    return bytes(mutated)


def mutate_field(rng, data):
    """A record's opcode or length, or the name or size of a chunk's compression, becomes another."""
    mutated = bytearray(data)
    offset, record = rng.choice(list(places(data)))
    if record.opcode == Opcode.CHUNK and rng.random() < 0.6:
        at = offset + RECORD.size + rng.choice((0, 8, 16, 24, 28, 32, 36))
        encoded = rng.choice(EXTREMES).to_bytes(8, "little")[: rng.choice((4, 8))]
    elif rng.random() < 0.5:
        at, encoded = offset, bytes([rng.choice((0, *OPCODES, 0x80, 0xFF))])
    else:
        length = rng.choice((*EXTREMES, len(record.content) - 1, len(record.content) + 1))
        at, encoded = offset + 1, (length % 2**64).to_bytes(8, "little")
    mutated[at : at + len(encoded)] = encoded
    return bytes(mutated)


def mutate_order(rng, data):
    """Whole records removed, repeated, swapped, or put in each other's place."""
    spans = [(offset, offset + RECORD.size + len(record.content)) for offset, record in places(data)]
    (a, b), (c, d) = sorted(rng.sample(spans, 2))
    change = rng.randrange(4)
    if change == 0:
        return data[:a] + data[b:]
    if change == 1:
        return data[:c] + data[a:b] + data[c:]
    if change == 2:
        return data[:a] + data[c:d] + data[b:c] + data[a:b] + data[d:]
    return data[:a] + data[c:d].ljust(b - a, b"\0")[: b - a] + data[b:]


def places(data):
    """(offset, record) of every record of a sound segment."""
    offset = len(MCAP0_MAGIC)
    while offset < len(data) - len(MCAP0_MAGIC):
        opcode, length = RECORD.unpack_from(data, offset)
        end = offset + RECORD.size + length
        yield offset, Record(opcode, data[offset + RECORD.size : end])
        offset = end


def take_apart(data):
    """The records of a sound segment, those of its chunks inside them."""
    return [_open_chunk(record) if record.opcode == Opcode.CHUNK else record for _, record in places(data)]


def _open_chunk(chunk):
    _, _, _, _, length = CHUNK.unpack_from(chunk.content)
    name = chunk.content[CHUNK.size : CHUNK.size + length]
    body = CODECS[name][1](chunk.content[CHUNK.size + length + 8 :])
    wrapped = MCAP0_MAGIC + body + MCAP0_MAGIC
    inner = [record for _, record in places(wrapped)]
    return Record(chunk.opcode, chunk.content[: CHUNK.size + length], inner)


def put_together(records):
    """The segment of these records: sizes, offsets and CRCs as a writer would have made them."""
    out = bytearray(MCAP0_MAGIC)
    chunks, summary_begin = [], None
    for record in records:
        if record.opcode == Opcode.FOOTER:
            footer = RECORD.pack(Opcode.FOOTER, 20) + struct.pack("<QQ", summary_begin or len(out), 0)
            out += footer + struct.pack("<I", zlib.crc32(out[summary_begin or len(out) :] + footer))
            continue
        content = record.content
        if record.inner is not None:
            content = _close_chunk(record)
            chunks.append((len(out), RECORD.size + len(content)))
        elif record.opcode == Opcode.ATTACHMENT:
            content = content[:-4] + struct.pack("<I", zlib.crc32(content[:-4]))
        elif record.opcode == Opcode.CHUNK_INDEX and chunks and len(content) >= 32:
            content = content[:16] + CHUNK_PLACE.pack(*chunks.pop(0)) + content[32:]
        out += RECORD.pack(record.opcode, len(content)) + content
        if record.opcode == Opcode.DATA_END:
            summary_begin = len(out)
    return bytes(out + MCAP0_MAGIC)


def _close_chunk(chunk):
    body = b"".join(RECORD.pack(record.opcode, len(record.content)) + record.content for record in chunk.inner)
    first_ns, last_ns, _, _, length = CHUNK.unpack_from(chunk.content)
    name = chunk.content[CHUNK.size : CHUNK.size + length]
    packed = CODECS[name][0](body)
    head = CHUNK.pack(first_ns, last_ns, len(body), zlib.crc32(body), length) + name
    return head + len(packed).to_bytes(8, "little") + packed


def mutate_inside(rng: Random, data):
    """One or two records inside, changed or moved about, in a file whose sizes, offsets and CRCs are right."""
    records = take_apart(data)
    for _ in range(rng.choice((1, 1, 2))):
        lists = [records] + 4 * [record.inner for record in records if record.inner]
        chosen = rng.choice(lists)
        index = rng.randrange(len(chosen))
        change = rng.random()
        if change < 0.75:
            _mutate_content(rng, chosen[index])
        elif change < 0.83:
            del chosen[index]
        elif change < 0.91:
            chosen.insert(rng.randrange(len(chosen) + 1), chosen[index])
        else:
            other = rng.choice(chosen)
            chosen[index] = Record(rng.choice(OPCODES), other.content, other.inner)
        if not chosen:
            break
    return put_together(records)


def _mutate_content(rng, record):
    if record.opcode == Opcode.MESSAGE and rng.random() < 0.8:  # the message itself
        record.content = record.content[:22] + mutate_bytes(rng, record.content[22:])
    elif record.inner is None:
        record.content = mutate_bytes(rng, record.content)
    else:  # the log times; the rest of a chunk's head is made right again
        times = mutate_bytes(rng, record.content[:16]).ljust(16, b"\0")[:16]
        record.content = times + record.content[16:]
