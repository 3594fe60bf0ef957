"""The wheel, installed in an environment outside of the clone: it runs without it, and leaves nothing behind.

The libraries are those of this environment, put on the path behind it, so that no package index is asked; CI and a
release install them afresh (docs/how-to/install.md says with which versions of Python that was tried).
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import sysconfig
import venv
from pathlib import Path

import cv2
import pytest

from tests.compensation.other_laboratories import write_picture, write_target

ROOT = Path(__file__).parents[2]
RECIPE = """name: look
steps:
  - open_flap
  - capture: {role: reference, frames: 2, chamber_degC: 24}
"""


def run(command: list[str | Path], folder: Path, **more: str) -> str:
    """What a program prints; it is run in `folder`, and finds nothing of this clone by itself."""
    known = {key: value for key, value in os.environ.items() if key not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
    settings = {**known, "XDG_CACHE_HOME": str(folder / "cache"), "PYTHONDONTWRITEBYTECODE": "1", **more}
    done = subprocess.run(command, cwd=folder, env=settings, capture_output=True, text=True, check=False, timeout=170)
    assert done.returncode == 0, done.stderr
    return done.stdout


def list_files(folder: Path) -> set[Path]:
    return {path for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With an environment `installed`, in which nothing is installed."""
    made = tmp_path_factory.mktemp("elsewhere")
    venv.create(made / "installed", with_pip=False)
    (site,) = (made / "installed").glob("lib/python*/site-packages")
    (site / "libraries.pth").write_text(sysconfig.get_path("purelib") + "\n")
    (made / "files.json").write_text(json.dumps(sorted(map(str, list_files(made / "installed")))))
    run([sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", made / "dist"], ROOT)
    (wheel,) = (made / "dist").glob("*.whl")
    pip = [
        sys.executable,
        "-m",
        "pip",
        "--python",
        made / "installed" / "bin" / "python",
        "--disable-pip-version-check",
    ]
    run([*pip, "install", "--quiet", "--no-deps", "--no-index", "--no-compile", wheel], made)
    return made


@pytest.mark.nightly
def test_the_wheel_runs_outside_of_the_clone_and_leaves_nothing_behind(folder: Path):
    installed = folder / "installed" / "bin"
    where = (
        "import thermostand.stand, importlib.metadata as m; print(thermostand.stand.__file__, m.version('thermostand'))"
    )
    assert run([installed / "python", "-c", where], folder).startswith(str(folder / "installed"))
    assert "thermal-cycle" in run([installed / "stand", "recipes"], folder)
    (folder / "look.yaml").write_text(RECIPE)
    run(
        [installed / "stand", "run", "look.yaml", "--config", "simulated", "--virtual-time", "--out", "sessions"],
        folder,
    )
    (session,) = (folder / "sessions").glob("*-look")
    assert json.loads(run([installed / "stand", "session", "verify", session, "--json"], folder))
    write_target(folder)
    for seed, degC in enumerate((10, 14, 18, 22, 26, 30)):
        write_picture(folder / "pictures" / f"t{degC}" / "1.png", degC, 700, seed)
    run([installed / "compensate", "observe", "pictures", "--target", "small.yaml", "-o", "centres.csv"], folder)
    run([installed / "compensate", "fit", "centres.csv", "-o", "model.json"], folder)
    picture = ["pictures/t10/1.png", "--camera-degC", "10", "-o", "corrected.tiff"]
    run([installed / "compensate", "apply", "model.json", *picture], folder)
    corrected = cv2.imread(str(folder / "corrected.tiff"), cv2.IMREAD_UNCHANGED)
    assert corrected is not None
    assert corrected.shape == (256, 320)
    assert len(list((folder / "cache" / "thermostand" / "machine-code").rglob("*.nbi"))) >= 5
    pip = [sys.executable, "-m", "pip", "--python", installed / "python", "--disable-pip-version-check"]
    run([*pip, "uninstall", "--quiet", "--yes", "thermostand"], folder)
    before = json.loads((folder / "files.json").read_text())
    assert sorted(map(str, list_files(folder / "installed"))) == before
