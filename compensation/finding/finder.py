"""The markers of whole sessions: what is kept is taken, the rest is worked on and kept as it comes."""

from __future__ import annotations

import hashlib
import os
import tempfile
import zipfile
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from functools import cache
from pathlib import Path

import cv2
import numpy as np

import thermostand.markers.target
from thermostand import markers
from thermostand.compensation.finding.piece import FoundMarkers, Piece, list_frames_in_order
from thermostand.compensation.finding.workers import Work, find_in_turn, make_cluster_work, make_process_work
from thermostand.foundation.errors import ConfigError
from thermostand.recording.format.records import FramePlace, read_frame_crcs

# Markers found once are kept, by the content they were found in: a copied or renamed session finds them, too.
#
# The key is made of the frames' instants, lengths and CRCs, as the heads of their chunks say them, the target, the
# noise, and the program text that finds markers: a changed program searches again. The frames themselves were compared
# with their CRCs when their markers were found, and are not read again. Files are in
# $XDG_CACHE_HOME/thermostand/markers, or ~/.cache; delete them at will.


def get_cache_folder() -> Path:
    """Return where found markers are kept."""
    home = os.environ.get("XDG_CACHE_HOME") or str(Path.home() / ".cache")
    return Path(home) / "thermostand" / "markers"


def compute_key(piece: Piece, places: Sequence[FramePlace]) -> str:
    """The name under which the piece's markers are kept; `places` are the frames of its segment. SessionError when it
    cannot be read."""
    own = piece.select_places(places)
    crcs = read_frame_crcs(piece.segment, own)
    frames = [(place.time_ns, place.chunk.length, crc) for place, crc in zip(own, crcs, strict=True)]
    parts = (frames, piece.target.model_dump_json(), piece.noise, _hash_program())
    return hashlib.sha256(repr(parts).encode()).hexdigest()


def load_markers(folder: Path, key: str) -> FoundMarkers | None:
    """Return what is kept under `key`; None when there is nothing, or nothing that can be read."""
    try:
        with (folder / f"{key}.npz").open("rb") as file, np.load(file, allow_pickle=False) as arrays:
            return FoundMarkers(**{field.name: arrays[field.name] for field in fields(FoundMarkers)})
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def save_markers(folder: Path, key: str, found: FoundMarkers) -> None:
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
def _hash_program() -> str:
    """A hash of what finds markers: our own text and the version of OpenCV."""
    digest = hashlib.sha256(f"{cv2.__version__} {np.__version__}".encode())
    (folder,) = markers.__path__
    for path in (*sorted(Path(folder).glob("*.py")), Path(str(thermostand.markers.target.__file__))):
        digest.update(path.read_bytes())
    return digest.hexdigest()


@dataclass(frozen=True, slots=True)
class Finder:
    """How markers are found. folder: of what is kept, None to keep nothing."""

    work: Work = find_in_turn
    folder: Path | None = None

    def __call__(self, pieces: Sequence[Piece], report: Callable[[int], None]) -> list[FoundMarkers]:
        """The markers of each piece; `report` gets the number of frames done."""
        places_in = cache(list_frames_in_order)
        keys = ["" if self.folder is None else compute_key(piece, places_in(piece.segment)) for piece in pieces]
        results = [None if self.folder is None else load_markers(self.folder, key) for key in keys]
        missing = [index for index, result in enumerate(results) if result is None]
        done = sum(piece.frames for piece, result in zip(pieces, results, strict=True) if result is not None)
        report(done)
        for number, found in self.work([pieces[index] for index in missing]):
            index = missing[number]
            results[index] = found
            if self.folder is not None:
                save_markers(self.folder, keys[index], found)
            done += pieces[index].frames
            report(done)
        return [result for result in results if result is not None]


def finder(workers: int = 1, cluster: str | None = None, *, use_cache: bool = True) -> Finder:
    """Make the finder that the options of the command line describe.

    Parameters
    ----------
    workers : int
        Processes that search for markers in parallel.
    cluster : str, optional
        Address (host:port) of a Dask scheduler whose workers see the same files.
    use_cache : bool
        Keep the markers found, and reuse those kept.

    Returns
    -------
    Finder
        What `observe` takes to find markers.

    Raises
    ------
    ConfigError
        When both ways of sharing the work are asked for, or workers is less than 1.
    """
    if workers < 1:
        raise ConfigError(f"--workers is 1 or more, not {workers}")
    if cluster is not None and workers > 1:
        raise ConfigError("--workers and --cluster exclude each other")
    work = (
        make_cluster_work(cluster)
        if cluster is not None
        else make_process_work(workers)
        if workers > 1
        else find_in_turn
    )
    return Finder(work, get_cache_folder() if use_cache else None)
