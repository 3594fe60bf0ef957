"""The runtime folder: control sockets and locks of the daemons that live now, on a memory file system.

It is not on the sessions' disk, so that a daemon can be reached and identified also when that disk hangs, and when a
session's folder was renamed or removed.
"""

from __future__ import annotations

import os
import stat
from pathlib import Path

from foundation.errors import SessionError

NAME = "thermostand"
SYSTEM_FOLDER = Path("/run/lock") / NAME


def runtime_folder() -> Path:
    """`$XDG_RUNTIME_DIR/thermostand`, else `/run/lock/thermostand`; made with mode 0700 when it is absent.

    An XDG_RUNTIME_DIR that is not there, or belongs to another user (as after `sudo -E`), does not count. SessionError
    when the folder cannot be made or is another user's.
    """
    folder = _user_folder() or SYSTEM_FOLDER
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


def runtime_folders() -> tuple[Path, ...]:
    """Every runtime folder in which this user may have a daemon, own first: a service is started without
    XDG_RUNTIME_DIR, a login has one."""
    login = Path(f"/run/user/{os.geteuid()}") / NAME
    candidates = dict.fromkeys((_user_folder() or SYSTEM_FOLDER, login, SYSTEM_FOLDER))
    return tuple(folder for folder in candidates if _is_ours(folder))


def _user_folder() -> Path | None:
    parent = Path(os.environ.get("XDG_RUNTIME_DIR", ""))
    return parent / NAME if parent.is_absolute() and _is_ours(parent) else None


def _is_ours(folder: Path) -> bool:
    try:
        found = folder.lstat()
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid()
