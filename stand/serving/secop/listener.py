"""The node's TCP port: who is connected, what each has asked and not been answered, and what each follows.

A client has its requests answered in the order of coming; STOP passes them. Of
values that it follows only the newest waits for it, so that a slow one keeps nothing, and one that does not read for a
while is disconnected. There is always room for one more: the client that was silent longest leaves, strangers first. A
first line that is no SECoP ends the connection: it may be a browser that was made to send commands here.
"""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable

from thermostand.stand.serving.api.bridge import Bridge
from thermostand.stand.serving.api.listeners import ProtocolListener
from thermostand.stand.serving.secop.node import Node, ParameterPath
from thermostand.stand.serving.secop.secop_lines import (
    ANSWERS,
    IDENTIFY,
    LINE_LIMIT_BYTES,
    Refusal,
    SecopRequest,
    make_error_reply,
    make_message,
    parse_request,
)

HOST = "127.0.0.1"  # the protocol knows neither user nor password: others come through a tunnel of theirs
# Round numbers; nothing was measured.
MOST_CLIENTS = 16
_MOST_WAITING = 64  # requests of a client
_MOST_ANSWERS = 256  # that a client has not read
_LOOK_S = 0.1
_REST_S = 0.05  # for a client that has spent the budget
_RECEIVE_BYTES = 4096
_SEND_BYTES = 1 << 16
_SEND_LIMIT_S = 10.0  # round number; nothing was measured
_SPEAK_WITHIN_S = 10.0  # the first request, from the first moment
_NO_DESCRIPTOR_S = 0.1  # round number; nothing was measured
_FAREWELL_S = 1.0


def make_secop_listener(port: int, *, read_only: bool = False) -> ProtocolListener:
    """The node's door, for this machine only. read_only: who comes may look, and order nothing but STOP."""

    async def serve(listening: socket.socket, bridge: Bridge, failed: Callable[[Exception], None]) -> None:
        await SecopListener(listening, bridge, failed, read_only=read_only).run()

    return ProtocolListener("--secop", HOST, port, serve)


class SecopListener:
    """Serves the node at a listening socket until cancelled. `failed` is called with errors that should not happen."""

    def __init__(
        self,
        listening: socket.socket,
        bridge: Bridge,
        failed: Callable[[Exception], None],
        *,
        read_only: bool = False,
    ) -> None:
        self._listening = listening
        self._read_only = read_only
        self._bridge = bridge
        self._failed = failed
        self._clients: dict[_Client, asyncio.Task[None]] = {}
        self._ending: set[asyncio.Task[None]] = set()

    async def run(self) -> None:
        """Serve until cancelled."""
        devices = await self._bridge.ask(lambda desk: desk.devices())
        self._listening.setblocking(False)
        node = Node(self._bridge, devices, self._tell, self._failed, read_only=self._read_only)
        looking = asyncio.create_task(self._look(node))
        try:
            await self._accept(node)
        finally:
            looking.cancel()
            for client in tuple(self._clients):
                self._send_away(client)
            await asyncio.gather(looking, *self._ending, return_exceptions=True)

    async def _look(self, node: Node) -> None:
        sent = None
        while True:
            snapshot = self._bridge.snapshot
            if snapshot is not sent or snapshot.age_s > 1.0:
                sent = snapshot
                try:
                    node.look()
                except Exception as error:  # noqa: BLE001 - what one value is must not end the door
                    self._failed(error)
            for client in tuple(self._clients):
                if client.is_stranger and client.silent_s > _SPEAK_WITHIN_S:
                    self._send_away(client)
            await asyncio.sleep(_LOOK_S)

    async def _accept(self, node: Node) -> None:
        loop = asyncio.get_running_loop()
        while True:
            try:
                connection, _ = await loop.sock_accept(self._listening)
            except OSError:  # no descriptor left, or gone again
                self._drop_silent_clients(len(self._clients))
                await asyncio.sleep(_NO_DESCRIPTOR_S)
                continue
            self._drop_silent_clients(MOST_CLIENTS)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            client = _Client(connection, node)
            self._clients[client] = task = asyncio.create_task(self._serve(client))
            task.add_done_callback(client.close)  # also of one that is sent away before it has begun

    async def _serve(self, client: _Client) -> None:
        try:
            await client.run()
        except Exception as error:  # noqa: BLE001 - it has lost its connection, and nobody else has
            self._failed(error)
        finally:
            self._clients.pop(client, None)

    def _send_away(self, client: _Client) -> None:
        task = self._clients.pop(client)
        task.cancel()
        self._ending.add(task)
        task.add_done_callback(self._ending.discard)

    def _drop_silent_clients(self, most: int) -> None:
        """Drop clients so that fewer than `most` are connected: the silent go, those first who have asked nothing that
        is SECoP."""
        silent = sorted(self._clients, key=lambda client: (not client.is_stranger, -client.silent_s))
        for client in silent[: max(0, len(silent) - most + 1)]:
            self._send_away(client)

    def _tell(self, place: ParameterPath, line: bytes) -> None:
        for client in self._clients:
            if client.is_following(place[0]):
                client.update(place, line)


class _Client:
    def __init__(self, connection: socket.socket, node: Node) -> None:
        self.is_stranger = True
        self._connection = connection
        self._node = node
        self._loop = asyncio.get_running_loop()
        self._heard_s = self._loop.time()
        self._followed: set[str] = set()  # modules
        self._asked: asyncio.Queue[SecopRequest] = asyncio.Queue(_MOST_WAITING)
        self._stops: deque[SecopRequest] = deque(maxlen=_MOST_WAITING)
        self._stopping: asyncio.Task[None] | None = None
        self._outgoing: dict[ParameterPath | int, bytes] = {}
        self._answers = 0  # ever given, and how many of them wait
        self._unread = 0
        self._something = asyncio.Event()
        self._is_leaving = False

    @property
    def silent_s(self) -> float:
        """How long since it last sent something, s."""
        return self._loop.time() - self._heard_s

    def is_following(self, module: str) -> bool:
        """Whether it gets what changes there."""
        return module in self._followed

    def update(self, place: ParameterPath, line: bytes) -> None:
        """The newest of a place, instead of one that waits, behind all else."""
        self._outgoing.pop(place, None)
        self._outgoing[place] = line
        self._something.set()

    def close(self, _: object = None) -> None:
        """The connection."""
        if self._stopping is not None:
            self._stopping.cancel()
        self._connection.close()

    async def run(self) -> None:
        """Serve the client until it leaves, or has to."""
        tasks = [asyncio.ensure_future(work()) for work in (self._receive, self._answer, self._send)]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
            if self._is_leaving:  # what it was sent last still arrives
                await asyncio.wait([tasks[2]], timeout=_FAREWELL_S)
        finally:
            for task in tasks:
                task.cancel()
            ends = await asyncio.gather(*tasks, return_exceptions=True)
        for end in ends:
            if isinstance(end, Exception) and not isinstance(end, OSError | TimeoutError):
                raise end

    async def _receive(self) -> None:
        rest = bytearray()
        while data := await self._loop.sock_recv(self._connection, _RECEIVE_BYTES):
            self._heard_s = self._loop.time()
            rest += data
            *lines, tail = rest.split(b"\n")
            rest = bytearray(tail)
            for line in lines:
                self._take(bytes(line))
            if len(rest) > LINE_LIMIT_BYTES:
                self._refuse_long_line()
            if self._is_leaving:
                return
            if self._asked.full():
                await asyncio.sleep(_REST_S)

    def _refuse_long_line(self) -> None:
        self._refuse(SecopRequest("line"), Refusal("ProtocolError", f"a line has at most {LINE_LIMIT_BYTES} bytes"))
        self._is_leaving = True

    def _take(self, line: bytes) -> None:
        """A line, unless one before it has ended the connection."""
        if self._is_leaving:
            return
        try:
            request = parse_request(line)
        except Refusal as refusal:
            self._refuse(SecopRequest("line"), refusal)
            self._is_leaving = self.is_stranger
            return
        if self.is_stranger and request.action not in ANSWERS and request.action != IDENTIFY:
            self._refuse(request, Refusal("ProtocolError", "this is no SECoP"))
            self._is_leaving = True
            return
        self.is_stranger = False
        if self._node.is_stop(request):
            self._stops.append(request)
            if self._stopping is None:
                self._stopping = asyncio.create_task(self._stop())
        elif self._asked.full():
            self._refuse(request, Refusal("IsBusy", f"{_MOST_WAITING} requests wait already"))
        else:
            self._asked.put_nowait(request)

    async def _stop(self) -> None:
        """All stops that came until the last one was done."""
        while self._stops:
            requests = list(self._stops)
            self._stops.clear()
            try:
                line = await self._node.stop(requests[0])
            except Refusal as refusal:
                line = make_error_reply(requests[0], refusal)
            for _ in requests:
                self._queue_answer(line)
        self._stopping = None

    async def _answer(self) -> None:
        while True:
            request = await self._asked.get()
            try:
                self._queue_answer(self._change_subscription(request) or await self._node.answer(request))
            except Refusal as refusal:
                self._refuse(request, refusal)

    def _change_subscription(self, request: SecopRequest) -> bytes:
        """The answer to what changes whom it follows, b"" for anything else."""
        module = request.place[0]
        match request.action:
            case "activate":
                names = {module} if self._names_module(module) else set(self._node.modules)
                for place in self._node.list_parameters(module):
                    self.update(place, self._node.make_update(place))
                self._followed |= names
                return make_message("active", module)
            case "deactivate":
                self._followed -= {module} if self._names_module(module) else set(self._node.modules)
                return make_message("inactive", module)
            case action if action == IDENTIFY:
                self._followed.clear()
                return b""
            case _:
                return b""

    def _names_module(self, module: str) -> bool:
        """Whether one module is meant; Refusal when there is none of that name."""
        return bool(module and self._node.get_module(module))

    def _refuse(self, request: SecopRequest, refusal: Refusal) -> None:
        self._queue_answer(make_error_reply(request, refusal))

    def _queue_answer(self, line: bytes) -> None:
        """An answer. Who does not read them is given no more, and leaves."""
        self._answers += 1
        self._unread += 1
        self._outgoing[self._answers] = line
        self._is_leaving = self._is_leaving or self._unread > _MOST_ANSWERS
        self._something.set()

    async def _send(self) -> None:
        while not (self._is_leaving and not self._outgoing):
            if not self._outgoing:
                self._something.clear()
                await self._something.wait()
            data = bytearray()
            while self._outgoing and len(data) < _SEND_BYTES:
                key = next(iter(self._outgoing))
                data += self._outgoing.pop(key)
                self._unread -= isinstance(key, int)
            async with asyncio.timeout(_SEND_LIMIT_S):
                await self._loop.sock_sendall(self._connection, data)
