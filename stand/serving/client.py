"""The other end of a daemon's HTTP interface: which daemon is meant, and what it answers.

Plain http.client: a command line that stops a stand must not import for half a second first.
"""

from __future__ import annotations

import http.client
import json
import os
import socket
import struct
import threading
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TypeVar, cast
from urllib.parse import urlsplit

from pydantic import ValidationError

from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.files import describe_unreadable
from thermostand.stand.serving.api_models import StandState
from thermostand.stand.serving.instances import STOP_SUFFIX, LiveDaemon, list_daemons, make_socket_address, open_folder

API = "/api/v1"
LIMIT_S = 5.0  # as bridge.COMMAND_LIMIT_S
_DISK_LIMIT_S = 1.0  # the disk of a session is asked no longer than this: it may hang

Result = TypeVar("Result")
Answer = dict[str, object]


@dataclass(frozen=True, slots=True)
class Server:
    """Where a stand answers. name: for messages. socket: its Unix socket, else `url` with `token`."""

    name: str
    socket: Path | None = None
    url: str = ""
    token: str = field(default="", repr=False)

    def request(
        self, method: str, path: str, body: Mapping[str, object] | None = None, timeout_s: float = LIMIT_S
    ) -> object:
        """The JSON it answers, None when that is empty. SessionError when it does not answer, or refuses: then with its
        sentence."""
        return self._parse_answer(*self._exchange(method, path, body, timeout_s)[:2])

    def fetch_picture(self, timeout_s: float = LIMIT_S) -> tuple[int, bytes] | None:
        """The last frame: its time in ns since the epoch, on the stand's clock, and a JPEG; None when there is none.
        SessionError as `request`."""
        status, content, headers = self._exchange("GET", f"{API}/frame.jpg", None, timeout_s)
        if status != http.HTTPStatus.OK:
            self._parse_answer(status, content)
            return None
        return int(headers.get("x-time-ns", "0")), content

    def _exchange(
        self, method: str, path: str, body: Mapping[str, object] | None, timeout_s: float, spent_s: float = 0.0
    ) -> tuple[int, bytes, http.client.HTTPMessage]:
        """Status, content and headers. spent_s: how much of the time is gone already."""
        connection = self._make_connection(timeout_s - spent_s)
        headers = {"Authorization": f"Bearer {self.token}"} if self.token else {}
        try:
            with suppress(BrokenPipeError):  # it may have refused before it was asked
                content = None if body is None else json.dumps(dict(body))
                if content is not None:
                    headers["Content-Type"] = "application/json"
                connection.request(method, path, content, headers)
            reply = connection.getresponse()
            return reply.status, reply.read(), reply.headers
        except TimeoutError:
            raise SessionError(
                f"{self.name}: its daemon has not answered within {timeout_s:g} s; it may hang"
            ) from None
        except (FileNotFoundError, ConnectionRefusedError):
            raise SessionError(f"{self.name}: no daemon is running {'there' if self.url else 'this session'}") from None
        except BlockingIOError:  # its queue of connections is full
            raise SessionError(f"{self.name}: its daemon takes no more connections; it may hang") from None
        except (http.client.RemoteDisconnected, ConnectionResetError):
            raise SessionError(f"{self.name}: its daemon ended before it answered") from None
        except OSError as error:
            raise SessionError(f"{self.name}: its daemon cannot be reached ({error.strerror or error})") from error
        except http.client.HTTPException:
            raise SessionError(f"{self.name}: its daemon sent {_UNKNOWN}") from None
        finally:
            connection.close()

    def order(self, verb: str, body: Mapping[str, object] | None = None, timeout_s: float = LIMIT_S) -> Answer:
        """Return what a command to the run is answered (desk.Done). STOP goes to the socket for it, for half of the
        time, and then as everything does."""
        spent_s = 0.0
        if verb == "stop" and self.socket is not None and self.socket.suffix != STOP_SUFFIX:
            begun_s = time.monotonic()
            with suppress(SessionError):
                return replace(self, socket=self.socket.with_suffix(STOP_SUFFIX)).order(verb, None, timeout_s / 2)
            spent_s = time.monotonic() - begun_s
        answer = self._parse_answer(*self._exchange("POST", f"{API}/run/{verb}", body, timeout_s, spent_s)[:2])
        if not isinstance(answer, dict):
            raise SessionError(f"{self.name}: its daemon sent {_UNKNOWN}")
        return cast("Answer", answer)

    def state(self, timeout_s: float = LIMIT_S) -> StandState:
        """The stand as it is now."""
        try:
            return StandState.model_validate(self.request("GET", f"{API}/state", None, timeout_s))
        except ValidationError as error:
            raise SessionError(f"{self.name}: its daemon sent {_UNKNOWN}") from error

    def _make_connection(self, timeout_s: float) -> http.client.HTTPConnection:
        if self.socket is not None:
            return _UnixConnection(self.socket, timeout_s)
        parts = urlsplit(self.url)
        kind = http.client.HTTPSConnection if parts.scheme == "https" else http.client.HTTPConnection
        return kind(parts.hostname or "", parts.port, timeout=timeout_s)

    def _parse_answer(self, status: int, text: bytes) -> object:
        if status == http.HTTPStatus.NO_CONTENT:
            return None
        try:
            answer: object = json.loads(text)
        except (ValueError, RecursionError):
            raise SessionError(f"{self.name}: its daemon sent {_UNKNOWN}") from None
        if status < 400:
            return answer
        error = cast("Answer", answer).get("error") if isinstance(answer, dict) else None
        if not isinstance(error, str):
            raise SessionError(f"{self.name}: its daemon sent {_UNKNOWN}")
        raise SessionError(f"{self.name}: {error}")


_UNKNOWN = "an unknown reply; is its version different?"


class _UnixConnection(http.client.HTTPConnection):
    """HTTP over a Unix socket; while its queue of connections is full, it waits in line."""

    def __init__(self, path: Path, timeout_s: float) -> None:
        super().__init__("localhost", timeout=timeout_s)
        self._path = path
        self._limit_s = timeout_s

    def connect(self) -> None:
        """Connect as HTTPConnection does."""
        daemon = socket.socket(socket.AF_UNIX)
        # The kernel's own time-out: with Python's, a full queue would be an error at once.
        seconds, rest_s = divmod(self._limit_s, 1.0)
        daemon.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, struct.pack("@ll", int(seconds), int(1e6 * rest_s)))
        try:
            with open_folder(self._path.parent) as folder:
                daemon.connect(make_socket_address(folder, self._path.name))
            daemon.settimeout(self._limit_s)
        except BaseException:
            daemon.close()
            raise
        self.sock = daemon


def make_server(url: str, token_file: Path | None = None) -> Server:
    """The stand at `http://host:port`, with the token in the file; ConfigError when either is wrong."""
    try:
        parts = urlsplit(url)
        fits = (
            parts.scheme in ("http", "https") and bool(parts.hostname) and parts.path in ("", "/") and parts.port != 0
        )
    except ValueError:
        fits = False
    if not fits:
        raise ConfigError(f"--url {url}: expected http://HOST:PORT")
    try:
        token = token_file.read_text("utf-8").strip() if token_file is not None else ""
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"--token-file {describe_unreadable(token_file or '', error)}") from error
    if not token.isprintable() or not token.isascii():
        raise ConfigError(f"--token-file {token_file}: expected one line with a token")
    return Server(url, url=url, token=token)


def find_session_server(session: Path) -> Server:
    """The daemon that runs `session`: the folder's name of today, or the name it had when the run began. SessionError
    when there is none."""
    found = _select_daemons(session, list_daemons())
    if not found:
        raise SessionError(f"{session}: no daemon is running this session")
    return Server(str(session), found[0].socket)


def list_running_sessions(root: Path | None = None) -> list[Path]:
    """The sessions that a daemon of this user is running now: `root` itself when it is one, else those directly below
    it, by their present names as far as the disk gives them; all of this machine without `root`."""
    daemons = list_daemons()
    if root is None:
        return sorted(Path(daemon.entry.session) for daemon in daemons)
    if _select_daemons(root, daemons):
        return [root]
    paths = _list_spellings(root)
    known = [daemon for daemon in daemons if not paths.isdisjoint(map(os.path.dirname, _list_paths(daemon)))]
    here = {root / os.path.basename(daemon.entry.session) for daemon in known}
    moved = {daemon.entry.identity for daemon in daemons if daemon not in known} - {None}
    if moved:  # into this folder, perhaps
        found = _ask_disk(lambda: [path for path in root.iterdir() if _get_identity(path) in moved])
        here.update(found or ())
    return sorted(here)


def _select_daemons(session: Path, daemons: list[LiveDaemon]) -> list[LiveDaemon]:
    """Select the daemons that run `session`, by its name, else by the folder that has this name now."""
    paths = _list_spellings(session)
    named = [daemon for daemon in daemons if not paths.isdisjoint(_list_paths(daemon))]
    if len(named) == 1 or not daemons:
        return named
    identity = _ask_disk(lambda: _get_identity(session))
    same = [daemon for daemon in daemons if identity is not None and daemon.entry.identity == identity]
    return same or named


def _list_paths(daemon: LiveDaemon) -> set[str]:
    return {daemon.entry.session, daemon.entry.real_path} - {""}


def _list_spellings(path: Path) -> set[str]:
    return {os.path.abspath(path), _ask_disk(lambda: os.path.realpath(path)) or os.path.abspath(path)}


def _get_identity(path: Path) -> tuple[int, int] | None:
    try:
        found = path.stat()
    except OSError:
        return None
    return found.st_dev, found.st_ino


def _ask_disk(question: Callable[[], Result]) -> Result | None:
    """The answer; None when the disk refuses it, or does not give it within _DISK_LIMIT_S."""
    answers: list[Result] = []

    def ask_it() -> None:
        with suppress(OSError):
            answers.append(question())

    asking = threading.Thread(target=ask_it, name="disk", daemon=True)
    asking.start()
    asking.join(_DISK_LIMIT_S)
    return answers[0] if answers else None
