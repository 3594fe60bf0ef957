"""Only `thermostand` is installed: what else a laboratory has by a room's name is left alone."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

ROOT = Path(__file__).parents[2]
FOLDERS = ("compensation", "configs", "drivers", "experiments", "foundation", "markers", "recording", "stand")
# What is not installed here (ROS 2) may be missing; that a room is missing may not.
EVERYTHING = """
import importlib, pkgutil, thermostand
for module in pkgutil.walk_packages(thermostand.__path__, "thermostand."):
    if not module.name.endswith("__main__"):
        try:
            importlib.import_module(module.name)
        except ModuleNotFoundError as error:
            assert error.name == "rclpy", error
"""
# The quick ones first: what they import is not there yet.
PROGRAMS = """
import sys, thermostand
from thermostand.stand.cli import app as stand
from thermostand.compensation.cli import app as compensate
for app, line in ((stand, "stand recipes"), (stand, "stand plan demo"), (compensate, "compensate schema --help")):
    sys.argv = line.split()
    try:
        app()
    except SystemExit as end:
        assert not end.code
[getattr(thermostand, name) for name in dir(thermostand)]
"""


def test_each_folder_is_linked_into_the_package():
    linked = {path.name for path in (ROOT / "thermostand").iterdir() if path.is_symlink()}
    assert linked == set(FOLDERS)
    assert all((ROOT / "thermostand" / folder).resolve() == ROOT / folder for folder in FOLDERS)


def test_files_of_the_same_names_in_a_notebooks_folder_are_not_imported(tmp_path: Path):
    for folder in FOLDERS:
        (tmp_path / f"{folder}.py").write_text("raise SystemExit('a stranger was imported')\n")
    tail = f"\nimport sys; sys.stderr.write('bare ' + ' '.join({{*{FOLDERS}}} & {{*sys.modules}}))"
    done = subprocess.run(
        [sys.executable, "-c", PROGRAMS + EVERYTHING + tail], cwd=tmp_path, capture_output=True, text=True
    )
    assert (done.returncode, done.stderr.splitlines()[-1:]) == (0, ["bare "]), done.stderr


def test_a_wheel_built_of_the_source_package_holds_all_folders_and_no_other_name(tmp_path: Path):
    build = "import hatchling.build as build, sys; print(getattr(build, sys.argv[1])(sys.argv[2]))"
    options = {"cwd": ROOT, "capture_output": True, "text": True, "check": True}
    subprocess.run([sys.executable, "-c", build, "build_sdist", str(tmp_path)], **options)
    (source,) = tmp_path.glob("*.tar.gz")
    with tarfile.open(source) as archive:
        archive.extractall(tmp_path, filter="data")
    options["cwd"] = tmp_path / source.name.removesuffix(".tar.gz")
    subprocess.run([sys.executable, "-c", build, "build_wheel", str(tmp_path)], **options)
    (wheel,) = tmp_path.glob("*.whl")
    names = zipfile.ZipFile(wheel).namelist()
    tops = {name.partition("/")[0] for name in names}
    assert {top for top in tops if not top.endswith(".dist-info")} == {"thermostand"}
    tracked = subprocess.run(["git", "ls-files", *FOLDERS], cwd=ROOT, capture_output=True, text=True, check=True)
    missing = {f"thermostand/{name}" for name in tracked.stdout.split("\n") if name} - set(names)
    assert missing == set()
