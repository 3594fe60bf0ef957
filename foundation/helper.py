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

from thermostand.foundation.calls import Line, answer_all
from thermostand.foundation.patience import Patience

_END_WITHIN_S = 0.5  # round number; nothing was measured
_LOOK_S = 0.01


class Helper:
    """The process, from the start on, and its lines. It is in a session of its own, so that Ctrl-C does not end it.

    `module` has LEFT_NAME, what the process is called once the daemon has gone, while a call is not at its end (15
    characters are kept); its `prepare()`, if any, is called first.
    """

    def __init__(self, module: str, lines: Sequence[str], ended: str) -> None:
        pairs = [socket.socketpair() for _ in ("life", *lines)]
        numbers = [theirs.fileno() for _, theirs in pairs]
        command = [sys.executable, "-m", "thermostand.foundation.helper", module, str(os.getpid()), *map(str, numbers)]
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
        self._let_go()
        try:
            self._process.wait(_END_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._leave()
            return False
        return True

    async def ended_within(self, patience: Patience) -> bool:
        """As `close`, while the event loop goes on."""
        self._let_go()
        ending = asyncio.create_task(self._ending())
        try:
            if await patience.wait(ending, _END_WITHIN_S):
                return True
        finally:
            ending.cancel()
        self._leave()
        return False

    async def _ending(self) -> None:
        while self._process.poll() is None:  # noqa: ASYNC110 - it tells nobody that it has ended
            await asyncio.sleep(_LOOK_S)

    def _let_go(self) -> None:
        self._life.close()
        for line in self._lines.values():
            line.close()

    def _leave(self) -> None:
        if self._process.poll() is None:
            self._process.returncode = 0  # it is not waited for any more, and Python need not warn of that


def _how(status: int) -> str:
    return f"killed by {signal.Signals(-status).name}" if status < 0 else f"status {status}"


def main() -> None:
    """`python -m thermostand.foundation.helper MODULE DAEMON FD ...`: serve the daemon at these sockets until it
    is gone; the first carries nothing, its end is the daemon's. MODULE is imported first: from then on it is in
    memory."""
    module = importlib.import_module(sys.argv[1])
    getattr(module, "prepare", _nothing)()
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


def go_behind_all_others() -> None:
    """For `prepare`: everything else on the machine goes before this process."""
    with suppress(OSError):
        os.nice(19)
    with suppress(OSError, AttributeError):  # Linux
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def _nothing() -> None:
    pass


if __name__ == "__main__":
    main()
