"""A session's positions -> the calibrated camera, chosen, checked and scored."""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from compensation.calibration.adjustment import Adjustment, adjust
from compensation.calibration.board import board_of
from compensation.calibration.model_scores import (
    BROWN,
    RATIONAL,
    ModelScore,
    best,
    halves,
    ray_name,
    rays_of,
    score_models,
)
from compensation.calibration.rays import DEGREES, RayLens
from compensation.calibration.session_centres import Positions
from compensation.calibration.stage_geometry import TableSigma
from compensation.calibration.uncertainty import Difference, UncertaintyMap, projection_uncertainty
from markers.target import Target


class Model(StrEnum):
    """Which pinhole to use. AUTO: the one that does better at positions it was not fitted to."""

    AUTO = "auto"
    BROWN = "brown"
    RATIONAL = "rational"


@dataclass(frozen=True, slots=True, eq=False)
class Calibration:
    """The result. scores: of all models at held-out positions. model: the pinhole in use, one of the scores' names.
    uncertainty, halves: at the mean distance of the target."""

    adjustment: Adjustment
    rays: RayLens
    scores: tuple[ModelScore, ...]
    model: str
    uncertainty: UncertaintyMap
    halves: Difference

    def score(self, model: str) -> ModelScore:
        """The score of a model by its name."""
        return next(score for score in self.scores if score.model == model)


def calibrate(
    positions: Positions, target: Target, sigma: TableSigma | None = None, model: Model = Model.AUTO
) -> Calibration:
    """Adjust, choose pinhole and degree of the rays by held-out positions, and compare the session's halves.

    sigma: of the table, else a TableSigma as it is. CalibrationError when the positions do not determine a camera.
    """
    board, sigma = board_of(target), sigma or TableSigma()
    scores = score_models(positions, board, sigma)
    pinholes = tuple(score for score in scores if score.model in (BROWN, RATIONAL))
    chosen = {Model.BROWN: BROWN, Model.RATIONAL: RATIONAL}.get(model) or best(pinholes)
    adjustment = adjust(positions, board, sigma, rational=chosen == RATIONAL)
    name = best(tuple(score for score in scores if score not in pinholes))
    rays = rays_of(adjustment, next(degree for degree in DEGREES if ray_name(degree) == name))
    distance_mm = float(np.mean(adjustment.poses()[1][:, 2]))
    return Calibration(
        adjustment=adjustment,
        rays=rays,
        scores=scores,
        model=chosen,
        uncertainty=projection_uncertainty(adjustment, distance_mm),
        halves=halves(positions, board, sigma, distance_mm, rational=chosen == RATIONAL),
    )
