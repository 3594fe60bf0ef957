"""The other end of a running daemon's control socket."""

from __future__ import annotations

import json
import socket
from collections.abc import Generator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path

from pydantic import ValidationError

from drivers.interface import SessionError
from stand.remote.control import SOCKET_NAME, Answer, RunStatus, address_in, object_of, opened_folder


def ask(session: Path, request: Mapping[str, object], timeout_s: float = 5.0) -> Answer:
    """What the daemon that runs `session` answers; a SessionError when none runs, it does not answer, or it refuses."""
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
        raise SessionError(f"{session}: its daemon answered what nobody understands; is it of another version?")
    if not answer.pop("ok"):
        raise SessionError(f"{session}: {answer.get('error')}")
    return answer


def ask_status(session: Path, timeout_s: float = 5.0) -> RunStatus:
    """The status of the run; SessionError as `ask`."""
    try:
        return RunStatus.model_validate(ask(session, {"do": "status"}, timeout_s).get("status"))
    except ValidationError as error:
        raise SessionError(f"{session}: its daemon tells its status as another version would") from error


def running_sessions(root: Path) -> list[Path]:
    """The sessions directly below `root` that a daemon is running now."""
    return [path.parent for path in sorted(root.glob(f"*/{SOCKET_NAME}")) if _is_running(path.parent)]


def _is_running(session: Path) -> bool:
    try:
        with _connected(session, 1.0):
            return True
    except SessionError:
        return False


@contextmanager
def _connected(session: Path, timeout_s: float) -> Generator[socket.socket]:
    with opened_folder(session) as folder, socket.socket(socket.AF_UNIX) as daemon:
        daemon.settimeout(timeout_s)
        try:
            daemon.connect(address_in(folder, SOCKET_NAME))
        except (FileNotFoundError, ConnectionRefusedError):
            raise SessionError(f"{session}: no daemon is running this session") from None
        except (TimeoutError, BlockingIOError):  # its queue of connections is full
            raise SessionError(f"{session}: its daemon takes no more connections; it may hang") from None
        except OSError as error:
            raise SessionError(f"{session}: its daemon cannot be reached ({error.strerror})") from error
        yield daemon
