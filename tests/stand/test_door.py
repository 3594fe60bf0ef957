"""A control socket that is flooded, and one of a process that has no descriptor left."""

import asyncio
import contextlib
import json
import socket
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

import pytest

from stand.serving.control import serve
from stand.serving.control_client import ask
from stand.serving.door import MOST_CLIENTS
from stand.serving.presence import address_in, living, opened_folder

STAND = "a stand"
HANDLER_S = 0.003
_FLOOD = 20


def connected(session: Path) -> socket.socket:
    """A client that has not said anything yet."""
    (daemon,) = [each for each in living() if each.entry.session == str(session)]
    client = socket.socket(socket.AF_UNIX)
    try:
        with opened_folder(daemon.socket.parent) as folder:
            client.connect(address_in(folder, daemon.socket.name))
    except OSError:
        client.close()
        raise
    return client


class Slow:
    """A handler that keeps the event loop for some ms each time."""

    def __init__(self) -> None:
        self.calls = 0
        self.took_s = 0.0

    def __call__(self, _: Mapping[str, object]) -> dict[str, object]:
        began_s = time.monotonic()
        while time.monotonic() < began_s + HANDLER_S:
            pass
        self.calls += 1
        self.took_s += time.monotonic() - began_s
        return {}


async def test_a_flood_of_clients_takes_one_turn_of_the_loop_at_a_time_and_a_fifth_of_it(tmp_path: Path):
    """Turns are counted and times compared with each other, so that a busy machine changes nothing."""
    slow, most_in_a_turn, until_answered = Slow(), 0, -1
    async with serve(tmp_path, STAND, {"slow": slow, "stop": lambda _: {}}), contextlib.AsyncExitStack() as stack:
        began_s = time.monotonic()
        for _ in range(_FLOOD):
            stack.enter_context(connected(tmp_path)).sendall(b'{"do": "slow"}\n' * 100)
        while slow.calls < 2 * _FLOOD:
            before = slow.calls
            await asyncio.sleep(0)
            most_in_a_turn = max(most_in_a_turn, slow.calls - before)
        stop = stack.enter_context(connected(tmp_path))
        stop.sendall(b'{"do": "stop"}\n')
        stop.setblocking(False)
        while until_answered < 0:
            await asyncio.sleep(0)
            with contextlib.suppress(BlockingIOError):
                assert json.loads(stop.recv(1000)) == {"ok": True}
                until_answered = slow.calls - 2 * _FLOOD
        elapsed_s = time.monotonic() - began_s
    assert most_in_a_turn == 1
    assert slow.took_s < 0.25 * elapsed_s
    assert until_answered <= 3  # it does not wait for its turn behind the others


@pytest.mark.parametrize("silence", [b"", b'{"do": "sto'])
async def test_silent_clients_shut_nobody_out(tmp_path: Path, silence: bytes):
    async with serve(tmp_path, STAND, {"stop": lambda _: {}}), contextlib.AsyncExitStack() as stack:
        for _ in range(3 * MOST_CLIENTS):
            client = stack.enter_context(await asyncio.to_thread(connected, tmp_path))
            with contextlib.suppress(BrokenPipeError):  # it had to make room already
                client.sendall(silence)
        for _ in range(2 * MOST_CLIENTS):
            assert await asyncio.to_thread(ask, tmp_path, {"do": "stop"}) == {}


DAEMON = """
import asyncio, os, resource, sys, time
from pathlib import Path
from stand.serving.control import serve

async def run():
    ended = asyncio.Event()
    table = {"status": lambda _: {"files": used()}, "stop": lambda _: ended.set() or {}}
    async with serve(Path(sys.argv[1]), "a stand", table):
        try:
            while True:
                os.open("/dev/null", os.O_RDONLY)
        except OSError:
            print("no descriptor left", flush=True)
        await ended.wait()

def used():
    try:
        os.close(os.open("/dev/null", os.O_RDONLY))
    except OSError as error:
        return error.strerror
    return "one left"

resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
asyncio.run(run())
print("ended", flush=True)
"""


def test_a_daemon_without_a_descriptor_left_still_answers(tmp_path: Path):
    with contextlib.ExitStack() as stack:
        daemon = stack.enter_context(
            subprocess.Popen([sys.executable, "-c", DAEMON, tmp_path], stdout=subprocess.PIPE, text=True)
        )
        stack.callback(daemon.kill)
        assert daemon.stdout is not None
        assert daemon.stdout.readline() == "no descriptor left\n"
        for _ in range(3):
            assert ask(tmp_path, {"do": "status"})["files"] == "Too many open files"
        silent = [stack.enter_context(connected(tmp_path)) for _ in range(20)]  # more than there are spares
        for _ in range(10):
            assert "files" in ask(tmp_path, {"do": "status"})
        with silent[0].makefile("rb") as answers:
            assert "no descriptor left" in json.loads(answers.readline())["error"]
        assert ask(tmp_path, {"do": "stop"}) == {}
        assert daemon.stdout.readline() == "ended\n"
