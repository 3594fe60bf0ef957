"""Serves all clients of a control socket from the event loop without delaying its other work.

It accepts by itself and not with asyncio's server, which stops accepting for 1 s when no descriptor is left and has no
word in how much is done in one turn of the loop. All work (accepting, reading, answering) waits in one queue and takes
at most _TURN_S of a turn and a fifth of the time, so that a flood of clients cannot make the guard late. There is
always room for one more: with _MOST_CLIENTS connected, or no descriptor left, the client that was silent longest is
disconnected; a few spare descriptors are kept for that case.
"""

from __future__ import annotations

import asyncio
import inspect
import json
import os
import select
import socket
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from contextlib import suppress
from typing import cast

from foundation.errors import StandError

LINE_LIMIT_BYTES = 1 << 16
MOST_CLIENTS = 64  # a script that leaks connections must not take the files the recording needs
_IDLE_LIMIT_S = 60.0
_TURN_S = 0.002
_REST = 4  # times what a turn took
_ACCEPTED_AT_ONCE = 16
_SPARES = 4  # more than one: another thread may open a file between our closing a spare and accepting
_NO_DESCRIPTOR_PAUSE_S = 0.1
_LOOK_S = 1.0
_FAREWELL_LIMIT_S = 1.0  # for clients that do not read their last answer

Answer = dict[str, object]
Handler = Callable[[Mapping[str, object]], "Answer | Awaitable[Answer]"]
Handlers = Mapping[str, Handler]


class _Client:
    """One connection. heard_s: when it last said something, on the loop's clock."""

    def __init__(self, connection: socket.socket, heard_s: float) -> None:
        self.socket = connection
        self.heard_s = heard_s
        self.incoming = bytearray()
        self.outgoing = bytearray()
        self.is_over = False  # it will say nothing more
        self.is_leaving = False  # nothing more is done for it than to send what it has been answered
        self.answering: asyncio.Task[Answer] | None = None

    def receive(self, now_s: float) -> bool:
        """Take what has come, if anything; False when there may be more later. Raises OSError when it is gone."""
        try:
            data = self.socket.recv(LINE_LIMIT_BYTES)
        except (BlockingIOError, InterruptedError):
            return False
        self.heard_s = now_s
        self.incoming += data
        self.is_over = not data
        return True

    def line(self) -> bytes | None:
        """The next whole request, or None."""
        end = self.incoming.find(b"\n") + 1
        if not end:
            return None
        line = bytes(self.incoming[:end])
        del self.incoming[:end]
        return line

    def send(self) -> bool:
        """Send what it takes now; whether that was all. Raises OSError when it is gone."""
        with suppress(BlockingIOError, InterruptedError):
            while self.outgoing:
                del self.outgoing[: self.socket.send(self.outgoing)]
        return not self.outgoing


class Door:
    """Accepts at a listening socket and answers by `handlers` until closed. `look_after` is called every second."""

    def __init__(self, handlers: Handlers, look_after: Callable[[], None]) -> None:
        self._handlers = handlers
        self._look_after = look_after
        self._loop = asyncio.get_running_loop()
        self._listening: socket.socket | None = None
        self._somebody_knocks = False
        self._clients: set[_Client] = set()
        self._newcomers: deque[_Client] = (
            deque()
        )  # who has come to ask has asked already, and does not wait for all others
        self._queue: deque[_Client] = deque()
        self._newcomer_is_next = True
        self._next: asyncio.Handle | None = None  # the next turn
        self._rested_s = 0.0  # not before this instant
        self._spares: list[int] = []
        self._keep_spares()
        self._looking = self._loop.call_later(_LOOK_S, self._look)

    def listen(self, listening: socket.socket) -> None:
        """Accept at this socket from now on, instead of the one before."""
        self._stop_listening()
        self._listening = listening
        self._await_knock()

    async def close(self) -> None:
        """End every connection; answers that were given still arrive."""
        self._stop_listening()
        self._looking.cancel()
        if self._next is not None:
            self._next.cancel()
        for client in tuple(self._clients):
            self._loop.remove_reader(client.socket)
            client.is_leaving = True
            if not client.outgoing:
                self._hang_up(client)
        until_s = self._loop.time() + _FAREWELL_LIMIT_S
        while self._clients and self._loop.time() < until_s:  # noqa: ASYNC110 - they leave by themselves
            await asyncio.sleep(0.01)
        for client in tuple(self._clients):
            self._hang_up(client)
        for spare in self._spares:
            os.close(spare)
        self._spares.clear()

    def _stop_listening(self) -> None:
        if self._listening is not None:
            self._loop.remove_reader(self._listening)
            self._listening.close()
            self._listening = None

    def _await_knock(self) -> None:
        self._somebody_knocks = False
        if self._listening is not None:
            self._loop.add_reader(self._listening, self._knocked)

    def _knocked(self) -> None:
        if self._listening is not None:
            self._loop.remove_reader(self._listening)
            self._somebody_knocks = True
            self._wake()

    def _wake(self) -> None:
        """See to it that there is a next turn."""
        if self._next is None:
            rest_s = self._rested_s - self._loop.time()
            later = self._loop.call_later
            self._next = later(rest_s, self._turn) if rest_s > 0 else self._loop.call_soon(self._turn)

    def _turn(self) -> None:
        began_s = self._loop.time()
        try:
            while self._has_work() and self._loop.time() - began_s < _TURN_S:
                if self._newcomers or self._queue:
                    self._serve(self._next_client())
                for _ in range(_ACCEPTED_AT_ONCE):
                    if self._somebody_knocks and len(self._newcomers) < _ACCEPTED_AT_ONCE:
                        self._accept()
        finally:
            now_s = self._loop.time()
            self._rested_s = now_s + _REST * (now_s - began_s)
            self._next = None  # only now: what this turn puts into the queue waits for the next one
            if self._has_work():
                self._wake()

    def _has_work(self) -> bool:
        return bool(self._newcomers or self._queue) or self._somebody_knocks

    def _next_client(self) -> _Client:
        """Newcomers and the others by turns."""
        queues = (self._newcomers, self._queue) if self._newcomer_is_next else (self._queue, self._newcomers)
        self._newcomer_is_next = not self._newcomer_is_next
        return (queues[0] or queues[1]).popleft()

    def _accept(self) -> None:
        """Let one more in. The kernel is asked first whether there is one: without a descriptor to give it refuses to
        accept also when no client waits."""
        if self._listening is None:
            self._somebody_knocks = False
            return
        if not _is_readable(self._listening):
            self._await_knock()
            return
        try:
            connection, _ = self._listening.accept()
        except (BlockingIOError, InterruptedError):
            self._await_knock()
            return
        except ConnectionAbortedError:  # gone again
            return
        except OSError:  # no descriptor left, or no memory
            self._make_room()
            return
        connection.setblocking(False)
        if len(self._clients) >= MOST_CLIENTS:
            self._send_away(self._most_silent(), f"{MOST_CLIENTS} clients are connected, and you were silent longest")
        client = _Client(connection, self._loop.time())
        self._clients.add(client)
        self._newcomers.append(client)

    def _make_room(self) -> None:
        """Free a descriptor for a new client."""
        if self._spares:
            os.close(self._spares.pop())
        elif self._clients:
            self._send_away(self._most_silent(), "the daemon has no descriptor left, and you were silent longest")
        else:
            self._somebody_knocks = False
            self._loop.call_later(_NO_DESCRIPTOR_PAUSE_S, self._knocked)

    def _most_silent(self) -> _Client:
        """One that waits for an answer only when there is no other."""
        return min(self._clients, key=lambda client: (client.answering is not None, client.heard_s))

    def _serve(self, client: _Client) -> None:
        """One request of a client, or what has come of it."""
        if client not in self._clients or client.is_leaving or client.answering is not None:
            return
        line = client.line()
        if line is None and not client.is_over:
            try:
                if not client.receive(self._loop.time()):
                    self._loop.add_reader(client.socket, self._heard, client)
                    return
            except OSError:
                self._hang_up(client)
                return
            line = client.line()
        size_bytes = len(client.incoming if line is None else line)
        if size_bytes > LINE_LIMIT_BYTES:  # where the next request begins is not known
            self._send_away(client, f"a request has at most {LINE_LIMIT_BYTES} bytes")
        elif line is not None:
            self._answer(client, line)
        elif client.is_over:
            broken = "the request broke off before the end of its line; nothing was done"
            self._send_away(client, broken if client.incoming else "")
        else:
            self._enqueue(client)

    def _heard(self, client: _Client) -> None:
        self._loop.remove_reader(client.socket)
        self._enqueue(client)

    def _enqueue(self, client: _Client) -> None:
        self._queue.append(client)
        self._wake()

    def _answer(self, client: _Client, line: bytes) -> None:
        answer = self._handled(line)
        if not inspect.isawaitable(answer):
            self._send(client, answer)
            return
        client.answering = asyncio.ensure_future(_completed(answer))
        client.answering.add_done_callback(lambda task: self._answered(client, task))

    def _answered(self, client: _Client, task: asyncio.Task[Answer]) -> None:
        client.answering = None
        if not task.cancelled():
            self._send(client, task.result())

    def _handled(self, line: bytes) -> Answer | Awaitable[Answer]:
        request = object_of(line)
        if request is None:
            return refusal('expected a JSON object such as {"do": "status"}')
        do = request.get("do")
        handler = self._handlers.get(do) if isinstance(do, str) else None
        if handler is None:
            return refusal(f'"do" is one of {", ".join(self._handlers)}')
        try:
            answer = handler(request)
        except Exception as error:  # noqa: BLE001 - after a request that fails, the next must be answered
            return _failure(error)
        return answer if inspect.isawaitable(answer) else {"ok": True, **answer}

    def _send(self, client: _Client, answer: Answer) -> None:
        """Send the answer, then read on from the client."""
        if client in self._clients:
            client.outgoing += json.dumps(answer).encode() + b"\n"
            self._flush(client)

    def _flush(self, client: _Client) -> None:
        self._loop.remove_writer(client.socket)
        try:
            if not client.send():
                self._loop.add_writer(client.socket, self._flush, client)
                return
        except OSError:
            self._hang_up(client)
            return
        if client.is_leaving:
            self._hang_up(client)
        else:
            self._enqueue(client)

    def _send_away(self, client: _Client, sentence: str) -> None:
        """Send the reason, as far as the client takes it, and disconnect."""
        if sentence:
            client.outgoing += json.dumps(refusal(sentence)).encode() + b"\n"
            with suppress(OSError):
                client.send()
        self._hang_up(client)

    def _hang_up(self, client: _Client) -> None:
        self._clients.discard(client)
        if client.answering is not None:
            client.answering.cancel()
        self._loop.remove_reader(client.socket)
        self._loop.remove_writer(client.socket)
        client.socket.close()
        self._keep_spares()

    def _keep_spares(self) -> None:
        with suppress(OSError):  # none to be had now
            while len(self._spares) < _SPARES:
                self._spares.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def _look(self) -> None:
        """Once a second."""
        self._looking = self._loop.call_later(_LOOK_S, self._look)
        self._keep_spares()
        oldest_s = self._loop.time() - _IDLE_LIMIT_S
        for client in tuple(self._clients):
            if client.heard_s < oldest_s and client.answering is None:
                self._hang_up(client)
        self._look_after()


def _is_readable(listening: socket.socket) -> bool:
    poll = select.poll()  # select.select takes no descriptor above 1023
    poll.register(listening, select.POLLIN)
    return bool(poll.poll(0))


async def _completed(answer: Awaitable[Answer]) -> Answer:
    try:
        return {"ok": True, **await answer}
    except Exception as error:  # noqa: BLE001 - after a request that fails, the next must be answered
        return _failure(error)


def _failure(error: Exception) -> Answer:
    """A StandError is a sentence already."""
    return refusal(str(error) if isinstance(error, StandError) else f"failed ({type(error).__name__}: {error})")


def refusal(sentence: str) -> Answer:
    """The answer to what is not done."""
    return {"ok": False, "error": sentence}


def object_of(line: bytes) -> dict[str, object] | None:
    """The JSON object of a line, or None when it is none."""
    try:
        value: object = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return cast("dict[str, object]", value) if isinstance(value, dict) else None
