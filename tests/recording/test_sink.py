import errno
import fcntl
import os
from contextlib import suppress

import numpy as np
import pytest

from tests.recording.disks import ext4, limit_files, mount, run, tmpfs
from thermostand.recording.writing.segment import CommitSink

MB = 1_000_000


@pytest.fixture(params=["here", "ext4", "tmpfs"])
def disk(request, tmp_path):
    """A folder on the test machine's own disk, on ext4 and on tmpfs."""
    match request.param:
        case "here":
            yield tmp_path
        case "ext4":
            with ext4(tmp_path / "disk", 64 << 20) as folder:
                yield folder
        case "tmpfs":
            with tmpfs(tmp_path / "disk", "64m") as folder:
                yield folder


@pytest.fixture
def limited():
    """`limited(size_bytes)` sets, and lifts, the largest size of a file."""
    yield limit_files
    limit_files()


def allocated_bytes(path):
    return path.stat().st_blocks * 512


def test_a_reserve_is_taken_at_once_is_no_part_of_the_size_and_is_given_back(disk):
    sink = CommitSink(disk / "file", 20 * MB)
    sink.append([b"a" * 1000, b"", b"b" * 500])
    assert (disk / "file").read_bytes() == b"a" * 1000 + b"b" * 500
    assert allocated_bytes(disk / "file") >= 20 * MB
    assert sink.reserved_bytes == 20 * MB - 1500
    sink.settle()
    assert allocated_bytes(disk / "file") <= 16384
    assert sink.reserved_bytes == 0
    sink.close()
    assert (disk / "file").stat().st_size == 1500


def test_a_block_of_several_pieces_is_written_whole(disk):
    parts = [bytes([number % 251]) * size for number, size in enumerate((300_000, 7, 0, 900_000, *[3] * 3000))]
    sink = CommitSink(disk / "file")
    sink.append(parts)
    sink.append(parts[:1])
    sink.close()
    assert (disk / "file").read_bytes() == b"".join(parts) + parts[0]


def test_a_block_the_disk_refuses_is_cut_off_again_and_the_reserve_with_it(disk, limited):
    sink = CommitSink(disk / "file", 20 * MB)
    sink.append([b"a" * 1000])
    limited(1500)
    with pytest.raises(OSError, match="too large"):
        sink.append([b"b" * 300, b"c" * 700])
    limited()
    assert (disk / "file").read_bytes() == b"a" * 1000
    assert allocated_bytes(disk / "file") <= 16384
    sink.close()


def test_a_reserve_that_does_not_fit_is_an_error_at_once_and_leaves_nothing(tmp_path):
    for mounted in (lambda: ext4(tmp_path / "a", 64 << 20), lambda: tmpfs(tmp_path / "b", "64m")):
        with mounted() as folder:
            free_bytes = os.statvfs(folder).f_bfree
            with pytest.raises(OSError, match="to reserve 200 MB") as caught:
                CommitSink(folder / "file", 200 * MB)
            assert caught.value.errno == errno.ENOSPC
            assert not (folder / "file").exists()
            assert os.statvfs(folder).f_bfree == free_bytes


def test_a_disk_that_cannot_reserve_is_written_to_all_the_same(tmp_path):
    """Linux has no fallocate on ramfs."""
    with mount(tmp_path / "disk", "-t", "ramfs", "ramfs") as folder:
        sink = CommitSink(folder / "file", 20 * MB)
        sink.append([b"a" * 1000])
        sink.settle()
        sink.close()
        assert (folder / "file").read_bytes() == b"a" * 1000


def test_what_was_reserved_is_left_when_another_program_has_filled_the_disk(tmp_path):
    with tmpfs(tmp_path / "disk", "8m") as folder:
        sink = CommitSink(folder / "file", 4 * MB)
        with suppress(OSError), (folder / "other").open("wb", buffering=0) as other:
            while other.write(bytes(100_000)):
                pass
        for number in range(4):
            sink.append([bytes([number]) * (MB - 5000)])
        with pytest.raises(OSError, match="No space"):
            sink.append([bytes(MB)])
        sink.close()
        assert (folder / "file").stat().st_size == 4 * (MB - 5000)


def test_more_parts_than_the_kernel_takes_at_once_are_written_in_order(tmp_path):
    sink = CommitSink(tmp_path / "file")
    parts = [bytes([number % 251]) * (number % 7) for number in range(3000)]
    sink.append(parts)
    sink.close()
    assert (tmp_path / "file").read_bytes() == b"".join(parts)


@pytest.mark.nightly
def test_a_block_larger_than_the_kernel_writes_at_once_is_whole(tmp_path):
    """Linux writes 2 GiB less a page at a time and returns."""
    part = np.random.default_rng(1).bytes(3_000_001)
    with tmpfs(tmp_path / "disk", "3g") as folder:
        sink = CommitSink(folder / "file")
        sink.append([part] * 720)
        sink.close()
        with (folder / "file").open("rb") as file:
            assert all(file.read(len(part)) == part for _ in range(720))
            assert file.read() == b""


def test_the_file_is_locked_as_long_as_it_is_open(tmp_path):
    sink = CommitSink(tmp_path / "file")
    with (tmp_path / "file").open("rb") as other:
        with pytest.raises(BlockingIOError):
            fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
        sink.close()
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
    sink.close()  # may be called twice


def test_a_file_that_was_removed_takes_nothing_more(tmp_path):
    sink = CommitSink(tmp_path / "file")
    sink.append([b"a"])
    (tmp_path / "file").unlink()
    with pytest.raises(FileNotFoundError, match="was removed"):
        sink.append([b"b"])
    sink.close()


def test_a_partial_block_that_cannot_be_cut_off_yet_is_cut_off_later(tmp_path, limited):
    """An append-only file cannot be made shorter, no matter who asks."""
    with ext4(tmp_path / "disk", 16 << 20) as folder:
        sink = CommitSink(folder / "file")
        sink.append([b"a" * 1000])
        run("chattr", "+a", folder / "file")
        limited(1500)
        with pytest.raises(OSError, match="too large"):
            sink.append([b"b" * 1000])
        limited()  # before pytest writes its own output, which may be a longer file
        assert (folder / "file").stat().st_size == 1500
        with pytest.raises(PermissionError):
            sink.settle()
        run("chattr", "-a", folder / "file")
        sink.settle()
        assert (folder / "file").read_bytes() == b"a" * 1000
        sink.close()
