"""A drift model as a ROS 2 package: the node, the runtime module and the model, to be built by colcon where ROS is."""

from __future__ import annotations

import importlib.resources
from pathlib import Path

from thermostand.compensation.apply.runtime_export import export
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.foundation.files import make_folder, write_whole

PACKAGE = "camera_drift"


def export_ros2(model: DriftModel, folder: Path) -> tuple[Path, ...]:
    """Write the package `camera_drift` into `folder`, made when it is missing; each file whole or not at all.

    SessionError when the place refuses.
    """
    module = folder / PACKAGE
    written = list(export(model, _made(folder) / PACKAGE))
    files = {
        folder / "package.xml": _text("package.xml"),
        folder / "setup.py": _text("setup.py.txt"),
        folder / "setup.cfg": _text("setup.cfg"),
        _made(folder / "resource") / PACKAGE: "",
        module / "__init__.py": "",
        module / "drift_node.py": _text("drift_node.py"),
    }
    for path, text in files.items():
        write_whole(path, text.replace("@VERSION@", _version(model)))
        written.append(path)
    return tuple(written)


def _made(folder: Path) -> Path:
    make_folder(folder)
    return folder


def _text(name: str) -> str:
    return (
        importlib.resources.files("thermostand.compensation.apply").joinpath("ros2", name).read_text(encoding="utf-8")
    )


def _version(model: DriftModel) -> str:
    """Three numbers, as package.xml wants them."""
    parts = [part for part in model.facts.software_version.split(".") if part.isdecimal()]
    return ".".join([*parts, "0", "0", "0"][:3])
