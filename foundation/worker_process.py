"""A small process that makes calls for a daemon, from its start to its end; the calls themselves are in calls.py.

Each line to the daemon is a socket with a thread of its own in the process, which answers one request after the other:
a call that hangs does not stop those of the other lines. When the daemon has closed its ends, or is dead, each thread
ends with the request it is at, and then the process. It is for calls that may hang in the kernel, or take long.
"""

from __future__ import annotations

import asyncio
import importlib
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from threading import Thread

from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.workers import WorkerConnection, answer_all

_END_WITHIN_S = 0.5  # round number; nothing was measured
_LOOK_S = 0.01  # of the loop that waits for an answer; not measured


class WorkerProcess:
    """The process, from the start on, and its lines. It is in a session of its own, so that Ctrl-C does not end it.

    `module` has LEFT_NAME, what the process is called once the daemon has gone, while a call is not at its end (15
    characters are kept); its `prepare()`, if any, is called first.
    """

    def __init__(self, module: str, lines: Sequence[str], ended: str) -> None:
        pairs = [socket.socketpair() for _ in ("life", *lines)]
        numbers = [theirs.fileno() for _, theirs in pairs]
        command = [
            sys.executable,
            "-m",
            "thermostand.foundation.worker_process",
            module,
            str(os.getpid()),
            *map(str, numbers),
        ]
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
        self._lines = {name: WorkerConnection(ours, ended) for name, (ours, _) in zip(lines, pairs[1:], strict=True)}

    @property
    def pid(self) -> int:
        """The id of the process."""
        return self._process.pid

    @property
    def ended(self) -> str:
        """Why there is no process any more, as a sentence; "" while there is one."""
        status = self._process.poll()
        return "" if status is None else f"{self._ended} ({_describe_status(status)})"

    def line(self, name: str) -> WorkerConnection:
        """The line of that name."""
        return self._lines[name]

    def close(self) -> bool:
        """End the process, which is waited for for half a second; False when it hangs in the kernel, or in a call, and
        is left. May be called twice."""
        self._release()
        try:
            self._process.wait(_END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._abandon()
            return False
        return True

    async def end_within(self, deadline: ShutdownDeadline) -> bool:
        """Close, as `close` does, while the event loop goes on."""
        self._release()
        ending = asyncio.create_task(self._wait_for_end())
        try:
            if await deadline.wait(ending, _END_WITHIN_S):
                return True
        finally:
            ending.cancel()
        self._abandon()
        return False

    async def _wait_for_end(self) -> None:
        while self._process.poll() is None:  # noqa: ASYNC110 - nothing notifies of its end
            await asyncio.sleep(_LOOK_S)

    def _release(self) -> None:
        self._life.close()
        for line in self._lines.values():
            line.close()

    def _abandon(self) -> None:
        if self._process.poll() is None:
            self._process.returncode = 0  # it is not waited for any more, and Python need not warn of that


def _describe_status(status: int) -> str:
    return f"killed by {signal.Signals(-status).name}" if status < 0 else f"status {status}"


def main() -> None:
    """`python -m thermostand.foundation.worker_process MODULE DAEMON FD ...`: serve the daemon at these sockets until
    it is gone; the first carries nothing, its end is the daemon's. MODULE is imported first: from then on it is in
    memory."""
    module = importlib.import_module(sys.argv[1])
    getattr(module, "prepare", _do_nothing)()
    kept: dict[str, object] = {}
    life, *connections = [socket.socket(fileno=int(number)) for number in sys.argv[3:]]
    threads = [Thread(target=answer_all, args=(each, kept), daemon=True) for each in connections]
    for thread in threads:
        thread.start()
    with suppress(OSError):
        life.recv(1)
    Path("/proc/self/comm").write_text(module.LEFT_NAME)
    for thread in threads:
        thread.join()
    os._exit(0)


def lower_priority() -> None:
    """Lower the priority, for `prepare`: everything else on the machine goes before this process."""
    with suppress(OSError):
        os.nice(19)
    with suppress(OSError, AttributeError):  # Linux
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _do_nothing() -> None:
    pass


if __name__ == "__main__":
    main()
