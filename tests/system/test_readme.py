"""What README.md tells a reader to type: each command and option exists, and in an empty folder does what it says."""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner, Result

from tests.compensation.rendered import Scene, photograph, render
from tests.system.conftest import require_aravis
from tests.system.test_validation_nightly import VALIDATION
from thermostand.compensation.cli import app as compensate
from thermostand.stand.commands.command_table import app as stand

ROOT = Path(__file__).parents[2]
README = (ROOT / "README.md").read_text(encoding="utf-8")
PROGRAMS = {"stand": stand, "compensate": compensate}
QUICK = (
    "stand plan thermal-cycle",
    "compensate detect photo.png --target robot-cal-tools-10x10 -o centres.csv",
)
# They need a laboratory in real time, somebody at the console, a run that was killed, or 9 GB: tests of their own do
# that (the last: test_reported_run.py).
NOT_RUN = {
    "stand run overnight --virtual-time --report",
    "stand simulate",
    "stand serve --port 8080",
    "stand run warm-up",
    "stand run warm-up --attended",
    "stand status",
    "stand pause",
    "stand continue",
    "stand stop",
    "stand resume sessions/NAME",
    "stand queue add calibration",
    "stand queue add thermal-cycle",
}
LIMIT_S = 3600.0  # for a whole night in virtual time on a busy machine


def commands() -> Iterator[str]:
    """Those of the indented blocks, one by one, without their comments."""
    for line in README.splitlines():
        if line.startswith("    .venv/bin/"):
            for command in line.split("  #")[0].split(";"):
                yield command.strip().removeprefix(".venv/bin/")


def called(words: list[str]) -> Result:
    return CliRunner().invoke(PROGRAMS[words[0]], words[1:], prog_name=words[0])


def test_the_readme_has_its_commands():
    found = list(commands())
    assert len(found) >= 30
    assert {*QUICK, *NOT_RUN} <= set(found)


@pytest.mark.parametrize("command", tuple(commands()))
def test_a_command_of_the_readme_exists_with_its_options(command: str):
    """A wrong option is refused before the help is shown."""
    result = called([*shlex.split(command), "--help"])
    assert result.exit_code == 0, result.output


def test_a_command_or_option_that_does_not_exist_would_be_found():
    for command in ("stand plant thermal-cycle", "stand plan thermal-cycle --jason", "compensate fit x --outt y"):
        assert called([*shlex.split(command), "--help"]).exit_code == 2, command


@pytest.mark.parametrize("command", sorted(set(re.findall(r"`((?:stand|compensate) [a-z][^`]*)`", README))))
def test_a_command_in_the_text_exists(command: str):
    words = [word for word in shlex.split(command) if not word.startswith("-") and not word.isupper()]
    assert called([*words, "--help"]).exit_code == 0


def test_the_commands_in_the_pages_of_docs_exist_with_their_options():
    pages = [page.read_text(encoding="utf-8") for page in ROOT.glob("docs/**/*.md")]
    inline = {found for page in pages for found in re.findall(r"`((?:stand|compensate) [a-z][^`]*)`", page)}
    blocks = {
        found for page in pages for found in re.findall(r"(?m)^ {4}(?:\.venv/bin/)?((?:stand|compensate) .*)", page)
    }
    typed = {
        re.sub(r"  #.*|[\[\]]| --[a-z-]+$", "", command) for command in inline | blocks
    }  # a last option lacks its value
    assert len(typed) > 60
    wrong = {
        command: result.output for command in typed if (result := called([*shlex.split(command), "--help"])).exit_code
    }
    assert not wrong


@pytest.mark.parametrize("option", sorted(set(re.findall(r"`(--[a-z-]+)", README))))
def test_an_option_in_the_text_exists(option: str):
    sources = [*ROOT.glob("stand/commands/*.py"), *ROOT.glob("compensation/commands/*.py")]
    names = {option, option.removeprefix("--").replace("-", "_")}
    assert any(f'"{option}"' in text or f"{name}: " in text for name in names for text in map(Path.read_text, sources))


@pytest.mark.parametrize("target", sorted(set(re.findall(r"(?m)^    make (\w+)|`make (\w+)`", README))))
def test_a_target_of_make_exists(target: tuple[str, str]):
    assert f"\n{target[0] or target[1]}:" in (ROOT / "Makefile").read_text()


def photographed(path: Path) -> None:
    """The target of robot_cal_tools, as README's photograph shows it."""
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
        result = called(shlex.split(command))
        assert result.exit_code == 0, (command, result.output)
    assert len((tmp_path / "centres.csv").read_text().splitlines()) == 101


def run(command: str, folder: Path) -> str:
    """What the command says, in a shell of that folder; it must end well."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OPENBLAS_NUM_THREADS": "1"}
    ended = subprocess.run(
        command, shell=True, cwd=folder, env=environment, capture_output=True, text=True, check=False, timeout=LIMIT_S
    )
    assert ended.returncode == 0, f"{command}\n{ended.stdout}\n{ended.stderr}"
    return ended.stdout


@pytest.mark.nightly
def test_every_command_of_the_readme_runs_in_an_empty_folder(tmp_path: Path):
    """`make demo` first; another session has the frames of a calibration and a validation."""
    require_aravis()
    photographs = ROOT.parent / "shared" / "data" / "robot_cal_tools_10x10" / "images"
    if not photographs.is_dir():
        pytest.skip(f"{photographs} is missing")
    (tmp_path / "photos").symlink_to(photographs)
    (tmp_path / ".venv").symlink_to(sys.prefix)
    photographed(tmp_path / "photo.png")
    (tmp_path / "points.csv").write_text("x_px,y_px\n1200,1000\n")
    (tmp_path / "night.yaml").write_text(VALIDATION)
    night = run(".venv/bin/stand run night.yaml --virtual-time --out nights", tmp_path).strip()
    said = {"stand demo": run(".venv/bin/stand demo", tmp_path)}
    for command in commands():
        if command in NOT_RUN:
            continue
        recorded = next(tmp_path.glob("sessions/*-demo"), Path("none"))
        words = {
            "CALIBRATION": night,
            "VALIDATION": night,
            "SESSION": night,
            "sessions/NAME": f"sessions/{recorded.name}",
        }
        typed = command
        for word, place in words.items():
            typed = re.sub(rf"(?<![\w/]){word}(?!\w)", str(place), typed)
        said[command] = run(f".venv/bin/{typed}", tmp_path)
    made = {path.name for path in tmp_path.iterdir()}
    assert made >= {
        *("demo", "sessions", "model.json", "report.html", "markers.csv", "corrected.csv", "runtime", "camera.json"),
        *("exports", "validation.html", "centres.csv", "copy", "tables", "part"),
    }
    (verified,) = (text for command, text in said.items() if command.startswith("stand session verify"))
    assert "sound" in verified
    corrected = np.genfromtxt(tmp_path / "corrected.csv", delimiter=",", names=True, dtype=None, encoding="utf-8")
    assert np.isfinite(corrected["x_reference_px"]).all()
