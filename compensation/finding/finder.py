"""The markers of whole sessions: what is kept is taken, the rest is worked on and kept as it comes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from thermostand.compensation.finding.cache import cache_folder, keep, kept, key_of
from thermostand.compensation.finding.piece import FoundMarkers, Piece, frames_in_order
from thermostand.compensation.finding.workers import Work, in_processes, in_turn, on_cluster
from thermostand.foundation.errors import ConfigError


@dataclass(frozen=True, slots=True)
class Finder:
    """How markers are found. folder: of what is kept, None to keep nothing."""

    work: Work = in_turn
    folder: Path | None = None

    def __call__(self, pieces: Sequence[Piece], report: Callable[[int], None]) -> list[FoundMarkers]:
        """The markers of each piece; `report` gets the number of frames done."""
        places_in = cache(frames_in_order)
        keys = ["" if self.folder is None else key_of(piece, places_in(piece.segment)) for piece in pieces]
        results = [None if self.folder is None else kept(self.folder, key) for key in keys]
        missing = [index for index, result in enumerate(results) if result is None]
        done = sum(piece.frames for piece, result in zip(pieces, results, strict=True) if result is not None)
        report(done)
        for number, found in self.work([pieces[index] for index in missing]):
            index = missing[number]
            results[index] = found
            if self.folder is not None:
                keep(self.folder, keys[index], found)
            done += pieces[index].frames
            report(done)
        return [result for result in results if result is not None]


def finder(workers: int = 1, cluster: str | None = None, *, use_cache: bool = True) -> Finder:
    """As the command line has it; ConfigError when both ways of sharing the work are asked for."""
    if workers < 1:
        raise ConfigError(f"--workers is 1 or more, not {workers}")
    if cluster is not None and workers > 1:
        raise ConfigError("--workers and --cluster exclude each other")
    work = on_cluster(cluster) if cluster is not None else in_processes(workers) if workers > 1 else in_turn
    return Finder(work, cache_folder() if use_cache else None)
