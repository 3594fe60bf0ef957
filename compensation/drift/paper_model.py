"""The paper's drift model: where would this point have been at the reference temperature?

The paper's form (section 6.1), one polynomial per coordinate of total degree n in the measured position (I, J) and the
camera's own temperature T, fitted to the displacement (reference minus measured). For n >= 1 the position itself is in
the space, so this is the same fit as that of the reference positions. compensation/drift/paper_fit.py makes the model.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, cast

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
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
from thermostand.compensation.history.states import ThermalMemory
from thermostand.foundation.documents import Document

Float = NDArray[np.float64]

_WORST_CONDITION = 1e8
"""Beyond it the data do not determine the coefficients: too few temperatures, or markers in one line."""


@dataclass(frozen=True, slots=True)
class Scaling:
    """What becomes [-1, 1]: the image (width, height) in px and the calibrated range of the camera's temperature."""

    image_size: tuple[int, int]
    camera_degC: tuple[float, float]

    def scale(self, xy_px: Float, camera_degC: Float) -> tuple[Float, Float, Float]:
        """I, J and T, each (M,), from centres (M, 2) and temperatures (M,)."""
        width, height = self.image_size
        low, high = self.camera_degC
        return (
            2 * (xy_px[:, 0] + 0.5) / width - 1,
            2 * (xy_px[:, 1] + 0.5) / height - 1,
            (2 * camera_degC - low - high) / (high - low),
        )


def exponents(degree: int) -> list[tuple[int, int, int]]:
    """The (a, b, c) of the terms, in the order of the coefficients; (n+1)(n+2)(n+3)/6 of them."""
    numbers = range(degree + 1)
    return [(a, b, c) for a in numbers for b in numbers for c in numbers if a + b + c <= degree]


def design(xy_px: Float, camera_degC: Float, degree: int, scaling: Scaling) -> Float:
    """The terms (M, K) at centres (M, 2) and temperatures (M,)."""
    i, j, t = (chebyshev.chebvander(values, degree) for values in scaling.scale(xy_px, camera_degC))
    a, b, c = np.array(exponents(degree)).T
    return i[:, a] * j[:, b] * t[:, c]


@dataclass(frozen=True, slots=True, eq=False)
class PolynomialFit:
    """A weighted least-squares fit of one coordinate.

    coefficients (K,). covariance (K, K): (A' W A)^-1, times chi^2 per degree of freedom where that exceeds 1.
    condition: 2-norm condition number of the weighted terms.
    """

    coefficients: Float
    covariance: Float
    condition: float


def condense(terms: Float, values: Float, variance: Float) -> Float:
    """Rows [terms | values] (M, K + 1) with variances (M,) as a triangle of at most K + 1 rows that gives the same fit:
    the R of their weighted QR. So each group of rows is worked through once, however often it is then left out."""
    weight = 1 / np.sqrt(variance)
    return _triangle(np.column_stack([terms, values]) * weight[:, None])


def solve(triangles: Sequence[Float], count: int) -> PolynomialFit:
    """The fit of all the rows, `count` of them, that were condensed into the triangles; raises LinAlgError when they
    do not determine it."""
    r = _triangle(np.concatenate(triangles))
    terms = r.shape[1] - 1
    if min(count, len(r)) < terms:
        raise np.linalg.LinAlgError(f"{count} values for {terms} terms")
    singular = np.linalg.svd(r[:terms, :terms], compute_uv=False)
    if not singular[-1] * _WORST_CONDITION > singular[0]:
        raise np.linalg.LinAlgError(f"singular values from {singular[0]:.2g} to {singular[-1]:.2g}")
    inverse = cast(Float, np.linalg.inv(r[:terms, :terms]))
    chi2 = float((r[terms:, terms] ** 2).sum()) / max(count - terms, 1)
    return PolynomialFit(
        coefficients=inverse @ r[:terms, terms],
        covariance=inverse @ inverse.T * max(chi2, 1.0),
        condition=float(singular[0] / singular[-1]),
    )


def _triangle(rows: Float) -> Float:
    return cast(Float, np.linalg.qr(rows, mode="r"))  # for this mode numpy's stubs promise a pair


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
    def memory(self) -> ThermalMemory:
        """It needs nothing remembered."""
        return ThermalMemory()

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
