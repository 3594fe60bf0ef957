"""Blocking calls made elsewhere, one after the other: by a thread of this process (Lane), or by another one (Line).

A wire has a lane; what may hang in the kernel, such as a disk, has a line to a helper process, which is waited for in a
lane. A request to a process is a function and its arguments, pickled by reference. What it returns stays there under
`keep` and is called by its methods' names later; else it goes back, as an exception does.
"""

from __future__ import annotations

import _thread
import asyncio
import errno
import pickle
import socket
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from queue import SimpleQueue
from threading import Event, Lock
from typing import Any, TypeVar

from thermostand.foundation.clock import Clock, VirtualClock

Result = TypeVar("Result")

# How long a lane's thread that computes (encoding, checksums) may keep the event loop from its turn; Python's own 5 ms
# would make frames late by as much.
_SWITCH_S = 0.0005
_BEGIN_LIMIT_S = 3.0  # for a new thread's first step
_LENGTH = struct.Struct("<Q")


class WorkerThread:
    """Runs blocking calls one at a time in its own thread; the thread is the lock of the wire.

    Several devices on one bus share one lane. A cancelled caller waits for the call under way to end (it is bounded
    by the wire's own time-out), so that no half transaction stays on the wire. Where nothing bounds a call (`patient`
    false: a disk that hangs), a cancelled caller leaves at once and the call continues. The thread never keeps the
    process from ending.

    In virtual time nothing may happen meanwhile, so there is no thread to hand over to: the call is made at once, and
    the loop waits with it. A signal is then served when the call has ended, on a dead wire after its time-out.
    """

    def __init__(self, name: str, clock: Clock, *, patient: bool = True) -> None:
        self._name = name
        self._clock = clock
        self._patient = patient
        self._has_thread = not isinstance(clock, VirtualClock)
        self._work: SimpleQueue[Callable[[], None] | None] | None = None  # with the thread, from the first call on
        self._closed = self._abandoned = False
        self._waiting: set[asyncio.Future[Any]] = set()
        if self._has_thread:
            sys.setswitchinterval(_SWITCH_S)

    async def call(self, function: Callable[..., Result], *args: object) -> Result:
        """`function(*args)` in its turn; what it raises is raised here. ValueError after `close`."""
        if self._abandoned:
            raise self._make_timeout_error()
        if not self._has_thread:
            # On the spot: the hand-over to a thread took 0.18 ms for a transaction of 0.06.
            return function(*args)
        with self._clock.hold():
            future = self._submit(function, args)
            try:
                return await asyncio.shield(future)
            except asyncio.CancelledError:
                if self._patient:
                    await asyncio.wait([future])
                future.add_done_callback(_ignore_error)
                raise

    def abandon(self) -> None:
        """Wait no longer: the calls under way and all later ones raise TimeoutError; the thread is left to itself."""
        self._abandoned = True
        for future in tuple(self._waiting):
            _set_error(future, self._make_timeout_error())
        self.close()

    def _make_timeout_error(self) -> TimeoutError:
        return TimeoutError(f"{self._name} has not answered; no longer waiting for it")

    def close(self) -> None:
        """End the thread after the calls handed over; may be called twice."""
        self._closed = True
        if self._work is not None:
            self._work.put(None)
            self._work = None

    def _submit(self, function: Callable[..., Result], args: tuple[object, ...]) -> asyncio.Future[Result]:
        """The future of a call that the thread makes in its turn."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Result] = loop.create_future()

        def work() -> None:
            try:
                settle = partial(_set_result, future, function(*args))
            except BaseException as error:  # noqa: BLE001 - the caller waits for any error
                settle = partial(_set_error, future, error)
            with suppress(RuntimeError):  # the loop has ended, and no caller waits any more
                loop.call_soon_threadsafe(settle)

        self._get_queue().put(work)
        self._waiting.add(future)
        future.add_done_callback(self._waiting.discard)
        return future

    def _get_queue(self) -> SimpleQueue[Callable[[], None] | None]:
        if self._closed:
            raise ValueError(f"the lane {self._name} is closed")
        if self._work is None:
            work: SimpleQueue[Callable[[], None] | None] = SimpleQueue()
            begun = Event()
            # Not a threading.Thread, whose start waits for ever where memory does not suffice for its first steps. An
            # interpreter that ends does not wait for this one, which may hang in the kernel.
            try:
                _thread.start_new_thread(_serve, (work, begun))
            except RuntimeError as error:
                raise MemoryError(f"no thread for {self._name}: {error}") from error
            self._work = work
            asyncio.get_running_loop().call_later(_BEGIN_LIMIT_S, self._check_started, begun)
        return self._work

    def _check_started(self, begun: Event) -> None:
        """A thread that memory did not suffice for does none of its work."""
        if not begun.is_set():
            self._work = None
            for future in tuple(self._waiting):
                _set_error(future, MemoryError(f"no memory for the thread of {self._name}"))


def _serve(queue: SimpleQueue[Callable[[], None] | None], begun: Event) -> None:
    """The thread: one call after the other, to the end."""
    begun.set()
    while (work := queue.get()) is not None:
        work()


def _set_result(future: asyncio.Future[Result], result: Result) -> None:
    if not future.done():
        future.set_result(result)


def _set_error(future: asyncio.Future[Any], error: BaseException) -> None:
    if not future.done():
        future.set_exception(error)


def _ignore_error(future: asyncio.Future[Any]) -> None:
    """The caller has gone; asyncio need not report the exception as never retrieved."""
    if not future.cancelled():
        future.exception()


_Request = tuple[Callable[..., object] | str, tuple[object, ...], str, str]
"""A function and its arguments, "", and the name under which its result is kept, "" for none; or the name of a method,
its arguments, and what is kept under which name has that method."""
_Answer = tuple[object, BaseException | None]
"""What the request returned, or raised."""


def send(connection: socket.socket, data: bytes) -> None:
    """One message; OSError when the other end is gone."""
    connection.sendall(_LENGTH.pack(len(data)))
    connection.sendall(data)


def receive(connection: socket.socket) -> bytearray | None:
    """The next message; None when the other end is gone."""
    head = _receive_exactly(connection, _LENGTH.size)
    return None if head is None else _receive_exactly(connection, _LENGTH.unpack(head)[0])


def _receive_exactly(connection: socket.socket, size_bytes: int) -> bytearray | None:
    data = bytearray(size_bytes)
    view, got = memoryview(data), 0
    while got < size_bytes:
        try:
            count = connection.recv_into(view[got:])
        except OSError:
            return None
        if not count:
            return None
        got += count
    return data


def answer_request(data: bytes | bytearray, kept: dict[str, object]) -> bytes:
    """The answer to a request, both pickled. What cannot be unpickled here (the program was replaced by another version
    while it ran), or pickled, is answered with an OSError: who asks waits for an answer."""
    try:
        return _pickle(_answer(pickle.loads(data), kept))
    except Exception as error:  # noqa: BLE001 - as above
        return _pickle((None, OSError(errno.EPROTO, _describe_failure(error))))


def _describe_failure(error: Exception) -> str:
    return f"a call to another process failed ({type(error).__name__}: {error}); was the program replaced meanwhile?"


def _pickle(message: _Request | _Answer) -> bytes:
    return pickle.dumps(message, protocol=5)


def _answer(request: _Request, kept: dict[str, object]) -> _Answer:
    """Return what comes of the request."""
    function, args, target, keep = request
    try:
        if isinstance(function, str):
            return getattr(kept[target], function)(*args), None
        result = function(*args)
        if keep:
            kept[keep], result = result, None
        return result, None
    except BaseException as error:  # noqa: BLE001 - the daemon waits for any error
        return None, error


def answer_all(connection: socket.socket, kept: dict[str, object]) -> None:
    """Answer, in the process, one request after the other, until the other end is gone."""
    with connection:  # who asks must not wait for a thread that has ended
        while (data := receive(connection)) is not None:
            try:
                send(connection, answer_request(data, kept))
            except OSError:
                return  # the daemon has gone


class WorkerConnection:
    """One thread of the process; requests are answered one after the other. Blocking: used from a lane. `ended` is the
    sentence for a process that has ended."""

    def __init__(self, connection: socket.socket, ended: str) -> None:
        self._connection = connection
        self._ended = ended
        self._lock = Lock()

    def run(self, function: Callable[..., object], *args: object) -> Any:
        """`function(*args)` there; both are pickled. Raises what it raises, and OSError when the process is gone."""
        return self._request((function, args, "", ""))

    def make(self, name: str, function: Callable[..., object], *args: object) -> None:
        """Keep what `function(*args)` returns there under this name, which every line then knows."""
        self._request((function, args, "", name))

    def call(self, name: str, method: str, *args: object) -> Any:
        """The method of what is kept under this name."""
        return self._request((method, args, name, ""))

    def close(self) -> None:
        """Take no more requests; the one under way is completed."""
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits for an answer
        self._connection.close()

    def _request(self, request: _Request) -> Any:
        data = _pickle(request)
        with self._lock:
            try:
                send(self._connection, data)
                answer = receive(self._connection)
            except OSError:
                answer = None
        if answer is None:
            raise OSError(errno.EPIPE, self._ended)
        try:
            found: _Answer = pickle.loads(answer)
            result, raised = found
        except Exception as error:
            raise OSError(errno.EPROTO, _describe_failure(error)) from error
        if raised is not None:
            raise raised
        return result
