"""Markers found once are kept, by the content they were found in: a copied or renamed session finds them, too.

The key is made of the frames' instants, lengths and CRCs, as the heads of their chunks say them, the target, the noise,
and the program text that finds markers: a changed program searches again. The frames themselves were compared with
their CRCs when their markers were found, and are not read again. Files are in $XDG_CACHE_HOME/thermostand/markers, or
~/.cache; delete them at will.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import fields
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import thermostand.markers.target
from thermostand import markers
from thermostand.compensation.finding.piece import FoundMarkers, Piece
from thermostand.recording.format.records import FramePlace, frame_crcs


def cache_folder() -> Path:
    """Where found markers are kept."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "thermostand" / "markers"


def key_of(piece: Piece, places: Sequence[FramePlace]) -> str:
    """The name under which the piece's markers are kept; `places` are the frames of its segment. SessionError when it
    cannot be read."""
    own = piece.places_of(places)
    crcs = frame_crcs(piece.segment, own)
    frames = [(place.time_ns, place.chunk.length, crc) for place, crc in zip(own, crcs, strict=True)]
    parts = (frames, piece.target.model_dump_json(), piece.noise, _program())
    return hashlib.sha256(repr(parts).encode()).hexdigest()


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
    for path in (*sorted(Path(folder).glob("*.py")), Path(str(thermostand.markers.target.__file__))):
        digest.update(path.read_bytes())
    return digest.hexdigest()
