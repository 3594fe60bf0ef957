"""Damaged places that claim far more than they hold: a salvage takes time in proportion to the file, and finds what is
sound behind them."""

import os
import random
import zlib
from pathlib import Path

import pytest
import zstandard

from tests.recording.damage import read_segment, write_segment
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.mcap_bytes import CHUNK, LENGTH, RECORD, Source
from thermostand.recording.reading.segment_scan import RangeCrcs
from thermostand.recording.repair.salvage import salvage_session

ZSTD_HEAD = zstandard.ZstdCompressor().compress(bytes(1 << 20))[:9]
CHUNK_OPCODE, ATTACHMENT_OPCODE, METADATA_OPCODE = 6, 9, 12


class Read(Source):
    """Counts what is read."""

    read_bytes = 0

    def read(self, offset: int, length: int) -> bytes:
        data = super().read(offset, length)
        Read.read_bytes += len(data)
        return data


def chunk(length: int, name: bytes = b"", size_bytes: int | None = None) -> bytes:
    """The head of a chunk's record with so many bytes behind it; its CRC is wrong."""
    head_bytes = CHUNK.size + len(name) + LENGTH.size
    size_bytes = length - head_bytes if size_bytes is None else size_bytes
    head = CHUNK.pack(1, 2, size_bytes, 12345, len(name)) + name + LENGTH.pack(length - head_bytes)
    return RECORD.pack(CHUNK_OPCODE, length) + head


def compressed(length: int) -> bytes:
    """As `chunk`, with the head of a zstd frame of 1 MB and a block of a kind that there is not."""
    return chunk(length, b"zstd", 1 << 20) + ZSTD_HEAD + b"\xff\xff\xff"


def empty_blocks(length: int) -> bytes:
    """As `compressed`, with blocks without anything in them: all of it has to be read."""
    return chunk(length, b"zstd", 1 << 20) + ZSTD_HEAD + bytes(340)


def attachment(length: int) -> bytes:
    return RECORD.pack(ATTACHMENT_OPCODE, length) + bytes(16) + b"\x04\0\0\0name"


def session(length: int) -> bytes:
    return RECORD.pack(METADATA_OPCODE, length) + b"\x07\0\0\0session" + (length - 15).to_bytes(4, "little")


def false_heads(kind, size_bytes: int, step_bytes: int) -> bytes:
    """Heads that each claim all the rest."""
    data = bytearray(size_bytes)
    for place in range(0, size_bytes - 200, step_bytes):
        head = kind(size_bytes - place - RECORD.size)
        data[place : place + len(head)] = head
    return bytes(data)


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> type[Read]:
    monkeypatch.setattr("thermostand.recording.repair.salvage.Source", Read)
    Read.read_bytes = 0
    return Read


@pytest.mark.parametrize("kind", [chunk, compressed, attachment, session])
@pytest.mark.parametrize("place", ["at the end", "at the begin", "in the middle"])
def test_false_heads_are_read_a_few_times_and_hide_nothing(tmp_path: Path, counted: type[Read], kind, place: str):
    """With the old walk 2 MB were read 2,500 times, 5 GB; what follows them is sound."""
    write_segment(tmp_path / TELEMETRY, TELEMETRY, range(3), finish=True)
    written = write_segment(tmp_path / FRAMES, FRAMES, range(5))
    heads = false_heads(kind, 2_000_000, 400)
    begin = {"at the end": len(written.data), "at the begin": 8, "in the middle": written.blocks[2].begin}[place]
    data = written.data[:begin] + heads + written.data[begin:]
    (part,) = (tmp_path / FRAMES).glob("*.part")
    part.write_bytes(data)
    (done,) = salvage_session(tmp_path)
    assert counted.read_bytes < 10 * len(data) + 5000 * (1 << 14)
    assert done.path is not None
    assert read_segment(done.path) == written.messages


def test_what_goes_on_lying_is_given_up_and_kept(tmp_path: Path, counted: type[Read]):
    write_segment(tmp_path / TELEMETRY, TELEMETRY, range(3), finish=True)
    written = write_segment(tmp_path / FRAMES, FRAMES, range(5))
    begin = written.blocks[2].begin
    data = written.data[:begin] + false_heads(empty_blocks, 2_000_000, 400) + written.data[begin:]
    (part,) = (tmp_path / FRAMES).glob("*.part")
    part.write_bytes(data)
    (done,) = salvage_session(tmp_path)
    assert counted.read_bytes < 2 * (16 * len(data) + (1 << 28))
    assert read_segment(done.path)[:2] == written.messages[:2]
    assert done.kept is not None
    assert done.kept.read_bytes() == data


def test_a_hole_of_half_a_terabyte_is_not_read(tmp_path: Path, counted: type[Read]):
    write_segment(tmp_path / TELEMETRY, TELEMETRY, range(3), finish=True)
    written = write_segment(tmp_path / FRAMES, FRAMES, range(5))
    (part,), last = (tmp_path / FRAMES).glob("*.part"), written.blocks[4]
    size_bytes = 1 << 39
    try:
        os.truncate(part, last.begin)
        os.truncate(part, size_bytes)
        with part.open("r+b") as file:
            file.seek(1 << 38)
            file.write(written.data[last.begin : last.end])
    except OSError as error:
        pytest.skip(f"no file with so large a hole can be made here: {error}")
    (done,) = salvage_session(tmp_path)
    assert counted.read_bytes < 100_000_000
    assert done.path is not None
    assert read_segment(done.path) == written.messages


def test_the_crc_of_any_stretch_follows_from_those_of_beginnings(tmp_path: Path):
    rng = random.Random(3)
    data = rng.randbytes(70_000)
    path = tmp_path / "file"
    path.write_bytes(data)
    with path.open("rb") as file:
        crcs = RangeCrcs(Source(file.fileno()), 100)
        for begin, end in [(100, 100), (100, 101), (4196, 8292), (100, 70_000), (69_999, 70_000), (70_000, 70_000)]:
            assert crcs.of(begin, end) == zlib.crc32(data[begin:end])
        for _ in range(200):
            begin, end = sorted(rng.randint(100, len(data)) for _ in range(2))
            assert crcs.of(begin, end) == zlib.crc32(data[begin:end])


def crc_of_zeros(size_bytes: int) -> int:
    """Piece by piece: to make them all at once takes longer."""
    piece, crc = bytes(1 << 16), zlib.crc32(bytes(size_bytes % (1 << 16)))
    for _ in range(size_bytes >> 16):
        crc = zlib.crc32(piece, crc)
    return crc


def test_the_stretch_may_be_as_long_as_a_chunk(tmp_path: Path):
    path = tmp_path / "file"
    path.touch()
    os.truncate(path, (1 << 28) + 77)
    with path.open("rb") as file:
        assert RangeCrcs(Source(file.fileno()), 0).of(5, (1 << 28) + 76) == crc_of_zeros((1 << 28) + 71)
