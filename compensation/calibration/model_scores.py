"""Models compared on data they were not fitted to: positions held out, and the two halves of a session."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.adjustment import Adjustment, adjust, start_of
from thermostand.compensation.calibration.board import Board
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pose import Lens, find_pose
from thermostand.compensation.calibration.rays import DEGREES, RayLens, fit_rays
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.compensation.calibration.uncertainty import CameraDifference, difference
from thermostand.foundation.errors import CalibrationError

BROWN, RATIONAL = "pinhole, Brown", "pinhole, rational"
_FOLDS = 5


@dataclass(frozen=True, slots=True)
class ModelScore:
    """rms_px: of held-out markers per coordinate about the pose found from them, corrected for the pose's six degrees
    of freedom. sigma_px: its standard error from the scatter between positions. positions: how many were held out."""

    model: str
    rms_px: float
    sigma_px: float
    positions: int


Check = TypeVar("Check")


def known_or_why(check: Callable[[], Check]) -> tuple[Check | None, str]:
    """What a check of a result gives, or None and why it cannot be made: the result stands without it."""
    try:
        return check(), ""
    except CalibrationError as error:
        return None, str(error)


def rays_of(adjustment: Adjustment, degree: int) -> RayLens:
    """The ray model of a degree through the adjusted markers."""
    return fit_rays(degree, *_used(adjustment), adjustment.scene.lens, adjustment.hull_px)


def times_the_pinhole(adjustment: Adjustment, rays: RayLens, scores: tuple[ModelScore, ...]) -> float:
    """What the rays leave over what the pinhole leaves: RMS at held-out positions, and without these residuals in
    units of the noise and of what the pinhole does not explain."""
    of = {score.model: score.rms_px for score in scores}
    if scores:
        return of[ray_name(rays.degree)] / min(of[BROWN], of[RATIONAL])
    pixels, points_mm, sigma_px = _used(adjustment)
    return float(np.sqrt(np.mean((rays.misfit(points_mm, pixels) / sigma_px[:, None]) ** 2)))


def _used(adjustment: Adjustment) -> tuple[Float, Float, Float]:
    """Pixels (M, 2), points (M, 3), mm, of the camera's frame, and sigma (M,), px, of the markers that were used."""
    used, positions = adjustment.used, adjustment.positions
    rotations, translations = adjustment.poses()
    points = np.einsum("pij,nj->pni", rotations, adjustment.scene.points_mm) + translations[:, None]
    variance = np.trace(positions.covariance_px2[used], axis1=1, axis2=2) / 2 + adjustment.discrepancy_px**2
    return positions.centres_px[used], points[used], np.sqrt(variance)


def score_models(positions: Positions, board: Board, sigma: TableSigma) -> tuple[ModelScore, ...]:
    """Hold-out scores of all models: each position is left out once, in as many folds as there may be."""
    fold = np.arange(len(positions.linear_mm)) % _FOLDS
    squares: dict[str, list[float]] = {}
    for number in range(_FOLDS):
        kept, held = positions.part(fold != number), positions.part(fold == number)
        for name, lens, adjusted in _models(kept, board, sigma):
            squares.setdefault(name, []).extend(_held_out_squares(lens, adjusted, held))
    return tuple(_score(name, np.array(values)) for name, values in squares.items())


def best(scores: tuple[ModelScore, ...]) -> str:
    """The simplest model (they come in order) whose score is within one standard error of the best."""
    lowest = min(scores, key=lambda score: score.rms_px)
    return next(score.model for score in scores if score.rms_px <= lowest.rms_px + lowest.sigma_px)


def halves(
    positions: Positions, board: Board, sigma: TableSigma, distance_mm: float, *, rational: bool
) -> CameraDifference:
    """What the calibrations from every other position and from the rest say differently."""
    odd = np.arange(len(positions.linear_mm)) % 2 == 1
    first, second = (adjust(positions.part(chosen), board, sigma, rational=rational) for chosen in (~odd, odd))
    return difference(first, second, distance_mm)


def ray_name(degree: int) -> str:
    """What the ray model of a degree is called in a score."""
    return f"rays, degree {degree}"


def _models(positions: Positions, board: Board, sigma: TableSigma) -> list[tuple[str, Lens, Board]]:
    start = start_of(positions, board)
    brown = adjust(positions, board, sigma, start=start)
    rational = adjust(positions, board, sigma, rational=True, start=start)
    rays = [(ray_name(degree), rays_of(brown, degree), brown.adjusted_board) for degree in DEGREES]
    return [
        (BROWN, brown.scene.lens, brown.adjusted_board),
        (RATIONAL, rational.scene.lens, rational.adjusted_board),
        *rays,
    ]


def _held_out_squares(lens: Lens, board: Board, held: Positions) -> list[float]:
    """Mean square residual per coordinate, px^2, of each held-out position with enough markers."""
    found: list[float] = []
    for centres, covariance in zip(held.centres_px, held.covariance_px2, strict=True):
        inside = _inside(lens, centres)
        if np.count_nonzero(inside) < 12:
            continue
        kept = np.where(inside[:, None], centres, np.nan)
        try:
            pose = find_pose(lens, board, kept, covariance)
        except CalibrationError:
            continue
        squares = pose.residuals_px[inside] ** 2
        found.append(float(squares.sum() / (squares.size - 6)))
    return found


def _inside(lens: Lens, centres_px: Float) -> NDArray[np.bool_]:
    """Markers that are seen, and for the ray model within its hull: it must not be extrapolated."""
    seen = np.isfinite(centres_px[:, 0])
    if isinstance(lens, RayLens):
        seen[seen] = lens.inside(centres_px[seen])
    return seen


def _score(model: str, squares: Float) -> ModelScore:
    rms = float(np.sqrt(squares.mean()))
    return ModelScore(model, rms, float(squares.std() / np.sqrt(len(squares)) / (2 * rms)), len(squares))
