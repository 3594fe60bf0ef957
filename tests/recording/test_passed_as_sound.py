"""Damage that a list, a verification or a fit might take for a sound session."""

import shutil
from dataclasses import replace

import pytest

from tests.recording.recorded import INFO
from tests.recording.runs import SECONDS, entries, record_run, second, write_journal
from tests.stand.hostile_sessions import everywhere, rewritten
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepMark
from thermostand.foundation.readings import Frame
from thermostand.recording.format.journal_lines import text_hash
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.format.manifest import SessionInfo
from thermostand.recording.reading.run_word import Files
from thermostand.recording.reading.scan import scan, verify
from thermostand.recording.reading.session import Session, open_whole
from thermostand.recording.repair.salvage import salvage_session


@pytest.fixture
async def session(tmp_path):
    return await record_run(tmp_path / "night-1")


def words(directory):
    """What list and verify say of its files."""
    found = verify(directory).files
    assert scan(directory).files is found
    return found


def air(directory):
    return Session.open(directory).readings("thermometers.air")[0].shape


COPIES = ["00003.mcap", "0003 (1).mcap", "._0003.mcap", "0003.2.mcap", "3.mcap", "0003 (1).mcap.part", "0003.mcap.mcap"]


@pytest.mark.parametrize("series", [TELEMETRY, FRAMES])
@pytest.mark.parametrize("name", COPIES)
def test_a_copy_under_another_name_counts_for_nothing_and_is_named(session, series, name):
    readings, frames = air(session), Session.open(session).frame_count
    shutil.copy(session / series / "0003.mcap", session / series / name)
    assert words(session) is Files.SOUND
    assert any(str(each).startswith(f"note: {series}/{name}: is no segment") for each in verify(session).findings)
    assert (air(session), open_whole(session).frame_count) == (readings, frames)
    assert salvage_session(session) == []
    assert (session / series / name).exists()


@pytest.mark.parametrize("name", COPIES[:3])
def test_a_segment_that_has_only_another_name_is_missing(session, name):
    (session / TELEMETRY / "0003.mcap").rename(session / TELEMETRY / name)
    assert words(session) is Files.INCOMPLETE


def test_a_text_that_was_edited_in_one_segment_is_damage(session):
    rewritten(session / FRAMES / "0001.mcap", attachments={"config.yaml": b"camera: {gain_dB: 9.0}\n"})
    assert words(session) is Files.DAMAGED
    with pytest.raises(SessionError, match=r"frames/0001\.mcap: has other texts attached than"):
        list(Session.open(session).frames())


@pytest.mark.parametrize("text", [b"camera: {gain_dB: 9.0}\n", None])
def test_a_text_that_was_edited_or_removed_everywhere_is_not_what_the_run_began_with(session, text):
    texts = {name: text_hash(known) for name, known in Session.open(session).attachments.items()}
    begun, *rest = entries()
    write_journal(session, {**begun, "texts": texts}, *rest)
    assert words(session) is Files.SOUND
    if text is None:
        begun = {**begun, "texts": {**texts, "recipe.yaml": text_hash("a recipe that was attached")}}
        write_journal(session, begun, *rest)
    else:
        everywhere(session, attachments={"config.yaml": text})
    assert words(session) is Files.DAMAGED
    with pytest.raises(SessionError, match="is not attached as the run began with it"):
        open_whole(session)


def without_step(time_ns, index):
    """A capture of the plan that was never begun, and nobody left it out."""
    for item in second(time_ns, index):
        if not (index == 7 and isinstance(item, StepMark | Frame)):
            yield item


async def test_complete_without_a_planned_capture_is_incomplete(tmp_path):
    directory = await record_run(tmp_path / "s", items=without_step)
    write_journal(directory, *(entry for entry in entries() if entry.get("step_id") != "capture-7"))
    assert words(directory) is Files.INCOMPLETE
    assert any("1 frame of the plan: missing" in str(finding) for finding in verify(directory).findings)
    with pytest.raises(SessionError, match=f"{SECONDS - 1} of the {SECONDS} frames of the plan are there"):
        open_whole(directory)


def test_segments_of_another_session_of_the_same_second_and_recipe_are_not_its_own(session):
    everywhere(session, uid="00ff")
    assert words(session) is Files.SOUND
    rewritten(session / FRAMES / "0001.mcap", uid="11ee")
    assert words(session) is Files.DAMAGED


def test_what_a_session_is_alone_goes_with_its_copies():
    info = replace(INFO, uid="00ff")
    assert SessionInfo.of(info.metadata()) == info
    assert "uid" not in INFO.metadata()
