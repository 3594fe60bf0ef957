"""A session's positions -> the calibrated camera, chosen, checked and scored."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from thermostand.compensation.calibration.adjustment import Adjustment, adjust
from thermostand.compensation.calibration.board import board_of
from thermostand.compensation.calibration.model_scores import (
    BROWN,
    RATIONAL,
    ModelScore,
    best,
    halves,
    known_or_why,
    ray_name,
    rays_of,
    score_models,
    times_the_pinhole,
)
from thermostand.compensation.calibration.rays import DEGREES, RayLens
from thermostand.compensation.calibration.session_centres import Positions
from thermostand.compensation.calibration.stage_geometry import TableSigma
from thermostand.compensation.calibration.uncertainty import CameraDifference, UncertaintyMap, projection_uncertainty
from thermostand.markers.target import Target


class Model(StrEnum):
    """Which pinhole to use. AUTO: the one that does better at positions it was not fitted to."""

    AUTO = "auto"
    BROWN = "brown"
    RATIONAL = "rational"


_MOST_TIMES = 2.0
"""Of 21 drawn lenses, f 900 to 7246 px, 11 with scores at held-out positions: there, rays that describe the lens leave
at most 1.02 times what the pinhole does, those that do not 4 times and more. Without scores the residuals of the fits
are a weaker sign: of one lens they were 1.51 times, where held-out positions said 4."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """The result. scores: of all models at held-out positions, none when too few are left to tell. model: the pinhole
    in use. uncertainty, halves: at the mean distance of the target; halves is None when one of them determines no
    camera. not_known: of scores and halves, why they are not known. rays_times: what the rays leave over what the
    pinhole leaves."""

    adjustment: Adjustment
    rays: RayLens
    scores: tuple[ModelScore, ...]
    model: str
    uncertainty: UncertaintyMap
    halves: CameraDifference | None
    not_known: tuple[str, ...] = ()
    rays_times: float = 1.0

    @property
    def rays_doubt(self) -> str:
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

    Without scores the pinhole is Brown's unless `model` says otherwise, and the rays are of the lowest degree.
    sigma: of the table, else a TableSigma as it is. CalibrationError when the positions do not determine a camera.
    """
    board, sigma = board_of(target), sigma or TableSigma()
    known, no_scores = known_or_why(lambda: score_models(positions, board, sigma))
    scores = known or ()
    pinholes = tuple(score for score in scores if score.model in (BROWN, RATIONAL))
    chosen = {Model.BROWN: BROWN, Model.RATIONAL: RATIONAL}.get(model) or (best(pinholes) if scores else BROWN)
    adjustment = adjust(positions, board, sigma, rational=chosen == RATIONAL)
    name = best(tuple(score for score in scores if score not in pinholes)) if scores else ray_name(min(DEGREES))
    rays = rays_of(adjustment, next(degree for degree in DEGREES if ray_name(degree) == name))
    distance_mm = float(np.mean(adjustment.poses()[1][:, 2]))
    apart, no_halves = known_or_why(lambda: halves(positions, board, sigma, distance_mm, rational=chosen == RATIONAL))
    checks = {"how well held-out positions are met": no_scores, "by how much the halves differ": no_halves}
    return CameraCalibration(
        adjustment=adjustment,
        rays=rays,
        scores=scores,
        model=chosen,
        uncertainty=projection_uncertainty(adjustment, distance_mm),
        halves=apart,
        not_known=tuple(f"{what} is not known: {why}" for what, why in checks.items() if why),
        rays_times=times_the_pinhole(adjustment, rays, scores),
    )
