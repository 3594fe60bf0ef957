"""The paper's drift model: where would this point have been at the reference temperature?

The paper's form (section 6.1), one polynomial per coordinate of total degree n in the measured position (I, J) and the
camera's own temperature T, fitted to the displacement (reference minus measured). For n >= 1 the position itself is in
the space, so this is the same fit as that of the reference positions. compensation/drift/paper_fit.py makes the model.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field, model_validator

from thermostand.compensation.drift.candidates import Pair, check_folds
from thermostand.compensation.drift.drift_model import (
    DriftModel,
    Flags,
    Outside,
    Situation,
    place_flags,
    range_flags,
    states_of,
)
from thermostand.compensation.drift.polynomial import Float, Scaling, design
from thermostand.compensation.history.states import Memory
from thermostand.foundation.documents import Document

MAX_DEGREE = 5


class DegreeScore(Document):
    """What leave-temperatures-out says of one degree; a fold is one chamber set-point with all its visits.

    condition: 2-norm condition number of the weighted terms, all folds together. rms_px: held-out RMS along I and J,
    all folds counting the same. fold_chamber_degC, fold_rms_px: the same for each fold.
    """

    degree: Annotated[int, Field(ge=1, le=MAX_DEGREE)]
    terms: int
    condition: float
    rms_px: Pair
    fold_chamber_degC: tuple[float, ...]
    fold_rms_px: tuple[Pair, ...]

    @model_validator(mode="after")
    def _fits_together(self) -> DegreeScore:
        check_folds(self.fold_chamber_degC, self.fold_rms_px)
        return self


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PaperModel(DriftModel):
    """degree: n. coefficients (2, K) px and their covariance (2, K, K) px^2, rows I and J, terms in the order of
    polynomial.exponents. scores: of every degree tried. Of a state only the camera's temperature counts."""

    form = "paper"
    degree: int
    coefficients: Float
    coefficient_covariance: Float
    scores: tuple[DegreeScore, ...]

    @property
    def memory(self) -> Memory:
        """It needs nothing remembered."""
        return Memory()

    @property
    def scaling(self) -> Scaling:
        """Of image and calibrated temperature range."""
        return Scaling(self.facts.image_size, self.facts.camera_range_degC)

    @property
    def title(self) -> str:
        """The form in words."""
        return f"degree {self.degree}, {self.score.terms} terms, condition {self.score.condition:.0f}"

    def shift(self, xy_px: Float, state: Situation) -> Float:
        """As in DriftModel."""
        return self._terms(xy_px, state) @ self.coefficients.T

    def covariance(self, xy_px: Float, state: Situation) -> Float:
        """A (A' W A)^-1 A' + s^2."""
        terms = self._terms(xy_px, state)
        variance = np.einsum("nk,ckl,nl->nc", terms, self.coefficient_covariance, terms) + self.discrepancy_px**2
        return variance[:, :, None] * np.eye(2)

    def flags(self, xy_px: Float, state: Situation) -> Flags:
        """PLACE and CAMERA."""
        camera_degC = states_of(state, len(xy_px), self.memory).camera_degC
        found = place_flags(xy_px, self.facts.hull_px)
        return found | range_flags(camera_degC, self.facts.camera_range_degC, Outside.CAMERA)

    @property
    def score(self) -> DegreeScore:
        """The cross-validation of the degree in use."""
        return next(score for score in self.scores if score.degree == self.degree)

    def _terms(self, xy_px: Float, state: Situation) -> Float:
        camera_degC = states_of(state, len(xy_px), self.memory).camera_degC
        return design(xy_px, camera_degC, self.degree, self.scaling)
