"""README.md of this folder lists the failure table beside its tests: each named test exists, each fault as well."""

import json
import re
import subprocess
import sys
from pathlib import Path

TESTS = Path(__file__).parents[1]
README = Path(__file__).with_name("README.md").read_text()


def test_each_test_that_the_table_names_exists():
    named = re.findall(r"`(\w+/test_\w+)\.(test_\w+)`", README)
    assert len(named) > 100
    missing = [f"{file}.{name}" for file, name in named if f"def {name}(" not in (TESTS / f"{file}.py").read_text()]
    assert missing == []


def test_each_fault_that_the_table_names_is_one_of_the_simulator():
    listed = subprocess.run(
        [sys.executable, "-m", "thermostand.drivers.sim", "--faults"], capture_output=True, check=True
    ).stdout
    known = {row["name"] for row in json.loads(listed)}
    named = set(
        re.findall(
            r"`((?:bus|linear|regulator|chamber|relays|thermometers?|flap|camera|heater|imager|heat_module|inputs)\.\w+)`",
            README,
        )
    )
    assert named
    assert named <= known
