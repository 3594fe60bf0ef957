"""A validation read back from the JSON that document.py wrote: array for array the same, null being NaN again."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from compensation.drift.drift_model import Outside
from compensation.observations import Float
from compensation.validation3d.deviations import Deviations
from compensation.validation3d.validate import Validation
from foundation.documents import Document, load_json
from foundation.errors import SessionError

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


def load_validation(path: Path) -> Validation:
    """The validation in a file of `compensate validate`; SessionError when it is anything else."""
    file = load_json(path, lambda text: _File.model_validate_json(text, strict=True), "a validation")
    try:
        return _validation(file)
    except (ValueError, KeyError) as error:
        raise SessionError(f"{path}: not a validation of this program (its arrays do not fit: {error})") from error


def _validation(file: _File) -> Validation:
    shape = (len(file.chamber_degC), len(file.positions))
    variants = [_deviations(one, shape) for one in file.results]
    before, after, camera_alone, with_stand = (*variants, None, None)[:4]
    if before is None or after is None:  # the file has at least two
        raise ValueError("results")
    return Validation(
        names=tuple(one.name for one in file.positions),
        linear_mm=np.array([one.linear_mm for one in file.positions]),
        rotary_deg=np.array([one.rotary_deg for one in file.positions]),
        distance_mm=np.array([one.distance_mm for one in file.positions]),
        chamber_degC=np.array(file.chamber_degC),
        camera_degC=_array(file.camera_degC, shape[:1]),
        frame_count=np.array(file.frames, np.int64).reshape(shape),
        outside=_array(file.outside_valid_range, shape),
        flags=np.array([[_flags(names) for names in row] for row in file.outside_because], np.uint8).reshape(shape),
        before=before,
        after=after,
        camera_alone=camera_alone,
        with_stand=with_stand,
        lens=file.camera_model,
        model=file.drift_model,
        session_id=file.session_id,
        simulated=file.simulated,
    )


def _deviations(one: _Result, shape: tuple[int, int]) -> Deviations:
    in_space = (*shape, 3)
    return Deviations(
        name=one.name,
        translation_um=_array(one.translation_um, in_space),
        rotation_mrad=_array(one.rotation_mrad, in_space),
        noise_um=_array(one.noise_um, in_space),
        model_um=_array(one.model_um, in_space),
        stand_um=_array(one.stand_um, in_space),
        u_mrad=_array(one.u_mrad, in_space),
        repeat_um=_array(one.v0_again_um, (shape[0], 3)),
        table_um=_array(one.table_um, (3,)),
        chi=_array(one.chi, shape),
    )


def _array(values: _Row | _Grid | _Cube, shape: tuple[int, ...]) -> Float:
    """ValueError when the values have another shape."""
    found = np.array(values, np.float64)
    if found.shape != shape:
        raise ValueError(f"{found.shape} instead of {shape}")
    return found


def _flags(names: tuple[str, ...]) -> int:
    """KeyError for a name that is no reason."""
    found = 0
    for name in names:
        found |= Outside[name.upper().replace(" ", "_")]
    return found
