"""The thread at the listening sockets, which serves STOP, and does nothing else for anybody.

It accepts at the TCP port, at the Unix socket, and at another one for the command line's STOP. What a connection says
first is looked at and left in the kernel: a request for STOP is answered here, without its body; every other connection
is handed over as it is, once its head has come and there is a place for it. Whatever others do meanwhile, a STOP waits
for this thread's turn only, which is a few system calls. A silent client makes way for the next.
"""

from __future__ import annotations

import concurrent.futures
import os
import re
import select
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Literal

import h11
from pydantic import BaseModel

from thermostand.stand.serving.api.access import (
    CHUNKS,
    FAILED,
    STOP_PATH,
    Access,
    Denied,
    Scope,
    get_peer_uid,
    make_last_answer,
    make_last_refusal,
)
from thermostand.stand.serving.api.bridge import COMMAND_LIMIT_S, NoAnswer, make_no_answer
from thermostand.stand.serving.api_models import Requester

ListenerKind = Literal["stop", "socket", "tcp"]
Stopping = Callable[[Requester], "concurrent.futures.Future[BaseModel]"]

# Chosen with `python -m tests.bench stop`: under a flood of connections STOP takes 227 to 412 ms, of silent ones
# 39 to 182, with 2,000 open sockets 1.6 (medians).
_MOST_CLIENTS = 128  # of a door, before _AT_ONCE more are let in, who have not been answered or handed over
_MOST_WAITING = {"tcp": 64, "socket": 256, "stop": 0}  # to be handed over
_AT_ONCE = 128  # with the rest about 6,000 connections a second, more than most floods of one machine make
_REST_S = 0.01  # at most, however much is asked of this thread
_MAY_SPEAK_S = 0.02  # between connecting and speaking, on a busy machine: who is younger is not sent away
_HEAD_BYTES = 1 << 15  # of a request, beyond which it is refused; round number, nothing was measured
_ASK_WITHIN_S = 10.0  # round number; nothing was measured
_DRAIN_S = 1.0  # for what a client still sends: closed before it is read, the answer would be lost
_LOOK_S = 0.1  # how late a silent client is dropped; STOP wakes the thread at once
_SPARES = 2  # descriptors kept open, so that STOP is accepted when the process has no other left
_REQUEST = f"POST {STOP_PATH}".encode()
_CHUNKED = re.compile(rb"\n[Tt][Rr][Aa][Nn][Ss][Ff][Ee][Rr]-[Ee][Nn][Cc][Oo][Dd][Ii][Nn][Gg][ \t]*:")


def is_readable(listening: socket.socket) -> bool:
    """Return whether somebody waits there: without a descriptor the kernel refuses also when nobody does."""
    poll = select.poll()  # select.select takes no descriptor above 1023
    poll.register(listening, select.POLLIN)
    return bool(poll.poll(0))


class _Client:
    """One connection: it has sent nothing that is understood, or waits for `answer`, or `has_answer` and is listened to
    no more; until `until_s`."""

    def __init__(self, door: ListenerKind, connection: socket.socket, now_s: float) -> None:
        self.door: ListenerKind = door
        self.connection = connection
        self.came_s = now_s
        self.until_s = now_s + _ASK_WITHIN_S
        self.answer: concurrent.futures.Future[BaseModel] | None = None
        self.has_spoken = False
        self.waits = False  # to be handed over
        self.has_answer = False

    def may_leave(self, now_s: float) -> bool:
        """Return whether it makes way for another; a STOP arrives as a whole, except from clients that drip."""
        has_time = not self.has_spoken and now_s < self.came_s + _MAY_SPEAK_S
        return self.has_answer or not (self.answer is not None or self.waits or has_time)

    def make_scope(self, request: h11.Request) -> Scope:
        """Make the scope of the client's request, as the gatekeeper gets it."""
        is_local = self.connection.family == socket.AF_UNIX
        remote, here = (None, None) if is_local else (self.connection.getpeername(), self.connection.getsockname())
        return {
            "type": "http",
            "method": "POST",
            "path": STOP_PATH,
            "headers": list(request.headers),
            "client": remote,
            "server": here,
            "state": {
                "door": "socket" if is_local else "tcp",
                "uid": get_peer_uid(self.connection) if is_local else None,
            },
        }


class StopThread:
    """The thread that accepts connections, from `start` to `end`; `listen`, `start` and `end` are for any thread.
    hand_over: is given who wants something else, and returns whether there is a place. `stopping` as that of the
    bridge; `failed` is called with what should not happen."""

    def __init__(self, stopping: Stopping, access: Access, failed: Callable[[Exception], None]) -> None:
        self.hand_over: Callable[[ListenerKind, socket.socket], bool] = lambda _door, _connection: False
        self.has_failed = False
        self._spares: list[int] = []
        self._stopping = stopping
        self._access = access
        self._failed = failed
        self._doors: dict[int, tuple[ListenerKind, socket.socket]] = {}
        self._new: deque[tuple[ListenerKind, socket.socket]] = deque()
        self._clients: dict[int, _Client] = {}
        self._epoll = select.epoll()
        self._called = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._epoll.register(self._called, select.EPOLLIN)
        self._lock = threading.Lock()
        self._has_ended = False
        self._is_over = threading.Event()
        self._is_crowded = False
        self._thread = threading.Thread(target=self._run, name="stop", daemon=True)

    def listen(self, door: ListenerKind, listening: socket.socket) -> None:
        """Accept at this socket from now on, which does not block, instead of the one of that door before."""
        self._new.append((door, listening))
        self._wake()
        if self.has_failed:
            listening.close()

    def start(self) -> None:
        """Begin."""
        self._thread.start()

    def end(self, within_s: float) -> None:
        """Wait for it so long: answers that are due within a second are still given."""
        self._is_over.set()
        self._wake()
        self._thread.join(within_s)

    def _wake(self, _: object = None) -> None:
        with self._lock:
            if not self._has_ended:  # else its number may be that of another file
                os.eventfd_write(self._called, 1)

    def _run(self) -> None:
        try:
            while not self._is_over.is_set():
                self._serve_ready()
                if self._is_crowded:
                    self._is_over.wait(_REST_S)
            self._shut_down()
        except Exception as error:  # noqa: BLE001 - the framework has a route for STOP, too
            self.has_failed = True
            self._failed(error)
        finally:
            for client in self._clients.values():
                client.connection.close()
            for spare in self._spares:
                os.close(spare)
            for door, listening in self._doors.values():
                if door == "stop" or not self.has_failed:  # the process that accepts there now has STOP, too
                    listening.close()
            self._epoll.close()
            with self._lock:
                self._has_ended = True
                os.close(self._called)

    def _shut_down(self) -> None:
        for number in self._doors:
            self._epoll.unregister(number)
        until_s = time.monotonic() + _DRAIN_S
        while any(each.answer or each.has_answer for each in self._clients.values()) and time.monotonic() < until_s:
            self._serve_ready()

    def _serve_ready(self) -> None:
        """Serve every client that has sent something, then those who are new."""
        wait_s = _LOOK_S if self._clients else None
        events = self._epoll.poll(_REST_S if any(each.waits for each in self._clients.values()) else wait_s)
        for number, _ in events:
            if (client := self._clients.get(number)) is not None:
                self._receive(client)
        self._is_crowded = False
        for number, _ in events:
            if (door := self._doors.get(number)) is not None:
                self._accept(*door)
        with suppress(BlockingIOError):
            os.eventfd_read(self._called)
        while self._new:
            self._open(*self._new.popleft())
        self._check_answers()

    def _open(self, door: ListenerKind, listening: socket.socket) -> None:
        for number, (name, before) in (*self._doors.items(),):
            if name == door:
                del self._doors[number]
                self._epoll.unregister(number)
                before.close()
        self._doors[listening.fileno()] = (door, listening)
        self._epoll.register(listening, select.EPOLLIN)

    def _accept(self, door: ListenerKind, listening: socket.socket) -> None:
        if not self._admits(door):
            self._is_crowded = True
            return
        for _ in range(_AT_ONCE):
            try:
                connection, _ = listening.accept()
            except BlockingIOError:
                return
            except (InterruptedError, ConnectionAbortedError):
                continue
            except OSError:  # no descriptor left, or no memory
                if not is_readable(listening):
                    return
                if self._free_descriptor():
                    continue
                self._is_crowded = True
                return
            self._keep_spares()
            connection.setblocking(False)
            client = self._clients[connection.fileno()] = _Client(door, connection, time.monotonic())
            self._epoll.register(connection, select.EPOLLIN | select.EPOLLRDHUP | select.EPOLLET)
            self._receive(client)  # it has mostly sent something by now

    def _admits(self, door: ListenerKind) -> bool:
        clients = [each for each in self._clients.values() if each.door == door and not each.waits]
        excess, now_s = len(clients) - _MOST_CLIENTS + 1, time.monotonic()
        if excess > 0:
            leaving = [each for each in clients if each.may_leave(now_s)]
            leaving.sort(key=lambda each: (not each.has_answer, each.came_s))
            for each in leaving[:excess]:
                self._drop(each)
            excess -= len(leaving)
        return excess <= 0

    def _free_descriptor(self) -> bool:
        """Return whether there is a descriptor now, which there was not."""
        silent = [each for each in self._clients.values() if each.answer is None or each.has_answer]
        if silent:
            with suppress(OSError):
                silent[0].connection.send(
                    make_last_refusal(503, "the daemon has no descriptor left, and you sent nothing")
                )
            self._drop(silent[0])
        elif self._spares:
            os.close(self._spares.pop())
        return bool(silent or self._spares)

    def _keep_spares(self) -> None:
        with suppress(OSError):  # none to be had now
            while len(self._spares) < _SPARES:
                self._spares.append(os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC))

    def _receive(self, client: _Client) -> None:
        try:
            if client.has_answer:
                if not client.connection.recv(1 << 16):
                    self._drop(client)
            elif client.answer is None and not client.waits:
                self._parse(client, client.connection.recv(_HEAD_BYTES, socket.MSG_PEEK))
        except BlockingIOError:
            pass
        except OSError:
            self._drop(client)
        except Exception as error:  # noqa: BLE001 - after a client that fails, the next must be answered
            self._failed(error)
            self._answer(client, make_last_refusal(500, FAILED.format(type(error).__name__)))

    def _parse(self, client: _Client, text: bytes) -> None:
        client.has_spoken = True
        if not text:
            self._drop(client)
        elif not (b"\n\r\n" in text or b"\n\n" in text or len(text) == _HEAD_BYTES):
            return
        elif text[: len(_REQUEST)] != _REQUEST:
            self._hand_over(client, text)
        else:
            parser = h11.Connection(h11.SERVER, max_incomplete_event_size=_HEAD_BYTES - 1)
            parser.receive_data(text)
            try:
                request = parser.next_event()
            except h11.RemoteProtocolError:
                self._hand_over(client, text)
                return
            if isinstance(request, h11.Request):
                if request.target.partition(b"?")[0] == STOP_PATH.encode():
                    self._stop(client, request)
                else:
                    self._hand_over(client, text)

    def _hand_over(self, client: _Client, text: bytes) -> None:
        most = _MOST_WAITING[client.door]
        if client.door == "stop":
            self._answer(client, make_last_refusal(404, "here is nothing but STOP"))
        elif _CHUNKED.search(text.partition(b"\n\r\n")[0]):
            # A megabyte of them, of one byte each, would keep a thread for half a minute.
            self._answer(client, make_last_refusal(411, CHUNKS))
        elif sum(each.waits and each.door == client.door for each in self._clients.values()) >= most:
            self._answer(client, make_last_refusal(503, f"{most} clients wait already to be let in"))
        else:
            client.waits = True
            self._let_in(client)

    def _let_in(self, client: _Client) -> None:
        number = client.connection.fileno()
        if self.hand_over(client.door, client.connection):
            del self._clients[number]
            with suppress(OSError):  # it may be closed by now
                self._epoll.unregister(number)

    def _stop(self, client: _Client, request: h11.Request) -> None:
        try:
            who = self._access.admit(client.make_scope(request))
        except Denied as denied:
            self._answer(client, make_last_refusal(denied.status, str(denied)))
            return
        client.until_s = time.monotonic() + COMMAND_LIMIT_S
        client.answer = self._stopping(who)
        client.answer.add_done_callback(self._wake)

    def _check_answers(self) -> None:
        """Answers that have come, and what takes too long."""
        now_s = time.monotonic()
        for client in (*self._clients.values(),):
            if client.answer is not None and client.answer.done():
                self._answer(client, _make_answer(client.answer))
            elif client.answer is not None and now_s > client.until_s:
                self._answer(client, make_last_refusal(504, str(make_no_answer(COMMAND_LIMIT_S))))
            elif now_s > client.until_s:
                self._drop(client)
            elif client.waits:
                self._let_in(client)

    def _answer(self, client: _Client, answer: bytes) -> None:
        """All of it fits into what the kernel keeps; then what the client still sends is thrown away for a moment."""
        client.answer, client.has_answer, client.until_s = None, True, time.monotonic() + _DRAIN_S
        try:
            client.connection.send(answer)
            client.connection.shutdown(socket.SHUT_WR)
            self._epoll.modify(client.connection, select.EPOLLIN)
        except OSError:  # it has left
            self._drop(client)

    def _forget(self, client: _Client) -> None:
        del self._clients[client.connection.fileno()]
        self._epoll.unregister(client.connection)

    def _drop(self, client: _Client) -> None:
        self._forget(client)
        client.connection.close()


def _make_answer(answer: concurrent.futures.Future[BaseModel]) -> bytes:
    error = answer.exception()
    if error is None:
        return make_last_answer(200, answer.result().model_dump_json().encode())
    if isinstance(error, NoAnswer):
        return make_last_refusal(504, str(error))
    return make_last_refusal(500, FAILED.format(type(error).__name__))
