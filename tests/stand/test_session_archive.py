"""`stand session archive`: copies, says what must wait, shows the rule, and deletes only with --yes."""

import asyncio
import json
import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.recording.runs import publish_killed, record_run
from thermostand.stand.commands.sessions.session_commands import app


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cycles")
    asyncio.run(record_run(folder / "a"))
    asyncio.run(record_run(folder / "killed", publish_killed, ""))
    return folder


@pytest.fixture
def sessions(recorded: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(recorded, tmp_path / "sessions"))


def ask(*arguments: object, status: int = 0):
    result = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert result.exit_code == status, result.output
    return result


def test_finished_sessions_are_copied_and_the_others_are_reported(sessions: Path, tmp_path: Path):
    nas = tmp_path / "nas"
    result = ask("archive", sessions, "--to", nas)
    assert result.stdout.startswith(f"a: copied to {nas}/a and read back (")
    assert "killed: not yet" in result.stderr
    assert ask("archive", sessions, "--to", nas).stdout == f"nothing to copy: 1 of 2 have a copy in {nas}\n"
    assert ask("list", sessions).stdout.splitlines()[0].split()[-1] == "archived"
    assert [line.split()[0] for line in ask("list", sessions, "--not-archived").stdout.splitlines()[1:]] == ["killed"]
    assert f"archived      {nas}/a" in ask("info", sessions / "a").stdout


def test_what_would_be_deleted_is_shown_and_deleted_with_yes(sessions: Path, tmp_path: Path):
    nas = tmp_path / "nas"
    shown = ask("archive", sessions, "--to", nas, "--delete-after", 0).stdout.splitlines()
    assert shown[1].startswith("deleted are sound sessions")
    assert shown[2].startswith(f"  {sessions}/a (")
    assert shown[3].endswith("--yes deletes them")
    assert (sessions / "a").is_dir()
    assert "none" in ask("archive", sessions, "--to", nas, "--delete-after", 1e6, "--yes").stdout
    ask("archive", sessions, "--to", nas, "--delete-after", 0, "--yes")
    assert sorted(path.name for path in sessions.iterdir() if not path.name.startswith(".")) == ["killed"]
    assert (nas / "a" / "telemetry").is_dir()


def test_a_place_is_needed_and_not_among_the_sessions(sessions: Path):
    assert "give --to DIR, or recording.archive_directory" in ask("archive", sessions, status=2).stderr
    assert "on another disk" in ask("archive", sessions, "--to", sessions / "x", status=2).stderr


def test_copies_elsewhere_do_not_count_and_a_missing_one_is_reported(sessions: Path, tmp_path: Path):
    nas, other = tmp_path / "nas", tmp_path / "other"
    ask("archive", sessions, "--to", nas)
    found = json.loads(ask("archive", sessions, "--to", other, "--json").stdout)
    (name,) = found["copied"]
    assert (other / name).is_dir()
    shutil.rmtree(other / name)
    answer = ask("archive", sessions, "--to", other, status=1)
    assert f"{(other / name).resolve()}: the copy is gone" in answer.stderr
    assert not (other / name).exists()  # the disk that its place is on is not filled
    ask("archive", sessions, "--to", other, "--again")
    assert (other / name).is_dir()
