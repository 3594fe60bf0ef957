"""The daemon's end of a process that makes calls for it, see helper_process.py."""

from __future__ import annotations

import errno
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from contextlib import suppress
from threading import Lock
from typing import Any

from foundation.helper_process import Request, receive, send

_END_WITHIN_S = 0.5


class Line:
    """One thread of the process; requests are answered one after the other. Blocking: used from a lane. `ended` is the
    sentence for a process that has ended."""

    def __init__(self, connection: socket.socket, ended: str) -> None:
        self._connection = connection
        self._ended = ended
        self._lock = Lock()

    def run(self, function: Callable[..., object], *args: object) -> Any:
        """`function(*args)` there; both are pickled. Raises what it raises, and OSError when the process is gone."""
        return self._asked(Request(function, args))

    def make(self, name: str, function: Callable[..., object], *args: object) -> None:
        """Keep what `function(*args)` returns there under this name, which every line then knows."""
        self._asked(Request(function, args, keep=name))

    def call(self, name: str, method: str, *args: object) -> Any:
        """The method of what is kept under this name."""
        return self._asked(Request(method, args, name))

    def close(self) -> None:
        """No more requests; the one under way is completed."""
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)  # wakes a thread that waits for an answer
        self._connection.close()

    def _asked(self, request: Request) -> Any:
        with self._lock:
            try:
                send(self._connection, request)
                found = receive(self._connection)
            except OSError:
                found = None
        if found is None:
            raise OSError(errno.EPIPE, self._ended)
        if found.error is not None:
            raise found.error
        return found.result


class Helper:
    """The process, from the start on, and its lines. It is in a session of its own, so that Ctrl-C does not end it.

    `module` is run with the daemon's process id and the lines' descriptors.
    """

    def __init__(self, module: str, lines: Sequence[str], ended: str) -> None:
        pairs = [socket.socketpair() for _ in ("life", *lines)]
        numbers = [theirs.fileno() for _, theirs in pairs]
        command = [sys.executable, "-m", module, str(os.getpid()), *map(str, numbers)]
        try:
            self._process = subprocess.Popen(
                command,
                pass_fds=numbers,
                start_new_session=True,
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,  # the daemon's readers need not wait for this one
                stderr=subprocess.DEVNULL,
            )
        except BaseException:
            for ours, _ in pairs:
                ours.close()
            raise
        finally:
            for _, theirs in pairs:
                theirs.close()
        self._ended = ended
        self._life = pairs[0][0]
        self._lines = {name: Line(ours, ended) for name, (ours, _) in zip(lines, pairs[1:], strict=True)}

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    @property
    def ended(self) -> str:
        """Why there is no process any more, as a sentence; "" while there is one."""
        status = self._process.poll()
        return "" if status is None else f"{self._ended} ({_how(status)})"

    def line(self, name: str) -> Line:
        """The line of that name."""
        return self._lines[name]

    def close(self) -> bool:
        """End the process, which is waited for for half a second; False when it hangs in the kernel, or in a call, and
        is left. May be called twice."""
        self._life.close()
        for line in self._lines.values():
            line.close()
        try:
            self._process.wait(_END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.returncode = 0  # it is not waited for any more, and Python need not warn of that
            return False
        return True


def _how(status: int) -> str:
    return f"killed by {signal.Signals(-status).name}" if status < 0 else f"status {status}"
