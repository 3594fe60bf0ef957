"""Files that appear when they are complete: a reader, or an interrupted run, never sees half of one."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

from drivers.interface import SessionError


def write_whole(path: Path, text: str) -> None:
    """Write beside the place, then rename; an older file stays as it was until then. SessionError when refused."""
    temporary = _temporary(path)
    try:
        with temporary.open("w", encoding="utf-8", newline="\n") as file:
            file.write(text)
            file.flush()
            os.fsync(file.fileno())
        temporary.chmod(0o644)
        temporary.replace(path)
    except OSError as error:
        raise _refused(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """SessionError when nothing could be written to `path`: to be told before the work, not after it."""
    if path.is_dir():
        raise SessionError(f"{path}: cannot be written (it is a folder)")
    _temporary(path).unlink()


def _temporary(path: Path) -> Path:
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as error:
        raise _refused(path, error) from error
    os.close(handle)
    return Path(name)


def _refused(path: Path, error: OSError) -> SessionError:
    return SessionError(f"{path}: cannot be written ({error.strerror})")
