"""Ten cameras on a Dask cluster of two local workers: what a frame takes, and the memory of a worker. The frames are
those of tests/bench/pipeline.py.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path

from tests.bench.figures import Figure, make_absolute, make_skipped, report_progress, set_upper_goal
from tests.bench.pipeline import SEQUENCE, render_photograph, write_session
from tests.compensation.cluster_week import CAMERAS, run_week
from thermostand.recording.reading.session import Session

FRAMES, PER_PIECE = 48, 16
WEEK = 4_000_000
"""Frames of ten cameras in a week."""


def figures(directory: Path) -> Iterator[Figure]:
    """Processor time of a frame, memory after the first and after the last camera, and what the killed worker cost."""
    try:
        made = run_week(_iterate_sessions(directory), PER_PIECE)
    except ImportError as error:
        yield make_skipped("cluster", error)
        return
    frame_ms = 1e3 * made.used_s / (FRAMES * (CAMERAS - 1))
    yield make_absolute("10 cameras on Dask, a frame of 5 MP, both workers", "CPU ms", [frame_ms])
    yield make_absolute("  of 4 million frames, a week", "core-hours", [frame_ms * WEEK / 3.6e6])
    yield make_absolute("  memory of a worker after the first camera", "MB", [made.memory_MB[0]])
    yield set_upper_goal(
        1.1, make_absolute("  after the last one, over it", "", [made.memory_MB[-1] / made.memory_MB[0]])
    )
    yield set_upper_goal(2, make_absolute("  pieces done again for a killed worker", "", [float(made.twice)]))


def _iterate_sessions(directory: Path) -> Iterator[Session]:
    """Each is there while it is worked on."""
    photographs = [render_photograph(index) for index in range(len(SEQUENCE))]
    for camera in range(CAMERAS):
        report_progress(f"cluster, camera {camera + 1} of {CAMERAS}")
        folder = directory / f"cluster-{camera}"
        write_session(folder, photographs, FRAMES)
        yield Session.open(folder)
        shutil.rmtree(folder)
