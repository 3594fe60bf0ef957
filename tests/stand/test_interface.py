"""A daemon's Unix socket: a real one, and those who may connect to it."""

import asyncio
import contextlib
import json
import os
import stat
from pathlib import Path

import pytest

from tests.daemon_queries import ask, ask_status
from tests.stand.fake_service import STATUS, FakeService, serve_fake
from tests.stand.interface_client import entries_of, obeys
from thermostand.foundation.errors import SessionError
from thermostand.stand.serving.client import list_running_sessions
from thermostand.stand.serving.instances import list_daemons, make_socket_address, open_folder

HEALTH = b"GET /healthz HTTP/1.1\r\nHost: localhost\r\n\r\n"
STOP = b"POST /api/v1/run/stop HTTP/1.1\r\nHost: localhost\r\n\r\n"


async def connect(session: Path) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:
    """To the daemon that runs `session`, over the few characters that a socket's path may have."""
    (daemon,) = [each for each in list_daemons() if each.entry.session == str(session)]
    with open_folder(daemon.socket.parent) as folder:
        return await asyncio.open_unix_connection(make_socket_address(folder, daemon.socket.name))


async def reply(reader: asyncio.StreamReader) -> tuple[int, dict[str, object]]:
    """One answer: its status and JSON; (0, {}) when the connection ends instead."""
    line, length = await reader.readline(), 0
    if not line:
        return 0, {}
    while header := (await reader.readline()).strip():
        name, _, value = header.decode().partition(":")
        length = int(value) if name.lower() == "content-length" else length
    return int(line.split()[1]), json.loads(await reader.readexactly(length))


async def answers(session: Path, sent: bytes) -> list[tuple[int, dict[str, object]]]:
    """Everything that comes back for these bytes, until the daemon hangs up."""
    reader, writer = await connect(session)
    found = []
    with contextlib.suppress(OSError, asyncio.IncompleteReadError):  # it may hang up before it has read everything
        writer.write(sent)
        await writer.drain()
        while (answer := await reply(reader)) != (0, {}):
            found.append(answer)
            if len(found) >= sent.count(b"HTTP/1.1"):
                break
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
    return found


@pytest.mark.parametrize(
    "sent",
    [
        b"\x00\xff\xfe\r\n\r\n",
        b'{"do": "status"}\r\n\r\n',
        b"GET\r\n\r\n",
        b"GET /healthz HTTP/1\r\n\r\n",
        b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX: " + b"x" * 70_000,
        b"GET /" + b"x" * 70_000,
        b"POST /api/v1/run/pause HTTP/1.1\r\nHost: localhost\r\nContent-Length: 1\r\nContent-Length: 2\r\n\r\n",
        b"POST /api/v1/run/pause HTTP/1.1\r\nHost: localhost\r\nContent-Length: -1\r\n\r\n",
    ],
)
async def test_garbage_is_answered_with_a_sentence_and_hurts_nobody(tmp_path: Path, sent: bytes):
    async with serve_fake(FakeService(), tmp_path) as desk:
        for status, answer in await answers(tmp_path, sent):  # the kernel may drop what a sender is cut off with
            assert status == 400
            assert "no HTTP request" in str(answer["error"])
        ((status, answer),) = await answers(tmp_path, HEALTH)
        assert (status, answer["ok"]) == (200, True)
        assert desk.orders == []


async def test_requests_arrive_whole_byte_by_byte_and_many_at_once(tmp_path: Path):
    async with serve_fake(FakeService(), tmp_path):
        assert [status for status, _ in await answers(tmp_path, HEALTH * 3)] == [200]  # each answer ends its connection
        reader, writer = await connect(tmp_path)
        for byte in STOP:
            writer.write(bytes([byte]))
            await writer.drain()
            await asyncio.sleep(0)
        assert (await reply(reader))[1]["verb"] == "stop"
        writer.close()
        await writer.wait_closed()


async def test_a_client_that_hangs_up_half_way_harms_nobody(tmp_path: Path):
    async with serve_fake(FakeService(), tmp_path):
        for sent in (b"", STOP[:20], HEALTH * 300):
            _, writer = await connect(tmp_path)
            writer.write(sent)
            writer.transport.abort()
        assert (await asyncio.to_thread(ask, tmp_path, "pause"))["reasons"] == ["operator"]


async def test_a_request_that_ends_the_daemon_is_still_answered(tmp_path: Path):
    ended = asyncio.Event()

    class Ending(FakeService):
        def stop(self, who):
            ended.set()
            return super().stop(who)

    async def daemon() -> None:
        async with serve_fake(Ending(), tmp_path):
            await ended.wait()

    running = asyncio.create_task(daemon())
    await asyncio.sleep(0)
    ((status, answer),) = await answers(tmp_path, STOP)
    assert (status, answer["verb"]) == (200, "stop")
    await running
    assert entries_of(tmp_path) == []


async def test_ending_does_not_wait_for_a_client_that_neither_asks_nor_reads(tmp_path: Path):
    async with asyncio.timeout(5):
        async with serve_fake(FakeService(), tmp_path):
            reader, writer = await connect(tmp_path)
            await answers(tmp_path, HEALTH)
        assert await reader.read() == b""
    writer.close()
    await writer.wait_closed()


async def test_only_its_user_may_reach_the_socket_whatever_the_umask(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    before = os.umask(0)
    try:
        async with serve_fake(FakeService(), tmp_path):
            (daemon,) = [each for each in list_daemons() if each.entry.session == str(tmp_path)]
            files = daemon.socket.parent.glob("[!.]*")  # one that is being written is there for a moment
            modes = [stat.S_IMODE(path.stat().st_mode) for path in (daemon.socket.parent, *files)]
    finally:
        os.umask(before)
    assert modes == [0o700, 0o600, 0o600, 0o600]


async def test_paths_longer_than_the_kernel_takes_are_served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    session, runtime = (tmp_path / name / ("a" * 200) / ("b" * 200) for name in ("sessions", "runtime"))
    session.mkdir(parents=True)
    runtime.mkdir(parents=True)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    async with serve_fake(FakeService(), session):
        assert await asyncio.to_thread(obeys, session)
        assert await asyncio.to_thread(list_running_sessions, session.parent) == [session]
    assert list(session.iterdir()) == []
    assert list((runtime / "thermostand").iterdir()) == []


async def test_an_operator_holds_releases_clears_and_stops_the_run(tmp_path: Path):
    async with serve_fake(FakeService("interlock", run=STATUS), tmp_path) as desk:

        async def do(what: str) -> dict[str, object]:
            return await asyncio.to_thread(ask, tmp_path, what)

        assert (await do("pause"))["reasons"] == ["interlock", "operator"]
        assert (await do("continue"))["reasons"] == ["interlock"]  # no reason takes another's place
        assert (await do("reset"))["reasons"] == []
        with pytest.raises(SessionError, match="nothing to reset"):
            await do("reset")
        assert await asyncio.to_thread(ask_status, tmp_path) == STATUS
        assert [verb for _, verb, _ in desk.orders] == ["pause", "continue", "reset"]
        await do("stop")
        assert [verb for _, verb, _ in desk.orders][-1] == "stop"
