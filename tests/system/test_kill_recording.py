"""kill -9 at random moments of a recording: what was acknowledged is there, once, and can be read."""

import random
from pathlib import Path

import pytest

from tests.recording.damage import names, read_segment
from tests.system.recording_process import MESSAGES_PER_ROUND, frame_records, images_in, nursery, telemetry_records
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import MANIFEST_NAME
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session, salvage_unfinished

LONGEST_S = 0.5


def read_series(directory, series):
    """Every message of a series in the order of the files."""
    return [record for path in sorted((directory / series).glob("*.mcap")) for record in read_segment(path)]


@pytest.fixture(scope="module")
def start():
    with nursery() as start:
        yield start


@pytest.mark.parametrize("kills", [12, pytest.param(50, marks=pytest.mark.nightly)])
def test_nothing_acknowledged_is_missing_after_kill_9(tmp_path, start, kills):
    rng = random.Random(9)
    left = set()
    for kill in range(kills):
        directory = tmp_path / f"{kill:02d}" / "session"
        recording = start(directory)
        recording.wait(rng.uniform(0, LONGEST_S))
        last = recording.kill()
        left |= {Path(name).suffix for name in names(directory)}
        salvage_unfinished(directory.parent)

        frames, telemetry = images_in(read_series(directory, FRAMES)), read_series(directory, TELEMETRY)
        assert frames == frame_records(len(frames))
        assert telemetry == telemetry_records(last.rounds + 1)[: len(telemetry)]
        assert len(frames) >= max(last.frames, last.rounds - 1)
        assert len(telemetry) >= max(last.messages, (last.rounds - 1) * MESSAGES_PER_ROUND)
        session = Session.open(directory)
        assert session.frame_count == len(frames)
        assert (session.incomplete, session.damaged) == ((), ())
        assert all(name.endswith((".mcap", MANIFEST_NAME)) for name in names(directory))
        assert salvage_session(directory) == []
    assert left >= {".mcap", ".part"}
