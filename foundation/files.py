"""Files and folders that appear when they are complete: a reader, or an interrupted run, never sees half of one."""

from __future__ import annotations

import errno
import os
import shutil
import stat
import tempfile
from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TextIO

from thermostand.foundation.errors import SessionError


def describe_unreadable(path: Path | str, error: OSError | UnicodeDecodeError) -> str:
    """Return why the text file there cannot be read, as `path: sentence`."""
    if isinstance(error, UnicodeDecodeError):
        line = error.object[: error.start].count(b"\n") + 1
        return f"{path}: cannot be read (line {line} is not UTF-8; save the file as UTF-8)"
    if isinstance(error, FileNotFoundError):
        return f"{path}: no such file"
    return f"{path}: cannot be read ({error.strerror or error})"


def replace_file(path: Path, data: bytes) -> None:
    """`data` as the file `path`, complete and on the disk when this returns, also when others write one of that name at
    the same time; its folder is made. Raises OSError, and then a file that was there before is unchanged."""
    make_durable_folder(path.parent)
    temporary = _create_temporary(path)
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            _move_into_place(file.fileno(), temporary, path)
    except BaseException:
        with suppress(OSError):
            temporary.unlink()
        raise
    sync_folder(path.parent)


def write_atomically(path: Path, text: str) -> None:
    """Write the text to a temporary file in the same folder, then rename it; SessionError when refused."""
    with open_atomic(path) as file:
        file.write(text)


def write_bytes_atomically(path: Path, data: bytes) -> None:
    """Write bytes as `write_atomically` writes text."""
    _check_place(path)
    try:
        replace_file(path, data)
    except OSError as error:
        raise _make_refusal(path, error) from error


@contextmanager
def open_atomic(path: Path) -> Generator[TextIO]:
    """A text file (UTF-8, line ends as written) that takes its place when the block ends well.

    Until then, and for good when the block raises, an older file stays as it was and nothing else is left behind.
    SessionError when the place refuses.
    """
    _check_place(path)
    temporary = _name_temporary(path)
    try:
        with temporary.open("w", encoding="utf-8", newline="") as file:
            yield file
            file.flush()
            _check_place(path)
            _move_into_place(file.fileno(), temporary, path)
        sync_folder(path.parent)
    except OSError as error:
        raise _make_refusal(path, error) from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: Path) -> None:
    """SessionError when nothing could be written to `path`: to be raised before the work, not after it."""
    _check_place(path)
    _name_temporary(path).unlink()


def make_durable_folder(path: Path) -> None:
    """The folder, with those above it, unless it is there; each new name is on the disk when this returns: what is
    synced into a folder whose own name is not would be lost with it. Raises OSError."""
    if path.is_dir():
        return
    if path.parent != path:
        make_durable_folder(path.parent)
    path.mkdir(exist_ok=True)
    sync_folder(path.parent)


def name_part(out: Path) -> Path:
    """The name that the new file `out` has until it is whole; SessionError when one of the two is in the way."""
    part = out.with_name(f"{out.name}.part")
    if out.exists() or part.exists():
        raise SessionError(f"{out if out.exists() else part}: is in the way; remove it or choose another name")
    return part


def make_folder(path: Path) -> None:
    """Make a folder as `make_durable_folder` does; SessionError when the place refuses."""
    try:
        make_durable_folder(path)
    except OSError as error:
        raise SessionError(f"{path}: cannot be made ({error.strerror})") from error


def check_folder_writable(path: Path, names: Iterable[str]) -> None:
    """SessionError when files of these names could not be written into the folder, which need not be there yet: to be
    raised before the work. Nothing is made."""
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
        raise _make_refusal(path, error) from error
    if stat.S_ISDIR(mode):
        raise SessionError(f"{path}: cannot be written (it is a folder)")
    if not stat.S_ISREG(mode):
        raise SessionError(f"{path}: cannot be written (it is not a regular file)")


def _name_temporary(path: Path) -> Path:
    try:
        return _create_temporary(path)
    except OSError as error:
        raise _make_refusal(path, error) from error


def _create_temporary(path: Path) -> Path:
    """A new file in the same folder, under a unique name."""
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")
    os.close(handle)
    return Path(name)


def _move_into_place(fd: int, temporary: Path, path: Path) -> None:
    """What was written is on the disk, and then under its name."""
    os.fchmod(fd, 0o644)
    os.fsync(fd)
    temporary.replace(path)


def _make_refusal(path: Path, error: OSError) -> SessionError:
    return SessionError(f"{path}: cannot be written ({error.strerror})")


@contextmanager
def create_folder(out: Path) -> Generator[Path]:
    """A folder next to `out` (`NAME.part`) to write into. When the block ends well it is on the disk and becomes `out`;
    when it does not, it is removed. SessionError when `out` exists or the disk refuses."""
    part = out.parent / f"{out.name}.part"
    try:
        make_durable_folder(out.parent)
        if out.exists():
            raise SessionError(f"{out}: exists already; choose another name or move it away")
        if part.exists():
            raise SessionError(f"{part}: is in the way, left by a command that was killed; remove it")
        part.mkdir()
    except OSError as error:
        raise SessionError(f"{out}: cannot be made ({error})") from error
    try:
        yield part
        _sync_all(part)
        part.rename(out)
        sync_folder(out.parent)
    except OSError as error:
        raise SessionError(f"{out}: cannot be written ({error})") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)  # there is none any more when all went well


def _sync_all(folder: Path) -> None:
    """Everything in `folder` on the disk, then the folder itself."""
    for path in folder.iterdir():
        if path.is_dir():
            _sync_all(path)
            continue
        with path.open("rb") as file:
            os.fsync(file.fileno())
    sync_folder(folder)


_CANNOT_SYNC = (errno.EINVAL, errno.ENOTSUP, errno.ENOSYS)  # of CIFS, some FUSE file systems and exchange disks
_accepting: list[Callable[[str], None]] = []


@contextmanager
def accept_unsynced_folders(say: Callable[[str], None]) -> Generator[None]:
    """While inside, a file system that cannot sync folders is no error: `say` gets one sentence about it. For commands
    that somebody runs on an exchange disk, and can run again; what must be durable stays strict."""
    warned: set[str] = set()

    def say_once(text: str) -> None:
        if not warned:
            warned.add(text)
            say(text)

    _accepting.append(say_once)
    try:
        yield
    finally:
        _accepting.remove(say_once)


def sync_folder(folder: Path) -> None:
    """Make the folder's names durable; OSError when the disk refuses, and where its file system cannot do that."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    except OSError as error:
        if error.errno not in _CANNOT_SYNC:
            raise
        cause = f"the file system of {folder} cannot sync folders ({error.strerror})"
        if not _accepting:
            raise OSError(error.errno, f"{cause}; record to a disk that can, as ext4 or XFS") from error
        _accepting[-1](f"{cause}: unmount it before you take it away")
    finally:
        os.close(fd)
