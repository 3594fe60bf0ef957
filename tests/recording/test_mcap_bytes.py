"""What a chunk's bytes are believed, by reader, salvage and verification alike."""

import struct
import zlib

import pytest
import zstandard
from mcap.reader import SeekingReader

from tests.recording.damage import write_segment
from thermostand.foundation.errors import SessionError
from thermostand.recording.format.layout import TELEMETRY
from thermostand.recording.format.mcap_bytes import Source, decompress_chunk, iterate_records
from thermostand.recording.format.records import read_telemetry_messages
from thermostand.recording.reading.scan import verify
from thermostand.recording.reading.segment_scan import read_stored_messages, scan_segment
from thermostand.recording.repair.salvage import salvage_session

RECORDS = struct.pack("<BQ", 3, 5) + b"hello" + struct.pack("<BQ", 4, 0)


def chunk(data=RECORDS, size=None, crc=None, name=b"", data_bytes=None, packed=None):
    packed = {b"": data, b"zstd": zstandard.compress(data)}.get(name, data) if packed is None else packed
    size, crc = len(data) if size is None else size, zlib.crc32(data) if crc is None else crc
    data_bytes = len(packed) if data_bytes is None else data_bytes
    return struct.pack("<qqQII", 1, 2, size, crc, len(name)) + name + struct.pack("<Q", data_bytes) + packed


@pytest.mark.parametrize("name", [b"", b"zstd"])
def test_a_sound_chunk_gives_its_head_and_its_records(name):
    head, content = decompress_chunk(memoryview(chunk(name=name)))
    assert (head.first_ns, head.last_ns, head.size_bytes, head.compression) == (1, 2, len(RECORDS), name)
    assert list(iterate_records(content)) == [(3, b"hello"), (4, b"")]


@pytest.mark.parametrize(
    ("damaged", "text"),
    [
        (chunk(crc=1), "the CRC of a chunk is wrong"),
        (chunk(crc=1, name=b"zstd"), "the CRC of a chunk is wrong"),
        (chunk(size=3), "size is wrong"),
        (chunk(size=3, name=b"zstd"), "size is wrong"),
        (chunk(data_bytes=3), "size is wrong"),
        (chunk() + b"more", "size is wrong"),
        (chunk(name=b"lz4"), "compressed with b'lz4'"),
        (chunk(size=1 << 40), "claims 1099511627776 bytes"),
        (chunk(size=1 << 40, name=b"zstd"), "claims 1099511627776 bytes"),
    ],
)
def test_a_damaged_chunk_is_refused(damaged, text):
    with pytest.raises(ValueError, match=text):
        decompress_chunk(memoryview(damaged))


def test_what_the_reader_refuses_neither_salvage_nor_verification_accepts(tmp_path):
    path = tmp_path / TELEMETRY / "0000.mcap"
    whole = write_segment(path.parent, TELEMETRY, range(3), finish=True)
    large = bytearray(whole.data)
    with path.open("rb") as file:
        place = SeekingReader(file).get_summary().chunk_indexes[0].chunk_start_offset
    large[place + 25 : place + 33] = struct.pack("<Q", 1 << 40)  # its size, uncompressed
    path.write_bytes(large)
    with pytest.raises(SessionError, match="a chunk"):
        list(read_telemetry_messages(path, lambda channel: True))
    assert any("a chunk claims" in finding.text for finding in verify(tmp_path).findings)
    (done,) = salvage_session(tmp_path)
    assert done.lost_bytes > 0
    assert not any("a chunk" in finding.text for finding in verify(tmp_path).findings)


def test_a_disk_that_reads_differently_each_time_is_the_disks_error(tmp_path):
    path = tmp_path / TELEMETRY / "0000.mcap"
    write_segment(path.parent, TELEMETRY, range(3), finish=True)
    with path.open("r+b") as file:
        source = Source(file.fileno())
        place = scan_segment(source).chunks[0]
        assert list(read_stored_messages(source, place))
        file.seek(place.offset + place.length - 1)
        file.write(b"\xff")
        file.flush()
        with pytest.raises(OSError, match="reads differently"):
            list(read_stored_messages(source, place))
