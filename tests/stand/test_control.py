"""A daemon's control socket: a real one, and whoever may connect to it."""

import asyncio
import contextlib
import json
import os
import signal
import socket
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path

import pytest

from drivers.interface import SessionError
from stand.remote.control import LINE_LIMIT_BYTES, SOCKET_NAME, RunStatus, handlers, serve
from stand.remote.control_client import ask, ask_status, running_sessions
from stand.running.gate import Gate

STATUS = RunStatus(
    recipe="thermal-cycle",
    step=12,
    steps=87,
    doing="Soak duration_s=2700",
    state="running",
    reasons=(),
    now_ns=1_000_000_000_000,
    since_ns=900_000_000_000,
    end_ns=None,
    temperatures_degC={"thermometers.air": 23.98, "camera.temperature": None},
    frames_saved=120,
    frames_lost=1,
    disk_free_bytes=12_300_000_000,
)


def gate_held_by(*reasons: str) -> Gate:
    gate = Gate()
    for reason in reasons:
        gate.hold(reason)
    return gate


def echo(request: Mapping[str, object]) -> dict[str, object]:
    return {"text": request.get("text")}


async def slow_echo(request: Mapping[str, object]) -> dict[str, object]:
    await asyncio.sleep(0)
    return echo(request)


def refuse(_: Mapping[str, object]) -> dict[str, object]:
    raise SessionError("the session is not in the mood")


HANDLERS = {"echo": echo, "slow_echo": slow_echo, "refuse": refuse}


async def answers(session: Path, sent: bytes) -> list[dict[str, object]]:
    """Everything that comes back for these bytes, the sender's end closed behind them."""
    reader, writer = await asyncio.open_unix_connection(session / SOCKET_NAME)
    with contextlib.suppress(OSError):  # it may hang up before it has read everything
        writer.write(sent)
        await writer.drain()
        writer.write_eof()
    lines = []
    with contextlib.suppress(OSError):
        lines = (await reader.read()).splitlines()
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return [json.loads(line) for line in lines]


async def test_a_request_is_answered_by_its_handler_whether_it_waits_or_not(tmp_path: Path):
    async with serve(tmp_path / SOCKET_NAME, HANDLERS):
        for do in ("echo", "slow_echo"):
            answer = await asyncio.to_thread(ask, tmp_path, {"do": do, "text": "ü\n°"})
            assert answer == {"text": "ü\n°"}
        with pytest.raises(SessionError, match="the session is not in the mood"):
            await asyncio.to_thread(ask, tmp_path, {"do": "refuse"})


@pytest.mark.parametrize(
    ("sent", "sentence"),
    [
        (b"\x00\xff\xfe\n", "expected a JSON object"),
        (b"GET / HTTP/1.1\r\n", "expected a JSON object"),
        (b"[1, 2]\n", "expected a JSON object"),
        (b"\n", "expected a JSON object"),
        (b"[" * 60_000 + b"\n", "expected a JSON object"),
        (b"9" * 60_000 + b"\n", "expected a JSON object"),
        (b'{"do": "explode"}\n', '"do" is one of echo, slow_echo, refuse'),
        (b'{"do": ["echo"]}\n', '"do" is one of'),
        (b"{}\n", '"do" is one of'),
        (b'{"do": "echo"}', "broke off before the end of its line; nothing was done"),
        (b"x" * (LINE_LIMIT_BYTES + 10), "at most 65536 bytes"),
        (b"x" * (4 * LINE_LIMIT_BYTES) + b"\n", "at most 65536 bytes"),
    ],
)
async def test_garbage_is_answered_with_a_sentence_and_hurts_nobody(tmp_path: Path, sent: bytes, sentence: str):
    async with serve(tmp_path / SOCKET_NAME, HANDLERS):
        got = await answers(tmp_path, sent)
        if got:  # the kernel drops what it has for a sender that is cut off while it still sends
            assert got[0]["ok"] is False
            assert sentence in str(got[0]["error"])
        else:
            assert len(sent) > LINE_LIMIT_BYTES
        assert await answers(tmp_path, b'{"do": "echo"}\n') == [{"ok": True, "text": None}]


async def test_requests_arrive_whole_byte_by_byte_and_many_at_once(tmp_path: Path):
    line = b'{"do": "slow_echo", "text": 1}\n'
    async with serve(tmp_path / SOCKET_NAME, HANDLERS):
        assert await answers(tmp_path, line * 3 + b"nonsense\n" + line) == [
            *[{"ok": True, "text": 1}] * 3,
            {"ok": False, "error": 'expected a JSON object such as {"do": "status"}'},
            {"ok": True, "text": 1},
        ]
        reader, writer = await asyncio.open_unix_connection(tmp_path / SOCKET_NAME)
        for byte in line:
            writer.write(bytes([byte]))
            await writer.drain()
            await asyncio.sleep(0)
        assert json.loads(await reader.readline()) == {"ok": True, "text": 1}
        writer.close()
        await writer.wait_closed()


async def test_a_client_that_hangs_up_half_way_harms_nobody(tmp_path: Path):
    async with serve(tmp_path / SOCKET_NAME, HANDLERS):
        for sent in (b"", b'{"do"', b'{"do": "echo"}\n' * 1000):
            _, writer = await asyncio.open_unix_connection(tmp_path / SOCKET_NAME)
            writer.write(sent)
            writer.transport.abort()
        assert await asyncio.to_thread(ask, tmp_path, {"do": "echo", "text": 1}) == {"text": 1}


async def test_many_clients_are_served_side_by_side_and_too_many_are_told_so(tmp_path: Path):
    async with serve(tmp_path / SOCKET_NAME, HANDLERS), contextlib.AsyncExitStack() as stack:
        clients = []
        for number in range(64):
            client = await asyncio.open_unix_connection(tmp_path / SOCKET_NAME)
            stack.callback(client[1].close)
            client[1].write(json.dumps({"do": "echo", "text": number}).encode() + b"\n")
            clients.append(client)
        for number, (reader, _) in enumerate(clients):
            assert json.loads(await reader.readline())["text"] == number
        with pytest.raises(SessionError, match="64 clients are connected already"):
            await asyncio.to_thread(ask, tmp_path, {"do": "echo"})
        clients[0][1].write_eof()
        assert await clients[0][0].read() == b""
        assert await asyncio.to_thread(ask, tmp_path, {"do": "echo"}) == {"text": None}


async def test_a_request_that_ends_the_daemon_is_still_answered(tmp_path: Path):
    ended = asyncio.Event()

    def end(_: Mapping[str, object]) -> dict[str, object]:
        ended.set()
        return {"said": "goodbye"}

    async def daemon() -> None:
        async with serve(tmp_path / SOCKET_NAME, {"stop": end}):
            await ended.wait()

    running = asyncio.create_task(daemon())
    await asyncio.sleep(0)
    assert await answers(tmp_path, b'{"do": "stop"}\n') == [{"ok": True, "said": "goodbye"}]
    await running
    assert not (tmp_path / SOCKET_NAME).exists()


async def test_ending_does_not_wait_for_a_client_that_neither_asks_nor_reads(tmp_path: Path):
    async with asyncio.timeout(5):
        async with serve(tmp_path / SOCKET_NAME, HANDLERS):
            reader, writer = await asyncio.open_unix_connection(tmp_path / SOCKET_NAME)
            await answers(tmp_path, b'{"do": "echo"}\n')
        assert await reader.read() == b""
    writer.close()
    await writer.wait_closed()


async def test_only_its_user_may_reach_the_socket_whatever_the_umask(tmp_path: Path):
    before = os.umask(0)
    try:
        async with serve(tmp_path / SOCKET_NAME, HANDLERS):
            mode = (tmp_path / SOCKET_NAME).stat().st_mode
    finally:
        os.umask(before)
    assert stat.S_IMODE(mode) == 0o600


async def test_a_path_longer_than_the_kernel_takes_is_served(tmp_path: Path):
    session = tmp_path / ("a" * 200) / ("b" * 200)
    session.mkdir(parents=True)
    async with serve(session / SOCKET_NAME, HANDLERS):
        assert await asyncio.to_thread(ask, session, {"do": "echo", "text": 1}) == {"text": 1}
        assert await asyncio.to_thread(running_sessions, session.parent) == [session]
    assert list(session.iterdir()) == []


async def test_a_second_daemon_is_refused_and_leaves_the_first_alone(tmp_path: Path):
    async with serve(tmp_path / SOCKET_NAME, HANDLERS):
        with pytest.raises(SessionError, match="another daemon is running this session"):
            async with serve(tmp_path / SOCKET_NAME, HANDLERS):
                pass
        assert await asyncio.to_thread(ask, tmp_path, {"do": "echo", "text": 1}) == {"text": 1}
    async with serve(tmp_path / SOCKET_NAME, HANDLERS):
        pass


DAEMON = """
import asyncio, sys
from pathlib import Path
from stand.remote.control import serve

async def run():
    async with serve(Path(sys.argv[1]), {"echo": lambda request: {}}):
        print("ready", flush=True)
        await asyncio.Event().wait()

asyncio.run(run())
"""


@pytest.fixture
def daemon() -> Iterator[Callable[[Path], "subprocess.Popen[str]"]]:
    started = []

    def start(session: Path) -> "subprocess.Popen[str]":
        process = subprocess.Popen(
            [sys.executable, "-c", DAEMON, str(session / SOCKET_NAME)], stdout=subprocess.PIPE, text=True
        )
        started.append(process)
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()
        process.stdout.close()


async def test_the_socket_of_a_killed_daemon_is_nobodys_and_is_replaced(
    tmp_path: Path, daemon: Callable[[Path], "subprocess.Popen[str]"]
):
    process = daemon(tmp_path)
    assert ask(tmp_path, {"do": "echo"}) == {}
    with pytest.raises(SessionError, match="another daemon is running this session"):
        async with serve(tmp_path / SOCKET_NAME, HANDLERS):
            pass
    process.kill()
    process.wait()
    assert (tmp_path / SOCKET_NAME).is_socket()
    with pytest.raises(SessionError, match="no daemon is running this session"):
        ask(tmp_path, {"do": "echo"})
    assert running_sessions(tmp_path.parent) == []
    async with serve(tmp_path / SOCKET_NAME, HANDLERS):
        assert await asyncio.to_thread(ask, tmp_path, {"do": "echo", "text": 1}) == {"text": 1}


def test_a_daemon_that_hangs_is_told_from_one_that_is_not_there(
    tmp_path: Path, daemon: Callable[[Path], "subprocess.Popen[str]"]
):
    daemon(tmp_path).send_signal(signal.SIGSTOP)
    with pytest.raises(SessionError, match=r"has not answered within 0\.2 s; it may hang"):
        ask(tmp_path, {"do": "echo"}, timeout_s=0.2)


async def test_a_file_of_the_sockets_name_is_not_removed(tmp_path: Path):
    (tmp_path / SOCKET_NAME).write_text("mine")
    with pytest.raises(SessionError, match="is in the way of the control socket"):
        async with serve(tmp_path / SOCKET_NAME, HANDLERS):
            pass
    assert (tmp_path / SOCKET_NAME).read_text() == "mine"
    with pytest.raises(SessionError, match="no daemon is running this session"):
        ask(tmp_path, {"do": "echo"})


def test_a_folder_without_a_daemon_and_no_folder_at_all_have_their_sentences(tmp_path: Path):
    with pytest.raises(SessionError, match="no daemon is running this session"):
        ask(tmp_path, {"do": "status"})
    with pytest.raises(SessionError, match="cannot be opened"):
        ask(tmp_path / "nowhere", {"do": "status"})


@pytest.mark.parametrize(
    ("said", "sentence"),
    [
        (b"", "ended before it answered"),
        (b'{"ok": true', "ended before it answered"),
        (b"hello\n", "answered what nobody understands"),
        (b'{"ok": 1}\n', "answered what nobody understands"),
        (b'{"ok": true, "status": {"recipe": 3}}\n', "as another version would"),
    ],
)
async def test_a_daemon_that_talks_nonsense_is_said_to(tmp_path: Path, said: bytes, sentence: str):
    async def talk(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.readline()
        writer.write(said)
        writer.close()

    listening = socket.socket(socket.AF_UNIX)
    listening.bind(str(tmp_path / SOCKET_NAME))
    async with await asyncio.start_unix_server(talk, sock=listening):
        with pytest.raises(SessionError, match=sentence):
            await asyncio.to_thread(ask_status, tmp_path)


async def test_an_operator_holds_releases_clears_and_stops_the_run(tmp_path: Path):
    gate, stopped = gate_held_by("interlock"), asyncio.Event()
    async with serve(tmp_path / SOCKET_NAME, handlers(gate, stopped.set, lambda: STATUS)):

        async def do(what: str) -> dict[str, object]:
            return await asyncio.to_thread(ask, tmp_path, {"do": what})

        assert await do("pause") == {"reasons": ["interlock", "operator"]}
        assert await do("continue") == {"reasons": ["interlock"]}  # no reason takes another's place
        assert await do("clear") == {"reasons": []}
        with pytest.raises(SessionError, match="nothing to clear"):
            await do("clear")
        assert await asyncio.to_thread(ask_status, tmp_path) == STATUS
        assert not stopped.is_set()
        assert await do("stop") == {}
        assert stopped.is_set()
