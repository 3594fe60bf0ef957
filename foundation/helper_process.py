"""What a small process does that makes calls for a daemon, and the messages between the two.

Each line to the daemon is a socket with a thread of its own, which answers one request after the other: a call that
hangs does not stop those of the other lines. When the daemon has closed its ends, or is dead, each thread ends with the
request it is at, and then the process.

A request is a function and its arguments, pickled by reference. What it returns stays here under `keep` and is called
by its methods' names later; else it goes back, as an exception does.
"""

from __future__ import annotations

import os
import pickle
import socket
import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

_LENGTH = struct.Struct("<Q")


@dataclass(frozen=True, slots=True)
class Request:
    """`function(*args)`, or the method of that name of what is kept under `target`. keep: the name for the result."""

    function: Callable[..., object] | str
    args: tuple[object, ...] = ()
    target: str = ""
    keep: str = ""


@dataclass(frozen=True, slots=True)
class Answer:
    """What the request returned, or raised."""

    result: object = None
    error: BaseException | None = None


def send(connection: socket.socket, message: Request | Answer) -> None:
    """One message; OSError when the other end is gone."""
    data = pickle.dumps(message, protocol=5)
    connection.sendall(_LENGTH.pack(len(data)))
    connection.sendall(data)


def receive(connection: socket.socket) -> Any:
    """The next message; None when the other end is gone."""
    head = _exactly(connection, _LENGTH.size)
    data = None if head is None else _exactly(connection, _LENGTH.unpack(head)[0])
    return None if data is None else pickle.loads(data)


def _exactly(connection: socket.socket, size_bytes: int) -> bytearray | None:
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


def answer(request: Request, kept: dict[str, object]) -> Answer:
    """What comes of the request."""
    try:
        if isinstance(request.function, str):
            return Answer(getattr(kept[request.target], request.function)(*request.args))
        result = request.function(*request.args)
        if request.keep:
            kept[request.keep] = result
            return Answer()
        return Answer(result)
    except BaseException as error:  # noqa: BLE001 - the daemon waits for any error
        return Answer(error=error)


def _serve(connection: socket.socket, kept: dict[str, object]) -> None:
    while (request := receive(connection)) is not None:
        found = answer(request, kept)
        try:
            send(connection, found)
        except OSError:
            return  # the daemon has gone


def serve(descriptors: Sequence[int], left_name: str) -> None:
    """Serve the daemon at these sockets until it is gone; the first carries nothing, its end is the daemon's.
    left_name: what the process is called from then on, while a call is not at its end (15 characters are kept)."""
    kept: dict[str, object] = {}
    life, *connections = [socket.socket(fileno=number) for number in descriptors]
    threads = [Thread(target=_serve, args=(each, kept), daemon=True) for each in connections]
    for thread in threads:
        thread.start()
    receive(life)
    Path("/proc/self/comm").write_text(left_name)
    for thread in threads:
        thread.join()
    os._exit(0)
