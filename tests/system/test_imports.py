"""What is imported when: help and the public names come at once, the libraries of the long work when it is begun."""

from __future__ import annotations

import asyncio
import subprocess
import sys

import pytest

from tests.recording.runs import record_run

HEAVY = ("numba", "scipy", "cv2", "matplotlib")

STAGES = {
    "stand --help": "from thermostand.stand.cli import app; help_of(app, 'stand')",
    "compensate --help": "from thermostand.compensation.cli import app; help_of(app, 'compensate')",
    "folders": "from thermostand import compensation, experiments, foundation, markers, recording, stand",
    "session": "from thermostand.recording import Session; s = Session.open(sys.argv[1]); "
    "s.channels(); s.frames_table(); s.holes",
    "frame": "s.frame(0)",
    "demo": "load('demo')",
    "thermal-cycle-settled": "load('thermal-cycle-settled')",
}
"""In this order, in one interpreter: what a stage has loaded stays."""
BEGIN = """
import sys

def help_of(app, name):
    given, sys.argv = sys.argv, [name, "--help"]
    try:
        app()
    except SystemExit as end:
        assert not end.code
    sys.argv = given

def load(recipe):
    import thermostand.stand.service.run
    from thermostand.stand.running.executing.settling_watch import preload_for
    from thermostand.stand.running.order import load_order
    preload_for(load_order(recipe, "simulated").recipe.plan())
"""


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Which of the heavy libraries a new interpreter has loaded after each stage."""
    session = asyncio.run(record_run(tmp_path_factory.mktemp("sessions") / "cycle"))
    tell = f"print('loaded', *({{*{HEAVY}}} & {{*sys.modules}}), file=sys.stderr)"
    code = BEGIN + "".join(f"{stage}\n{tell}\n" for stage in STAGES.values())
    done = subprocess.run([sys.executable, "-c", code, str(session)], capture_output=True, text=True, check=True)
    lines = [line.split()[1:] for line in done.stderr.splitlines() if line.startswith("loaded")]
    return dict(zip(STAGES, map(set, lines), strict=True))


@pytest.mark.parametrize("stage", ["stand --help", "compensate --help", "folders", "session", "frame"])
def test_help_packages_and_the_reading_of_a_session_load_no_heavy_library(loaded: dict[str, set[str]], stage: str):
    assert loaded[stage] == set()


# The second shows also that a heavy library would be found.
@pytest.mark.parametrize(("recipe", "heavy"), [("demo", set[str]()), ("thermal-cycle-settled", {"numba", "scipy"})])
def test_what_the_looks_of_a_plan_need_is_imported_before_it_is_run(
    loaded: dict[str, set[str]], recipe: str, heavy: set[str]
):
    assert loaded[recipe] - {"cv2"} == heavy
