"""What is missing of a session: each command says so, in the same words; those that use all of it want --incomplete."""

import asyncio
import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.recording.runs import SECONDS, ended, entries, publish_half_done, record_run, remove, write_journal
from thermostand.recording.reading.session import Session
from thermostand.stand.commands.sessions.session_commands import app

runner = CliRunner()
USES = [("export", "--out"), ("trim", "--out"), ("replay", "--record")]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A complete run; not to be changed."""
    directory = tmp_path_factory.mktemp("sessions") / "cycle-1"
    asyncio.run(record_run(directory))
    return directory


@pytest.fixture
def session(whole: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(whole, tmp_path / "sessions" / whole.name))


def ask(*arguments: object, status: int = 0):
    result = runner.invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result


def words_everywhere(session: Path, status: int) -> tuple[str, str]:
    """Run and files by verify; list and info say the same, as lines and as JSON."""
    found = json.loads(ask("verify", session, "--json", status=status).stdout)
    words = found["run"], found["files"]
    last = ask("verify", session, status=status).stdout.splitlines()[-1]
    assert last.startswith(f"files {words[1]}")
    assert f"; run {words[0]}; " in last
    (listed,) = json.loads(ask("list", session, "--json").stdout)
    known = json.loads(ask("info", session, "--json").stdout)
    assert (listed["run"], listed["files"]) == (known["run"], known["files"]) == words
    assert f" {words[0]} {words[1]}" in " ".join(ask("list", session).stdout.splitlines()[1].split())
    answer = " ".join(ask("info", session).stdout.split())
    assert f"run {words[0]} files {words[1]} " in answer
    return words


def test_a_complete_run_is_sound_everywhere(session: Path):
    assert words_everywhere(session, 0) == ("complete", "sound")
    assert "steps 20 of 20 done: 20 capture" in " ".join(ask("info", session).stdout.split())


@pytest.mark.parametrize("status", ["stopped", "tripped", "failed"])
def test_a_run_that_did_not_come_to_its_end_has_its_word_and_sound_files(tmp_path: Path, status: str):
    asyncio.run(record_run(tmp_path / "s", items=ended("error", "aborted: why", status=status), status=status))
    assert words_everywhere(tmp_path / "s", 0) == (status, "sound")


def test_steps_are_counted_when_they_are_done_and_against_the_plan(tmp_path: Path):
    asyncio.run(record_run(tmp_path / "s", items=publish_half_done, status=""))
    write_journal(tmp_path / "s", *entries(SECONDS // 2, "stopped"))
    answer = " ".join(ask("info", tmp_path / "s").stdout.split())
    assert "steps 10 of 20 done: 10 capture" in answer
    assert "not done 10 capture frames=1 interval_s=0.5" in answer


def test_segments_deleted_from_the_end_make_a_complete_run_incomplete(session: Path):
    remove(session, "telemetry", 4, 5)
    remove(session, "frames", 3, 4)
    assert words_everywhere(session, 1) == ("complete", "incomplete")
    answer = " ".join(ask("info", session).stdout.split())
    assert "missing telemetry/0004.mcap: is missing" in answer


@pytest.fixture
def holed(session: Path) -> Path:
    """Two segments of the telemetry and one of the frames are missing in the middle."""
    remove(session, "telemetry", 1, 2)
    remove(session, "frames", 3)
    return session


def test_what_only_looks_needs_no_flag(holed: Path):
    assert words_everywhere(holed, 1) == ("complete", "incomplete")
    assert ask("repair", holed).stdout == "nothing to repair\n"


@pytest.mark.parametrize(("command", "option"), USES)
def test_what_uses_all_of_it_refuses_it_with_a_sentence(holed: Path, tmp_path: Path, command: str, option: str):
    (line,) = ask(command, holed, option, tmp_path / "new", status=1).stderr.splitlines()
    assert line.startswith(f"error: {holed}: ")
    for missing in (
        "telemetry/0001.mcap to 0002.mcap (from 2026-01-01 18:00:02 to 2026-01-01 18:00:11 UTC)",
        "frames/0003.mcap (from 2026-01-01 18:00:11 to 2026-01-01 18:00:16 UTC, 4 frames",
        "16 of the 20 frames",
        "--incomplete",
    ):
        assert missing in line
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("command", "option"), USES)
def test_with_the_flag_it_says_what_is_missing_and_uses_the_rest(
    holed: Path, tmp_path: Path, command: str, option: str
):
    speed = ("--speed", "max") if command == "replay" else ()
    result = ask(command, holed, option, tmp_path / "new", "--incomplete", *speed)
    line, *_ = result.stderr.splitlines()  # of a replay its progress follows
    assert line.startswith(f"warning: {holed}: is incomplete; missing: telemetry/0001.mcap to 0002.mcap (from ")
    if command == "export":
        assert len(list((tmp_path / "new" / "frames").glob("*.png"))) == SECONDS - 4
        return
    assert words_everywhere(tmp_path / "new", 1) == ("complete", "incomplete")
    copy, original = Session.open(tmp_path / "new"), Session.open(holed)
    assert [image.time_ns for image in copy.images()] == [image.time_ns for image in original.images()]
    assert repr(copy.frame_metas()) == repr(original.frame_metas())  # none is invented, none is dropped


def test_a_replay_without_a_copy_wants_the_flag_as_well(holed: Path):
    assert "is incomplete; missing: telemetry/0001.mcap" in ask("replay", holed, "--speed", "max", status=1).stderr
    ask("replay", holed, "--speed", "max", "--incomplete")


@pytest.mark.parametrize("series", ["telemetry", "frames"])
@pytest.mark.parametrize(("command", "option"), USES)
def test_doubled_segments_are_no_frames_of_this_session(
    session: Path, tmp_path: Path, command: str, option: str, series: str
):
    shutil.copy(session / series / "0001.mcap", session / series / "0009.mcap")
    for flag in ((), ("--incomplete",)):
        (line,) = ask(command, session, option, tmp_path / "new", *flag, status=1).stderr.splitlines()
        assert f"{series}/0009.mcap: was recorded as {series}/0001.mcap" in line
    assert words_everywhere(session, 1) == ("complete", "damaged")


@pytest.mark.parametrize(("command", "option"), USES)
def test_frames_of_another_camera_are_refused(session: Path, tmp_path: Path, command: str, option: str):
    asyncio.run(record_run(tmp_path / "other"))
    foreign = (tmp_path / "other" / "frames" / "0001.mcap").read_bytes().replace(b"DA1234567", b"DA7654321")
    (session / "frames" / "0001.mcap").write_bytes(foreign)
    (line,) = ask(command, session, option, tmp_path / "new", "--incomplete", status=1).stderr.splitlines()
    assert f"{session}/frames/0001.mcap: " in line
    assert not (tmp_path / "new").exists()
    assert words_everywhere(session, 1) == ("complete", "damaged")


def flip(path: Path, place: int) -> None:
    data = bytearray(path.read_bytes())
    data[place] ^= 1
    path.write_bytes(data)


def test_a_flipped_bit_of_the_journal_is_named_and_a_missing_journal_too(session: Path):
    journal = session / "journal.jsonl"
    flip(journal, len(journal.read_bytes()) // 2)
    before = journal.read_bytes()
    assert words_everywhere(session, 1) == ("complete", "damaged")
    lines = ask("verify", session, status=1).stdout.splitlines()
    assert "line 22 of 42" in lines[0]
    assert journal.read_bytes() == before
    journal.unlink()
    assert words_everywhere(session, 1) == ("complete", "incomplete")
    assert ask("verify", session, status=1).stdout.startswith("error: journal.jsonl: is missing; ")


def test_what_is_lost_in_a_damaged_segment_is_not_looked_for_behind_the_last_one(session: Path):
    for name in ("0001.mcap", "0005.mcap"):
        path = session / "telemetry" / name
        whole = path.read_bytes()
        flip(path, len(whole) // 2)
        found = json.loads(ask("verify", session, "--json", status=1).stdout)["findings"]
        assert {each["where"] for each in found if each["severity"] == "error"} == {f"telemetry/{name}"}
        path.write_bytes(whole)


def test_damaged_notes_are_named_by_all(session: Path):
    ask("note", session, "a cloudy day")
    ask("tag", session, "keep")
    flip(session / "notes.jsonl", 40)
    assert words_everywhere(session, 1) == ("complete", "damaged")
    (line, *_) = ask("verify", session, status=1).stdout.splitlines()
    assert "line 1 of 2" in line
