"""The simulated laboratories of the tests are forked from one process that has their modules loaded: a start then
does without the 0.44 s of processor time that importing them takes. What a person starts is a program of its own, and
so are those that other programs of the tests start."""

from __future__ import annotations

import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Lock
from typing import Any, NoReturn

_COMMAND = [sys.executable, "-m", "drivers.sim"]
_MESSAGE_BYTES = 200_000


class Forked:
    """Of subprocess.Popen what a Simulator uses; the exit code is not known."""

    def __init__(self, pid: int, pipes: Sequence[int]) -> None:
        self.pid = pid
        self.stdin = os.fdopen(pipes[0], "w")
        self.stdout, self.stderr = (os.fdopen(pipe) for pipe in pipes[1:])
        try:
            self._pidfd = os.pidfd_open(pid)
        except ProcessLookupError:
            self._pidfd = -1

    def send_signal(self, number: int) -> None:
        if self._pidfd >= 0:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def wait(self, timeout: float | None = None) -> int:
        if self._pidfd >= 0:
            if not select.select([self._pidfd], [], [], timeout)[0]:
                raise subprocess.TimeoutExpired(_COMMAND, timeout or 0.0)
            os.close(self._pidfd)
            self._pidfd = -1
        return 0


class Laboratories:
    """In the place of the module `subprocess` where simulators are started."""

    PIPE, TimeoutExpired, run = subprocess.PIPE, subprocess.TimeoutExpired, staticmethod(subprocess.run)

    def __init__(self) -> None:
        self._lock = Lock()
        self._path = os.environ.get("PYTHONPATH")
        self._line: socket.socket | None = None
        self._server: subprocess.Popen[bytes] | None = None

    def Popen(self, command: Sequence[str], env: dict[str, str], **others: Any) -> Any:
        assert list(command) == _COMMAND
        if env.get("PYTHONPATH") != self._path:  # a program whose modules are not the loaded ones
            return subprocess.Popen(command, env=env, **others)
        child_ends, own_ends = [], []
        for is_read_by_child in (True, False, False):
            reads, writes = os.pipe()
            child_ends.append(reads if is_read_by_child else writes)
            own_ends.append(writes if is_read_by_child else reads)
        wanted = {"env": env, "folder": os.getcwd(), "processors": sorted(os.sched_getaffinity(0))}
        with self._lock:
            line = self._line or self._begin()
            socket.send_fds(line, [json.dumps(wanted).encode()], child_ends)
            pid = int(line.recv(64))
        for end in child_ends:
            os.close(end)
        return Forked(pid, own_ends)

    def _begin(self) -> socket.socket:
        """A line to the process that forks, which ends with it."""
        self._line, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
            command = [sys.executable, "-m", "tests.forked", str(other.fileno())]
            folder = Path(__file__).parents[1]
            self._server = subprocess.Popen(command, pass_fds=[other.fileno()], env=environment, cwd=folder)
        return self._line

    def close(self) -> None:
        if self._line is not None and self._server is not None:
            self._line.close()
            self._server.wait()


def _serve(line: socket.socket) -> None:
    import drivers.sim.__main__  # all that forks have loaded

    assert drivers.sim.__main__.main
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # which also lets the ended go
    gc.freeze()
    while True:
        message, ends, _, _ = socket.recv_fds(line, _MESSAGE_BYTES, 3)
        if not message:
            return
        pid = os.fork()
        if not pid:
            line.close()
            _become(json.loads(message), ends)
        for end in ends:
            os.close(end)
        line.send(str(pid).encode())


def _become(wanted: dict[str, Any], ends: Sequence[int]) -> NoReturn:
    from drivers.sim.__main__ import main

    code = 1
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        os.setsid()
        os.sched_setaffinity(0, wanted["processors"])
        os.chdir(wanted["folder"])
        os.environ.clear()
        os.environ.update(wanted["env"])
        for number, end in enumerate(ends):
            os.dup2(end, number)
            os.close(end)
        sys.argv = ["drivers.sim"]
        code = main()
        sys.stdout.flush()
        sys.stderr.flush()
    except BaseException:  # noqa: BLE001 - nothing of it is the server's
        traceback.print_exc()
    finally:
        os._exit(code)


if __name__ == "__main__":
    _serve(socket.socket(fileno=int(sys.argv[1])))
