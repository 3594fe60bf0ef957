"""Ten cameras on a Dask cluster of two local workers, one of which is killed."""

from __future__ import annotations

import shutil
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.finding.piece import FoundMarkers, concatenate_markers, find_markers, split_into_pieces
from thermostand.compensation.observations import read_session_target
from thermostand.recording.reading.session import Session

from .cluster_week import CAMERAS, run_week
from .conftest import Recorded

PER_PIECE = 5


@pytest.mark.nightly
def test_ten_cameras_give_the_same_bits_in_flat_memory_and_a_killed_worker_costs_its_piece(
    recorded: Recorded, tmp_path: Path
):
    pytest.importorskip("distributed")
    session = Session.open(recorded.path)
    expected = concatenate_markers(
        [find_markers(piece) for piece in split_into_pieces(session, read_session_target(session), None, PER_PIECE)]
    )
    cameras = [shutil.copytree(recorded.path, tmp_path / f"camera-{number}") for number in range(CAMERAS)]
    made = run_week(map(Session.open, cameras), PER_PIECE)
    assert len(made.found) == CAMERAS
    for found in made.found:
        for field in fields(FoundMarkers):
            np.testing.assert_array_equal(getattr(found, field.name), getattr(expected, field.name), field.name)
    assert 0 <= made.twice <= 2
    assert made.memory_MB[-1] < 1.1 * made.memory_MB[0]
