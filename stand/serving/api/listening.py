"""Lets clients in, in front of uvicorn's protocols.

It accepts by itself and not with asyncio's server, which stops accepting for 1 s when no descriptor is left. There is
always room for one more: with MOST_CLIENTS connected, or no descriptor left, the client that was silent longest is
disconnected; a few spare descriptors are kept for that case. When all of them wait for an answer, a client that has
been answered leaves, and the next ones come in, in the order of the kernel's queue. Who neither asks nor reads is not
kept for ever.
"""

from __future__ import annotations

import asyncio
import os
import socket
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol, cast

from uvicorn.config import Config
from uvicorn.protocols.http.h11_impl import H11Protocol
from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol
from uvicorn.server import ServerState
from websockets.frames import CloseCode

from thermostand.stand.serving.api.access import last_refusal, uid_of
from thermostand.stand.serving.api.pace import Pace
from thermostand.stand.serving.api.stop_thread import Others, is_readable

MOST_CLIENTS = 64  # a script that leaks connections must not take the files the recording needs
_MOST_ASKING = 96  # when all of them wait for an answer
_MAY_SPEAK_S, _MOST_SILENT = 0.25, 16  # who has come and not spoken yet is not the first to go
_SPARES = 4  # more than one: another thread may open a file between our closing a spare and accepting
_AT_ONCE = 4
_REST_S = 0.02  # at most, however little budget there is: STOP may be among those who wait
_NO_DESCRIPTOR_PAUSE_S = 0.1
_ASK_WITHIN_S = 10.0  # a whole request's head, from the first moment or the answer before
_IDLE_LIMIT_S = 60.0
_FAREWELL_LIMIT_S = 1.0  # for clients that do not read their last answer
_BACKLOG = 4096  # who finds no place in it is tried again by the kernel after 1 s
_PIECE_BYTES = 4096  # of what a client sends, looked at before more of it is taken apart
# A browser answers a ping each 20 s with 10 bytes. A read counts as 64 bytes at least: eight a second, 64 at once.
_VIEWER_BYTES_PER_S, _VIEWER_BURST_BYTES, _LEAST_BYTES = 512, 4096, 64

Door = socket.socket | Others


class _Connection(Protocol):
    """What uvicorn's protocols for HTTP and for the stream have in common."""

    transport: asyncio.Transport

    def shutdown(self) -> None: ...


class _Client(H11Protocol):
    """One connection. heard_s: when it last said something, on the loop's clock."""

    heard_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """As ever."""
        self.heard_s = self.loop.time()
        super().connection_made(transport)

    def data_received(self, data: bytes) -> None:
        """As ever, but for a body in chunks, which is refused and not taken apart: of one byte each, a megabyte of them
        keeps the thread, and STOP with it, for half a minute."""
        self.heard_s = self.loop.time()
        for begin in range(0, len(data), _PIECE_BYTES):
            if self._is_in_chunks:
                return
            super().data_received(data[begin : begin + _PIECE_BYTES])
            if self.transport.get_protocol() is not self:  # it is a viewer from here on
                if rest := data[begin + _PIECE_BYTES :]:
                    self.transport.get_protocol().data_received(rest)  # pyright: ignore[reportAttributeAccessIssue]
                return

    @property
    def _is_in_chunks(self) -> bool:
        """Whether the request under way, or the last one, has its body in chunks."""
        return self.cycle is not None and any(  # pyright: ignore[reportUnnecessaryComparison]
            name == b"transfer-encoding" for name, _ in self.scope["headers"]
        )

    def send_400_response(self, msg: str) -> None:
        """A sentence, as for everything that is refused."""
        _hang_up(self.transport, 400, "this is no HTTP request, or its head is longer than 32 KiB")

    @property
    def has_spoken(self) -> bool:
        """Whether there is something to read."""
        return is_readable(self.transport.get_extra_info("socket"))

    @property
    def is_answering(self) -> bool:
        """Whether it waits for an answer."""
        return self.cycle is not None and not self.cycle.response_complete  # pyright: ignore[reportUnnecessaryComparison]


class _Viewer(WebSocketsSansIOProtocol):
    """One viewer. It has nothing to say but the answers to our pings, so that little of what it sends is ever looked
    at: one that says more is disconnected, before anything is done for it."""

    _heard_s = 0.0
    _budget_bytes = 0.0
    _has_asked = False

    def data_received(self, data: bytes) -> None:
        """As ever, within the budget; the first is the request, and until it is answered there is nothing to say."""
        now_s = self.loop.time()
        if not self._has_asked:
            self._has_asked, self._budget_bytes = True, float(_VIEWER_BURST_BYTES)
        elif not self.handshake_complete:
            self.transport.abort()
            return
        else:
            earned_bytes = (now_s - self._heard_s) * _VIEWER_BYTES_PER_S
            self._budget_bytes = min(self._budget_bytes + earned_bytes, _VIEWER_BURST_BYTES)
            self._budget_bytes -= max(len(data), _LEAST_BYTES)
        self._heard_s = now_s
        if self._budget_bytes >= 0:
            super().data_received(data)
        elif not self.transport.is_closing():
            self.conn.fail(CloseCode.POLICY_VIOLATION, "a viewer has nothing to say")
            self.transport.write(b"".join(self.conn.data_to_send()))
            self.transport.close()


class Listening:
    """Accepts at listening sockets for `app` until closed."""

    def __init__(self, app: Callable[..., Any], pace: Pace) -> None:
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
            timeout_keep_alive=int(_ASK_WITHIN_S),
            ws_max_size=1 << 12,
            ws_ping_interval=20.0,
            ws_ping_timeout=20.0,
            ws_per_message_deflate=False,
        )
        self._config.load()
        self._server = ServerState()
        self._pace = pace
        self._loop = asyncio.get_running_loop()
        self._doors: dict[str, Door] = {}
        self._welcoming: set[asyncio.Task[object]] = set()
        self._spares: list[int] = []
        self._is_open = True
        self._keep_spares()

    @property
    def clients(self) -> int:
        """How many are connected, viewers included."""
        return len(self._server.connections)

    def listen(self, door: str, listening: Door) -> None:
        """Accept here from now on, without blocking, instead of the one of that door before; door: "socket" or
        "tcp"."""
        self._shut(door)
        self._doors[door] = listening
        self._loop.add_reader(listening, self._knocked, door)

    def look_after(self) -> None:
        """To be called once a second."""
        self._keep_spares()
        now_s = self._loop.time()
        for client in self._silent():
            limit_s = _IDLE_LIMIT_S if client.is_answering or client.cycle else _ASK_WITHIN_S
            if now_s - client.heard_s > limit_s:
                client.transport.abort()

    async def close(self) -> None:
        """End every connection; answers that were given still arrive."""
        self._is_open = False
        for door in tuple(self._doors):
            self._shut(door)
        for connection in self._connections():
            connection.shutdown()
        until_s = self._loop.time() + _FAREWELL_LIMIT_S
        while (self._server.connections or self._server.tasks) and self._loop.time() < until_s:  # noqa: ASYNC110
            await asyncio.sleep(0.01)
        for task in tuple(self._server.tasks):
            task.cancel()
        for connection in self._connections():
            connection.transport.abort()
        await asyncio.sleep(0)
        for spare in self._spares:
            os.close(spare)
        self._spares.clear()

    def _connections(self) -> list[_Connection]:
        return [cast("_Connection", each) for each in self._server.connections]

    def _silent(self) -> list[_Client]:
        """Those of HTTP, the one that was silent longest first; one that waits for an answer is not silent."""
        clients = [each for each in self._server.connections if isinstance(each, _Client)]
        return sorted(clients, key=lambda client: (client.is_answering, client.heard_s))

    def _shut(self, door: str) -> None:
        listening = self._doors.pop(door, None)
        if listening is not None:
            self._loop.remove_reader(listening)
            listening.close()

    def _knocked(self, door: str) -> None:
        """Let some in; then rest when the budget is spent."""
        listening = self._doors[door]
        pause_s = 0.0
        for _ in range(_AT_ONCE):
            if not is_readable(listening):
                break
            self._pace.is_crowded = not self._has_room()
            if self._pace.is_crowded:
                pause_s = _REST_S
                break
            try:
                connection, _ = listening.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                continue
            except OSError:  # no descriptor left, or no memory
                if not self._make_room():
                    pause_s = _NO_DESCRIPTOR_PAUSE_S
                    break
                continue
            self._welcome(door, connection)
        pause_s = pause_s or min(_REST_S, self._pace.spent())
        if pause_s:
            self._loop.remove_reader(listening)
            self._loop.call_later(pause_s, self._await_knock, door, listening)

    def _await_knock(self, door: str, listening: Door) -> None:
        if self._doors.get(door) is listening:
            self._loop.add_reader(listening, self._knocked, door)

    def _welcome(self, door: str, connection: socket.socket) -> None:
        connection.setblocking(False)
        state = {"door": door, "uid": uid_of(connection) if door == "socket" else None}

        def protocol() -> _Client:
            return _Client(self._config, self._server, state, self._loop)

        task = self._loop.create_task(self._loop.connect_accepted_socket(protocol, connection))
        self._welcoming.add(task)
        task.add_done_callback(self._welcomed)

    def _welcomed(self, task: asyncio.Task[object]) -> None:
        self._welcoming.discard(task)
        if not task.cancelled():
            task.exception()  # it is gone again

    def _has_room(self) -> bool:
        """Whether one more may come in; somebody silent leaves for it."""
        if self.clients < MOST_CLIENTS:
            return True
        silent = [client for client in self._silent() if not client.is_answering]
        may_leave = silent and (len(silent) > _MOST_SILENT or self._loop.time() - silent[0].heard_s > _MAY_SPEAK_S)
        if may_leave and self._send_away(silent, f"{MOST_CLIENTS} clients are connected, and you were silent longest"):
            return True
        return self.clients < _MOST_ASKING

    def _make_room(self) -> bool:
        """Free a descriptor for a new client."""
        if self._spares:
            os.close(self._spares.pop())
            return True
        return self._send_away(self._silent(), "the daemon has no descriptor left, and you were silent longest")

    def _send_away(self, silent: list[_Client], sentence: str) -> bool:
        """Disconnect the first of these, with the reason as far as it takes it, but for those who have spoken when this
        thread had no time to hear it."""
        client = next((each for each in silent if each.is_answering or not each.has_spoken), None)
        if client is None:
            return False
        if not client.is_answering:
            _hang_up(client.transport, 503, sentence)
        else:
            client.transport.abort()
        self._server.connections.discard(client)
        return True

    def _keep_spares(self) -> None:
        with suppress(OSError):  # none to be had now
            while len(self._spares) < _SPARES:
                self._spares.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))


def _hang_up(transport: asyncio.Transport, status: int, sentence: str) -> None:
    """The reason, as far as the client takes it, and the end."""
    transport.write(last_refusal(status, sentence))
    transport.close()


def listening_at(host: str, port: int) -> socket.socket:
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
