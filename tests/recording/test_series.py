"""Segments on real disks: what a telemetry segment looks like when it is finished, and what becomes of a failed one."""

import fcntl
import os
import random
import shutil
from contextlib import suppress

import pytest
from mcap.exceptions import EndOfFile
from mcap.reader import make_reader
from mcap.records import Chunk, Message
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType

from tests.recording.disks import ext4, limit_files, run, tmpfs
from thermostand.recording.format.layout import make_segment_metadata
from thermostand.recording.format.messages import CLASSES, EVENT, LOG
from thermostand.recording.writing.folder_watch import FolderLost
from thermostand.recording.writing.segment import MessageRecord, SeriesSpec, Topic, merge_chunks
from thermostand.recording.writing.series import Series, find_next_number

ATTACHMENTS = {"config.yaml": "camera:\n  gain_dB: 0.0\n"}
SESSION = {"session_id": "cycle-1"}
RECORDS_PER_COMMIT = 8


def form(**changes):
    fields = {
        "name": "telemetry",
        "topics": (Topic(EVENT, CLASSES[EVENT]), Topic(LOG, CLASSES[LOG], {"of": "stand"})),
        "compression": CompressionType.ZSTD,
        "session": SESSION,
        "attachments": ATTACHMENTS,
        "segment_bytes": 1 << 40,
        "segment_ns": 1 << 60,
        "merge_chunks": True,
    }
    return SeriesSpec(**{**fields, **changes})


def records(commit, size_bytes=60):
    """Eight messages that do not compress, in no order of time."""
    noise = random.Random(commit)
    return [
        MessageRecord(
            noise.choice((EVENT, LOG)), noise.randrange(10**9), noise.randbytes(size_bytes), noise.randrange(1 << 32)
        )
        for _ in range(RECORDS_PER_COMMIT)
    ]


def write(folder, commits, size_bytes=60, **changes):
    folder.mkdir(exist_ok=True)
    series = Series(folder, form(**changes))
    for commit in range(commits):
        series.commit(records(commit, size_bytes), 0)
    assert series.finish()
    assert not series.troubles
    return folder / "0000.mcap"


def messages(path):
    """All messages of a segment, in the order of the file."""
    found = []
    collect_messages(path, found)
    return found


def collect_messages(path, found):
    topics = {}
    with path.open("rb") as file:
        for record in StreamReader(file, validate_crcs=True).records:
            if type(record).__name__ == "Channel":
                topics[record.id] = record.topic
            elif isinstance(record, Message):
                assert record.publish_time == record.log_time
                found.append(MessageRecord(topics[record.channel_id], record.log_time, record.data, record.sequence))


def all_records(commits, size_bytes=60):
    return [record for commit in range(commits) for record in records(commit, size_bytes)]


def chunks(path):
    with path.open("rb") as file:
        return [record for record in StreamReader(file, emit_chunks=True).records if isinstance(record, Chunk)]


@pytest.fixture
def limited():
    yield limit_files
    limit_files()


def test_a_finished_segment_has_few_large_chunks_with_everything_in_its_place(tmp_path):
    path = write(tmp_path / "s", 600, 1000)
    assert messages(path) == all_records(600, 1000)
    sizes = [chunk.uncompressed_size for chunk in chunks(path)]
    assert len(sizes) == 5  # of 4.8 MB
    assert max(sizes) < (1 << 20) + 2000
    assert [found.name for found in path.parent.iterdir()] == ["0000.mcap"]
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        assert {found.name: found.data.decode() for found in reader.iter_attachments()} == ATTACHMENTS
        metadata = {found.name: found.metadata for found in reader.iter_metadata()}
        assert metadata["session"] == SESSION
        assert metadata["segment"] == make_segment_metadata("telemetry", 0, metadata["session"])
        summary = reader.get_summary()
    assert summary.statistics.message_count == 600 * RECORDS_PER_COMMIT
    assert summary.statistics.chunk_count == len(summary.chunk_indexes) == 5
    assert [channel.metadata for channel in summary.channels.values()] == [{}, {"of": "stand"}]


def test_the_same_records_are_the_same_bytes_and_the_begin_is_that_of_the_uncompacted_file(tmp_path):
    one, other, plain = (
        write(tmp_path / name, 100, merge_chunks=merged) for name, merged in (("a", True), ("b", True), ("c", False))
    )
    assert one.read_bytes() == other.read_bytes()
    assert len(chunks(plain)) == 100
    opening = plain.read_bytes().index(SESSION["session_id"].encode())
    assert one.read_bytes()[:opening] == plain.read_bytes()[:opening]
    assert messages(one) == messages(plain)


def test_a_segment_of_a_few_chunks_is_left_as_it_is(tmp_path):
    assert len(chunks(write(tmp_path / "s", 10))) == 10


def test_a_disk_without_space_for_the_copy_keeps_the_segment_as_it_was_committed(tmp_path):
    with tmpfs(tmp_path / "disk", "4m") as disk:
        path = write(disk / "s", 100, 3000, reserve_bytes=3_500_000)  # 2.4 MB and an index
        assert len(chunks(path)) == 100
        assert messages(path) == all_records(100, 3000)
        assert [found.name for found in path.parent.iterdir()] == ["0000.mcap"]


def test_a_file_that_is_no_mcap_is_not_merged_and_says_so(tmp_path):
    source = tmp_path / "0000.mcap.part"
    source.write_bytes(bytes(100))
    with pytest.raises(ValueError, match="not an MCAP file"):
        merge_chunks(source, tmp_path / "0000.mcap", CompressionType.ZSTD)
    assert [found.name for found in tmp_path.iterdir()] == [source.name]


def test_a_name_that_is_taken_is_not_used_again_whatever_it_ends_in(tmp_path):
    for name, number in (("0003.mcap.damaged", 4), ("0004.mcap.tmp", 5), ("0007.mcap.part", 8), ("0006.mcap", 8)):
        (tmp_path / name).touch()
        assert find_next_number(tmp_path) == number
    (tmp_path / "notes.txt").touch()
    assert find_next_number(tmp_path) == 8


def test_a_file_under_a_number_far_outside_does_not_count(tmp_path):
    """Twelve digits are no segment for a salvage: what would be written behind it could be lost."""
    for name in ("0000.mcap", "0003.mcap.part", "99999999999.mcap", f"{'9' * 200}.mcap"):
        (tmp_path / name).touch()
    assert find_next_number(tmp_path) == 4


def test_no_next_segment_is_begun_while_a_refused_block_may_still_be_in_the_last_one(tmp_path, limited):
    """An append-only file cannot be made shorter, no matter who asks."""
    with ext4(tmp_path / "disk", 16 << 20) as disk:
        folder = disk / "s"
        folder.mkdir()
        series = Series(folder, form())
        series.commit(records(0), 0)
        good_bytes = (folder / "0000.mcap.part").stat().st_size
        run("chattr", "+a", folder / "0000.mcap.part")
        limited(good_bytes + 100)
        with pytest.raises(OSError, match="not permitted"):
            series.commit(records(1), 0)
        limited()
        with pytest.raises(OSError, match="not permitted"):
            series.commit(records(1), 0)
        assert [path.name for path in folder.iterdir()] == ["0000.mcap.part"]
        run("chattr", "-a", folder / "0000.mcap.part")
        series.commit(records(1), 0)
        assert (folder / "0000.mcap.part").stat().st_size == good_bytes
        assert series.finish()
        assert messages(folder / "0001.mcap") == records(1)
        assert [text.startswith("a segment of telemetry") for text in series.troubles] == [True]


def test_a_folder_that_was_removed_is_made_again_only_when_asked_and_its_numbers_continue(tmp_path):
    folder = tmp_path / "s"
    series = Series(folder, form())
    for commit in range(2):
        series.commit(records(commit), 0)
        series.finish()
    shutil.rmtree(folder)
    for _ in range(2):
        with pytest.raises(FolderLost, match="was removed while"):
            series.commit(records(2), 0)
        assert not folder.exists()
    assert not series.recover()
    series.commit(records(2), 0)
    assert series.finish()
    assert [path.name for path in folder.iterdir()] == ["0002.mcap"]
    assert messages(folder / "0002.mcap") == records(2)


def test_a_folder_that_was_renamed_is_written_into_again_when_it_is_back(tmp_path):
    folder, other = tmp_path / "s", tmp_path / "other"
    series = Series(folder, form())
    series.commit(records(0), 0)
    folder.rename(other)
    with pytest.raises(FolderLost, match=f"was renamed .* {other} now"):
        series.commit(records(1), 0)
    folder.mkdir()  # of the same name, and not the same
    with pytest.raises(FolderLost):
        series.commit(records(1), 0)
    folder.rmdir()
    other.rename(folder)
    assert series.recover()
    series.commit(records(1), 0)
    assert series.finish()
    assert messages(folder / "0000.mcap") == records(0) + records(1)


def test_a_new_folder_leaves_the_renamed_one_to_a_salvage(tmp_path):
    """What was being written in the old one is unlocked, and whole up to the last commit."""
    folder, other = tmp_path / "s", tmp_path / "other"
    series = Series(folder, form(reserve_bytes=1_000_000))
    series.commit(records(0), 0)
    folder.rename(other)
    assert not series.recover()
    series.commit(records(1), 0)
    assert series.finish()
    assert [path.name for path in folder.iterdir()] == ["0001.mcap"]
    with (other / "0000.mcap.part").open("rb") as part:
        fcntl.flock(part, fcntl.LOCK_EX | fcntl.LOCK_NB)
    found = []
    with suppress(EndOfFile):  # it was not finished
        collect_messages(other / "0000.mcap.part", found)
    assert found == records(0)


def test_a_probe_tells_what_the_disk_would_do_and_leaves_nothing(tmp_path, limited):
    series = Series(tmp_path / "s", form())
    series.probe(50_000, 0)
    limited(40_000)
    with pytest.raises(OSError, match="too large"):
        series.probe(50_000, 0)
    limited()
    assert list((tmp_path / "s").iterdir()) == []
    series.commit(records(0), 0)
    series.probe(50_000, 0)
    assert series.finish()
    assert [path.name for path in (tmp_path / "s").iterdir()] == ["0000.mcap"]
    (tmp_path / "s").rename(tmp_path / "t")
    with pytest.raises(FolderLost):
        series.probe(1, 0)


def test_a_segment_whose_name_is_taken_by_a_folder_stays_unfinished_and_whole(tmp_path):
    folder = tmp_path / "s"
    folder.mkdir()
    series = Series(folder, form())
    series.commit(records(0), 0)
    (folder / "0000.mcap").mkdir()
    assert not series.finish()
    assert series.troubles.pop().startswith("a segment of telemetry")
    assert messages(folder / "0000.mcap.part") == records(0)
    series.commit(records(1), 0)
    assert series.finish()
    assert messages(folder / "0001.mcap") == records(1)


def test_a_disk_that_dies_tells_at_once_and_keeps_what_was_acknowledged(tmp_path):
    """The disk behind ext4 is a sparse file on a disk of 24 MB: when that is full, a block is taken but not synced,
    and from then on ext4 refuses to cut it off again."""
    with tmpfs(tmp_path / "small", "24m") as small, ext4(small / "disk", 200 << 20) as disk:
        folder = disk / "s"
        folder.mkdir()
        os.sync()
        (small / "ballast").write_bytes(bytes(8_000_000))
        series = Series(folder, form())
        acknowledged = 0
        with suppress(OSError):
            while True:
                series.commit(records(acknowledged, 100_000), 0)
                acknowledged += 1
        assert 2 <= acknowledged < 30
        series.finish()
        found = []
        for path in sorted(folder.iterdir()):
            with suppress(Exception):  # an unfinished file ends anywhere
                collect_messages(path, found)
        assert len(found) >= acknowledged * RECORDS_PER_COMMIT
        assert found == all_records(acknowledged + 1, 100_000)[: len(found)]  # no message twice
