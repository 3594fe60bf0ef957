"""A week of ten cameras, made small: their sessions one after the other on a Dask cluster of two local workers, one of
which is killed in the middle.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import psutil

from thermostand.compensation.finding.piece import FoundMarkers, Piece, concatenate_markers, split_into_pieces
from thermostand.compensation.finding.workers import make_cluster_work
from thermostand.compensation.observations import read_session_target
from thermostand.recording.reading.session import Session

CAMERAS = 10
KILLED_IN = CAMERAS // 2


class Counted(Piece):
    """Leaves a file in the folder `received` of its session each time a process receives it: a worker, and before it
    the scheduler, which is in this process."""

    def __reduce__(self) -> tuple[object, ...]:
        return receive_piece, tuple(getattr(self, field.name) for field in fields(Piece))


def receive_piece(*values: Any) -> Piece:
    piece = Counted(*values)
    _get_received_folder(piece).mkdir(exist_ok=True)
    (_get_received_folder(piece) / f"{os.getpid()}-{time.monotonic_ns()}").touch()
    return piece


def _get_received_folder(piece: Piece) -> Path:
    return piece.segment.parent.parent / "received"


def _by_workers(piece: Piece) -> int:
    return sum(not path.name.startswith(f"{os.getpid()}-") for path in _get_received_folder(piece).iterdir())


@dataclass(frozen=True, slots=True, eq=False)
class Week:
    """found: of each camera. memory_MB: of the larger worker after each camera. used_s: of both workers' processors,
    without the camera in which one was killed. twice: how many pieces had to be done again for it."""

    found: list[FoundMarkers]
    memory_MB: list[float]
    used_s: float
    twice: int


def run_week(sessions: Iterable[Session], per_piece: int) -> Week:
    """Find the markers of the cameras' sessions, one after the other; a worker is killed in that of `KILLED_IN`."""
    from distributed import LocalCluster

    found: list[FoundMarkers] = []
    memory_MB, used_s, twice = [], 0.0, 0
    cluster: Any = LocalCluster
    with cluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0", host="127.0.0.1") as here:
        for camera, session in enumerate(sessions):
            workers = [psutil.Process(nanny.pid) for nanny in here.workers.values()]
            begin_s = _measure_used_s(workers)
            plain = split_into_pieces(session, read_session_target(session), frames_per_piece=per_piece)
            pieces = [Counted(*_values(piece)) for piece in plain]
            parts: list[FoundMarkers] = []
            for _, part in make_cluster_work(here.scheduler_address)(pieces):
                parts.append(part)
                if camera == KILLED_IN and len(parts) == 1:
                    workers[0].kill()
            found.append(concatenate_markers(parts))
            if camera == KILLED_IN:
                twice = _by_workers(pieces[0]) - len(pieces)
                continue
            memory_MB.append(max(worker.memory_info().rss for worker in workers) / 1e6)
            used_s += _measure_used_s(workers) - begin_s
    return Week(found, memory_MB, used_s, twice)


def _values(piece: Piece) -> list[Any]:
    return [getattr(piece, field.name) for field in fields(Piece)]


def _measure_used_s(workers: list[psutil.Process]) -> float:
    return sum(sum(worker.cpu_times()[:2]) for worker in workers)
