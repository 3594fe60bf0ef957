"""A session of which segments are missing is fitted, reported and applied only when that is asked for."""

import shutil
from pathlib import Path

import pytest
from typer.testing import CliRunner

from thermostand.compensation.cli import app
from thermostand.compensation.drift.model_file import save_model
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session

from .conftest import SEQUENCE, Recorded
from .made_up_models import paper

runner = CliRunner()


@pytest.fixture
def holed(recorded: Recorded, tmp_path: Path) -> Path:
    """The second segment of the frames, ten minutes of the night, is missing."""
    path = Path(shutil.copytree(recorded.path, tmp_path / "night"))
    assert len(list((path / "frames").glob("*.mcap"))) == 2
    (path / "frames" / "0000.mcap").unlink()
    return path


def ask(*arguments: object) -> tuple[int, str]:
    result = runner.invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, " ".join(result.stderr.split())


def test_the_markers_of_what_is_there_are_found_when_it_is_asked_for(holed: Path, tmp_path: Path):
    out = tmp_path / "markers.csv"
    status, said = ask("detect", holed, "-o", out)
    assert status == 1
    assert "is incomplete; missing: frames/0000.mcap (to 2026-01-01 18:1" in said
    assert said.endswith("; use --incomplete to read the rest")
    assert not out.exists()
    status, said = ask("detect", holed, "-o", out, "--incomplete")
    assert status == 0
    assert f"warning: {holed}: is incomplete; missing: frames/0000.mcap" in said
    assert 0 < len({line.split(",")[0] for line in out.read_text().splitlines()[1:]}) < len(SEQUENCE)


@pytest.mark.parametrize(
    "command",
    [
        ("fit", "{session}", "-o", "{out}"),
        ("report", "{session}", "-o", "{out}"),
        ("budget", "{session}"),
        ("calibrate", "{session}", "-o", "{out}"),
    ],
)
def test_each_command_refuses_it_with_the_same_sentence(holed: Path, tmp_path: Path, command: tuple[str, ...]):
    out = tmp_path / "out.html"
    status, said = ask(*(text.format(session=holed, out=out) for text in command))
    assert status == 1
    assert said.startswith(f"error: {holed}: is incomplete; missing: frames/0000.mcap (to ")
    assert said.endswith("use --incomplete to read the rest")
    assert not out.exists()
    _, said = ask(*(text.format(session=holed, out=out) for text in command), "--incomplete")
    assert said.startswith(f"warning: {holed}: is incomplete; missing: frames/0000.mcap (to ")


def test_corrections_want_the_whole_session_too(holed: Path, recorded: Recorded, tmp_path: Path):
    model, points = tmp_path / "model.json", tmp_path / "points.csv"
    save_model(paper(), model)
    time_ns = Session.open(recorded.path).frame_times_ns[-1]
    points.write_text(f"x_px,y_px,time_ns\n320,240,{time_ns}\n")
    for source in ((holed,), (points, "--session", holed)):
        out = tmp_path / "out"
        status, said = ask("apply", model, *source, "-o", out)
        assert status == 1
        assert said.endswith("use --incomplete to read the rest")
        assert not out.exists()
    status, said = ask("apply", model, points, "--session", holed, "-o", tmp_path / "out.csv", "--incomplete")
    assert (status, said.startswith(f"warning: {holed}: is incomplete; missing: frames/0000.mcap")) == (0, True)


@pytest.fixture
def unfinished(recorded: Recorded, tmp_path: Path) -> Path:
    """A killed recorder has left the second segment of the frames."""
    path = Path(shutil.copytree(recorded.path, tmp_path / "night"))
    last = path / "frames" / "0001.mcap"
    last.rename(last.with_name("0001.mcap.part"))
    return path


def test_what_a_killed_recorder_left_is_not_left_out_in_silence(unfinished: Path, tmp_path: Path):
    out = tmp_path / "markers.csv"
    status, said = ask("detect", unfinished, "-o", out)
    assert status == 1
    assert said == (
        f"error: {unfinished}: frames/0001.mcap.part is not finished and would be left out; "
        f"`stand session salvage {unfinished}` first"
    )
    assert not out.exists()
    status, said = ask("detect", unfinished, "-o", out, "--incomplete")
    assert status == 0
    assert f"warning: {unfinished}: frames/0001.mcap.part is not finished and left out" in said
    salvage_session(unfinished)
    status, said = ask("detect", unfinished, "-o", out)
    assert (status, "warning" in said) == (0, False)
