"""The container file: a Debian slim base, no rights, what has to be kept in volumes; and what its linter says."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from thermostand.stand.safety.latch import SYSTEM_FOLDER
from thermostand.stand.serving.instances import STANDS_FOLDER

ROOT = Path(__file__).parents[2]
FILE = ROOT / "Containerfile"


def read_instructions() -> list[tuple[str, str]]:
    """(word, arguments) of each instruction, continued lines joined, without comments."""
    lines = [line for line in FILE.read_text().splitlines() if not line.lstrip().startswith("#")]
    joined = re.sub(r"\\\n\s*", "", "\n".join(lines))
    return [(line.split()[0], line.split(maxsplit=1)[1]) for line in joined.splitlines() if line.strip()]


def test_the_image_is_slim_has_no_rights_and_keeps_sessions_and_trips_in_volumes():
    found = read_instructions()
    bases = [text for word, text in found if word == "FROM"]
    assert all(re.match(r"python:3\.\d+-slim-\w+( AS \w+)?$", text) for text in bases)
    words = [word for word, _ in found]
    (user,) = [text for word, text in found if word == "USER"]
    assert int(user) > 0
    assert "RUN" not in words[words.index("USER") :]
    assert json.loads(dict(found)["VOLUME"]) == ["/data", str(SYSTEM_FOLDER)]
    assert json.loads(dict(found)["ENTRYPOINT"]) == ["stand"]
    assert dict(found)["STOPSIGNAL"] == "SIGTERM"
    (made,) = [text for word, text in found if word == "RUN" and "useradd" in text]
    assert str(SYSTEM_FOLDER) in made
    assert str(STANDS_FOLDER) in made


def test_what_is_copied_into_the_build_is_what_the_wheel_is_made_of():
    kept = {line[1:] for line in (ROOT / ".dockerignore").read_text().splitlines() if line.startswith("!")}
    folders = {path.name for path in (ROOT / "thermostand").iterdir() if path.is_symlink()}
    assert folders | {"thermostand", "pyproject.toml", "constraints.txt", "README.md", "LICENSE"} <= kept
    assert all((ROOT / name).exists() for name in kept)


def test_the_linter_has_nothing_to_say():
    linter = shutil.which("hadolint", path=f"{Path(sys.executable).parent}:{os.environ.get('PATH', '')}")
    if linter is None:
        if os.environ.get("CI") == "true":
            pytest.fail("hadolint is missing; it is of the extra dev")
        pytest.skip("hadolint is missing; it is of the extra dev")
    done = subprocess.run([linter, "--no-color", FILE], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, "")
