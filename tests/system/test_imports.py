"""What is imported when: help and the public names come at once, the libraries of the long work when it is begun."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from tests.recording.runs import record_run

HEAVY = ("numba", "scipy", "cv2", "matplotlib")

WORK = {
    "stand": "import sys; sys.argv = ['stand', '--help']; from thermostand.stand.cli import app",
    "compensate": "import sys; sys.argv = ['compensate', '--help']; from thermostand.compensation.cli import app",
}


def loaded(code: str) -> set[str]:
    """Which of the heavy libraries a new interpreter has loaded at the end of the code."""
    tail = f"\nimport sys\nsys.stderr.write('loaded ' + ' '.join({{*{HEAVY}}} & {{*sys.modules}}))"
    done = subprocess.run([sys.executable, "-c", code + tail], capture_output=True, text=True, check=True)
    last = done.stderr.splitlines()[-1]
    assert last.startswith("loaded")
    return set(last.split()[1:])


@pytest.mark.parametrize("command", sorted(WORK))
def test_help_loads_no_heavy_library(command: str):
    assert loaded(f"{WORK[command]}\ntry:\n    app()\nexcept SystemExit as end:\n    assert not end.code") == set()


def test_a_package_loads_no_heavy_library():
    rooms = ("foundation.clock", "recording", "markers", "compensation", "experiments", "stand")
    assert loaded(";".join(f"import thermostand.{room}" for room in rooms)) == set()


# The second shows also that a heavy library would be found.
@pytest.mark.parametrize(("recipe", "heavy"), [("demo", set[str]()), ("thermal-cycle-settled", {"numba", "scipy"})])
def test_what_the_looks_of_a_plan_need_is_imported_before_it_is_run(recipe: str, heavy: set[str]):
    code = (
        "import thermostand.stand.service.run\n"
        "from thermostand.stand.running.order import load_order\n"
        "from thermostand.stand.running.executing.settling_watch import load_for\n"
        f"load_for(load_order({recipe!r}, 'simulated').recipe.plan())"
    )
    assert loaded(code) - {"cv2"} == heavy


async def test_reading_a_session_loads_no_heavy_library(tmp_path: Path):
    night = str(await record_run(tmp_path / "night"))
    code = f"from thermostand.recording import Session; s = Session.open({night!r}); "
    code += "s.channels(); s.frames_table(); s.holes"
    assert loaded(code) == set()
    assert loaded(f"{code}; s.frame(0)") == set()
