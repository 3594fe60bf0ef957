"""A session of the first format, recorded on 2026-11-22 and kept as it was: every later version opens it."""

import shutil
from pathlib import Path

import numpy as np

from recording.exporting.replay import replay_and_record
from recording.exporting.trim import trim
from recording.reading.glance import glance
from recording.reading.run_word import Files, Run
from recording.reading.session import Session
from recording.reading.using import open_whole
from recording.repair.verify import verify

SESSION = Path(__file__).parent / "data" / "20260101T180000Z-format-1"


def test_a_session_of_the_first_format_opens_and_verifies():
    session = Session.open(SESSION)
    frames = list(session.frames())
    times_ns, air_degC = session.readings("thermometers.air")
    assert len(frames) == 3
    assert frames[0].image.shape == (600, 880)
    assert len(times_ns) > 40
    assert np.isfinite(air_degC).all()
    assert session.attachments.keys() == {"config.yaml", "recipe.yaml", "target.yaml"}
    assert [event.kind for event in session.events()][-1] == "run.end"
    assert all(event.data == {} for event in session.events())
    assert "format" not in session.metadata
    assert open_whole(SESSION).holes == ()
    found, seen = verify(SESSION), glance(SESSION)
    assert (found.run, found.files) == (seen.run, seen.state) == (Run.COMPLETE, Files.SOUND)


async def test_a_copy_of_it_is_the_same_session_and_a_part_tells_its_extent(tmp_path):
    session = Session.open(SESSION)
    copy = await replay_and_record(session, tmp_path / "copy", None)
    assert Session.open(copy).metadata == session.metadata
    part = trim(session, tmp_path / "part", int(session.frame_times_ns[0]), int(session.frame_times_ns[-1]))
    assert Session.open(part).metadata["format"] == "2"
    for directory in (copy, part):
        found = verify(directory)
        assert (found.run, found.files) == (Run.COMPLETE, Files.SOUND), found.findings


def test_its_run_has_a_word_without_its_journal_too(tmp_path):
    directory = shutil.copytree(SESSION, tmp_path / "s")
    (directory / "journal.jsonl").unlink()
    assert (verify(directory).run, verify(directory).files) == (Run.COMPLETE, Files.INCOMPLETE)
