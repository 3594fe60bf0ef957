"""Sessions of the first format, recorded by its own recorder and kept as they were: every later version opens them. One
is a run of the simulated stand, the other has rendered photographs of a target that moves with the temperature."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from compensation import evaluate, fit, observe
from compensation.cli import app as compensate
from recording.exporting.replay import replay_and_record
from recording.exporting.trim import trim
from recording.reading.glance import glance
from recording.reading.run_word import Files, Run
from recording.reading.session import Session
from recording.reading.using import open_whole
from recording.repair.verify import verify
from stand.commands.command_table import app as stand

SESSION = Path(__file__).parent / "data" / "20260101T180000Z-format-1"
CYCLE = SESSION.with_name("20260101T180000Z-format-1-cycle")


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


def asked(app, *words) -> Result:
    return CliRunner().invoke(app, [str(word) for word in words])


def test_every_command_that_looks_at_a_session_works_on_it(tmp_path):
    info = asked(stand, "session", "info", SESSION)
    assert info.exit_code == 0, info.output
    assert "3" in next(line for line in info.output.splitlines() if line.startswith("frames"))
    listed = asked(stand, "session", "list", SESSION.parent)
    assert listed.exit_code == 0
    assert "complete" in listed.output
    verified = asked(stand, "session", "verify", SESSION)
    assert verified.exit_code == 0, verified.output
    assert "sound" in verified.output
    exported = asked(stand, "session", "export", SESSION, "--out", tmp_path / "tables")
    assert exported.exit_code == 0, exported.output
    assert len(list((tmp_path / "tables").rglob("*.png"))) == 3


def test_its_frames_are_a_table_and_are_looked_at_for_markers(tmp_path):
    table = Session.open(SESSION).frames_table()
    assert len(table) == 3
    assert np.isfinite(table.camera_degC).all()
    assert np.isfinite(table.air_degC).all()
    assert all(table.role)
    assert set(table.positions) == {"linear", "rotary"}
    for command in ("detect", "fit", "report"):  # its frames show too little of the target
        found = asked(compensate, command, SESSION, "-o", tmp_path / command)
        assert found.exit_code == 1
        assert "of 54 markers" in found.output.splitlines()[-1]


def test_a_thermal_cycle_of_the_first_format_is_fitted():
    """Its target moves by 0.01 px/K along I and 0.03 px/K along J; held out are 20 and 45 degC, from 24."""
    observations = observe([CYCLE])
    assert observations.usable.all()
    found = evaluate(fit(observations), observations)
    assert found.rms_before_px == pytest.approx((0.148, 0.443), abs=0.005)
    assert max(found.rms_after_px) < 0.005
