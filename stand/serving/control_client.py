"""The other end of a running daemon's control socket: which daemon is meant, and what it answers."""

from __future__ import annotations

import json
import os
import socket
import threading
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TypeVar

from pydantic import ValidationError

from foundation.clock import NS_PER_S, WallClock
from foundation.errors import SessionError
from stand.serving.desk import RunStatus
from stand.serving.door import Answer, object_of
from stand.serving.presence import Daemon, address_in, living, opened_folder

_DISK_LIMIT_S = 1.0  # the disk of a session is asked no longer than this: it may hang
_KNOCK_AGAIN_S = 0.02

Result = TypeVar("Result")


def ask(session: Path, request: Mapping[str, object], timeout_s: float = 5.0) -> Answer:
    """What the daemon that runs `session` answers; a SessionError when none runs, it does not answer, or it refuses.

    The session may be given by the folder's name of today, or by the name it had when the run began.
    """
    with _connected(session, timeout_s) as daemon:
        try:
            with suppress(BrokenPipeError):  # it may have refused before it was asked
                daemon.sendall(json.dumps(dict(request)).encode() + b"\n")
            with daemon.makefile("rb") as answers:
                line = answers.readline()
        except TimeoutError:
            raise SessionError(f"{session}: its daemon has not answered within {timeout_s:g} s; it may hang") from None
        except OSError as error:
            raise SessionError(f"{session}: its daemon ended before it answered ({error.strerror})") from error
    if not line.endswith(b"\n"):
        raise SessionError(f"{session}: its daemon ended before it answered")
    answer = object_of(line)
    if answer is None or not isinstance(answer.get("ok"), bool):
        raise SessionError(f"{session}: its daemon sent an unknown reply; is its version different?")
    if not answer.pop("ok"):
        raise SessionError(f"{session}: {answer.get('error')}")
    return answer


def ask_status(session: Path, timeout_s: float = 5.0) -> RunStatus:
    """The status of the run; SessionError as `ask`."""
    try:
        return RunStatus.model_validate(ask(session, {"do": "status"}, timeout_s).get("status"))
    except ValidationError as error:
        raise SessionError(f"{session}: its daemon sent an unknown status; is its version different?") from error


def running_sessions(root: Path | None = None) -> list[Path]:
    """The sessions that a daemon of this user is running now: `root` itself when it is one, else those directly below
    it, by their present names as far as the disk gives them; all of this machine without `root`."""
    daemons = living()
    if root is None:
        return sorted(Path(daemon.entry.session) for daemon in daemons)
    if _named(root, daemons):
        return [root]
    paths = _spellings(root)
    known = [daemon for daemon in daemons if not paths.isdisjoint(map(os.path.dirname, _paths(daemon)))]
    here = {root / os.path.basename(daemon.entry.session) for daemon in known}
    moved = {daemon.entry.identity for daemon in daemons if daemon not in known} - {None}
    if moved:  # into this folder, perhaps
        found = _asked_disk(lambda: [path for path in root.iterdir() if _identity(path) in moved])
        here.update(found or ())
    return sorted(here)


def _named(session: Path, daemons: list[Daemon]) -> list[Daemon]:
    """Those that run `session`, by its name, else by the folder that has this name now."""
    paths = _spellings(session)
    named = [daemon for daemon in daemons if not paths.isdisjoint(_paths(daemon))]
    if len(named) == 1 or not daemons:
        return named
    identity = _asked_disk(lambda: _identity(session))
    same = [daemon for daemon in daemons if identity is not None and daemon.entry.identity == identity]
    return same or named


def _paths(daemon: Daemon) -> set[str]:
    return {daemon.entry.session, daemon.entry.real_path} - {""}


def _spellings(path: Path) -> set[str]:
    return {os.path.abspath(path), _asked_disk(lambda: os.path.realpath(path)) or os.path.abspath(path)}


def _identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _asked_disk(question: Callable[[], Result]) -> Result | None:
    """The answer; None when the disk refuses it, or does not give it within _DISK_LIMIT_S."""
    answers: list[Result] = []

    def ask_it() -> None:
        with suppress(OSError):
            answers.append(question())

    asking = threading.Thread(target=ask_it, name="disk", daemon=True)
    asking.start()
    asking.join(_DISK_LIMIT_S)
    return answers[0] if answers else None


@contextmanager
def _connected(session: Path, timeout_s: float) -> Generator[socket.socket]:
    found = _named(session, living())
    if not found:
        raise SessionError(f"{session}: no daemon is running this session")
    with socket.socket(socket.AF_UNIX) as daemon:
        daemon.settimeout(timeout_s)
        try:
            _connect(daemon, found[0].socket, timeout_s)
        except (FileNotFoundError, ConnectionRefusedError):
            raise SessionError(f"{session}: no daemon is running this session") from None
        except (TimeoutError, BlockingIOError):  # its queue of connections is full
            raise SessionError(f"{session}: its daemon takes no more connections; it may hang") from None
        except OSError as error:
            raise SessionError(f"{session}: its daemon cannot be reached ({error.strerror})") from error
        yield daemon


def _connect(daemon: socket.socket, path: Path, timeout_s: float) -> None:
    """Connect; while its queue of connections is full, try again until `timeout_s` has passed."""
    clock = WallClock()
    until_ns = clock.now_ns() + round(timeout_s * NS_PER_S)
    with opened_folder(path.parent) as folder:
        while True:
            try:
                return daemon.connect(address_in(folder, path.name))
            except BlockingIOError:
                if clock.now_ns() > until_ns:
                    raise
            threading.Event().wait(_KNOCK_AGAIN_S)
