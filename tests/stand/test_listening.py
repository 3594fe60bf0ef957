"""A daemon's interface that is flooded, and one of a process that has no descriptor left."""

import asyncio
import contextlib
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.daemon_queries import ask
from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.test_interface_access import free_port
from thermostand.stand.serving.api.http_clients import MOST_CLIENTS
from thermostand.stand.serving.client import find_session_server, make_server
from thermostand.stand.serving.instances import list_daemons, make_socket_address, open_folder

STATE = b"GET /api/v1/state HTTP/1.1\r\nHost: localhost\r\n\r\n"
LOOKS, PERIOD_S = 60, 0.02


def connected(session: Path) -> socket.socket:
    """A client that has not said anything yet."""
    (daemon,) = [each for each in list_daemons() if each.entry.session == str(session)]
    client = socket.socket(socket.AF_UNIX)
    try:
        with open_folder(daemon.socket.parent) as folder:
            client.connect(make_socket_address(folder, daemon.socket.name))
    except OSError:
        client.close()
        raise
    return client


FLOOD = """
import socket, sys, threading
from contextlib import suppress

def ask():
    while True:
        with suppress(OSError), socket.socket(socket.AF_UNIX) as client:
            client.settimeout(10.0)
            client.connect(sys.argv[1])
            while True:
                client.sendall(sys.argv[2].encode().decode("unicode_escape").encode())
                if not client.recv(65536):
                    break

for _ in range(int(sys.argv[3])):
    threading.Thread(target=ask, daemon=True).start()
threading.Event().wait()
"""


@contextlib.contextmanager
def flood(session: Path, count: int, request: bytes = STATE) -> Iterator[None]:
    """Clients of another process that ask as fast as they are answered, and come back when they are shut out."""
    (daemon,) = [each for each in list_daemons() if each.entry.session == str(session)]
    text = request.decode().encode("unicode_escape").decode()
    process = subprocess.Popen([sys.executable, "-c", FLOOD, str(daemon.socket), text, str(count)])
    try:
        yield
    finally:
        process.kill()
        process.wait()


async def lateness_s() -> list[float]:
    """How late this loop, on which a guard would look, comes to what is due."""
    late_s, due_s = [], time.monotonic()
    for _ in range(LOOKS):
        due_s = max(due_s + PERIOD_S, time.monotonic())
        await asyncio.sleep(due_s - time.monotonic())
        late_s.append(time.monotonic() - due_s)
    return sorted(late_s)


ANOTHER = """
import sys, time

late_s, due_s = [], time.monotonic()
for _ in range(int(sys.argv[1])):
    due_s = max(due_s + float(sys.argv[2]), time.monotonic())
    time.sleep(max(0.0, due_s - time.monotonic()))
    late_s.append(time.monotonic() - due_s)
print(sorted(late_s)[len(late_s) // 2])
"""


async def test_a_flood_of_clients_makes_neither_the_control_loop_late_nor_shuts_out_a_stop(tmp_path: Path):
    """What the control loop is late is the median, and compared with that of a process which has nothing to do with it:
    it takes turns with two threads more, each of which may wait for a processor."""
    async with serve_fake(FakeService(), tmp_path) as desk:
        await asyncio.to_thread(ask, tmp_path, "stop")  # everything is imported
        with flood(tmp_path, 2 * MOST_CLIENTS):
            await asyncio.sleep(1.0)
            command = [sys.executable, "-S", "-c", ANOTHER, str(LOOKS), str(PERIOD_S)]
            another = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
            late_s = await lateness_s()
            for _ in range(3):
                assert (await asyncio.to_thread(ask, tmp_path, "stop"))["verb"] == "stop"
                assert (await asyncio.to_thread(find_session_server(tmp_path).state)).stand == "a stand"
            another_s = float((await asyncio.to_thread(another.communicate))[0])
    assert late_s[len(late_s) // 2] < 0.01 + 4 * another_s
    assert {verb for _, verb, _ in desk.orders} == {"stop"}


async def test_a_flood_of_stops_is_one_stop_each_time(tmp_path: Path):
    stop = b"POST /api/v1/run/stop HTTP/1.1\r\nHost: localhost\r\n\r\n"
    async with serve_fake(FakeService(), tmp_path) as desk:
        await asyncio.to_thread(ask, tmp_path, "stop")
        began_s = time.monotonic()
        with flood(tmp_path, 8, stop):
            await asyncio.sleep(1.0)
        elapsed_s = time.monotonic() - began_s
    assert 2 <= len(desk.orders) <= 2 + 10 * elapsed_s  # 0.1 s apart: the recording is not filled with them


@pytest.mark.parametrize("silence", [b"", b"POST /api/v1/run/st"])
async def test_silent_clients_shut_nobody_out(tmp_path: Path, silence: bytes):
    async with serve_fake(FakeService(), tmp_path), contextlib.AsyncExitStack() as stack:
        for _ in range(3 * MOST_CLIENTS):
            client = stack.enter_context(await asyncio.to_thread(connected, tmp_path))
            with contextlib.suppress(BrokenPipeError):  # it had to make room already
                client.sendall(silence)
        for _ in range(2 * MOST_CLIENTS):
            assert (await asyncio.to_thread(ask, tmp_path, "pause"))["verb"] == "pause"
        assert (await asyncio.to_thread(ask, tmp_path, "stop"))["verb"] == "stop"


async def test_a_client_that_asks_and_never_reads_is_not_waited_for(tmp_path: Path):
    async with serve_fake(FakeService(), tmp_path), contextlib.AsyncExitStack() as stack:
        for _ in range(8):
            greedy = stack.enter_context(await asyncio.to_thread(connected, tmp_path))
            greedy.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                greedy.sendall(b"GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n" * 200)
        assert (await asyncio.to_thread(ask, tmp_path, "stop"))["verb"] == "stop"
        assert (await asyncio.to_thread(find_session_server(tmp_path).state)).stand == "a stand"


DAEMON = """
import asyncio, os, resource, sys
from pathlib import Path
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api_models import CommandAnswer
from tests.stand.fake_service import FakeService, serve_fake

class Desk(FakeService):
    def stop(self, who):
        ended.set()
        return super().stop(who)

    def pause(self, who, given):
        self.moving = (take_all(),)  # what clients that have left since held, too
        return super().pause(who, given)

def take_all():
    try:
        while True:
            os.open("/dev/null", os.O_RDONLY)
    except OSError as error:
        return error.strerror

async def run():
    global ended
    ended = asyncio.Event()
    folder, port = Path(sys.argv[1]), int(sys.argv[2])
    async with serve_fake(Desk(), folder, Interface(folder.parent, port=port)):
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        take_all()
        print("no descriptor left", flush=True)
        await ended.wait()

resource.setrlimit(resource.RLIMIT_NOFILE, (64, 64))
asyncio.run(run())
print("ended", flush=True)
"""


def test_a_daemon_without_a_descriptor_left_still_answers(tmp_path: Path):
    with contextlib.ExitStack() as stack:
        port = free_port()
        command = [sys.executable, "-c", DAEMON, tmp_path, str(port)]
        daemon = stack.enter_context(
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        )
        stack.callback(daemon.kill)
        assert daemon.stdout is not None
        assert daemon.stdin is not None
        assert daemon.stdout.readline() == "ready\n"
        assert ask(tmp_path, "continue", timeout_s=30.0)["verb"] == "continue"
        daemon.stdin.write("\n")
        daemon.stdin.flush()
        assert daemon.stdout.readline() == "no descriptor left\n"
        for _ in range(3):
            assert ask(tmp_path, "pause")["moving"] == ["Too many open files"]
        silent = [stack.enter_context(connected(tmp_path)) for _ in range(20)]  # more than there are spares
        for _ in range(10):
            assert ask(tmp_path, "pause")["moving"]
        silent[0].settimeout(5.0)
        with silent[0].makefile("rb") as answers:
            assert b"no descriptor left" in answers.read()
        for _ in range(20):
            stack.enter_context(socket.create_connection(("127.0.0.1", port), 5.0))
        assert make_server(f"http://127.0.0.1:{port}").order("pause", timeout_s=30.0)["moving"]
        assert make_server(f"http://127.0.0.1:{port}").order("stop")["verb"] == "stop"
        assert daemon.stdout.readline() == "ended\n"


async def test_a_body_in_chunks_is_not_taken_apart_and_the_stop_before_it_is_done(tmp_path: Path):
    """A megabyte of one byte each: it says so and hangs up; STOP needs no body, and does what it is asked to."""
    chunks = b"1\r\nx\r\n" * 170_000
    async with serve_fake(FakeService(), tmp_path) as desk:
        for path, status in (("run/stop", b"200"), ("run/pause", b"411")):
            head = f"POST /api/v1/{path} HTTP/1.1\r\nHost: localhost\r\nTransfer-Encoding: chunked\r\n\r\n".encode()
            with await asyncio.to_thread(connected, tmp_path) as client:
                client.settimeout(10.0)
                await asyncio.to_thread(client.sendall, head + chunks[:6000])
                with contextlib.suppress(OSError):
                    await asyncio.to_thread(client.sendall, chunks)
                with contextlib.suppress(ConnectionResetError):
                    answer = await asyncio.to_thread(client.recv, 65536)
                    assert answer.split(b" ")[1] == status
                    assert b"connection: close" in answer.lower()
        used_s = time.process_time()
        with flood(tmp_path, 8, head + chunks[:60_000]):
            await asyncio.sleep(1.0)
            assert (await asyncio.to_thread(ask, tmp_path, "stop"))["verb"] == "stop"
        assert time.process_time() - used_s < 10
    assert {verb for _, verb, _ in desk.orders} == {"stop"}
