"""A file that appears whole or not at all, whoever else writes one of the same name at the same time."""

from __future__ import annotations

import os
import tempfile
from contextlib import suppress
from pathlib import Path

from foundation.sink import sync_folder


def write_whole(path: Path, data: bytes) -> None:
    """`data` as the file `path`, on the disk when this returns; its folder is made. It blocks; raises OSError, and then
    whatever was there before still is."""
    path.parent.mkdir(parents=True, exist_ok=True)
    fd, name = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.", suffix=".part")  # a name nobody else has
    try:
        with open(fd, "wb") as file:
            os.fchmod(fd, 0o644)
            file.write(data)
            file.flush()
            os.fsync(fd)
        os.replace(name, path)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise
    sync_folder(path.parent)
