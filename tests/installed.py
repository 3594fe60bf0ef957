"""A package of somebody else, as an installer leaves it."""

import os
import subprocess
from collections.abc import Mapping
from pathlib import Path

import pytest

from thermostand.stand.assembly import simulator


def install(
    folder: Path, name: str, modules: Mapping[str, str], points: Mapping[str, str], version: str = "1.0"
) -> None:
    """Write the package `name` into `folder`. modules: their texts by their names; points: lines `NAME = MODULE:WHAT`
    by the group of entry points."""
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir(parents=True)
    for module, text in modules.items():
        (folder / f"{module}.py").write_text(text)
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = (f"[{group}]\n{lines}\n" for group, lines in points.items())
    (info / "entry_points.txt").write_text("".join(groups))


def see_it_everywhere(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is installed in `folder` is found by this program and by those that it starts, its laboratory among them."""
    monkeypatch.syspath_prepend(folder)
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")]))
    monkeypatch.setattr(simulator, "subprocess", subprocess)  # not a fork of this one
