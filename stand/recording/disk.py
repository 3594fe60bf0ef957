"""The daemon's end of the process that touches the disk for it, see disk_process.py."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import suppress
from threading import Lock
from typing import Any

from stand.recording.disk_process import MODULE, Request, receive, send

FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE = "frames", "telemetry", "journal", "files"
_LINES = (FRAMES_LINE, TELEMETRY_LINE, JOURNAL_LINE, FILES_LINE)
_END_WITHIN_S = 0.5


class Line:
    """One thread of the disk process; requests are answered one after the other. Blocking: used from a lane."""

    def __init__(self, connection: socket.socket) -> None:
        self._connection = connection
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
        """No more requests; the one under way goes on to its end."""
        with suppress(OSError):
            self._connection.shutdown(socket.SHUT_RDWR)  # wakes whoever waits for an answer
        self._connection.close()

    def _asked(self, request: Request) -> Any:
        with self._lock:
            try:
                send(self._connection, request)
                found = receive(self._connection)
            except OSError:
                found = None
        if found is None:
            raise OSError(errno.EPIPE, "the process that writes the session to the disk has ended")
        if found.error is not None:
            raise found.error
        return found.result


class Disk:
    """The process, from the start on, and its lines. It is in a session of its own, so that Ctrl-C does not end it."""

    def __init__(self) -> None:
        pairs = [socket.socketpair() for _ in ("life", *_LINES)]
        numbers = [theirs.fileno() for _, theirs in pairs]
        command = [sys.executable, "-m", MODULE, str(os.getpid()), *map(str, numbers)]
        self._process = subprocess.Popen(
            command,
            pass_fds=numbers,
            start_new_session=True,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,  # whoever reads what the daemon says need not wait for this one
            stderr=subprocess.DEVNULL,
        )
        for _, theirs in pairs:
            theirs.close()
        self._life = pairs[0][0]
        self._lines = {name: Line(ours) for name, (ours, _) in zip(_LINES, pairs[1:], strict=True)}

    @property
    def pid(self) -> int:
        """Of the process."""
        return self._process.pid

    def line(self, name: str) -> Line:
        """The line of that name."""
        return self._lines[name]

    def close(self) -> bool:
        """End the process, which is waited for for half a second; False when it hangs in the kernel and is left. May
        be called twice."""
        self._life.close()
        for line in self._lines.values():
            line.close()
        try:
            self._process.wait(_END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.returncode = 0  # nobody waits for it any more, and Python need not warn of that
            return False
        return True
