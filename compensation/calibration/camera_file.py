"""The camera file: a calibration with its covariances, board, table and scores, as JSON (which is YAML, too).

camera = load_camera(path)
pose = find_pose(camera.lens, camera.board_points, detection.centres_px, detection.covariance_px2)
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from thermostand.compensation.calibration.adjustment import Adjustment
from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.calibrate import CameraCalibration
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pinhole import NAMES, Pinhole
from thermostand.compensation.calibration.rays import RayLens, list_exponents
from thermostand.compensation.calibration.stage_geometry import ERRORS, PARAMETERS
from thermostand.compensation.calibration.uncertainty import NOT_SEEN
from thermostand.compensation.drift.hull import is_area
from thermostand.compensation.value_checks import (
    Hull,
    Length,
    NotNegative,
    Pair,
    Size,
    check_covariance,
    check_shape,
    check_within_image,
)
from thermostand.foundation.documents import Document, load_json
from thermostand.foundation.errors import CalibrationError
from thermostand.foundation.files import write_atomically
from thermostand.foundation.json_values import make_plain

FORMAT = "thermostand camera"

_LONGEST_FOCAL = 1000  # times the image's larger side; a telescope's lens has 300
_FARTHEST_CENTRE = 10  # of the image from the principal point, in larger sides: far more than a shifted lens has
_TURNED = 1e-6  # from a rotation, or a unit vector, by rounding

Triple = tuple[float, float, float]
Place = tuple[Length, Length, Length]
Row = tuple[float, ...]
Matrix3 = tuple[Triple, Triple, Triple]


class Fit(Document):
    """How the adjustment went. rms_px, detection_sigma_px: per coordinate; ratio: of the two, marker by marker.
    discrepancy_px: what noise and priors do not explain. chi: of all residuals per degree of freedom."""

    rms_px: NotNegative
    detection_sigma_px: NotNegative
    ratio: NotNegative
    discrepancy_px: NotNegative
    chi: NotNegative
    markers: int
    outliers: int
    frame_scatter_chi: NotNegative | None


class TablePart(Document):
    """The axes and the target's mount in the camera's frame, and per position what was recorded and what was wrong
    with it: errors d (mm) and w (rad) of compensation/calibration/stage_geometry.py, RMS residual per coordinate."""

    base_mm: Place
    linear: Triple
    rotary: Triple
    mount: Matrix3
    offset_mm: Place
    linear_mm: Row
    rotary_deg: Row
    errors_mm_rad: tuple[Row, ...]
    rms_px: tuple[NotNegative | None, ...]

    @model_validator(mode="after")
    def _check_consistent(self) -> TablePart:
        positions = len(self.linear_mm)
        check_shape("rotary_deg", self.rotary_deg, (positions,))
        check_shape("errors_mm_rad", self.errors_mm_rad, (positions, ERRORS))
        if len(self.rms_px) != positions:
            raise ValueError(f"rms_px: {len(self.rms_px)} for {positions} positions")
        mount = np.array(self.mount)
        if np.abs(mount @ mount.T - np.eye(3)).max() > _TURNED or np.linalg.det(mount) < 0:
            raise ValueError("mount: not a rotation")
        if np.abs(np.linalg.norm([self.linear, self.rotary], axis=1) - 1).max() > _TURNED:
            raise ValueError("linear, rotary: not of length 1")
        return self


class BoardPart(Document):
    """Adjusted marker centres, their standard uncertainties, and the diameters."""

    points_mm: tuple[Place, ...]
    sigma_mm: tuple[tuple[NotNegative, NotNegative, NotNegative], ...]
    diameters_mm: tuple[Annotated[float, Field(gt=0, le=1e6)], ...]


class RaysPart(Document):
    """compensation/calibration/rays.py; terms (p, q) are T_p(x) T_q(y), coefficients those of a and b, for X and Y."""

    degree: Annotated[int, Field(ge=1, le=9)]
    terms_pq: tuple[tuple[int, int], ...]
    coefficients_mm: tuple[tuple[Row, Row], tuple[Row, Row]]
    covariance_mm2: tuple[Row, ...]
    range_mm: Pair
    hull_px: Hull

    @model_validator(mode="after")
    def _check_consistent(self) -> RaysPart:
        count = len(list_exponents(self.degree))
        if list(self.terms_pq) != list_exponents(self.degree):
            raise ValueError(f"terms_pq: not the {count} terms of degree {self.degree}, in order")
        check_shape("coefficients_mm", self.coefficients_mm, (2, 2, count))
        check_shape("covariance_mm2", self.covariance_mm2, (2 * count, 2 * count))
        return self


class ScorePart(Document):
    """Hold-out score of a model (compensation/calibration/calibrate.py)."""

    model: str
    rms_px: NotNegative
    sigma_px: NotNegative
    positions: int


class UncertaintyPart(Document):
    """Standard uncertainty of the projection, root mean square of both coordinates, at evenly spread pixels; null where
    no marker was near, which not_seen says. halves_rms_px: how far the halves' calibrations differ where both have
    seen, null when that is not known."""

    distance_mm: float
    x_px: Row
    y_px: Row
    sigma_px: tuple[tuple[NotNegative | None, ...], ...]
    halves_rms_px: NotNegative | None
    not_seen: str = ""

    @model_validator(mode="after")
    def _check_consistent(self) -> UncertaintyPart:
        check_shape("sigma_px", self.sigma_px, (len(self.y_px), len(self.x_px)))
        return self


class CameraFile(Document):
    """A calibrated camera, as its file holds it.

    Attributes
    ----------
    names, vector
        Names and values of fx, fy, cx, cy (px) and of the distortion.
    covariance
        Covariance of `vector`, then of a step of the table (c mm, l, a, R0 rad, o mm).
    scores
        RMS at held-out positions; none when it is not known.
    not_known
        Which checks are not known, and why.
    rays_warning
        Why the file has no rays, or why not to use them; "" when they describe the lens.
    """

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
    rays: RaysPart | None
    scores: tuple[ScorePart, ...]
    uncertainty: UncertaintyPart
    not_known: tuple[str, ...] = ()
    rays_warning: str = ""

    @model_validator(mode="after")
    def _check_consistent(self) -> CameraFile:
        if len(self.vector) not in (9, 12) or self.names != NAMES[: len(self.vector)]:
            raise ValueError("names: not those of a pinhole with 5 or 8 distortion terms")
        known = len(self.vector) + PARAMETERS
        check_shape("covariance", self.covariance, (known, known))
        if not len(self.board.points_mm) == len(self.board.sigma_mm) == len(self.board.diameters_mm):
            raise ValueError("board: points_mm, sigma_mm and diameters_mm have different lengths")
        return self

    def check_sound(self) -> CameraFile:
        """Itself; ValueError unless covariances are some, and both lenses see the markers that they were made of, less
        than an image away from each other."""
        check_covariance("covariance", np.array(self.covariance))
        side = max(self.image_size_px)
        fx, fy, cx, cy = self.vector[:4]
        if not (0 < fx <= _LONGEST_FOCAL * side and 0 < fy <= _LONGEST_FOCAL * side):
            raise ValueError(f"vector: the focal lengths are {fx:.3g} and {fy:.3g} px for an image of {side} px")
        if max(abs(cx), abs(cy)) > _FARTHEST_CENTRE * side:
            raise ValueError(f"vector: the centre is at {cx:.3g}, {cy:.3g} px of an image of {side} px")
        middle = (np.array(self.image_size_px) - 1.0) / 2
        self._compute_slopes(middle if self.rays is None else np.array(self.rays.hull_px))
        if self.rays is not None:
            self._check_rays(self.rays)
        return self

    def _compute_slopes(self, pixels: Float) -> Float:
        """(..., 2), of the pinhole."""
        with np.errstate(all="ignore"):  # of numbers that are refused here
            slopes = self.lens.compute_slopes(pixels)
        if not np.isfinite(slopes).all():
            raise ValueError("vector: this distortion folds the image where the markers were seen")
        return slopes

    def _check_rays(self, rays: RaysPart) -> None:
        check_covariance("rays.covariance_mm2", np.array(rays.covariance_mm2))
        if not 0 < rays.range_mm[0] < rays.range_mm[1]:
            raise ValueError("rays.range_mm: not near, far")
        hull_px = np.array(rays.hull_px)
        if not is_area(hull_px):
            raise ValueError("rays.hull_px: not the corners of a convex area, in order")
        with np.errstate(all="ignore"):
            apart_px = (
                np.abs(self.ray_lens.compute_slopes(hull_px) - self._compute_slopes(hull_px)) * self.lens.focal_px
            )
        check_within_image("rays.coefficients_mm", apart_px, self.image_size_px)

    @property
    def lens(self) -> Pinhole:
        """The pinhole."""
        return Pinhole(np.array(self.vector), self.image_size_px)

    @property
    def ray_lens(self) -> RayLens:
        """The ray model; CalibrationError when the file has none."""
        if (part := self.rays) is None:
            raise CalibrationError(f"the camera file has no ray model: {self.rays_warning or 'it was left out'}")
        coefficients, covariance = np.array(part.coefficients_mm), np.array(part.covariance_mm2)
        return RayLens(part.degree, coefficients, covariance, part.range_mm, np.array(part.hull_px), self.lens)

    @property
    def adjusted_board(self) -> Board:
        """The board as the calibration left it."""
        part = self.board
        return Board(np.array(part.points_mm), np.array(part.sigma_mm), np.array(part.diameters_mm))

    def save(self, path: Path) -> None:
        """Write the file, whole or not at all; SessionError when the place refuses."""
        write_atomically(path, self.model_dump_json(indent=1) + "\n")


def load_camera(path: Path | str) -> CameraFile:
    """Load the camera from a file that `save` wrote, number for number.

    Parameters
    ----------
    path
        The JSON file.

    Returns
    -------
    CameraFile
        The camera.

    Raises
    ------
    SessionError
        When it is anything else, or of another version.
    """
    return load_json(
        path, lambda text: CameraFile.model_validate_json(text, strict=True).check_sound(), "a camera file"
    )


def build_camera_file(
    calibration: CameraCalibration,
    *,
    camera_serial: str,
    session_ids: tuple[str, ...],
    target_name: str,
    software_version: str,
    keep_rays: bool = False,
) -> CameraFile:
    """Everything a calibration found, as the file holds it; of a ray model that does not describe the lens why not,
    unless keep_rays."""
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
        "fit": _describe_fit(calibration),
        "table": _describe_table(calibration.adjustment),
        "board": calibration.adjustment.adjusted_board,
        "rays": None if calibration.rays_warning and not keep_rays else _describe_rays(calibration.rays),
        "rays_warning": calibration.rays_warning,
        "scores": calibration.scores,
        "uncertainty": _describe_uncertainty(calibration),
        "not_known": calibration.not_known,
    }
    return CameraFile.model_validate(make_plain(document))


def _describe_fit(calibration: CameraCalibration) -> dict[str, object]:
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


def _describe_table(adjustment: Adjustment) -> dict[str, object]:
    positions, squares = adjustment.positions, np.where(adjustment.used[:, :, None], adjustment.residuals_px**2, np.nan)
    return make_plain(adjustment.scene.table) | {
        "linear_mm": positions.linear_mm,
        "rotary_deg": positions.rotary_deg,
        "errors_mm_rad": adjustment.scene.errors,
        "rms_px": np.sqrt(np.nanmean(squares, axis=(1, 2))),
    }


def _describe_rays(rays: RayLens) -> dict[str, object]:
    return {
        "degree": rays.degree,
        "terms_pq": list_exponents(rays.degree),
        "coefficients_mm": rays.coefficients,
        "covariance_mm2": rays.covariance,
        "range_mm": rays.range_mm,
        "hull_px": rays.hull_px,
    }


def _describe_uncertainty(calibration: CameraCalibration) -> dict[str, object]:
    found = calibration.uncertainty
    return {
        "distance_mm": found.distance_mm,
        "x_px": found.pixels[0, :, 0],
        "y_px": found.pixels[:, 0, 1],
        "sigma_px": found.sigma_px,
        "halves_rms_px": None if calibration.halves is None else calibration.halves.rms_px,
        "not_seen": NOT_SEEN if np.isnan(found.sigma_px).any() else "",
    }
