"""Those who want something else than STOP, in uvicorn's protocols: the thread at the doors (stop_thread.py) hands them
over once their request is known.

At most MOST_CLIENTS are in at once, as a script that leaks connections must not take the files that others need; the
next one waits at the door. Each leaves with its answer, but for viewers. Who does not read is not kept for ever.
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol, cast

from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import CloseCode

from thermostand.stand.serving.api.access import get_peer_uid, make_last_refusal

MOST_CLIENTS = 64  # of 1,024 descriptors that a process usually has
_UNREAD = 10  # looks, one a second, at an answer that is not read
_FAREWELL_LIMIT_S = 1.0  # for clients that do not read their last answer
# A browser answers a ping each 20 s with 10 bytes. A read counts as 64 bytes at least: eight a second, 64 at once.
# Without a limit a viewer that talks is never sent away.
_VIEWER_BYTES_PER_S, _VIEWER_BURST_BYTES, _LEAST_BYTES = 512, 4096, 64
_BACKLOG = 4096  # who finds no place in it is tried again by the kernel after 1 s


class _Connection(Protocol):
    """What uvicorn's protocols for HTTP and for the stream have in common."""

    transport: asyncio.Transport

    def shutdown(self) -> None: ...


class _Client(H11Protocol):
    """One connection. unread: how often in a row it had not read all of its answer when it was looked at."""

    unread = 0

    def send_400_response(self, msg: str) -> None:
        """A sentence, as for everything that is refused."""
        self.transport.write(make_last_refusal(400, "this is no HTTP request, or its head is longer than 32 KiB"))
        self.transport.close()


class _Viewer(WebSocketsSansIOProtocol):
    """One viewer. It has nothing to say but the answers to our pings, so that little of what it sends is ever looked
    at: one that says more is disconnected, before anything is done for it."""

    _heard_s = 0.0
    _budget_bytes = 0.0
    _has_asked = False

    def data_received(self, data: bytes) -> None:
        """Take data within the budget; the first is the request, and until it is answered the client has nothing to
        say."""
        now_s = self.loop.time()
        if not self._has_asked:
            self._has_asked, self._budget_bytes = True, float(_VIEWER_BURST_BYTES)
        elif not self.handshake_complete:
            self.transport.abort()
            return
        else:
            granted_bytes = (now_s - self._heard_s) * _VIEWER_BYTES_PER_S
            self._budget_bytes = min(self._budget_bytes + granted_bytes, _VIEWER_BURST_BYTES)
            self._budget_bytes -= max(len(data), _LEAST_BYTES)
        self._heard_s = now_s
        if self._budget_bytes >= 0:
            super().data_received(data)
        elif not self.transport.is_closing():
            self.conn.fail(CloseCode.POLICY_VIOLATION, "a viewer has nothing to say")
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.transport.close()


class Clients:
    """The clients of `app`, until closed."""

    def __init__(self, app: Callable[..., Any]) -> None:
        self._config = Config(
            app,
            http="h11",
            ws=_Viewer,
            lifespan="off",
            interface="asgi3",
            log_config=None,
            log_level="critical",  # what fails is reported by the gatekeeper
            access_log=False,
            proxy_headers=False,
            server_header=False,
            date_header=False,
            h11_max_incomplete_event_size=1 << 15,
            timeout_keep_alive=5,
            ws_max_size=1 << 12,
            ws_ping_interval=20.0,
            ws_ping_timeout=20.0,
            ws_per_message_deflate=False,
        )
        self._config.load()
        self._server = ServerState()
        self._loop = asyncio.get_running_loop()
        self._coming: set[socket.socket] = set()
        self._is_open = True

    def take(self, door: str, connection: socket.socket) -> bool:
        """Let one in, from any thread; whether there is a place for it. door: "socket" or "tcp"."""
        if not self._is_open or len(self._server.connections) + len(self._coming) >= MOST_CLIENTS:
            return False
        self._coming.add(connection)
        try:
            self._loop.call_soon_threadsafe(self._welcome, door, connection)
        except RuntimeError:  # the loop has ended
            connection.close()
        return True

    async def accept_at(self, door: str, listening: socket.socket) -> asyncio.Server:
        """Accept here: the thread at the doors has ended."""
        return await self._loop.create_server(lambda: self._make_client(door, None), sock=listening)

    def look_after(self) -> None:
        """Drop clients that do not read their answers; to be called once a second."""
        for client in [each for each in self._server.connections if isinstance(each, _Client)]:
            client.unread = client.unread + 1 if client.transport.get_write_buffer_size() else 0
            if client.unread > _UNREAD:
                client.transport.abort()

    async def close(self) -> None:
        """End every connection; answers that were given still arrive."""
        self._is_open = False
        for connection in self._list_connections():
            connection.shutdown()
        until_s = self._loop.time() + _FAREWELL_LIMIT_S
        while (self._server.connections or self._server.tasks) and self._loop.time() < until_s:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        for task in tuple(self._server.tasks):
            task.cancel()
        for connection in self._list_connections():
            connection.transport.abort()
        await asyncio.sleep(0)

    def _list_connections(self) -> list[_Connection]:
        return [cast("_Connection", each) for each in self._server.connections]

    def _make_client(self, door: str, connection: socket.socket | None) -> _Client:
        state = {"door": door, "uid": get_peer_uid(connection) if connection is not None and door == "socket" else None}
        return _Client(self._config, self._server, state, self._loop)

    def _welcome(self, door: str, connection: socket.socket) -> None:
        async def welcome() -> None:
            try:
                with suppress(OSError):  # it is gone again
                    await self._loop.connect_accepted_socket(lambda: self._make_client(door, connection), connection)
            finally:
                self._coming.discard(connection)

        task = self._loop.create_task(welcome())
        self._server.tasks.add(task)
        task.add_done_callback(self._server.tasks.discard)


def open_listening_socket(host: str, port: int) -> socket.socket:
    """A listening TCP socket; raises OSError."""
    family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    listening = socket.socket(family, socket.SOCK_STREAM)
    try:
        listening.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listening.bind(address)
        listening.setblocking(False)
        listening.listen(_BACKLOG)
    except OSError:
        listening.close()
        raise
    return listening
