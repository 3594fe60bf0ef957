"""The `compensate` command on a recorded session and on photographs, and what it says to bad input."""

from __future__ import annotations

import csv
import json
import os
import shutil
import stat
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from thermostand.compensation import cli
from thermostand.compensation.drift.evaluation import format_table
from thermostand.compensation.drift.model_file import load_model
from thermostand.compensation.drift.paper_model import PaperModel
from thermostand.compensation.reporting.report import analyse
from thermostand.foundation.errors import SessionError
from thermostand.foundation.progress import progress
from thermostand.markers.detections_table import COLUMNS

from .conftest import DARK, SEQUENCE, TARGET_YAML, Recorded, photo


def run(*arguments: str | Path) -> Result:
    return CliRunner().invoke(cli.app, [str(argument) for argument in arguments])


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        reader = csv.DictReader(file)
        rows = list(reader)
    assert tuple(reader.fieldnames or ()) == COLUMNS
    return rows


@pytest.fixture
def target(tmp_path: Path) -> Path:
    path = tmp_path / "target.yaml"
    path.write_text(TARGET_YAML)
    return path


@pytest.fixture
def image(tmp_path: Path) -> Path:
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), photo(3))
    return path


def assert_refused(result: Result, sentence: str, out: Path, status: int = 1):
    """One line that has the sentence, and nothing written. status: 2 for bad arguments and configurations."""
    assert result.exit_code == status, result.output
    lines = [line for line in result.stderr.splitlines() if not line.startswith("find markers")]
    assert len(lines) == 1
    assert lines[0].startswith("error: ")
    assert sentence in lines[0]
    assert not out.exists()
    assert not list(out.parent.glob(".*.part"))


def test_detect_writes_a_row_per_marker_and_frame_of_a_session(recorded: Recorded, tmp_path: Path):
    result = run("detect", recorded.path, "-o", tmp_path / "markers.csv")
    assert result.exit_code == 0
    rows = rows_of(tmp_path / "markers.csv")
    assert len(rows) == 54 * len(SEQUENCE)
    assert [row["image"] for row in rows[::54]] == [str(index) for index in range(len(SEQUENCE))]
    got = np.array([[float(row["x_px"]), float(row["y_px"])] for row in rows]).reshape(-1, 54, 2)
    good = np.array([row["flags"] == "OK" for row in rows]).reshape(-1, 54)
    assert np.abs(got - recorded.true_px)[good].max() < 0.04
    assert (~good).sum() == 54 + 1
    dark = rows[54 * DARK : 54 * DARK + 54]
    assert {(row["x_px"], row["flags"]) for row in dark} == {("nan", "MISSING")}
    assert f"not found in {DARK}: " in result.stderr


def test_detect_takes_photographs_and_an_installed_target(image: Path, target: Path, tmp_path: Path):
    out = tmp_path / "markers.csv"
    assert run("detect", image, "-o", out).exit_code == 0  # paper-9x6 has the same proportions but for the discs
    assert run("detect", image, image, "--target", target, "-o", out).exit_code == 0
    rows = rows_of(out)
    assert [row["image"] for row in rows[::54]] == ["photo.png", "photo.png"]
    assert rows[0]["time_ns"] == ""
    assert (rows[0]["marker"], rows[0]["row"], rows[0]["column"]) == ("1", "0", "0")


@pytest.mark.usefixtures("undrawn")
def test_fit_then_report_then_analyse_agree(recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    fitted = run("fit", recorded.path, "-o", tmp_path / "model.json")
    assert fitted.exit_code == 0
    assert "paper              0.191     0.100    48 %       0.576     0.090    84 %" in fitted.stdout
    reported = run("report", recorded.path, "--model", tmp_path / "model.json", "-o", tmp_path / "report.html")
    assert reported.exit_code == 0
    evaluation = analyse([recorded.path], tmp_path / "model2.json", tmp_path / "report2.html", progress)
    assert evaluation is not None
    assert format_table(evaluation) == reported.stdout.rstrip("\n")
    assert (tmp_path / "model2.json").read_bytes() == (tmp_path / "model.json").read_bytes()
    for suffix in ("html", "json"):
        assert (tmp_path / f"report2.{suffix}").read_bytes() == (tmp_path / f"report.{suffix}").read_bytes()
    assert evaluation.rms_before_px[1] > 0.4
    assert max(evaluation.rms_after_px) < 0.012  # discs of 10 px in radius: about 6 mpx of noise
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "model.json",
        "model2.json",
        "report.html",
        "report.json",
        "report2.html",
        "report2.json",
    ]
    assert "find markers: 100%" in capsys.readouterr().err


def test_the_degree_can_be_given(recorded: Recorded, tmp_path: Path):
    assert run("fit", recorded.path, "-o", tmp_path / "model.json", "--degree", "3").exit_code == 0
    model = load_model(tmp_path / "model.json")
    assert isinstance(model, PaperModel)
    assert model.degree == 3
    assert json.loads((tmp_path / "model.json").read_text())["session_ids"] == ["cycle"]


@pytest.mark.parametrize("degree", ["0", "6", "-1"])
def test_a_degree_that_does_not_exist_is_refused_before_the_long_work(recorded: Recorded, tmp_path: Path, degree: str):
    out = tmp_path / "model.json"
    result = run("fit", recorded.path, "-o", out, "--degree", degree)
    assert_refused(result, f"the degree is 1 to 5, not {degree}", out, 2)
    assert "find markers" not in result.stderr


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["fit", "cycle", "-o", "model.json", "--degree", "two"], "'--degree'"),
        (["fit", "cycle"], "'--out'"),
        (["fit", "-o", "model.json"], "SESSION..."),
        (["report", "cycle", "--modle", "m.json"], "--modle"),
        (["fits"], "'fits'"),
        (["--loud"], "--loud"),
    ],
)
def test_wrong_arguments_are_reported_in_one_line(arguments: list[str], sentence: str, tmp_path: Path):
    assert_refused(run(*arguments), sentence, tmp_path / "out", 2)


def test_no_arguments_ask_for_help():
    result = run()
    assert result.exit_code == 2
    assert "Example: compensate" in result.output


def test_what_is_not_a_file_is_refused_before_the_work_and_stays(recorded: Recorded, tmp_path: Path):
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    for command in ("detect", "fit", "report"):
        result = run(command, recorded.path, "-o", pipe)
        assert result.exit_code == 1
        assert result.stderr.startswith(f"error: {pipe}: ")
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


def test_a_name_with_line_ends_or_no_text_at_all_stays_in_one_line(image: Path, target: Path, tmp_path: Path):
    out = tmp_path / "markers.csv"
    odd = tmp_path / os.fsdecode(b"two\nlines\r\xff.png")
    assert_refused(run("detect", odd, "-o", out), r"two\nlines\r\udcff.png: no such file or folder", out, 2)
    shutil.copy(image, odd)
    blank = tmp_path / "blank\n.png"
    cv2.imwrite(str(tmp_path / "blank.png"), np.full((480, 640), 128, np.uint8))
    (tmp_path / "blank.png").rename(blank)
    result = run("detect", odd, blank, "--target", target, "-o", out)
    assert result.exit_code == 0
    assert r"not found in blank\n.png: " in result.stderr
    assert {row["image"] for row in rows_of(out)} == {r"two\nlines\r\udcff.png", r"blank\n.png"}


def test_bad_input_to_detect_is_refused_with_a_sentence(image: Path, recorded: Recorded, tmp_path: Path):
    out = tmp_path / "markers.csv"
    text, blank = tmp_path / "notes.png", tmp_path / "blank.png"
    text.write_text("not a picture")
    cv2.imwrite(str(blank), np.full((480, 640), 128, np.uint8))
    empty = tmp_path / "empty"
    empty.mkdir()
    assert_refused(run("detect", tmp_path / "none.png", "-o", out), "none.png: no such file or folder", out, 2)
    assert_refused(run("detect", image, text, "-o", out), "notes.png: not an image", out)
    assert_refused(run("detect", blank, "-o", out), "blank.png: ", out)
    assert_refused(run("detect", empty, "-o", out), "empty: not a session", out, 2)
    assert_refused(run("detect", image, "--target", "dots", "-o", out), "installed targets: paper-9x6", out, 2)
    assert_refused(run("detect", image, "--target", text, "-o", out), "notes.png: ", out, 2)
    nowhere = tmp_path / "none" / "markers.csv"
    assert_refused(run("detect", recorded.path, "-o", nowhere), "cannot be written", nowhere)


def test_bad_input_to_fit_and_report_is_refused_with_a_sentence(recorded: Recorded, tmp_path: Path):
    out, model = tmp_path / "out", tmp_path / "model.json"
    model.write_text("{}")
    damaged = tmp_path / "damaged"
    shutil.copytree(recorded.path, damaged)
    segment = next((damaged / "frames").iterdir())
    segment.write_bytes(segment.read_bytes()[:1000])
    assert_refused(run("fit", tmp_path, "-o", out), "not a session", out, 2)
    assert_refused(run("fit", damaged, "-o", out), segment.name, out)
    assert_refused(run("fit", recorded.path, recorded.path, "-o", out), "given twice", out)
    assert_refused(run("report", recorded.path, "--model", model, "-o", out), "model.json: not a drift model", out)
    assert_refused(
        run("report", recorded.path, "-o", tmp_path / "no" / "out"), "cannot be written", tmp_path / "no" / "out"
    )


def test_an_interrupted_command_leaves_older_files_as_they_were(
    recorded: Recorded, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("thermostand.compensation.finding.piece.detect", interrupted)
    monkeypatch.setattr("thermostand.compensation.commands.detect_cli.detect", interrupted)
    for command in ("detect", "fit", "report"):
        out = tmp_path / command
        out.write_text("older")
        result = run(command, recorded.path, "-o", out)
        assert result.exit_code == 130
        assert out.read_text() == "older"
    assert len(list(tmp_path.iterdir())) == 3


def test_analyse_refuses_before_the_long_work(recorded: Recorded, tmp_path: Path):
    with pytest.raises(SessionError, match="cannot be written"):
        analyse([recorded.path], tmp_path / "model.json", tmp_path / "none" / "report.html", progress)
    assert not list(tmp_path.iterdir())


def test_help_has_examples():
    for arguments in ([], ["detect"], ["fit"], ["report"]):
        result = run(*arguments, "--help")
        assert result.exit_code == 0
        assert "Example: compensate" in result.stdout
