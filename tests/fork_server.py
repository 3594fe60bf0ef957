"""The programs of the tests are forked from a process that has their modules loaded: a start then does without the
second of processor time that importing them takes. So are the simulated laboratories and the helpers that they start
themselves. What a person starts is a program of its own, which a few tests start as such."""

from __future__ import annotations

import atexit
import fcntl
import gc
import importlib
import json
import os
import selectors
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from select import select
from typing import Any, NoReturn

_ENTRIES = {
    "thermostand.drivers.sim": "thermostand.drivers.sim.__main__:main",
    "thermostand.stand.cli": "thermostand.stand.cli:app",
}
"""Of what `python -m` starts, what runs it; of other modules it is `main`."""
_INTERFACE = (
    "thermostand.stand.serving.api.app",
    "thermostand.stand.serving.api.http_clients",
    "thermostand.stand.serving.api.stream",
)
"""Modules that a daemon imports when it begins to answer."""
_LOADED = {
    "thermostand.stand.cli": (
        "thermostand.stand.commands.run_cli",
        "thermostand.stand.commands.serve_cli",
        "thermostand.stand.commands.queue_cli",
        *_INTERFACE,
    ),
    "tests.torture.product": ("thermostand.stand.commands.run_cli", *_INTERFACE),
    "tests.code": (
        "thermostand.stand.service.run",
        "thermostand.stand.service.queue_worker",
        "thermostand.stand.serving.api.server",
        *_INTERFACE,
    ),
    "thermostand.recording.writing.disk": (
        "thermostand.recording.writing.recorder",
        "thermostand.stand.service.queue_worker",
    ),
    "thermostand.stand.serving.preview_process": (
        "thermostand.stand.serving.preview",
        "thermostand.stand.serving.recorded_drift",
    ),
}
"""What such a program imports on its way, too."""
_HELPER = "thermostand.foundation.worker_process"
"""It is given the module whose calls it makes."""
STARTERS = ("thermostand.stand.assembly.simulator", "thermostand.foundation.worker_process")
"""Modules that start such programs themselves."""
_AT_THE_START = ("PYTHONPATH", "LD_PRELOAD", "NUMBA_CACHE_DIR", "PYTHONWARNINGS")
"""Who changes one of these gets a program of its own: they count while modules are loaded."""
OWN_HELPERS = "OWN_HELPERS"
"""Where this is in the environment, helpers are programs of their own, children of who starts them."""
_MESSAGE_BYTES = 200_000
_MOST_ENDS = 3 + 16
_APART = 4096
"""From this number on are the files that a program is given, until it has closed all others."""
_address = ""
"""Where the process that forks answers."""


def popen(command: Sequence[Any], **options: Any) -> subprocess.Popen[Any]:
    """As subprocess.Popen, for `python -m module arguments`."""
    words, env = [os.fspath(word) for word in command], options.get("env") or os.environ
    is_alike = all(env.get(name) == os.environ.get(name) for name in _AT_THE_START)
    is_apart = OWN_HELPERS in env and words[2:3] == [_HELPER]
    if not _address or not is_alike or is_apart or words[:2] != [sys.executable, "-m"]:
        return subprocess.Popen(words, **options)
    return _Forked(words, **options)


def run(command: Sequence[Any], timeout: float | None = None, **options: Any) -> subprocess.CompletedProcess[Any]:
    """As subprocess.run without `check`."""
    if options.pop("capture_output", False):
        options |= {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with popen(command, **options) as process:
        try:
            out, err = process.communicate(timeout=timeout)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(command, process.returncode, out, err)


class Programs:
    """In the place of the module `subprocess` where simulators and helpers are started."""

    PIPE, DEVNULL, TimeoutExpired = subprocess.PIPE, subprocess.DEVNULL, subprocess.TimeoutExpired
    Popen, run = staticmethod(popen), staticmethod(subprocess.run)


def be_served(address: str) -> None:
    """Programs of this process, too, are forked by the one that answers there; "" for none."""
    global _address
    _address = address


def served_at() -> str:
    """Where the process that forks answers; "" where there is none."""
    return _address


def is_served() -> bool:
    """A process that forks programs for this one is there."""
    return bool(_address)


class _Forked(subprocess.Popen[Any]):
    """A program forked by another process, which says on a line of its own how it has ended."""

    def __init__(self, command: Sequence[str], **options: Any) -> None:
        self._wanted = {
            "words": list(command[2:]),
            "env": dict(options.get("env") or os.environ),
            "folder": os.fspath(options.get("cwd") or os.getcwd()),
            "processors": sorted(os.sched_getaffinity(0)),
            "asker": os.getpid(),
            "is_leader": bool(options.get("start_new_session")),
            "files": list(options.get("pass_fds", ())),
        }
        super().__init__(command, **options)

    def _get_handles(self, *streams: Any) -> Any:
        self._ends = super()._get_handles(*streams)  # type: ignore[misc]
        return self._ends

    def _execute_child(self, *_: Any) -> None:
        stdin, self_in, self_out, stdout, self_err, stderr = self._ends
        given = [usual if end < 0 else end for usual, end in enumerate((stdin, stdout, stderr))]
        self._line = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._line.connect(_address)
        socket.send_fds(self._line, [json.dumps(self._wanted).encode()], [*given, *self._wanted["files"]])
        self.pid = int(self._line.recv(64))
        self._child_created = True
        kept = {-1, self_in, self_out, self_err}
        for end in {stdin, stdout, stderr} - kept:
            os.close(end)

    def _try_wait(self, wait_flags: int) -> tuple[int, int]:
        if not select([self._line], [], [], 0 if wait_flags & os.WNOHANG else None)[0]:
            return 0, 0
        status = int(self._line.recv(64) or signal.SIGKILL)
        self._line.close()
        return self.pid, status

    def __del__(self, *_: Any, **__: Any) -> None:
        """Of a program that is not waited for any more, too."""
        if hasattr(self, "_line"):
            self._line.close()
        super().__del__()  # type: ignore[misc]

    def _internal_poll(self, _deadstate: Any = None, **_: Any) -> int | None:
        if self.returncode is None and self._waitpid_lock.acquire(False):  # type: ignore[attr-defined]
            try:
                if self.returncode is None:
                    pid, status = self._try_wait(os.WNOHANG)
                    if pid == self.pid:
                        self._handle_exitstatus(status)  # type: ignore[attr-defined]
            finally:
                self._waitpid_lock.release()  # type: ignore[attr-defined]
        return self.returncode


class Forks:
    """The process that forks, from here on for all programs of these tests; it ends with this one, or `close`."""

    def __init__(self) -> None:
        global _address
        self._folder = tempfile.TemporaryDirectory(prefix="forks-")
        _address = f"{self._folder.name}/line"
        listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        listener.bind(_address)
        listener.listen(64)
        command = [sys.executable, "-m", "tests.fork_server", str(listener.fileno()), _address]
        environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            command,
            stdin=subprocess.PIPE,
            pass_fds=[listener.fileno()],
            env=environment,
            cwd=Path(__file__).parents[1],
        )
        listener.close()

    def close(self) -> None:
        global _address
        _address = ""
        self._server.terminate()  # programs that still run stay: they have their own ends
        self._server.communicate()
        self._folder.cleanup()


class _Server:
    def __init__(self, listener: socket.socket) -> None:
        self._listener, self._lines = listener, dict[int, socket.socket]()
        self._woken, waking = os.pipe()
        os.set_blocking(waking, False)
        signal.signal(signal.SIGCHLD, lambda *_: None)
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # is for the programs
        signal.set_wakeup_fd(waking, warn_on_full_buffer=False)

    def wanted(self) -> dict[str, Any]:
        """Return in each program that is to run, once; nothing at the end."""
        with selectors.DefaultSelector() as ready:
            for file in (0, self._woken, self._listener):
                ready.register(file, selectors.EVENT_READ)
            while True:
                files = [key.fileobj for key, _ in ready.select()]
                if self._woken in files:
                    os.read(self._woken, 4096)
                    self._reap()
                if self._listener in files and (wanted := self._fork()):
                    return wanted
                if 0 in files:
                    os._exit(0)

    def _fork(self) -> dict[str, Any] | None:
        line, _ = self._listener.accept()
        message, ends, _, _ = socket.recv_fds(line, _MESSAGE_BYTES, _MOST_ENDS)
        wanted: dict[str, Any] = json.loads(message)
        with suppress(Exception):  # the program itself says why it cannot begin
            _load(*wanted["words"][:2])
        pid = os.fork()
        if not pid:
            for each in (self._listener, line, *self._lines.values()):
                each.detach()  # or their numbers, which may be those of the program's files, are closed with them
            _hold([0, 1, 2, *wanted["files"]], ends)
            return wanted
        for end in ends:
            os.close(end)
        self._lines[pid] = line
        line.send(str(pid).encode())
        return None

    def _reap(self) -> None:
        with suppress(ChildProcessError):
            while (ended := os.waitpid(-1, os.WNOHANG))[0]:
                with self._lines.pop(ended[0]) as line, suppress(OSError):
                    line.send(str(ended[1]).encode())


def _hold(numbers: Sequence[int], ends: Sequence[int]) -> None:
    """Have these files under these numbers, and no others."""
    apart = [fcntl.fcntl(end, fcntl.F_DUPFD, _APART) for end in ends]
    os.closerange(0, _APART)
    for number, end in zip(numbers, apart, strict=True):
        os.dup2(end, number)
        os.close(end)


def _load(module: str, argument: str = "") -> Callable[[], Any]:
    """What runs the program, whose first argument that is."""
    home, _, entry = _ENTRIES.get(module, f"{module}:main").partition(":")
    made = argument if module == _HELPER else module
    for each in (*_LOADED.get(made, ()), made if module == _HELPER else home, home):
        if each not in sys.modules:
            importlib.import_module(each)
            gc.freeze()  # a program that collects garbage would copy all memory that it shares with the others
    return getattr(importlib.import_module(home), entry)


def _become(wanted: Mapping[str, Any]) -> Callable[[], Any]:
    """This process is as one that was started so; return what runs."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if wanted["is_leader"]:
        os.setsid()
    asker = Path(f"/proc/{wanted['asker']}")
    os.getppid = lambda: wanted["asker"] if asker.exists() else 1  # a laboratory ends some time after who started it
    os.sched_setaffinity(0, wanted["processors"])
    os.chdir(wanted["folder"])
    os.environ.clear()
    os.environ.update(wanted["env"])
    time.tzset()
    sys.stdin, sys.stdout = os.fdopen(0, closefd=False), os.fdopen(1, "w", closefd=False)
    sys.stderr = os.fdopen(2, "w", buffering=1, errors="backslashreplace", closefd=False)
    module, *arguments = wanted["words"]
    runs = _load(module, *arguments[:1])
    sys.argv = [str(sys.modules[runs.__module__].__file__), *arguments]
    for starter in STARTERS:
        if starter in sys.modules:
            setattr(sys.modules[starter], "subprocess", Programs)  # noqa: B010
    return runs


def _serve(listener: socket.socket) -> Callable[[], Any]:
    return _become(_Server(listener).wanted())


def _leave(runs: Callable[[], Any]) -> NoReturn:
    """Run it and end as the interpreter does, up to the point where that takes each object apart: 0.1 s of processor
    time, most of it to copy memory that this process shares with the others."""
    status: Any = None
    try:
        status = runs()
    except SystemExit as ending:
        status = ending.code
    except KeyboardInterrupt:
        traceback.print_exc()
        signal.signal(signal.SIGINT, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGINT)
    except BaseException as error:  # noqa: BLE001 - it is shown, and the program ends
        sys.excepthook(type(error), error, error.__traceback__)
        status = 1
    threading._shutdown()  # type: ignore[attr-defined]  # as Py_Finalize: it waits for threads, then come the functions
    atexit._run_exitfuncs()
    if isinstance(status, str):
        print(status, file=sys.stderr)  # noqa: T201 - as sys.exit
        status = 1
    try:
        for stream in (sys.stdout, sys.stderr):
            if not stream.closed:
                stream.flush()
    except OSError:
        status = 120
    os._exit(status or 0)


if __name__ == "__main__":
    _address = sys.argv[2]
    _leave(_serve(socket.socket(fileno=int(sys.argv[1]))))
