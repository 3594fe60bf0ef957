"""Stands' files from before 2026-11-22: one `camera`, and thermometers below the module that reads them. They still
open, and so do the sessions that have them attached.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import cast

CAMERA = "camera"  # the name of the only camera there was
_CHANNELS = "channels"


def is_older(data: Mapping[str, object]) -> bool:
    """Whether the file has an older form."""
    return CAMERA in data or _module_of(data) is not None


def renewed(data: Mapping[str, object]) -> dict[str, object]:
    """The same content in today's form, which is left as it is. ValueError when both forms are given."""
    new = dict(data)
    if CAMERA in new:
        if "cameras" in new:
            raise ValueError("camera and cameras are both given; move the camera into cameras, under a name of its own")
        new["cameras"] = {CAMERA: new.pop(CAMERA)}
    if (thermometers := _module_of(new)) is not None:
        if "thermometer_module" in new:
            raise ValueError("thermometer_module and thermometers.channels are both given; take only one of them")
        module = {key: value for key, value in thermometers.items() if key != _CHANNELS}
        new = {**new, "thermometer_module": module, "thermometers": thermometers.get(_CHANNELS)}
    if (guard := new.get("guard")) is not None and isinstance(guard, dict):
        new["guard"] = _accepting(cast("dict[str, object]", guard))
    return new


def _module_of(data: Mapping[str, object]) -> dict[str, object] | None:
    thermometers = data.get("thermometers")
    is_module = isinstance(thermometers, dict) and _CHANNELS in thermometers
    return cast("dict[str, object]", thermometers) if is_module else None


def renewed_path(path: str) -> str:
    """The path of a value that guard.accept names, in today's form."""
    older = f"thermometers.{_CHANNELS}."
    return f"thermometers.{path.removeprefix(older)}" if path.startswith(older) else path


def _accepting(guard: dict[str, object]) -> dict[str, object]:
    accept = guard.get("accept")
    if not isinstance(accept, list):
        return guard
    paths = cast("list[object]", accept)
    return {**guard, "accept": [renewed_path(path) if isinstance(path, str) else path for path in paths]}
