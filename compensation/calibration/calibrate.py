"""A session's positions -> the calibrated camera, chosen, checked and scored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.adjustment import Adjustment, adjust, find_initial_guess
from thermostand.compensation.calibration.board import Board, make_board
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pinhole import transform_points
from thermostand.compensation.calibration.pose import Lens, find_pose
from thermostand.compensation.calibration.rays import DEGREES, RayLens, fit_rays
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.compensation.calibration.uncertainty import (
    CameraDifference,
    UncertaintyMap,
    compare_calibrations,
    compute_projection_uncertainty,
)
from thermostand.foundation.errors import CalibrationError
from thermostand.markers.target import Target

# Models compared on data they were not fitted to: positions held out, and the two halves of a session.

BROWN, RATIONAL = "pinhole, Brown", "pinhole, rational"
# Each fifth position is held out in turn: the usual number of folds; ten would take twice the time.
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


def try_check(check: Callable[[], Check]) -> tuple[Check | None, str]:
    """Return what a check of a result gives, or None and why it cannot be made: the result stands without it."""
    try:
        return check(), ""
    except CalibrationError as error:
        return None, str(error)


def fit_ray_lens(adjustment: Adjustment, degree: int) -> RayLens:
    """The ray model of a degree through the adjusted markers."""
    return fit_rays(degree, *_collect_used_markers(adjustment), adjustment.scene.lens, adjustment.hull_px)


def compute_rms_ratio(adjustment: Adjustment, rays: RayLens, scores: tuple[ModelScore, ...]) -> float:
    """Return what the rays leave over what the pinhole leaves: RMS at held-out positions, and without these residuals
    in units of the noise and of what the pinhole does not explain."""
    of = {score.model: score.rms_px for score in scores}
    if scores:
        return of[format_ray_name(rays.degree)] / min(of[BROWN], of[RATIONAL])
    pixels, points_mm, sigma_px = _collect_used_markers(adjustment)
    return float(np.sqrt(np.mean((rays.compute_misfit(points_mm, pixels) / sigma_px[:, None]) ** 2)))


def _collect_used_markers(adjustment: Adjustment) -> tuple[Float, Float, Float]:
    """Pixels (M, 2), points (M, 3), mm, of the camera's frame, and sigma (M,), px, of the markers that were used."""
    used, positions = adjustment.used, adjustment.positions
    rotations, translations = adjustment.compute_poses()
    points = transform_points(rotations, translations, adjustment.scene.points_mm)
    variance = np.trace(positions.covariance_px2[used], axis1=1, axis2=2) / 2 + adjustment.discrepancy_px**2
    return positions.centres_px[used], points[used], np.sqrt(variance)


def score_models(positions: Positions, board: Board, sigma: TableSigma) -> tuple[ModelScore, ...]:
    """Hold-out scores of all models: each position is left out once, in as many folds as there may be."""
    fold = np.arange(len(positions.linear_mm)) % _FOLDS
    squares: dict[str, list[float]] = {}
    for number in range(_FOLDS):
        kept, held = positions.select(fold != number), positions.select(fold == number)
        for name, lens, adjusted in _fit_models(kept, board, sigma):
            squares.setdefault(name, []).extend(_score_held_out(lens, adjusted, held))
    return tuple(_summarise_squares(name, np.array(values)) for name, values in squares.items())


def select_model(scores: tuple[ModelScore, ...]) -> str:
    """The simplest model (they come in order) whose score is within one standard error of the best."""
    lowest = min(scores, key=lambda score: score.rms_px)
    return next(score.model for score in scores if score.rms_px <= lowest.rms_px + lowest.sigma_px)


def compare_halves(
    positions: Positions, board: Board, sigma: TableSigma, distance_mm: float, *, rational: bool
) -> CameraDifference:
    """Return what the calibrations from every other position and from the rest say differently."""
    odd = np.arange(len(positions.linear_mm)) % 2 == 1
    first, second = (adjust(positions.select(chosen), board, sigma, rational=rational) for chosen in (~odd, odd))
    return compare_calibrations(first, second, distance_mm)


def format_ray_name(degree: int) -> str:
    """Return what the ray model of a degree is called in a score."""
    return f"rays, degree {degree}"


def _fit_models(positions: Positions, board: Board, sigma: TableSigma) -> list[tuple[str, Lens, Board]]:
    start = find_initial_guess(positions, board)
    brown = adjust(positions, board, sigma, start=start)
    rational = adjust(positions, board, sigma, rational=True, start=start)
    rays = [(format_ray_name(degree), fit_ray_lens(brown, degree), brown.adjusted_board) for degree in DEGREES]
    return [
        (BROWN, brown.scene.lens, brown.adjusted_board),
        (RATIONAL, rational.scene.lens, rational.adjusted_board),
        *rays,
    ]


def _score_held_out(lens: Lens, board: Board, held: Positions) -> list[float]:
    """Return the mean square residual per coordinate, px^2, of each held-out position with enough markers."""
    found: list[float] = []
    for centres, covariance in zip(held.centres_px, held.covariance_px2, strict=True):
        inside = _find_usable_markers(lens, centres)
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


def _find_usable_markers(lens: Lens, centres_px: Float) -> NDArray[np.bool_]:
    """Markers that are seen, and for the ray model within its hull: it must not be extrapolated."""
    seen = np.isfinite(centres_px[:, 0])
    if isinstance(lens, RayLens):
        seen[seen] = lens.inside(centres_px[seen])
    return seen


def _summarise_squares(model: str, squares: Float) -> ModelScore:
    rms = float(np.sqrt(squares.mean()))
    return ModelScore(model, rms, float(squares.std() / np.sqrt(len(squares)) / (2 * rms)), len(squares))


class Model(StrEnum):
    """The choice of a pinhole model. AUTO: the one that does better at positions it was not fitted to."""

    AUTO = "auto"
    BROWN = "brown"
    RATIONAL = "rational"


# Half of it would refuse rays that describe the lens, at up to 1.02 times; twice would take those that do not, at 4.
_MOST_TIMES = 2.0
"""Of 21 drawn lenses, f 900 to 7246 px, 11 with scores at held-out positions: there, rays that describe the lens leave
at most 1.02 times what the pinhole does, those that do not 4 times and more. Without scores the residuals of the fits
are a weaker sign: of one lens they were 1.51 times, where held-out positions gave 4."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """A camera and its table, as calibrated from one or several sessions.

    Attributes
    ----------
    scores
        Scores of all models at held-out positions; none when too few are left to tell.
    model
        The pinhole in use.
    uncertainty, halves
        At the mean distance of the target; `halves` is None when one of them determines no camera.
    not_known
        Of `scores` and `halves`, why they are not known.
    rays_times
        RMS that the rays leave over RMS that the pinhole leaves.
    """

    adjustment: Adjustment
    rays: RayLens
    scores: tuple[ModelScore, ...]
    model: str
    uncertainty: UncertaintyMap
    halves: CameraDifference | None
    not_known: tuple[str, ...] = ()
    rays_times: float = 1.0

    @property
    def rays_warning(self) -> str:
        """Why the ray model is not to be used; "" when it describes the lens."""
        if self.rays_times <= _MOST_TIMES:
            return ""
        return (
            f"the ray model (degree {self.rays.degree}) does not describe this lens: it leaves {self.rays_times:.3g} "
            f"times what the pinhole leaves, and {_MOST_TIMES:g} times is the most; use the pinhole"
        )

    def score(self, model: str) -> ModelScore:
        """The score of a model by its name."""
        return next(score for score in self.scores if score.model == model)


def calibrate(
    positions: Positions, target: Target, sigma: TableSigma | None = None, model: Model = Model.AUTO
) -> CameraCalibration:
    """Adjust, choose pinhole and degree of the rays by held-out positions, and compare the session's halves.

    Parameters
    ----------
    positions : Positions
        The target as it was found at positions of the stages.
    target : Target
        The target that was moved.
    sigma : TableSigma, optional
        The uncertainty of the table; by default a TableSigma with its default values.
    model : Model
        The pinhole. With AUTO held-out positions decide.

    Returns
    -------
    CameraCalibration
        Pinhole and rays, their scores and uncertainty.

    Raises
    ------
    CalibrationError
        When the positions do not determine a camera.

    Notes
    -----
    Without scores at held-out positions the pinhole is Brown's unless `model` says otherwise, and the rays are of the
    lowest degree.
    """
    board, sigma = make_board(target), sigma or TableSigma()
    known, no_scores = try_check(lambda: score_models(positions, board, sigma))
    scores = known or ()
    pinholes = tuple(score for score in scores if score.model in (BROWN, RATIONAL))
    chosen = {Model.BROWN: BROWN, Model.RATIONAL: RATIONAL}.get(model) or (select_model(pinholes) if scores else BROWN)
    adjustment = adjust(positions, board, sigma, rational=chosen == RATIONAL)
    name = (
        select_model(tuple(score for score in scores if score not in pinholes))
        if scores
        else format_ray_name(min(DEGREES))
    )
    rays = fit_ray_lens(adjustment, next(degree for degree in DEGREES if format_ray_name(degree) == name))
    distance_mm = float(np.mean(adjustment.compute_poses()[1][:, 2]))
    apart, no_halves = try_check(
        lambda: compare_halves(positions, board, sigma, distance_mm, rational=chosen == RATIONAL)
    )
    checks = {"how well held-out positions are met": no_scores, "by how much the halves differ": no_halves}
    return CameraCalibration(
        adjustment=adjustment,
        rays=rays,
        scores=scores,
        model=chosen,
        uncertainty=compute_projection_uncertainty(adjustment, distance_mm),
        halves=apart,
        not_known=tuple(f"{what} is not known: {why}" for what, why in checks.items() if why),
        rays_times=compute_rms_ratio(adjustment, rays, scores),
    )
