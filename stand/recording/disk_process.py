"""The process that touches the disk for a daemon: `python -m stand.recording.disk_process DAEMON FD ...`.

A thread that waits for a disk in the kernel cannot be killed, and keeps its whole process from ending. So a daemon that
has to leave while the disk hangs leaves this process behind. DAEMON is the daemon's process id, each FD a socket with
a thread of its own, which answers one request after the other: one file that hangs does not stop the others. When the
daemon has closed its ends, or is dead, each thread ends with the request it is at, and then the process; until then
its locks are held, and tell that somebody still writes.

A request is a function and its arguments, pickled by reference. What it returns stays here under `keep` and is called
by its methods' names later; else it goes back, as an exception does.
"""

from __future__ import annotations

import os
import pickle
import socket
import struct
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from threading import Thread
from typing import Any

MODULE = "stand.recording.disk_process"
LEFT_NAME = "stand-disk-left"  # of a process whose daemon has gone (15 characters are kept)
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
    except BaseException as error:  # noqa: BLE001 - whatever it is, the daemon is waiting for it
        return Answer(error=error)


def _serve(connection: socket.socket, kept: dict[str, object]) -> None:
    while (request := receive(connection)) is not None:
        found = answer(request, kept)
        try:
            send(connection, found)
        except OSError:
            return  # nobody is there any more


def main() -> None:
    """Serve until nobody is there any more."""
    kept: dict[str, object] = {}
    connections = [socket.socket(fileno=int(number)) for number in sys.argv[2:]]
    threads = [Thread(target=_serve, args=(each, kept), daemon=True) for each in connections[1:]]
    for thread in threads:
        thread.start()
    receive(connections[0])  # the first one carries nothing; its end is the daemon's
    Path("/proc/self/comm").write_text(LEFT_NAME)
    for thread in threads:
        thread.join()
    os._exit(0)


if __name__ == "__main__":
    import stand.recording.disk_process  # what is pickled has its classes there, not in __main__

    stand.recording.disk_process.main()
