"""What the commands on sessions refuse, and how they say it."""

import fcntl
import io
import os
from pathlib import Path

import pytest
from mcap.reader import make_reader

from tests.stand.session_commands import ask, read_refusal


@pytest.mark.parametrize("command", ["info", "verify", "replay", "repair"])
def test_what_is_no_session_is_refused(tmp_path: Path, command: str):
    (line,) = ask(command, tmp_path / "nowhere", status=2).stderr.splitlines()
    assert line.startswith(f"error: {tmp_path / 'nowhere'}: ")


USES = [("export", "--out"), ("trim", "--out"), ("replay", "--record")]


@pytest.mark.parametrize(("command", "option"), USES)
def test_what_was_not_finished_is_not_left_out_in_silence(session: Path, tmp_path: Path, command: str, option: str):
    path = session / "frames" / "0001.mcap"
    path.rename(path.with_name("0001.mcap.part"))
    (line,) = ask(command, session, option, tmp_path / "new", status=1).stderr.splitlines()
    assert line.startswith(f"error: {session}: frames/0001.mcap.part ")
    assert f"`stand session repair {session}`" in line
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("command", "option"), USES)
def test_of_a_session_being_recorded_what_is_finished_is_used(session: Path, tmp_path: Path, command: str, option: str):
    path = session / "frames" / "0002.mcap"
    part = path.rename(path.with_name("0002.mcap.part"))
    speed = ("--speed", "max") if command == "replay" else ()
    with part.open("rb") as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        result = ask(command, session, option, tmp_path / "new", *speed)
    warning = (
        f"warning: {session}: is being recorded; left out because they are not finished yet: frames/0002.mcap.part"
    )
    assert warning in result.stderr.splitlines()
    assert (tmp_path / "new").is_dir()


@pytest.mark.parametrize(("command", "option"), USES)
@pytest.mark.parametrize("series", ["frames", "telemetry"])
def test_a_command_that_meets_damage_says_that_a_salvage_helps(
    session: Path, tmp_path: Path, series: str, command: str, option: str
):
    path = session / series / "0000.mcap"
    data = bytearray(path.read_bytes())
    summary = make_reader(io.BytesIO(data)).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[len(summary.chunk_indexes) // 2]
    data[chunk.chunk_start_offset + chunk.chunk_length // 2] ^= 1
    path.write_bytes(data)
    speed = ("--speed", "max") if command == "replay" else ()
    line = ask(command, session, option, tmp_path / "new", *speed, status=1).stderr.splitlines()[-1]
    assert line.startswith(f"error: {path}: ")
    assert line.endswith(f"; `stand session repair {session}` recovers what is sound")
    assert not (tmp_path / "new").exists()


@pytest.mark.parametrize(("command", "option"), USES)
def test_nothing_is_made_inside_a_session(session: Path, command: str, option: str):
    out = session / "frames" / ".." / "part"
    assert read_refusal(command, session, option, out).endswith("outside of it")
    assert not out.exists()


@pytest.mark.parametrize("arguments", [("export", "--out"), ("trim", "--out"), ("replay", "--record")])
def test_what_exists_is_not_overwritten(session: Path, tmp_path: Path, arguments: tuple[str, str]):
    command, option = arguments
    (tmp_path / "taken").mkdir()
    assert "taken: exists already" in read_refusal(command, session, option, tmp_path / "taken")


def test_text_in_a_recording_cannot_write_to_the_terminal(session: Path):
    trick = session.rename(session.parent / "a\x1b[2Jb")
    for command in (("list", session.parent), ("info", trick)):
        output = ask(*command).output
        assert "\x1b" not in output
        assert "a\\x1b[2Jb" in output


@pytest.mark.skipif(os.geteuid() == 0, reason="root may read everything")
def test_a_file_that_may_not_be_read_is_reported(session: Path):
    (session / "frames" / "0000.mcap").chmod(0)
    assert "Permission" in ask("info", session).stdout
