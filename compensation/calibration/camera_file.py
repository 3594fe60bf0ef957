"""The camera file: a calibration with its covariances, board, table and scores, as JSON (which is YAML, too).

camera = CameraFile.load(path)
pose = find_pose(camera.lens, camera.board_points, detection.centres_px, detection.covariance_px2)
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from compensation.calibration.adjustment import Adjustment
from compensation.calibration.board import Board
from compensation.calibration.calibrate import Calibration
from compensation.calibration.pinhole import NAMES, Pinhole
from compensation.calibration.rays import RayLens, exponents
from compensation.calibration.stage_geometry import PARAMETERS
from foundation.documents import Document, load_json
from foundation.files import write_whole
from foundation.json_values import plain

FORMAT = "thermostand camera"

Size = tuple[Annotated[int, Field(gt=0)], Annotated[int, Field(gt=0)]]
Pair = tuple[float, float]
Triple = tuple[float, float, float]
Row = tuple[float, ...]
Matrix3 = tuple[Triple, Triple, Triple]


class Fit(Document):
    """How the adjustment went. rms_px, detection_sigma_px: per coordinate; ratio: of the two, marker by marker.
    discrepancy_px: what noise and priors do not explain. chi: of all residuals per degree of freedom."""

    rms_px: float
    detection_sigma_px: float
    ratio: float
    discrepancy_px: float
    chi: float
    markers: int
    outliers: int
    frame_scatter_chi: float | None


class TablePart(Document):
    """The axes and the target's mount in the camera's frame, and per position what was recorded and what was wrong
    with it: errors d (mm) and w (rad) of compensation/calibration/stage_geometry.py, RMS residual per coordinate."""

    base_mm: Triple
    linear: Triple
    rotary: Triple
    mount: Matrix3
    offset_mm: Triple
    linear_mm: Row
    rotary_deg: Row
    errors_mm_rad: tuple[Row, ...]
    rms_px: tuple[float | None, ...]


class BoardPart(Document):
    """Adjusted marker centres, their standard uncertainties, and the diameters."""

    points_mm: tuple[Triple, ...]
    sigma_mm: tuple[Triple, ...]
    diameters_mm: Row


class RaysPart(Document):
    """compensation/calibration/rays.py; terms (p, q) are T_p(x) T_q(y), coefficients those of a and b, for X and Y."""

    degree: Annotated[int, Field(ge=1, le=9)]
    terms_pq: tuple[tuple[int, int], ...]
    coefficients_mm: tuple[tuple[Row, Row], tuple[Row, Row]]
    covariance_mm2: tuple[Row, ...]
    range_mm: Pair
    hull_px: Annotated[tuple[Pair, ...], Field(min_length=3)]


class ScorePart(Document):
    """Hold-out score of a model (compensation/calibration/model_scores.py)."""

    model: str
    rms_px: float
    sigma_px: float
    positions: int


class UncertaintyPart(Document):
    """Standard uncertainty of the projection, root mean square of both coordinates, at evenly spread pixels.
    halves_rms_px: how far the halves' calibrations differ, null when that is not known."""

    distance_mm: float
    x_px: Row
    y_px: Row
    sigma_px: tuple[tuple[float | None, ...], ...]
    halves_rms_px: float | None


class CameraFile(Document):
    """A calibrated camera. names, vector: fx fy cx cy (px) and the distortion; covariance: of the vector, then a step
    of the table (c mm, l, a, R0 rad, o mm). scores: none when they are not known; not_known: which checks, and why."""

    format: Literal["thermostand camera"] = FORMAT
    schema_version: Literal[1] = 1
    software_version: str
    camera_serial: str
    session_ids: tuple[str, ...]
    target_name: str
    image_size_px: Size
    model: str
    names: tuple[str, ...]
    vector: Row
    covariance: tuple[Row, ...]
    fit: Fit
    table: TablePart
    board: BoardPart
    rays: RaysPart
    scores: tuple[ScorePart, ...]
    uncertainty: UncertaintyPart
    not_known: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _fits_together(self) -> CameraFile:
        if len(self.vector) not in (9, 12) or self.names != NAMES[: len(self.vector)]:
            raise ValueError("names: not those of a pinhole with 5 or 8 distortion terms")
        _square("covariance", self.covariance, len(self.vector) + PARAMETERS)
        terms = exponents(self.rays.degree)
        if list(self.rays.terms_pq) != terms:
            raise ValueError(f"rays.terms_pq: not the {len(terms)} terms of degree {self.rays.degree}, in order")
        if any(len(row) != len(terms) for part in self.rays.coefficients_mm for row in part):
            raise ValueError(f"rays.coefficients_mm: not {len(terms)} coefficients each")
        _square("rays.covariance_mm2", self.rays.covariance_mm2, 2 * len(terms))
        if not len(self.board.points_mm) == len(self.board.sigma_mm) == len(self.board.diameters_mm):
            raise ValueError("board: points_mm, sigma_mm and diameters_mm have different lengths")
        return self

    @property
    def lens(self) -> Pinhole:
        """The pinhole."""
        return Pinhole(np.array(self.vector), self.image_size_px)

    @property
    def ray_lens(self) -> RayLens:
        """The ray model."""
        part = self.rays
        coefficients, covariance = np.array(part.coefficients_mm), np.array(part.covariance_mm2)
        return RayLens(part.degree, coefficients, covariance, part.range_mm, np.array(part.hull_px), self.lens)

    @property
    def adjusted_board(self) -> Board:
        """The board as the calibration left it."""
        part = self.board
        return Board(np.array(part.points_mm), np.array(part.sigma_mm), np.array(part.diameters_mm))

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all; SessionError when the place refuses."""
        write_whole(path, self.model_dump_json(indent=1) + "\n")

    @classmethod
    def load(cls, path: Path) -> CameraFile:
        """The camera in a file that `save` wrote, number for number; SessionError when it is anything else."""
        return load_json(path, lambda text: cls.model_validate_json(text, strict=True), "a camera file")


def camera_file(
    calibration: Calibration,
    *,
    camera_serial: str,
    session_ids: tuple[str, ...],
    target_name: str,
    software_version: str,
) -> CameraFile:
    """Everything a calibration found, as the file holds it."""
    lens = calibration.adjustment.scene.lens
    known = len(lens.vector) + PARAMETERS
    document = {
        "software_version": software_version,
        "camera_serial": camera_serial,
        "session_ids": session_ids,
        "target_name": target_name,
        "image_size_px": lens.image_size,
        "model": calibration.model,
        "names": NAMES[: len(lens.vector)],
        "vector": lens.vector,
        "covariance": calibration.adjustment.covariance[:known, :known],
        "fit": _fit(calibration),
        "table": _table(calibration.adjustment),
        "board": calibration.adjustment.adjusted_board,
        "rays": _rays(calibration.rays),
        "scores": calibration.scores,
        "uncertainty": _uncertainty(calibration),
        "not_known": calibration.not_known,
    }
    return CameraFile.model_validate(plain(document))


def _fit(calibration: Calibration) -> dict[str, object]:
    adjustment = calibration.adjustment
    return {
        "rms_px": adjustment.rms_px,
        "detection_sigma_px": adjustment.positions.sigma_px,
        "ratio": adjustment.reprojection_ratio,
        "discrepancy_px": adjustment.discrepancy_px,
        "chi": adjustment.chi,
        "markers": int(adjustment.used.sum()),
        "outliers": int(adjustment.positions.seen.sum() - adjustment.used.sum()),
        "frame_scatter_chi": adjustment.positions.chi,
    }


def _table(adjustment: Adjustment) -> dict[str, object]:
    positions, squares = adjustment.positions, np.where(adjustment.used[:, :, None], adjustment.residuals_px**2, np.nan)
    return plain(adjustment.scene.table) | {
        "linear_mm": positions.linear_mm,
        "rotary_deg": positions.rotary_deg,
        "errors_mm_rad": adjustment.scene.errors,
        "rms_px": np.sqrt(np.nanmean(squares, axis=(1, 2))),
    }


def _rays(rays: RayLens) -> dict[str, object]:
    return {
        "degree": rays.degree,
        "terms_pq": exponents(rays.degree),
        "coefficients_mm": rays.coefficients,
        "covariance_mm2": rays.covariance,
        "range_mm": rays.range_mm,
        "hull_px": rays.hull_px,
    }


def _uncertainty(calibration: Calibration) -> dict[str, object]:
    found = calibration.uncertainty
    return {
        "distance_mm": found.distance_mm,
        "x_px": found.pixels[0, :, 0],
        "y_px": found.pixels[:, 0, 1],
        "sigma_px": found.sigma_px,
        "halves_rms_px": None if calibration.halves is None else calibration.halves.rms_px,
    }


def _square(name: str, rows: tuple[Row, ...], size: int) -> None:
    if len(rows) != size or any(len(row) != size for row in rows):
        raise ValueError(f"{name}: not {size} x {size}")
