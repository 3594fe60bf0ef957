"""Markers found once are kept, by the content they were found in: a copied or renamed session finds them, too.

The key is the SHA-256 of the segment's bytes, the range of time, the target, the noise, and the program text that
finds markers: a changed program searches again. Files are in $XDG_CACHE_HOME/thermostand/markers, or ~/.cache; delete
them at will.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from contextlib import suppress
from dataclasses import fields
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import markers
import markers.target
from compensation.finding.piece import FoundMarkers, Piece

_BLOCK_BYTES = 1 << 20


def cache_folder() -> Path:
    """Where found markers are kept."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "thermostand" / "markers"


def key_of(piece: Piece, content: str) -> str:
    """The name under which the piece's markers are kept; `content` is its segment's (content_of)."""
    parts = (content, piece.begin_ns, piece.end_ns, piece.target.model_dump_json(), piece.noise, _program())
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def content_of(segment: Path) -> str:
    """SHA-256 of the file; OSError."""
    digest = hashlib.sha256()
    with segment.open("rb") as file:
        while block := file.read(_BLOCK_BYTES):
            digest.update(block)
    return digest.hexdigest()


def kept(folder: Path, key: str) -> FoundMarkers | None:
    """What is kept under `key`; None when there is nothing, or nothing that can be read."""
    try:
        with (folder / f"{key}.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return FoundMarkers(**{field.name: arrays[field.name] for field in fields(FoundMarkers)})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def keep(folder: Path, key: str, found: FoundMarkers) -> None:
    """Keep it, whole or not at all; a place that refuses costs the time of finding it again and nothing else."""
    with suppress(OSError):
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.NamedTemporaryFile(dir=folder, suffix=".part", delete=False) as file:
            part = Path(file.name)
            try:
                np.savez(file, **{field.name: getattr(found, field.name) for field in fields(FoundMarkers)})
                file.close()
                part.replace(folder / f"{key}.npz")
            except BaseException:
                part.unlink(missing_ok=True)
                raise


@cache
def _program() -> str:
    """A hash of what finds markers: our own text and the version of OpenCV."""
    digest = hashlib.sha256(f"{cv2.__version__} {np.__version__}".encode())
    (folder,) = markers.__path__
    for path in (*sorted(Path(folder).glob("*.py")), Path(str(markers.target.__file__))):
        digest.update(path.read_bytes())
    return digest.hexdigest()
