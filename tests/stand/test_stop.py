"""STOP, which nobody can crowd out: over TCP and from the command line, beside clients that try."""

import asyncio
import contextlib
import http.client
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import pytest
from fastapi import APIRouter

from tests.daemon_queries import ask
from tests.nightly import mark_nightly
from tests.stand.fake_service import FakeService, serve_fake
from tests.stand.floods import FLOODS, PING, VIEW
from tests.stand.test_interface_access import book, free_port
from thermostand.foundation.items import Event
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.stop_thread import StopThread
from thermostand.stand.serving.api_models import Requester
from thermostand.stand.serving.client import find_session_server
from thermostand.stand.serving.secop import make_secop_listener

LIMIT_S = 5.0
STOP = b"POST /api/v1/run/stop HTTP/1.1\r\nHost: localhost\r\n"


def post(port: int, path: str = "/api/v1/run/stop", **headers: str) -> tuple[int, dict[str, Any]]:
    """The answer to a request on a new connection."""
    connection = http.client.HTTPConnection("127.0.0.1", port, timeout=LIMIT_S)
    with contextlib.closing(connection):
        connection.request("POST", path, headers=headers)
        answer = connection.getresponse()
        return answer.status, json.loads(answer.read())


def pressed(port: int) -> dict[str, Any]:
    """The answer to a STOP that is tried again as the page does it: among many who say nothing, one that a busy machine
    keeps from speaking for 20 ms may be sent away with them."""
    for _ in range(10):
        with contextlib.suppress(OSError, http.client.HTTPException):
            return post(port)[1]
    return post(port)[1]


def exchange(port: int, *parts: bytes) -> bytes:
    """All that comes back for these, each of them sent on its own, until the daemon hangs up."""
    with socket.create_connection(("127.0.0.1", port), LIMIT_S) as client:
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        for part in parts:
            client.sendall(part)
        with client.makefile("rb") as answer:
            return answer.read()


@contextlib.asynccontextmanager
async def open_stand(folder: Path, **interface: Any) -> AsyncIterator[tuple[FakeService, int]]:
    port = free_port()
    async with serve_fake(FakeService(), folder / "cycle", Interface(folder, port=port, **interface)) as desk:
        yield desk, port


@contextlib.contextmanager
def flooded(name: str, port: int, secop_port: int) -> Iterator[None]:
    """While inside clients of another process do it, and are still at it at the end."""
    program = Path(__file__).with_name("floods.py")
    command, ports = [sys.executable, "-S", str(program), name], {"PORTS": f"{port} {secop_port}"}
    with subprocess.Popen(command, stdout=subprocess.PIPE, env={**os.environ, **ports}) as flood:
        try:
            assert flood.stdout is not None
            assert flood.stdout.readline() == b"begun\n"
            yield
            assert flood.poll() is None
        finally:
            flood.kill()


DAILY = ("pings", "answers nobody reads", "half heads", "requests", "bodies in chunks", "uploads to STOP", "stops")


@pytest.mark.parametrize("name", [each if each in DAILY else mark_nightly(each) for each in FLOODS])
async def test_a_stop_is_done_and_answered_whatever_others_do(tmp_path: Path, name: str):
    secop_port = free_port()
    async with open_stand(tmp_path, doors=(make_secop_listener(secop_port),)) as (desk, port):
        flood = flooded(name, port, secop_port)
        await asyncio.to_thread(flood.__enter__)
        with contextlib.ExitStack() as stack:
            stack.push(flood)
            assert (await asyncio.to_thread(pressed, port))["verb"] == "stop"
            assert (await asyncio.to_thread(ask, tmp_path / "cycle", "stop"))["verb"] == "stop"
    assert "loopback" in [who.how for who, verb, _ in desk.orders if verb == "stop"]


class Stuck:
    """A room of which one route keeps the thread that serves clients until `end`."""

    def __init__(self) -> None:
        self.has_begun, self._end = threading.Event(), threading.Event()

    def end(self) -> None:
        self._end.set()

    def __call__(self, _: object) -> APIRouter:
        router = APIRouter()

        @router.get("/stuck")
        async def stuck() -> None:
            self.has_begun.set()
            self._end.wait(LIMIT_S)

        return router


async def test_a_stop_does_not_wait_for_what_serves_the_others(tmp_path: Path):
    routes = Stuck()
    async with open_stand(tmp_path, extra_routes=(routes,)) as (desk, port):
        waiting = asyncio.create_task(
            asyncio.to_thread(exchange, port, b"GET /stuck HTTP/1.1\r\nHost: localhost\r\n\r\n")
        )
        await asyncio.to_thread(routes.has_begun.wait, LIMIT_S)
        assert (await asyncio.to_thread(post, port))[1]["verb"] == "stop"
        assert (await asyncio.to_thread(ask, tmp_path / "cycle", "stop"))["verb"] == "stop"
        assert not waiting.done()
        assert [who.how for who, _, _ in desk.orders] == ["loopback", "socket"]
        routes.end()
        assert b"HTTP/1.1 200" in await waiting


@pytest.mark.parametrize(
    "parts",
    [
        (STOP + b"\r\n",),
        tuple(bytes([byte]) for byte in STOP + b"\r\n"),
        (STOP.replace(b" HTTP", b"?why=not HTTP") + b"\r\n",),
        (STOP, b"Content-Length: 1000000000\r\n\r\n", b"x" * 100_000),
        (STOP + b"Transfer-Encoding: chunked\r\n\r\n1\r\nx\r\n",),
        (STOP + b"\r\n" + STOP + b"\r\n",),
        (STOP.replace(b"1.1", b"1.0") + b"\r\n",),
        (STOP.replace(b"\r\n", b"\n") + b"\n",),
        (STOP.replace(b"stop", b"%73top") + b"\r\n",),
    ],
)
async def test_a_stop_is_understood_however_it_is_sent_and_its_body_is_not_waited_for(
    tmp_path: Path, parts: tuple[bytes, ...]
):
    async with open_stand(tmp_path) as (desk, port):
        answer = await asyncio.to_thread(exchange, port, *parts)
    head, _, body = answer.partition(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200 OK\r\n")
    assert b"connection: close" in head.lower()
    assert b"content-security-policy: default-src 'none'" in head
    assert json.loads(body)["verb"] == "stop"
    assert [verb for _, verb, _ in desk.orders] == ["stop"]


async def test_who_may_not_stop_gets_the_reason(tmp_path: Path):
    async with open_stand(tmp_path, tokens=book()) as (desk, port):
        for status, headers in (
            (403, {"Host": "evil.example"}),
            (403, {"Origin": "http://evil.example"}),
            (401, {"Authorization": "Bearer wrong"}),
        ):
            got, answer = await asyncio.to_thread(lambda headers=headers: post(port, **headers))
            assert (got, list(answer)) == (status, ["error"])
        assert desk.orders == []
        assert (await asyncio.to_thread(post, port))[0] == 200
    assert [who.how for who, _, _ in desk.orders] == ["network"]


async def test_a_viewer_that_speaks_before_it_is_let_in_is_left_without_a_failure(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
):
    async with open_stand(tmp_path) as (_, port):
        with socket.create_connection(("127.0.0.1", port), 10.0) as viewer, contextlib.suppress(ConnectionError):
            viewer.sendall(VIEW + PING * 1000)
            assert (await asyncio.to_thread(viewer.recv, 12)) in (b"", b"HTTP/1.1 101")
            viewer.sendall(PING * 1000)  # who was let in, and goes on so, has to leave
            while await asyncio.to_thread(viewer.recv, 1 << 16):
                pass
        assert (await asyncio.to_thread(find_session_server(tmp_path / "cycle").state)).stand == "a stand"
    assert caplog.records == []


@pytest.mark.parametrize("way", ["over TCP", "from the command line"])
async def test_a_stop_that_ends_the_daemon_is_answered(tmp_path: Path, way: str):
    ended = asyncio.Event()

    class Ending(FakeService):
        def stop(self, who: Requester) -> str:
            ended.set()
            return super().stop(who)

    port = free_port()

    def stop() -> Any:
        return post(port)[1]["verb"] if way == "over TCP" else ask(tmp_path / "cycle", "stop")["verb"]

    async with serve_fake(Ending(), tmp_path / "cycle", Interface(tmp_path, port=port)):
        stopping = asyncio.create_task(asyncio.to_thread(stop))
        await ended.wait()
    assert await stopping == "stop"
    with pytest.raises(ConnectionRefusedError):
        await asyncio.to_thread(post, port)


async def test_every_answer_over_the_network_ends_its_connection_so_that_stop_is_the_first_of_its_own(tmp_path: Path):
    async with open_stand(tmp_path) as (_, port):
        for path in (b"/healthz", b"/api/v1/state", b"/nothing"):
            request = b"GET " + path + b" HTTP/1.1\r\nHost: localhost\r\n\r\n"
            assert (await asyncio.to_thread(exchange, port, request)).count(b"connection: close") == 1


async def test_without_its_thread_stop_is_served_as_everything_else_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    def fails(self: StopThread) -> None:
        raise OSError("no epoll any more")

    async with open_stand(tmp_path) as (desk, port):
        failures = asyncio.Queue[Event]()
        desk.hub.subscribe(lambda item: failures.put_nowait(item) if isinstance(item, Event) else None)
        monkeypatch.setattr(StopThread, "_check_answers", fails)
        with contextlib.suppress(OSError, http.client.HTTPException):
            await asyncio.to_thread(post, port)
        assert (await asyncio.wait_for(failures.get(), LIMIT_S)).kind in ("command", "interface_failed")
        assert (await asyncio.to_thread(ask, tmp_path / "cycle", "stop"))["verb"] == "stop"
        assert (await asyncio.to_thread(post, port))[1]["verb"] == "stop"
        assert (await asyncio.to_thread(find_session_server(tmp_path / "cycle").state)).stand == "a stand"
