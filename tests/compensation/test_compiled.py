"""Compiled code is kept, and does without a place to keep it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from numba.core.event import RecordingListener, install_listener

from tests.compensation.conftest import GLARE, TARGET_YAML, photo
from thermostand.foundation.documents import parse_document
from thermostand.markers import jit
from thermostand.markers.compile_ahead import compile_ahead
from thermostand.markers.detection import Flag, detect
from thermostand.markers.jit import compute_digest
from thermostand.markers.target import Target
from thermostand.recording.format.images import encode_png

PROGRAM = """
from thermostand.markers.jit import compile_entry
from thing import twice
print(twice(21), len(twice.stats.cache_hits))
"""
THING = """
from thermostand.markers.jit import compile_entry
@compile_entry
def twice(x):
    return 2 * x
"""


def run(folder: Path, **environment: str) -> str:
    paths = os.pathsep.join([str(folder), str(Path(jit.__file__).parents[1])])
    settings = {**os.environ, "PYTHONPATH": paths, "PYTHONDONTWRITEBYTECODE": "1", **environment}
    done = subprocess.run([sys.executable, "-c", PROGRAM], env=settings, capture_output=True, text=True, check=True)
    return done.stdout


def test_code_is_compiled_once_and_then_loaded(tmp_path: Path):
    (tmp_path / "thing.py").write_text(THING)
    assert run(tmp_path) == "42 0\n"
    assert run(tmp_path) == "42 1\n"


def test_an_installation_where_nothing_can_be_written_compiles_in_every_process(tmp_path: Path):
    (tmp_path / "thing.py").write_text(THING)
    (tmp_path / "__pycache__").write_text("a file where the folder would be, which also stops root")
    assert run(tmp_path, HOME="/proc/nowhere", XDG_CACHE_HOME="/proc/nowhere") == "42 0\n"


def test_a_digest_follows_the_sources():
    assert compute_digest(jit) == compute_digest(jit)
    assert compute_digest(jit) != compute_digest(jit, pytest)


def test_nothing_is_compiled_once_that_was_done_ahead():
    compile_ahead(lambda: None)
    listener = RecordingListener()
    with install_listener("numba:compile", listener):
        found = detect(photo(GLARE[0]), parse_document(TARGET_YAML, Target, "target.yaml"))
        compile_ahead(lambda: pytest.fail("it is compiled again"))
    assert found.flags[GLARE[1]] & Flag.REFITTED  # so both fits were made
    assert listener.buffer == []


@pytest.mark.nightly
def test_what_is_compiled_is_reported_once_per_machine_and_no_part_of_the_time_left(tmp_path: Path):
    picture, target = tmp_path / "picture.png", tmp_path / "target.yaml"
    picture.write_bytes(encode_png(photo(0)))
    target.write_text(TARGET_YAML)
    command = [
        sys.executable,
        "-m",
        "thermostand.compensation.cli",
        "detect",
        picture,
        "--target",
        target,
        "-o",
        tmp_path / "out.csv",
    ]
    messages = [
        subprocess.run(
            command, env={**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}, capture_output=True, text=True, check=True
        ).stderr
        for _ in range(2)
    ]
    assert ["compiled" in each for each in messages] == [True, False]
    assert all("left" not in each for each in messages)  # one picture takes less than the 3 s from which on it is shown
