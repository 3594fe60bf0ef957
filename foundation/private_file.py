"""Files of secrets, which the configuration names and nothing records, attaches or shows."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from thermostand.foundation.documents import Model, parse_document
from thermostand.foundation.errors import ConfigError

_LARGEST_BYTES = 100_000  # a token has some dozen


def load_private_document(path: Path, key: str, model: type[Model], form: str) -> Model:
    """The file that `key` of a stand's file names. ConfigError, which says what `form` it should have, when it cannot
    be used, or others may read or write it; its sentence quotes nothing of the file."""
    place = f"{key}: {path}"
    text = _read_text(path, place)
    try:
        return parse_document(text, model, str(path))
    except ConfigError:
        raise ConfigError(f"{place}: is not as it should be: {form}") from None  # the reason would quote a secret


def _read_text(path: Path, place: str) -> str:
    try:
        fd = os.open(path.expanduser(), os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK)
    except OSError as error:
        raise ConfigError(f"{place}: cannot be read ({error.strerror})") from error
    try:
        status = os.fstat(fd)
        if not stat.S_ISREG(status.st_mode) or status.st_size > _LARGEST_BYTES:
            raise ConfigError(f"{place}: is no file of a few lines")
        if status.st_mode & (stat.S_IRWXG | stat.S_IRWXO):
            mode = stat.S_IMODE(status.st_mode)
            raise ConfigError(f"{place}: others may read or write it (mode {mode:04o}); type `chmod 600 {path}`")
        return os.read(fd, _LARGEST_BYTES).decode()
    except UnicodeDecodeError:
        raise ConfigError(f"{place}: is no text") from None
    finally:
        os.close(fd)
