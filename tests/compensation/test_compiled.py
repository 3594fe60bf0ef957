"""Compiled code is kept, and does without a place to keep it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from markers import compiled
from markers.compiled import digest

PROGRAM = """
from markers.compiled import entry
from thing import twice
print(twice(21), len(twice.stats.cache_hits))
"""
THING = """
from markers.compiled import entry
@entry
def twice(x):
    return 2 * x
"""


def run(folder: Path, **environment: str) -> str:
    paths = os.pathsep.join([str(folder), str(Path(compiled.__file__).parents[1])])
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
    assert digest(compiled) == digest(compiled)
    assert digest(compiled) != digest(compiled, pytest)
