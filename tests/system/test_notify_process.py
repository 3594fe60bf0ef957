"""Somebody is notified whatever state the daemon is in, by a small process that goes with it."""

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from thermostand.foundation.clock import WallClock
from thermostand.stand.guarding.notify import Notifier

LIMIT_S = 60.0  # for what takes milliseconds, on a machine that has other things to do


class Daemon:
    """It tells each sentence by a line in the file `reported`, after `nap_s`."""

    def __init__(self, reported, nap_s=0.0):
        script = f'sleep {nap_s}; printf "%s\\n" "$1" >> "$0"'
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.system.notify_daemon", "/bin/sh", "-c", script, str(reported)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.pid = int(self._line())

    def tell(self, text):
        """What became of it."""
        self.send(text)
        return self._line()

    def send(self, text):
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

    def _line(self):
        watchdog = threading.Timer(LIMIT_S, self.process.kill)
        watchdog.start()
        try:
            return self.process.stdout.readline().rstrip("\n")
        finally:
            watchdog.cancel()

    def close(self):
        self.process.kill()
        self.process.wait(LIMIT_S)
        self.process.stdin.close()
        self.process.stdout.close()


@pytest.fixture
def daemon(tmp_path):
    daemon = Daemon(tmp_path / "reported")
    yield daemon
    daemon.close()


def until(condition):
    deadline_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.01)


def gone(pid):
    command = Path(f"/proc/{pid}/cmdline")
    return not command.exists() or command.read_bytes() == b""


def test_a_daemon_that_has_no_descriptor_left_still_tells(daemon, tmp_path):
    assert daemon.tell("too warm!") == ""
    assert (tmp_path / "reported").read_text() == "too warm!\n"


def test_a_process_that_was_killed_is_replaced_when_something_is_to_be_reported(daemon, tmp_path):
    os.kill(daemon.pid, signal.SIGKILL)
    assert daemon.tell("too warm") == ""
    assert (tmp_path / "reported").read_text() == "too warm\n"


def test_a_process_that_cannot_be_replaced_is_a_sentence_and_tried_again_the_next_time(daemon, tmp_path):
    os.kill(daemon.pid, signal.SIGKILL)
    assert "/bin/sh could not" in daemon.tell("too warm!")
    assert daemon.tell("too cold") == ""
    assert (tmp_path / "reported").read_text() == "too cold\n"


async def test_a_slow_command_delays_no_other(tmp_path):
    """The first two end only when the third has reported."""
    script = 'case "$1" in slow*) until [ -e "$0" ]; do sleep 0.05; done;; *) : > "$0";; esac'
    notifier = Notifier(("/bin/sh", "-c", script, str(tmp_path / "third")), LIMIT_S, WallClock())
    try:
        slow = [asyncio.create_task(notifier.tell(text)) for text in ("slow 1", "slow 2")]
        await asyncio.sleep(0)
        assert await notifier.tell("third") == ""
        assert await asyncio.gather(*slow) == ["", ""]
    finally:
        notifier.close()


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_process_ends_with_its_daemon_and_what_was_under_way_is_reported(tmp_path, number):
    daemon = Daemon(tmp_path / "reported", nap_s=0.5)
    daemon.send("too warm")
    until(lambda: Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").exists() and children(daemon.pid))
    daemon.process.send_signal(number)
    daemon.process.wait(LIMIT_S)
    until(lambda: gone(daemon.pid))
    assert (tmp_path / "reported").read_text() == "too warm\n"
    daemon.close()


def children(pid):
    """Whether a command is under way."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return any((task / "children").read_text() for task in tasks)
