"""What README.md and the tutorials tell a reader to type does, in an empty folder, what they say."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from tests.compensation.renderer import Scene, photograph, render
from tests.system.conftest import require_aravis
from tests.system.test_docs import DOCS, PROGRAMS, blocks_of, called
from tests.system.test_validation_nightly import VALIDATION

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS = [line.strip() for line in README.splitlines() if line.startswith("    .venv/bin/")]
QUICK = (
    "stand plan thermal-cycle",
    "compensate detect photo.png --target robot-cal-tools-10x10 -o centres.csv",
)
RUN = (
    "tutorials/simulated-session.md",
    "how-to/fit-and-report.md",
    "how-to/make-a-datasheet.md",
    "how-to/calibrate-a-camera.md",
    "how-to/check-export-repair.md",
    "how-to/replay.md",
)
"""Pages whose commands are typed one after the other, by night."""
NOT_RUN = ("make ", "stand run calibration", "stand session replay sessions/NAME --speed 60", "--like", "calibrate-rig")
"""They set up, need a real stand, take real time, or need sessions of several units: tests of their own do that."""
LIMIT_S = 3600.0  # for a whole session in virtual time on a busy machine


def test_the_readme_has_its_three_more():
    assert len(COMMANDS) == 3


@pytest.mark.parametrize("command", [line for line in COMMANDS if "python" not in line])
def test_a_command_of_the_readme_exists_with_its_options(command: str):
    """A wrong option is refused before the help is shown."""
    result = called([*shlex.split(command.removeprefix(".venv/bin/")), "--help"])
    assert result.exit_code == 0, result.output


def test_a_command_or_option_that_does_not_exist_would_be_found():
    for command in ("stand plant thermal-cycle", "stand plan thermal-cycle --jason", "compensate fit x --outt y"):
        assert called([*shlex.split(command), "--help"]).exit_code == 2, command


@pytest.mark.parametrize("target", sorted(set(re.findall(r"(?m)^    make (\w+)", README))))
def test_a_target_of_make_exists(target: str):
    assert f"\n{target}:" in (ROOT / "Makefile").read_text(encoding="utf-8")


def photographed(path: Path) -> None:
    """The target of robot_cal_tools, as a photograph shows it."""
    scene = Scene(
        columns=10,
        rows=10,
        pitch_mm=25.4,
        diameter_mm=12.7,
        diameters_mm={1: 25.4},
        size=(640, 480),
        f_px=900.0,
        distance_mm=800.0,
        tilt_y_deg=10.0,
    )
    assert cv2.imwrite(str(path), photograph(scene, render(scene), 1))


def test_the_quick_commands_run_in_an_empty_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    photographed(Path("photo.png"))
    for command in QUICK:
        words = shlex.split(command)
        result = CliRunner().invoke(PROGRAMS[words[0]], words[1:], prog_name=words[0])
        assert result.exit_code == 0, (command, result.output)
    assert len((tmp_path / "centres.csv").read_text().splitlines()) == 101


def run(command: str, folder: Path) -> str:
    """What the command prints, in a shell of that folder; it must end well."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(
        command, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    assert ended.returncode == 0, f"{command}\n{ended.stdout}\n{ended.stderr}"
    return ended.stdout


def typed() -> list[str]:
    """The commands of the pages, in their order."""
    lines = [
        line
        for page in RUN
        for block in blocks_of(DOCS / page)
        if block.language == "console"
        for line in block.text.splitlines()
    ]
    return [line.removeprefix(".venv/bin/") for line in lines if not any(part in line for part in NOT_RUN)]


@pytest.mark.nightly
def test_every_command_of_the_tutorial_runs_in_an_empty_folder(tmp_path: Path):
    """`make demo` first; another session has the frames of a calibration and a validation."""
    require_aravis()
    photographs = ROOT.parent / "shared" / "data" / "robot_cal_tools_10x10" / "images"
    if not photographs.is_dir():
        pytest.skip(f"{photographs} is missing")
    (tmp_path / ".venv").symlink_to(sys.prefix)
    (tmp_path / "points.csv").write_text("x_px,y_px\n1200,1000\n")
    (tmp_path / "details.yaml").write_text("lens: 25 mm f/1.4\n")
    (tmp_path / "cycle.yaml").write_text(VALIDATION)
    session = run(".venv/bin/stand run cycle.yaml --virtual-time --out sessions-of-cycle", tmp_path).strip()
    run(".venv/bin/stand demo", tmp_path)
    printed: dict[str, str] = {}
    for command in typed():
        recorded = next(tmp_path.glob("sessions/*-demo"), Path("none"))
        words = {
            "SESSION-1 SESSION-2": f"sessions/{recorded.name}",
            "sessions/(?:CALIBRATION|VALIDATION)": session,
            "sessions/(?:NAME|LATER)": f"sessions/{recorded.name}",
            r"photos/left-01.png photos/left-02.png": f"{photographs}/*.png",
        }
        line = command
        for word, place in words.items():
            line = re.sub(word, str(place), line)
        printed[command] = run(f".venv/bin/{line}", tmp_path)
    made = {path.name for path in tmp_path.iterdir()}
    assert made >= {
        *("demo", "sessions", "model.json", "report.html", "markers.csv", "corrected.csv", "corrected", "camera.json"),
        *("exports", "validation.html", "camera.html", "copy", "tables", "part", "session.mcap"),
    }
    (verified,) = {text for command, text in printed.items() if command.startswith("stand session verify")}
    assert "sound" in verified
    corrected = np.genfromtxt(tmp_path / "corrected.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert np.isfinite(corrected["x_reference_px"]).all()
