"""Who holds a lock is found truly, also when the kernel's list of locks leaves it out at times."""

import fcntl
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from thermostand.recording.writing import locks
from thermostand.recording.writing.disk import MODULE

_HOLD = "import fcntl, signal, sys; fcntl.flock(sys.stdin, fcntl.LOCK_EX); print(flush=True); signal.pause()"


@pytest.fixture
def file(tmp_path: Path) -> Iterator[int]:
    path = tmp_path / "journal.jsonl"
    path.touch()
    fd = os.open(path, os.O_RDWR)
    yield fd
    os.close(fd)


@pytest.fixture
def left(file: int) -> Iterator[int]:
    """The process id of what looks like a disk process of a daemon that has gone; it has locked the file."""
    own = os.open(f"/proc/self/fd/{file}", os.O_RDWR)  # a lock of its own
    command = [sys.executable, "-c", _HOLD, MODULE, "1"]
    with subprocess.Popen(command, stdin=own, stdout=subprocess.PIPE) as process:
        os.close(own)
        assert process.stdout is not None
        process.stdout.readline()
        yield process.pid
        process.kill()


def test_the_holder_is_the_process_that_has_locked_the_file(file: int, left: int):
    assert locks.find_holder(file) == left


@pytest.mark.parametrize("listed", [[True, False], [False, True]])
def test_who_was_seen_once_is_named_when_the_list_leaves_it_out(
    file: int, left: int, listed: list[bool], monkeypatch: pytest.MonkeyPatch
):
    looks = iter(listed)
    monkeypatch.setattr(locks, "_LEFT_WITHIN_S", 0.2)
    monkeypatch.setattr(locks, "find_holder", lambda fd: left if next(looks, False) else 0)
    with pytest.raises(BlockingIOError, match=f"process {left} still waits"):
        locks.lock(file)


@pytest.mark.parametrize(("device", "pid"), [((7, 1), 0), ((7, 2), 31), ((0, 0x2B), 32), ((0, 0x2C), 32)])
def test_a_file_of_the_same_number_on_another_disk_is_another(device: tuple[int, int], pid: int):
    listed = (
        "1: FLOCK  ADVISORY  WRITE 31 07:02:13 0 EOF\n"
        "2: FLOCK  ADVISORY  WRITE 32 00:2b:13 0 EOF\n"
        "2: -> FLOCK  ADVISORY  WRITE 33 00:2b:13 0 EOF\n"
        "3: POSIX  ADVISORY  WRITE 34 07:01:13 0 EOF\n"
    )
    assert locks._find_in_list(listed, os.makedev(*device), 13) == pid


def test_a_lock_is_taken_when_its_holder_has_gone(file: int):
    locks.lock(file)
    with pytest.raises(BlockingIOError), Path(f"/proc/self/fd/{file}").open("rb") as other:
        fcntl.flock(other, fcntl.LOCK_EX | fcntl.LOCK_NB)
