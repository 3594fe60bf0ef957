"""A daemon ends whatever its disk does, and what it leaves behind says the truth."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.journals import read_lines
from tests.recording.disks import ext4, run
from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.gaps import list_reported_blocks
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session
from thermostand.recording.writing import locks
from thermostand.recording.writing.disk import LEFT_NAME
from thermostand.stand.running.memory.entries import Ended
from thermostand.stand.running.memory.journal import Journal

LIMIT_S = 60.0  # for what takes milliseconds, on a machine that has other things to do


class Daemon:
    def __init__(self, directory):
        self.directory = directory
        self._process = subprocess.Popen(
            [sys.executable, "-m", "tests.system.disk_daemon", str(directory)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.disk_pid = int(self._process.stdout.readline())

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._process.kill()
        self._process.communicate()

    def look(self):
        """When; frames and messages acknowledged, age of what waits (s), and why the folder is lost."""
        look_s, frames, messages, age_s, lost = self._process.stdout.readline().rstrip("\n").split("\t")
        return float(look_s), (int(frames), int(messages), float(age_s), lost)

    def until(self, wanted):
        """The first look from now on that is as wanted."""
        begin_s = time.monotonic()
        while True:
            look_s, found = self.look()  # those that have not been read yet are older
            if look_s >= begin_s and wanted(*found):
                return found
            assert time.monotonic() < begin_s + LIMIT_S

    def end(self, number):
        """Its exit code, last words and acknowledged frames, and how long it took (s)."""
        begin_s = time.monotonic()
        self._process.send_signal(number)
        out, output = self._process.communicate(timeout=LIMIT_S)
        last = [line for line in out.splitlines() if line.count("\t") == 4]
        return self._process.returncode, output, int(last[-1].split("\t")[1]) if last else 0, time.monotonic() - begin_s


def lives(pid):
    return Path(f"/proc/{pid}/cmdline").exists() and Path(f"/proc/{pid}/cmdline").read_bytes() != b""


def gone(pid):
    """How long it took the process to end (s)."""
    begin_s = time.monotonic()
    while lives(pid):
        assert time.monotonic() - begin_s < LIMIT_S
        threading.Event().wait(0.01)
    return time.monotonic() - begin_s


@contextmanager
def frozen(disk):
    run("fsfreeze", "-f", disk)
    try:
        yield
    finally:
        run("fsfreeze", "-u", disk)


def entries(directory):
    return read_lines((directory / "journal.jsonl").read_bytes())[0]


def check(directory, frames):
    """Everything acknowledged is in the session."""
    blocks, lost = recorded(directory)
    assert blocks == list(range(len(blocks)))
    assert len(blocks) >= frames
    assert lost == set()


def recorded(directory):
    """The numbers of the frames that are in the session, and of those that it says were lost."""
    salvage_session(directory)
    session = Session.open(directory)
    lost = {block for blocks in list_reported_blocks(session.events()) for block in blocks}
    return [frame.block_id for frame in session.frames()], lost


def test_a_daemon_on_a_healthy_disk_ends_with_a_whole_session_and_leaves_nothing(tmp_path):
    with Daemon(tmp_path / "s") as daemon:
        daemon.until(lambda frames, messages, age_s, lost: frames >= 20 and messages >= 20)
        code, output, frames, _ = daemon.end(signal.SIGTERM)
        assert (code, output) == (0, "")
        gone(daemon.disk_pid)
        assert not Session.open(tmp_path / "s").incomplete
        assert isinstance(entries(tmp_path / "s")[-1], Ended)
        check(tmp_path / "s", frames)


def test_after_kill_9_the_disk_process_is_gone_at_once_and_the_session_can_be_opened(tmp_path):
    with Daemon(tmp_path / "s") as daemon:
        daemon.until(lambda frames, messages, age_s, lost: frames >= 20)
        _, _, frames, _ = daemon.end(signal.SIGKILL)
        journal, found = Journal.open(tmp_path / "s")  # waits for the lock
        journal.release()
        assert len(found) > 1
        assert gone(daemon.disk_pid) < 5
        check(tmp_path / "s", frames)


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_daemon_whose_disk_hangs_leaves_and_its_disk_process_ends_with_the_hang(tmp_path, monkeypatch, number):
    monkeypatch.setattr(locks, "_LEFT_WITHIN_S", 1.0)  # the kernel's list leaves out a lock now and then
    with ext4(tmp_path / "disk", 64 << 20) as disk, Daemon(disk / "s") as daemon:
        daemon.until(lambda frames, messages, age_s, lost: frames >= 10)
        with frozen(disk):
            daemon.until(lambda frames, messages, age_s, lost: age_s > 0.5)
            code, output, frames, took_s = daemon.end(number)
            if number == signal.SIGTERM:
                assert code == 3
                assert "session is unfinished" in output
            else:
                assert code == -signal.SIGKILL
            assert took_s < 5 + 10  # 5 s; the machine may have other things to do
            assert lives(daemon.disk_pid)
            deadline_s = time.monotonic() + LIMIT_S
            while Path(f"/proc/{daemon.disk_pid}/comm").read_text().strip() != LEFT_NAME:
                assert time.monotonic() < deadline_s
            with pytest.raises(SessionError, match=f"process {daemon.disk_pid} still waits"):
                Journal.open(disk / "s")
            assert lives(daemon.disk_pid)
        gone(daemon.disk_pid)
        journal, _ = Journal.open(disk / "s")
        journal.release()
        check(disk / "s", frames)


def test_a_disk_process_that_was_killed_is_a_refusal_and_the_daemon_says_so(tmp_path):
    with Daemon(tmp_path / "s") as daemon:
        daemon.until(lambda frames, messages, age_s, lost: frames >= 10)
        os.kill(daemon.disk_pid, signal.SIGKILL)
        daemon.until(lambda frames, messages, age_s, lost: age_s > 0.5)
        code, output, frames, _ = daemon.end(signal.SIGTERM)
        assert code == 3
        assert "process that writes" in output
        check(tmp_path / "s", frames)


def test_a_folder_that_was_renamed_under_a_daemon_is_seen_within_a_commit(tmp_path):
    with Daemon(tmp_path / "s") as daemon:
        daemon.until(lambda frames, messages, age_s, lost: frames >= 10)
        (tmp_path / "s").rename(tmp_path / "t")
        # Renamed between the looks at the folder and at its journal, it is first the journal that has gone.
        daemon.until(lambda frames, messages, age_s, lost: f"it is {tmp_path / 't'}" in lost)
        (tmp_path / "t").rename(tmp_path / "s")
        frames, *_ = daemon.until(lambda frames, messages, age_s, lost: not lost and age_s < 0.2)
        daemon.until(lambda more, messages, age_s, lost: more > frames)
        code, output, frames, _ = daemon.end(signal.SIGTERM)
        assert (code, output) == (0, "")
        blocks, lost = recorded(tmp_path / "s")
        # On a busy machine the folder is away for longer than the queue of frames has room for.
        assert sorted([*blocks, *lost]) == list(range(len(blocks) + len(lost)))
        assert len(blocks) >= frames
