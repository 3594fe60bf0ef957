"""Files that appear when they are complete: a reader, or an interrupted run, never sees half of one."""

from __future__ import annotations

import os
import stat
import tempfile
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from pathlib import Path
from typing import TextIO

from foundation.errors import SessionError


def write_whole(path: Path, text: str) -> None:
    """Write the text beside the place, then rename; SessionError when refused."""
    with whole_file(path) as file:
        file.write(text)


def write_whole_bytes(path: Path, data: bytes) -> None:
    """As `write_whole`, for what is no text."""
    with _placed(path) as temporary, temporary.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def whole_file(path: Path) -> Generator[TextIO]:
    """A text file (UTF-8, line ends as written) that takes its place when the block ends well.

    Until then, and for good when the block raises, an older file stays as it was and nothing else is left behind.
    SessionError when the place refuses.
    """
    with _placed(path) as temporary, temporary.open("w", encoding="utf-8", newline="") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())


@contextmanager
def _placed(path: Path) -> Generator[Path]:
    """A temporary file beside `path` that replaces it when the block ends well."""
    _check_place(path)
    temporary = _temporary(path)
    try:
        yield temporary
        temporary.chmod(0o644)
        _check_place(path)
        temporary.replace(path)
    except OSError as error:
        raise _refused(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """SessionError when nothing could be written to `path`: to be told before the work, not after it."""
    _check_place(path)
    _temporary(path).unlink()


def make_folder(path: Path) -> None:
    """The folder, with those above it, unless it is there; SessionError when the place refuses."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise SessionError(f"{path}: cannot be made ({error.strerror})") from error


def check_folder_writable(path: Path, names: Iterable[str]) -> None:
    """SessionError when files of these names could not be written into the folder, which need not be there yet: to be
    told before the work. Nothing is made."""
    if path.is_dir():
        for name in names:
            check_writable(path / name)
        return
    above = next(folder for folder in path.absolute().parents if os.path.lexists(folder))
    if os.path.lexists(path) or not above.is_dir() or not os.access(above, os.W_OK | os.X_OK):
        raise SessionError(f"{path}: cannot be made")


def _check_place(path: Path) -> None:
    """SessionError when something other than a regular file is there: the rename would replace a device or a pipe."""
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    except OSError as error:
        raise _refused(path, error) from error
    if stat.S_ISDIR(mode):
        raise SessionError(f"{path}: cannot be written (it is a folder)")
    if not stat.S_ISREG(mode):
        raise SessionError(f"{path}: cannot be written (it is not a regular file)")


def _temporary(path: Path) -> Path:
    try:
        handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    except OSError as error:
        raise _refused(path, error) from error
    os.close(handle)
    return Path(name)


def _refused(path: Path, error: OSError) -> SessionError:
    return SessionError(f"{path}: cannot be written ({error.strerror})")
