"""An alert reaches the command whatever state the daemon is in, by a small process that goes with it."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

LIMIT_S = 60.0  # for what takes milliseconds, on a machine that has other things to do


class Daemon:
    """Each line that is sent becomes a line in the file `reported`, after `nap_s`."""

    def __init__(self, reported, nap_s=0.0):
        script = f'sleep {nap_s}; printf "%s\\n" "$1" >> "$0"'
        self.process = subprocess.Popen(
            [sys.executable, "-m", "tests.system.alert_daemon", "/bin/sh", "-c", script, str(reported)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )
        self.pid = int(self.line())

    def send(self, text):
        self.process.stdin.write(f"{text}\n")
        self.process.stdin.flush()

    def line(self):
        """What it says: the process that sends, then what was not delivered."""
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


def reported(folder):
    path = folder / "reported"
    return path.read_text().splitlines() if path.exists() else []


def test_a_daemon_that_has_no_descriptor_left_still_alerts(daemon, tmp_path):
    daemon.send("too warm!")
    until(lambda: reported(tmp_path))
    assert reported(tmp_path)[0].endswith(": too warm!")


def test_a_process_that_was_killed_is_replaced_when_something_is_to_be_reported(daemon, tmp_path):
    os.kill(daemon.pid, signal.SIGKILL)
    daemon.send("too warm")
    until(lambda: reported(tmp_path))
    assert reported(tmp_path)[0].endswith(": too warm")


def test_a_process_that_cannot_be_replaced_is_an_event_and_tried_again_with_the_next_message(daemon, tmp_path):
    os.kill(daemon.pid, signal.SIGKILL)
    daemon.send("too warm!")
    assert daemon.line() != ""
    daemon.send("too cold")
    until(lambda: reported(tmp_path))
    assert reported(tmp_path)[0].endswith(": too cold")


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM])
def test_the_process_ends_with_its_daemon_and_what_was_under_way_is_reported(tmp_path, number):
    daemon = Daemon(tmp_path / "reported", nap_s=0.5)
    daemon.send("too warm")
    until(lambda: Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").exists() and children(daemon.pid))
    daemon.process.send_signal(number)
    daemon.process.wait(LIMIT_S)
    until(lambda: gone(daemon.pid))
    assert reported(tmp_path)[0].endswith(": too warm")
    daemon.close()


def children(pid):
    """Whether a command is under way."""
    tasks = Path(f"/proc/{pid}/task").iterdir()
    return any((task / "children").read_text() for task in tasks)
