"""The daemons that live now: for each an entry and its control socket in the runtime folder.

`ID.json` says which session is run, by which process, on which stand; the daemon keeps it locked (flock), so an entry
that can be locked was left by a dead one and is removed when it is seen. `ID.sock` is the control socket, mode 0600,
and `ID.stop` such another, at which a thread of its own does nothing but stop.
The runtime folder is on a memory file system and not on the sessions' disk, so that a daemon can be reached and
identified also when that disk hangs, and when a session's folder was renamed or removed.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import stat
import threading
from collections.abc import Generator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import cast

from thermostand.foundation.errors import SessionError
from thermostand.foundation.lock_file import is_at, release_lock, take_lock, try_lock

NAME = "thermostand"
SYSTEM_FOLDER = Path("/run/lock") / NAME
STANDS_FOLDER = Path("/run/lock") / f"{NAME}-stands"
_BACKLOG = 1024  # round number; nothing was measured
STOP_SUFFIX = ".stop"
_SOCKETS = (".sock", STOP_SUFFIX)


@dataclass(frozen=True, slots=True)
class DaemonEntry:
    """session: its folder's path when the run began. real_path: the same without symbolic links, and identity: its
    device and inode, once the disk has given them. url: where its page is, "" without one."""

    session: str
    pid: int
    stand: str
    real_path: str = ""
    identity: tuple[int, int] | None = None
    url: str = ""


@dataclass(frozen=True, slots=True)
class LiveDaemon:
    """A living daemon and where it answers."""

    entry: DaemonEntry
    socket: Path


class DaemonInstance:
    """A daemon's own entry and sockets; `publish` before anything else. To be used from any thread."""

    def __init__(self, entry: DaemonEntry) -> None:
        self._lock = threading.RLock()
        self._entry = entry
        self._id = f"{entry.pid}-{secrets.token_hex(4)}"
        self._path = Path()
        self._file: int | None = None

    def publish(self) -> tuple[socket.socket, socket.socket]:
        """Make, or make again, its files; returns the listening sockets, for everything and for STOP alone.
        SessionError when they cannot be made."""
        path = find_runtime_folder() / f"{self._id}.json"
        with self._lock:
            try:
                self._write_entry(path)
                everything = _open_socket(self._path.with_suffix(".sock"))
                try:
                    return everything, _open_socket(self._path.with_suffix(STOP_SUFFIX))
                except OSError:
                    everything.close()
                    raise
            except OSError as error:
                self.withdraw()
                raise SessionError(f"{path.parent}: no control socket can be made there ({error.strerror})") from error

    def is_published(self) -> bool:
        """Return whether its files are still there; a logout removes $XDG_RUNTIME_DIR with all that is in it."""
        with self._lock, suppress(OSError):
            return (
                self._file is not None
                and is_at(self._file, self._path)
                and all(self._path.with_suffix(each).is_socket() for each in _SOCKETS)
            )
        return False

    def tell(self, entry: DaemonEntry) -> None:
        """Say this from now on."""
        with self._lock, suppress(OSError):  # the entry before stays
            self._entry = entry
            if self._file is not None:
                self._write_entry(self._path)

    def identify(self) -> None:
        """Note what the disk says of the session's folder, when it does: nothing waits for a disk that hangs."""

        def look() -> None:
            entry = self._entry
            with suppress(OSError):  # no such folder
                found, real_path = os.stat(entry.session), os.path.realpath(entry.session)
                self.tell(replace(entry, real_path=real_path, identity=(found.st_dev, found.st_ino)))

        threading.Thread(target=look, name="session-folder", daemon=True).start()

    def withdraw(self) -> None:
        """Remove its files; may be called twice."""
        with self._lock:
            if self._file is not None:
                for each in _SOCKETS:
                    with suppress(OSError):
                        self._path.with_suffix(each).unlink()
                release_lock(self._path, self._file)
                self._file = None

    def _write_entry(self, path: Path) -> None:
        """The entry appears whole and locked."""
        part = path.with_name(f".{path.name}")
        file = take_lock(part, json.dumps(asdict(self._entry)).encode())
        if file is None:
            raise BlockingIOError(0, "another process has locked it")
        try:
            part.replace(path)
        except OSError:
            release_lock(part, file)
            raise
        before, self._file, self._path = self._file, file, path
        if before is not None:
            os.close(before)


def list_daemons() -> list[LiveDaemon]:
    """Every daemon of this user on this machine, in the order of their processes; what dead ones left is removed."""
    found = [
        daemon
        for folder in list_runtime_folders()
        for path in folder.glob("[!.]*.json")
        if (daemon := _read_daemon(path)) is not None
    ]
    return sorted(found, key=lambda daemon: (daemon.entry.pid, daemon.socket))


@contextmanager
def open_folder(path: Path) -> Generator[int]:
    """The folder's descriptor while inside; raises OSError."""
    folder = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        yield folder
    finally:
        os.close(folder)


def make_socket_address(folder: int, name: str) -> str:
    """The socket by its opened folder: the kernel takes no more than 107 bytes of a path."""
    return f"/proc/self/fd/{folder}/{name}"


def _open_socket(path: Path) -> socket.socket:
    listening = socket.socket(socket.AF_UNIX)
    try:
        listening.setblocking(False)
        path.unlink(missing_ok=True)
        os.fchmod(listening.fileno(), 0o600)  # before bind, so that the name never has another mode
        with open_folder(path.parent) as folder:
            listening.bind(make_socket_address(folder, path.name))
        listening.listen(_BACKLOG)
    except OSError:
        listening.close()
        raise
    return listening


def _read_daemon(path: Path) -> LiveDaemon | None:
    try:
        file = os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW)
    except OSError:  # gone meanwhile
        return None
    try:
        if try_lock(file, shared=True):
            if is_at(file, path):
                for each in _SOCKETS:
                    path.with_suffix(each).unlink(missing_ok=True)
                path.unlink(missing_ok=True)
            return None
        with open(file, "rb", closefd=False) as opened:
            return LiveDaemon(_decode(opened.read()), path.with_suffix(".sock"))
    except (OSError, ValueError, LookupError, TypeError):  # nothing of ours
        return None
    finally:
        os.close(file)


def _decode(content: bytes) -> DaemonEntry:
    fields = cast("dict[str, object]", json.loads(content))
    identity = cast("list[int] | None", fields["identity"])
    return DaemonEntry(
        str(fields["session"]),
        int(str(fields["pid"])),
        str(fields["stand"]),
        str(fields["real_path"]),
        None if identity is None else (identity[0], identity[1]),
        str(fields.get("url", "")),
    )


def find_runtime_folder() -> Path:
    """`$XDG_RUNTIME_DIR/thermostand`, else `/run/lock/thermostand`; made with mode 0700 when it is absent.

    An XDG_RUNTIME_DIR that is not there, or belongs to another user (as after `sudo -E`), does not count. SessionError
    when the folder cannot be made or is another user's.
    """
    folder = _find_user_folder() or SYSTEM_FOLDER
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        found = folder.lstat()
        if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.geteuid():
            raise SessionError(f"{folder}: is not a folder of this user; set XDG_RUNTIME_DIR to one that is")
        if stat.S_IMODE(found.st_mode) != 0o700:
            folder.chmod(0o700)
    except OSError as error:
        text = f"{folder}: cannot be made ({error.strerror}); set XDG_RUNTIME_DIR to a folder of this user"
        raise SessionError(text) from error
    return folder


def find_lock_folder() -> Path | None:
    """`/run/lock/thermostand-stands`, where the locks of real stands lie on a machine on which `stand service install`
    has made it for the stand's group; None where there is none.

    A name that anybody may take first (a world-writable folder, the kernel's abstract sockets) lets any user of the
    machine keep a stand from its operators. SessionError when others than the group may write there, or this user may
    not: then he is not one of the stand's operators.
    """
    try:
        found = STANDS_FOLDER.lstat()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise SessionError(f"{STANDS_FOLDER}: cannot be looked at ({error.strerror})") from error
    if not stat.S_ISDIR(found.st_mode) or found.st_uid not in (0, os.geteuid()) or found.st_mode & stat.S_IWOTH:
        raise SessionError(f"{STANDS_FOLDER}: is not a folder that root has made for the stand's group; remove it")
    if not os.access(STANDS_FOLDER, os.R_OK | os.W_OK | os.X_OK):
        raise SessionError(f"{STANDS_FOLDER}: belongs to the operators of this machine's stands; ask for their group")
    return STANDS_FOLDER


def list_runtime_folders() -> tuple[Path, ...]:
    """Every runtime folder in which this user may have a daemon, own first: a service is started without
    XDG_RUNTIME_DIR, a login has one."""
    login = Path(f"/run/user/{os.geteuid()}") / NAME
    candidates = dict.fromkeys((_find_user_folder() or SYSTEM_FOLDER, login, SYSTEM_FOLDER))
    return tuple(folder for folder in candidates if _is_ours(folder))


def _find_user_folder() -> Path | None:
    parent = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    return parent / NAME if parent.is_absolute() and _is_ours(parent) else None


def _is_ours(folder: Path) -> bool:
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()
