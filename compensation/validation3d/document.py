"""A validation as JSON, every number with its unit in its name and null where there is no pose, and read back from it:
array for array the same, null being NaN again.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from thermostand.compensation.drift.drift_model import Outside
from thermostand.compensation.observations import Float
from thermostand.compensation.validation3d.validate import Deviations, SpatialValidation
from thermostand.foundation.documents import Document, load_json
from thermostand.foundation.errors import SessionError
from thermostand.foundation.json_values import make_plain

# What the paper reports (Sensors 2018, 18, 3685, section 7): figure 15's averages and Table 1, mm.

Triple = tuple[float, float, float]

BEFORE_mm: Triple = (0.0177, 0.1343, 0.1420)
AFTER_mm: Triple = (0.0124, 0.0254, 0.0287)
"""Mean over 11 temperatures of the mean absolute deviations of V0..V3, along X, Y, Z."""


@dataclass(frozen=True, slots=True)
class PaperTemperature:
    """One temperature of Table 1. camera_degC: of the sensor. before_mm, after_mm: deviations of V0..V3."""

    camera_degC: float
    before_mm: tuple[Triple, ...]
    after_mm: tuple[Triple, ...]
    mean_before_mm: Triple
    mean_after_mm: Triple


TABLE_1 = (
    PaperTemperature(
        55.55,
        ((0.0171, 0.0289, 0.1174), (-0.0093, 0.0193, 0.2016), (0.0000, 0.0537, 0.0174), (0.0157, 0.0341, 0.0481)),
        ((0.0093, -0.0034, 0.0354), (-0.0139, -0.0081, 0.0341), (-0.0041, 0.0312, -0.0761), (0.0092, 0.0150, -0.0244)),
        (0.0105, 0.0340, 0.0961),
        (0.0091, 0.0144, 0.0425),
    ),
    PaperTemperature(
        67.05,
        (
            (-0.0366, -0.1943, 0.1911),
            (-0.0129, -0.2312, 0.3267),
            (-0.0352, -0.2235, 0.2352),
            (-0.0344, -0.2015, 0.1775),
        ),
        ((0.0026, -0.0058, -0.0156), (0.0327, -0.0121, 0.1198), (0.0228, 0.0592, 0.0187), (0.0234, 0.0873, -0.0455)),
        (0.0298, 0.2126, 0.2326),
        (0.0204, 0.0411, 0.0499),
    ),
)


def format_summary(validation: SpatialValidation) -> str:
    """Write the mean absolute deviation along X, Y, Z with its standard uncertainty, for every variant; rotation and
    table."""
    width = max(len(one.name) for one in validation.variants) + 2
    where = " (simulated)" if validation.simulated else ""
    lines = [
        f"mean absolute deviation of {', '.join(validation.names)} from {validation.chamber_degC[0]:g} degC over "
        f"{len(validation.chamber_degC) - 1} temperatures{where}, um",
        f"{'':<{width}}{'X':>17}{'Y':>17}{'Z':>17}",
        _format_paper_line("paper, before", BEFORE_mm, width),
        _format_paper_line("paper, after", AFTER_mm, width),
    ]
    for one in validation.variants:
        cells = (format_with_limit(value, u) for value, u in zip(one.mean_um, one.u_mean_um, strict=True))
        lines.append(f"{one.name:<{width}}" + "".join(f"{cell:>17}" for cell in cells))
    table_um, rotation_mrad = validation.after.table_um, validation.after.mean_rotation_mrad
    lines += [
        f"table repeatability from V0 seen again: {_format_triple(table_um)} um; "
        f"rotation after compensation: {_format_triple(rotation_mrad, 3)} mrad",
        describe_flags(validation),
    ]
    return "\n".join(lines)


def format_with_limit(value_um: float, u_um: float) -> str:
    """A mean absolute value, which is never below 0, so that no symmetrical interval belongs to it: 0.10 (u ≤ 0.69)."""
    return f"{value_um:.2f} (u ≤ {u_um:.2f})"


def describe_flags(validation: SpatialValidation) -> str:
    """Return what of the corrections was beyond the model's valid range, and why."""
    reasons = Outside(int(np.bitwise_or.reduce(validation.flags[np.isfinite(validation.outside)], axis=None)))
    share = float(np.nanmean(validation.outside))
    if not reasons:
        return "all corrections are within the drift model's valid range"
    poses = int(np.count_nonzero(np.nan_to_num(validation.outside)))
    return (
        f"{share:.1%} of the corrections, at {poses} of {validation.outside.size} poses, are outside the drift model's "
        f"valid range ({', '.join(list_reason_names(reasons))})"
    )


def list_reason_names(flags: Outside) -> list[str]:
    """The reasons in a set of flags, in words."""
    return [(flag.name or "").lower().replace("_", " ") for flag in Outside if flag in flags]


def _format_paper_line(name: str, values_mm: tuple[float, float, float], width: int) -> str:
    return f"{name:<{width}}" + "".join(f"{1e3 * value:>14.1f}" for value in values_mm)


def _format_triple(values: Float, digits: int = 2) -> str:
    return " / ".join(f"{value:.{digits}f}" for value in values)


_AXES = "of the calibrated camera: X right and Y down in the image, Z away from the camera"
_WRITTEN_AS = {"repeat_um": "v0_again_um"}  # fields of Deviations

_Number = float | None
_Row = tuple[_Number, ...]
_Grid = tuple[_Row, ...]
_Cube = tuple[_Grid, ...]


class _Position(Document):
    name: str
    linear_mm: float
    rotary_deg: float
    distance_mm: float


class _PaperMean(Document):
    before: _Row
    after: _Row


class _Result(Document):
    """The result of a variant: arrays are [temperature][position][X, Y, Z]; temperature 0 is the reference."""

    name: str
    mean_um: _Row
    u_mean_um: _Row
    per_temperature_um: _Grid
    u_per_temperature_um: _Grid
    translation_um: _Cube
    u_um: _Cube
    noise_um: _Cube
    model_um: _Cube
    stand_um: _Cube
    table_um: _Row
    rotation_mrad: _Cube
    u_mrad: _Cube
    mean_rotation_mrad: _Row
    v0_again_um: _Grid
    chi: _Grid


class _File(Document):
    format: Literal["thermostand validation"]
    schema_version: Literal[1]
    session_id: str
    simulated: bool
    camera_model: str
    drift_model: str
    axes: str
    positions: Annotated[tuple[_Position, ...], Field(min_length=1)]
    chamber_degC: Annotated[tuple[float, ...], Field(min_length=2)]
    camera_degC: _Row
    frames: tuple[tuple[int, ...], ...]
    outside_valid_range: _Grid
    outside_because: tuple[tuple[tuple[str, ...], ...], ...]
    paper_mean_um: _PaperMean
    results: Annotated[tuple[_Result, ...], Field(min_length=2, max_length=4)]


def serialise_validation(validation: SpatialValidation) -> str:
    """The document's text."""
    places = zip(validation.names, validation.linear_mm, validation.rotary_deg, validation.distance_mm, strict=True)
    document = {
        "format": "thermostand validation",
        "schema_version": 1,
        "session_id": validation.session_id,
        "simulated": validation.simulated,
        "camera_model": validation.lens,
        "drift_model": validation.model,
        "axes": _AXES,
        "positions": [dict(zip(_Position.model_fields, place, strict=True)) for place in places],
        "chamber_degC": validation.chamber_degC,
        "camera_degC": validation.camera_degC,
        "frames": validation.frame_count,
        "outside_valid_range": validation.outside,
        "outside_because": [[list_reason_names(Outside(int(flag))) for flag in row] for row in validation.flags],
        "paper_mean_um": {"before": [1e3 * mm for mm in BEFORE_mm], "after": [1e3 * mm for mm in AFTER_mm]},
        "results": [_serialise_result(one) for one in validation.variants],
    }
    return json.dumps(make_plain(document), indent=1, allow_nan=False) + "\n"


def _serialise_result(one: Deviations) -> dict[str, Any]:
    attribute_of = {written: attribute for attribute, written in _WRITTEN_AS.items()}
    return {name: getattr(one, attribute_of.get(name, name)) for name in _Result.model_fields}


def load_validation(path: Path) -> SpatialValidation:
    """The validation in a file of `compensate validate`; SessionError when it is anything else."""
    file = load_json(path, lambda text: _File.model_validate_json(text, strict=True), "a validation")
    try:
        return _build_validation(file)
    except (ValueError, KeyError) as error:
        raise SessionError(f"{path}: not a validation of this program (its arrays do not fit: {error})") from error


def _build_validation(file: _File) -> SpatialValidation:
    shape = (len(file.chamber_degC), len(file.positions))
    before, after, *others = (_build_deviations(one, shape) for one in file.results)
    camera_alone, with_stand = (*others, None, None)[:2]
    return SpatialValidation(
        names=tuple(one.name for one in file.positions),
        linear_mm=np.array([one.linear_mm for one in file.positions]),
        rotary_deg=np.array([one.rotary_deg for one in file.positions]),
        distance_mm=np.array([one.distance_mm for one in file.positions]),
        chamber_degC=np.array(file.chamber_degC),
        camera_degC=_check_array(file.camera_degC, shape[:1]),
        frame_count=np.array(file.frames, np.int64).reshape(shape),
        outside=_check_array(file.outside_valid_range, shape),
        flags=np.array([[_parse_flags(names) for names in row] for row in file.outside_because], np.uint8).reshape(
            shape
        ),
        before=before,
        after=after,
        camera_alone=camera_alone,
        with_stand=with_stand,
        lens=file.camera_model,
        model=file.drift_model,
        session_id=file.session_id,
        simulated=file.simulated,
    )


def _build_deviations(one: _Result, shape: tuple[int, int]) -> Deviations:
    shapes = {"repeat_um": (shape[0], 3), "table_um": (3,), "chi": shape}
    names = [field.name for field in fields(Deviations) if field.name != "name"]
    arrays = {
        name: _check_array(getattr(one, _WRITTEN_AS.get(name, name)), shapes.get(name, (*shape, 3))) for name in names
    }
    return Deviations(one.name, **arrays)


def _check_array(values: _Row | _Grid | _Cube, shape: tuple[int, ...]) -> Float:
    """ValueError when the values have another shape."""
    found = np.array(values, np.float64)
    if found.shape != shape:
        raise ValueError(f"{found.shape} instead of {shape}")
    return found


def _parse_flags(names: tuple[str, ...]) -> int:
    """KeyError for a name that is no reason."""
    found = 0
    for name in names:
        found |= Outside[name.upper().replace(" ", "_")]
    return found
