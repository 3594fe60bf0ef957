"""What is installed is all that there is of the rooms."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
ROOMS = (
    "compensation",
    "configs",
    "drivers",
    "experiments",
    "foundation",
    "markers",
    "recording",
    "stand",
    "thermostand",
)


def test_a_wheel_holds_each_module(tmp_path: Path):
    build = "import hatchling.build, sys; hatchling.build.build_wheel(sys.argv[1])"
    subprocess.run([sys.executable, "-c", build, str(tmp_path)], cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    sources = {str(path.relative_to(ROOT)) for room in ROOMS for path in (ROOT / room).rglob("*.py")}
    assert sources - set(zipfile.ZipFile(wheel).namelist()) == set()
