"""A new folder that appears whole or not at all."""

from __future__ import annotations

import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from foundation.errors import SessionError
from foundation.sink import sync_folder


@contextmanager
def new_folder(out: Path) -> Generator[Path]:
    """A folder beside `out` (`NAME.part`) to write into. When the block ends well it is on the disk and becomes `out`;
    when it does not, it is removed. SessionError when `out` exists or the disk refuses."""
    part = out.parent / f"{out.name}.part"
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        if out.exists():
            raise SessionError(f"{out}: exists already; choose another name or move it away")
        if part.exists():
            raise SessionError(f"{part}: is in the way, left by a command that was killed; remove it")
        part.mkdir()
    except OSError as error:
        raise SessionError(f"{out}: cannot be made ({error})") from error
    try:
        yield part
        _sync(part)
        part.rename(out)
        sync_folder(out.parent)
    except OSError as error:
        raise SessionError(f"{out}: cannot be written ({error})") from error
    finally:
        shutil.rmtree(part, ignore_errors=True)  # there is none any more when all went well


def _sync(folder: Path) -> None:
    """Everything in `folder` on the disk, then the folder itself."""
    for path in folder.iterdir():
        if path.is_dir():
            _sync(path)
            continue
        with path.open("rb") as file:
            os.fsync(file.fileno())
    sync_folder(folder)
