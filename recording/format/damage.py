"""What reading damaged bytes raises, and the sentences it becomes."""

from __future__ import annotations

import struct
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

import zstandard
from mcap.exceptions import McapError

from thermostand.foundation.errors import SessionError

# CRC and Unicode errors are ValueErrors.
DAMAGE = (
    McapError,
    OSError,
    struct.error,
    zstandard.ZstdError,
    ValueError,
    LookupError,
    EOFError,
    OverflowError,
    MemoryError,
)


class FileDamaged(SessionError):
    """A file of a session is damaged or not what it should be: a repair recovers what is sound."""


@contextmanager
def convert_damage(path: Path) -> Generator[None]:
    """Errors that damage raises inside become a FileDamaged that names the file; one at once for a pipe or a device,
    which might never give a byte."""
    if path.exists() and not path.is_file():
        raise SessionError(f"{path}: is no file; no session has a folder, a pipe or a device of that name")
    try:
        yield
    except DAMAGE as error:
        text = " ".join(f"{type(error).__name__}: {error}".split())
        raise FileDamaged(f"{path}: damaged or not readable ({text})") from error


@contextmanager
def name_file_in_errors(path: Path) -> Generator[None]:
    """A SessionError from inside becomes a FileDamaged, with the file's name in front."""
    try:
        yield
    except SessionError as error:
        raise FileDamaged(f"{path}: {error}") from error
