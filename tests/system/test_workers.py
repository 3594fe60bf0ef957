"""The workers that run the tests: each test is run and reported once, also those after one that ends its worker."""

import os
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[2]
CONFTEST = """
from itertools import groupby

from tests.workers import run_units


def pytest_runtestloop(session):
    run_units(session, [list(tests) for _, tests in groupby(session.items, lambda test: test.path)], 2)
    return True
"""
ENDS = """
import os, time
import pytest

@pytest.fixture(scope="session")
def lasting():
    yield
    raise ValueError("at its end")

def test_passes(): print("not shown")
def test_ends_its_worker_and_leaves_a_process():
    if os.fork():
        os._exit(3)
    time.sleep(30)
def test_fails(lasting):
    print("shown")
    raise AssertionError
def test_after_it(tmp_path): (tmp_path / "file").touch()
"""
MANY = "import pytest\n\n@pytest.mark.parametrize('number', range(40))\ndef test_each(number): assert number != 7\n"


def pytest_in(folder: Path, *options: str) -> str:
    """What it says of these tests."""
    (folder / "conftest.py").write_text(CONFTEST)
    (folder / "test_ends.py").write_text(ENDS)
    (folder / "test_many.py").write_text(MANY)
    command = [sys.executable, "-m", "pytest", "-c", os.devnull, "--rootdir", ".", "-p", "no:cacheprovider", *options]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "COLUMNS": "200"}
    output = folder / "output.txt"  # a pipe would be open until the process that a test has left ends
    with output.open("w") as file:
        done = subprocess.run(command, cwd=folder, env=environment, stdout=file, stderr=subprocess.STDOUT, timeout=100)
    assert done.returncode == 1, output.read_text()
    return output.read_text()


def test_every_test_is_reported_once_also_when_one_ends_its_worker(tmp_path: Path):
    output = pytest_in(tmp_path, "-v", "-rfE")
    assert re.search(r"3 failed, 41 passed, 1 error in", output), output
    assert sorted(
        re.findall(
            r"^(?:FAILED|ERROR) (\S+) - (.*)$",
            re.sub(r"worker \d ended .* test", "worker N ended", output),
            re.MULTILINE,
        )
    ) == [
        ("test_ends.py::test_after_it", "ValueError: at its end"),
        ("test_ends.py::test_ends_its_worker_and_leaves_a_process", "worker N ended, with 3"),
        ("test_ends.py::test_fails", "AssertionError"),
        ("test_many.py::test_each[7]", "assert 7 != 7"),
    ]
    assert "\nshown\n" in output
    assert "not shown" not in output


def test_no_unit_is_begun_after_the_last_failure_that_is_wanted(tmp_path: Path):
    output = pytest_in(tmp_path, "-x")
    assert re.search(r"stopping after \d failures", output), output
    assert not re.search(r"\b(?:39|4\d) passed", output), output
