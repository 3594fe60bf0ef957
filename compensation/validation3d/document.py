"""A validation as JSON, every number with its unit in its name; null where there is no pose."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np

from compensation.drift.drift_model import Outside
from compensation.validation3d.deviations import Deviations
from compensation.validation3d.paper import AFTER_mm, BEFORE_mm
from compensation.validation3d.validate import Validation
from compensation.validation3d.validation_text import reason_names

FORMAT = "thermostand validation"
SCHEMA_VERSION = 1


def as_json(validation: Validation) -> str:
    """The document's text. Arrays are [temperature][position][X, Y, Z]; temperature 0 is the reference."""
    document = {
        "format": FORMAT,
        "schema_version": SCHEMA_VERSION,
        "session_id": validation.session_id,
        "simulated": validation.simulated,
        "camera_model": validation.lens,
        "drift_model": validation.model,
        "axes": "of the calibrated camera: X right and Y down in the image, Z away from the camera",
        "positions": [
            {"name": name, "linear_mm": linear, "rotary_deg": rotary, "distance_mm": distance}
            for name, linear, rotary, distance in zip(
                validation.names, validation.linear_mm, validation.rotary_deg, validation.distance_mm, strict=True
            )
        ],
        "chamber_degC": validation.chamber_degC,
        "camera_degC": validation.camera_degC,
        "frames": validation.frame_count,
        "outside_valid_range": validation.outside,
        "outside_because": [[reason_names(Outside(int(flag))) for flag in row] for row in validation.flags],
        "paper_mean_um": {"before": [1e3 * mm for mm in BEFORE_mm], "after": [1e3 * mm for mm in AFTER_mm]},
        "results": [_result(one) for one in validation.variants],
    }
    return json.dumps(_plain(document), indent=1, allow_nan=False) + "\n"


def _result(one: Deviations) -> dict[str, Any]:
    return {
        "name": one.name,
        "mean_um": one.mean_um,
        "u_mean_um": one.u_mean_um,
        "per_temperature_um": one.per_temperature_um,
        "u_per_temperature_um": one.u_per_temperature_um,
        "translation_um": one.translation_um,
        "u_um": one.u_um,
        "noise_um": one.noise_um,
        "model_um": one.model_um,
        "stand_um": one.stand_um,
        "table_um": one.table_um,
        "rotation_mrad": one.rotation_mrad,
        "u_mrad": one.u_mrad,
        "mean_rotation_mrad": one.mean_rotation_mrad,
        "v0_again_um": one.repeat_um,
        "chi": one.chi,
    }


def _plain(value: Any) -> Any:
    """Lists, numbers and null of arrays and NaN, at any depth."""
    match value:
        case np.ndarray():
            return _plain(value.tolist())
        case np.generic():
            return _plain(value.item())
        case dict():
            return {key: _plain(item) for key, item in value.items()}
        case list() | tuple():
            return [_plain(item) for item in value]
        case float() if not math.isfinite(value):
            return None
        case _:
            return value
