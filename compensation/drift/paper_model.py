"""The paper's drift model: where would this point have been at the reference temperature?

The paper's form (section 6.1), one polynomial per coordinate of total degree n in the measured position (I, J) and the
camera's own temperature T, fitted to the displacement (reference minus measured). For n >= 1 the position itself is in
the space, so this is the same fit as that of the reference positions.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, cast

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray
from pydantic import Field, model_validator

from thermostand.compensation.drift.candidates import (
    Candidate,
    Pair,
    average_folds,
    check_folds,
    compute_discrepancy_px,
    list_equivalent_to_best,
    make_pair,
)
from thermostand.compensation.drift.displacements import Displacements, compute_displacements
from thermostand.compensation.drift.drift_model import (
    DriftModel,
    Flags,
    Outside,
    Situation,
    broadcast_states,
    compute_place_flags,
    compute_range_flags,
)
from thermostand.compensation.drift.model_facts import collect_facts
from thermostand.compensation.history.thermal_history import ThermalStateSpec
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError, SessionError

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


def list_exponents(degree: int) -> list[tuple[int, int, int]]:
    """The (a, b, c) of the terms, in the order of the coefficients; (n+1)(n+2)(n+3)/6 of them."""
    numbers = range(degree + 1)
    return [(a, b, c) for a in numbers for b in numbers for c in numbers if a + b + c <= degree]


def build_design_matrix(xy_px: Float, camera_degC: Float, degree: int, scaling: Scaling) -> Float:
    """The terms (M, K) at centres (M, 2) and temperatures (M,)."""
    i, j, t = (chebyshev.chebvander(values, degree) for values in scaling.scale(xy_px, camera_degC))
    a, b, c = np.array(list_exponents(degree)).T
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
    return _triangularise(np.column_stack([terms, values]) * weight[:, None])


def solve(triangles: Sequence[Float], count: int) -> PolynomialFit:
    """The fit of all the rows, `count` of them, that were condensed into the triangles; raises LinAlgError when they
    do not determine it."""
    r = _triangularise(np.concatenate(triangles))
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


def _triangularise(rows: Float) -> Float:
    return cast(Float, np.linalg.qr(rows, mode="r"))  # for this mode numpy's stubs promise a pair


# Chebyshev products keep the condition number below 200 at degree 5, where raw pixels and degrees give 8e19.
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
    def _check_consistent(self) -> DegreeScore:
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
    def memory(self) -> ThermalStateSpec:
        """It needs nothing remembered."""
        return ThermalStateSpec()

    @property
    def scaling(self) -> Scaling:
        """The scales of image and calibrated temperature range, by which the polynomial's variables are divided."""
        return Scaling(self.facts.image_size, self.facts.camera_range_degC)

    @property
    def title(self) -> str:
        """The form in words."""
        return f"degree {self.degree}, {self.score.terms} terms, condition {self.score.condition:.0f}"

    def shift(self, xy_px: Float, state: Situation) -> Float:
        """Predict the drift, as DriftModel.shift states."""
        return self._build_terms(xy_px, state) @ self.coefficients.T

    def covariance(self, xy_px: Float, state: Situation) -> Float:
        """A (A' W A)^-1 A' + s^2."""
        terms = self._build_terms(xy_px, state)
        variance = np.einsum("nk,ckl,nl->nc", terms, self.coefficient_covariance, terms) + self.discrepancy_px**2
        return variance[:, :, None] * np.eye(2)

    def flags(self, xy_px: Float, state: Situation) -> Flags:
        """PLACE and CAMERA."""
        camera_degC = broadcast_states(state, len(xy_px), self.memory).camera_degC
        found = compute_place_flags(xy_px, self.facts.hull_px)
        return found | compute_range_flags(camera_degC, self.facts.camera_range_degC, Outside.CAMERA)

    @property
    def score(self) -> DegreeScore:
        """The cross-validation of the degree in use."""
        return next(score for score in self.scores if score.degree == self.degree)

    def _build_terms(self, xy_px: Float, state: Situation) -> Float:
        camera_degC = broadcast_states(state, len(xy_px), self.memory).camera_degC
        return build_design_matrix(xy_px, camera_degC, self.degree, self.scaling)


# The paper's polynomial: choose its degree by temperatures left out, fit it, and say how far it can be trusted.

_LEAST_TEMPERATURES = 3  # of a line and what it leaves
_LEAST_RANGE_K = 1.0  # round number; nothing was measured


def fit_paper(observations: Observations, degree: int | None = None) -> PaperModel:
    """The model of the REFERENCE and FIT frames; nothing else is looked at.

    degree: 1..5; None takes the simplest within one standard error of the best (cross-validation, see `choose`).
    SessionError when the sessions cannot support it.
    """
    frames = observations.of(Role.REFERENCE, Role.FIT)
    rows = compute_displacements(observations, frames)
    scaling = make_scaling(observations, rows)
    scores = cross_validate(rows, scaling, list_degrees(rows, degree))
    chosen = choose_degree(scores) if degree is None else _check_determined(scores, degree)
    solutions = _solve_folds(_condense_folds(rows, chosen, scaling))
    held_out = compute_left_out_residuals(rows, chosen, scaling)
    reference_degC = float(observations.camera_degC[observations.of(Role.REFERENCE)].mean())
    return PaperModel(
        facts=collect_facts(observations, rows, scaling.camera_degC, reference_degC),
        degree=chosen,
        coefficients=np.array([solution.coefficients for solution in solutions]),
        coefficient_covariance=np.array([solution.covariance for solution in solutions]),
        discrepancy_px=compute_discrepancy_px(rows, held_out),
        scores=scores,
        candidates=list_candidates(scores, chosen),
    )


def check_degree(degree: int | None) -> None:
    """ConfigError when there is no model of this degree; None, the choice by cross-validation, is fine."""
    if degree is not None and not 1 <= degree <= MAX_DEGREE:
        raise ConfigError(f"the degree is 1 to {MAX_DEGREE}, not {degree}")


def list_degrees(rows: Displacements, degree: int | None) -> range:
    """The degrees that the temperatures can decide on: T^n needs n + 1 of them, and one more to be left out.

    SessionError when `degree` (None: any at all) is not among them.
    """
    check_degree(degree)
    set_points = np.unique(rows.chamber_degC)
    least = _LEAST_TEMPERATURES if degree is None else degree + 2
    if len(set_points) < least:
        listed = ", ".join(f"{value:g}" for value in set_points)
        of_degree = "" if degree is None else f" of degree {degree}"
        raise SessionError(
            f"a fit{of_degree} needs frames at {least} chamber temperatures or more, "
            f"found {len(set_points)} ({listed} degC)"
        )
    return range(1, min(MAX_DEGREE, len(set_points) - 2) + 1)


def make_scaling(observations: Observations, rows: Displacements) -> Scaling:
    """The image and the range of the camera's temperature in these rows; SessionError when that hardly changes."""
    if len(rows.frame) == 0:
        raise SessionError(
            "the sessions have no usable frames for a fit, which needs the roles reference and fit; usable frames: "
            f"{observations.roles_text}"
        )
    low, high = float(rows.camera_degC.min()), float(rows.camera_degC.max())
    if high - low < _LEAST_RANGE_K:
        raise SessionError(f"the camera's temperature hardly changes ({low:.2f} to {high:.2f} degC); nothing to fit")
    return Scaling(observations.image_size, (low, high))


def cross_validate(rows: Displacements, scaling: Scaling, degrees: range) -> tuple[DegreeScore, ...]:
    """The score of each degree, up to the first that the markers cannot determine."""
    scores: list[DegreeScore] = []
    for degree in degrees:
        try:
            scores.append(_score_degree(rows, degree, scaling))
        except np.linalg.LinAlgError:
            break
    if not scores:
        raise SessionError("the markers do not determine even a polynomial of degree 1: too few, or all in one line")
    return tuple(scores)


def _score_degree(rows: Displacements, degree: int, scaling: Scaling) -> DegreeScore:
    squares = average_folds(rows, compute_left_out_residuals(rows, degree, scaling) ** 2)
    return DegreeScore(
        degree=degree,
        terms=len(list_exponents(degree)),
        condition=max(solution.condition for solution in _solve_folds(_condense_folds(rows, degree, scaling))),
        rms_px=make_pair(np.sqrt(squares.mean(axis=0))),
        fold_chamber_degC=tuple(np.unique(rows.chamber_degC).tolist()),
        fold_rms_px=tuple(map(make_pair, np.sqrt(squares))),
    )


def compute_left_out_residuals(
    rows: Displacements, degree: int, scaling: Scaling, asked: Displacements | None = None
) -> Float:
    """Residual displacement (M, 2) of each row that is asked for, by default the same, from a fit to the rows that has
    not seen its chamber set-point; where that is NaN, to all."""
    asked = rows if asked is None else asked
    folds = _condense_folds(rows, degree, scaling)
    residual = asked.displacement_px.copy()
    for chamber_degC in np.unique(asked.chamber_degC).tolist():
        known = _solve_folds([fold for fold in folds if fold.chamber_degC != chamber_degC])
        here = np.isnan(asked.chamber_degC) if math.isnan(chamber_degC) else asked.chamber_degC == chamber_degC
        coefficients = np.stack([solution.coefficients for solution in known], axis=1)
        residual[here] -= (
            build_design_matrix(asked.measured_px[here], asked.camera_degC[here], degree, scaling) @ coefficients
        )
    return residual


@dataclass(frozen=True, slots=True, eq=False)
class _Fold:
    """How many rows one chamber set-point has, and their triangles for I and J."""

    chamber_degC: float
    count: int
    triangles: tuple[Float, Float]


def _condense_folds(rows: Displacements, degree: int, scaling: Scaling) -> list[_Fold]:
    """All rows, a fold for each chamber set-point."""
    folds: list[_Fold] = []
    for chamber_degC in np.unique(rows.chamber_degC).tolist():
        here = rows.chamber_degC == chamber_degC
        terms = build_design_matrix(rows.measured_px[here], rows.camera_degC[here], degree, scaling)
        values, variance = rows.displacement_px[here], rows.variance_px2[here]
        i, j = (condense(terms, values[:, axis], variance[:, axis]) for axis in (0, 1))
        folds.append(_Fold(chamber_degC, int(here.sum()), (i, j)))
    return folds


def _solve_folds(folds: Sequence[_Fold]) -> list[PolynomialFit]:
    """The fits of I and of J to all rows of the folds; LinAlgError when they do not determine them."""
    count = sum(fold.count for fold in folds)
    return [solve([fold.triangles[axis] for fold in folds], count) for axis in (0, 1)]


def choose_degree(scores: tuple[DegreeScore, ...]) -> int:
    """The simplest degree whose held-out mean square is within one standard error of the best.

    The standard error is that of the difference, fold by fold: what is common to both (a set-point that is hard for
    every degree) does not count.
    """
    squares = [np.array([i**2 + j**2 for i, j in score.fold_rms_px]) for score in scores]
    return scores[list_equivalent_to_best(squares)[0]].degree


def list_candidates(scores: tuple[DegreeScore, ...], degree: int) -> tuple[Candidate, ...]:
    """The degrees as rows of the table of choice."""
    return tuple(
        Candidate(
            form="paper",
            name=f"P^{score.degree}",
            terms=2 * score.terms,
            rms_px=score.rms_px,
            chosen=score.degree == degree,
            fold_chamber_degC=score.fold_chamber_degC,
            fold_rms_px=score.fold_rms_px,
        )
        for score in scores
    )


def _check_determined(scores: tuple[DegreeScore, ...], degree: int) -> int:
    if degree not in {score.degree for score in scores}:
        raise SessionError(f"the markers do not determine a polynomial of degree {degree}; at most {len(scores)}")
    return degree
