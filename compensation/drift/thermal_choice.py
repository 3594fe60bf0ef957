"""Observations -> thermal model: time constants by BIC, the family by temperatures left out, then the fit of all.

In use is the simplest family within one standard error of the best; of two as simple, the one of less BIC.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from compensation.drift.candidates import NO_MATTER_PX, Candidate, as_good_as_best, between, discrepancy_px, fold_means
from compensation.drift.displacements import Displacements
from compensation.drift.facts import facts_of
from compensation.drift.families import PLAYS_K, TAUS_S, Family, Terms, all_terms, families
from compensation.drift.terms import MOTIONS, Kind, motions
from compensation.drift.thermal_fit import RIDGE, RIDGE_WITH_PLAYS, Equations, equations, solve_thermal
from compensation.drift.thermal_model import ThermalModel, ThermalRange, form_name
from compensation.drift.training import Training, self_heating_K, training
from compensation.drift_runtime import SETTLED_TAUS
from compensation.history.states import Float, Memory
from compensation.observations import Observations
from experiments.steps import Role
from foundation.errors import SessionError

_FEWEST_FOLDS = 3
_MOST_OF = 0.8
_GUESSED = {Kind.AMBIENT_LAG: 0.25, Kind.CAMERA_LAG: 0.25, Kind.CAMERA_LAG_SQUARE: 0.25, Kind.POWER_LAG: 0.5}
"""How wrong the first guess of a feature may be: 5 K of 20, half of the self-heating."""
_LEAST_PX, _STEP_S = 0.001, 300.0


@dataclass(frozen=True, slots=True, eq=False)
class _Tried:
    """A family with its best time constants. held_out (M, 2): residuals of the rows at set-points."""

    terms: Terms
    ridge: float
    bic: float
    held_out: Float


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """The normal equations for every term, of all instants, of those of each set-point and of each session."""

    trained: Training
    whole: Equations
    folds: dict[float, Equations]
    nights: dict[int, Equations]

    def columns(self, terms: Terms) -> NDArray[np.int64]:
        """Where the terms are among all."""
        return np.array([self.trained.terms.index(term) for term in terms])


def fit_thermal(observations: Observations) -> ThermalModel:
    """The model of the REFERENCE, FIT and WARM_UP frames; SessionError when the sessions cannot support it.

    Lags of the power are only tried when there is a warm-up: a camera that is always on does not determine them.
    """
    with_power = bool(observations.of(Role.WARM_UP).any())
    memory = Memory(TAUS_S, PLAYS_K, self_heating_K(observations))
    trained = training(observations, all_terms(with_power=with_power), memory)
    problem = _problem(trained)
    tried = [found for family in families(with_power=with_power) if (found := _tried(problem, family)) is not None]
    if not tried:
        raise SessionError("the markers and temperatures do not determine a thermal model")
    rows = trained.fold_rows
    inner = between(rows.chamber_degC)
    squares = [fold_means(rows.where(inner), one.held_out[inner] ** 2).sum(axis=1) for one in tried]
    chosen = min(_as_good(squares), key=lambda index: (len(tried[index].terms), tried[index].bic))
    candidates = tuple(_candidate(trained, one, index == chosen) for index, one in enumerate(tried))
    return _model(problem, tried[chosen], memory.self_heating_K, candidates)


def _as_good(squares: list[Float]) -> set[int]:
    """Within one standard error of the best, or worse by less than anybody measures."""
    rms_px = np.sqrt([own.mean() for own in squares])
    near = np.flatnonzero(rms_px <= rms_px.min() + NO_MATTER_PX)
    return set(as_good_as_best(squares)) | set(near.tolist())


def left_out_thermal(model: ThermalModel, observations: Observations) -> tuple[Displacements, Float]:
    """The rows at set-points of other observations, and their residuals (M, 2), each from a new fit of the same terms
    that has not seen its set-point."""
    trained = training(observations, model.terms, model.memory)
    rest = trained.at_rest
    plays = any(term.kind is Kind.PLAY for term in model.terms)
    try:
        held_out = _held_out(_problem(trained), model.terms, RIDGE_WITH_PLAYS if plays else RIDGE)
    except np.linalg.LinAlgError as error:
        raise SessionError("the markers and temperatures do not determine a thermal model of these terms") from error
    return trained.fold_rows.where(rest), held_out[rest]


def _problem(trained: Training) -> _Problem:
    instants = trained.instants()
    set_points = np.unique(instants.chamber_degC[np.isfinite(instants.chamber_degC)]).tolist()
    if len(set_points) < _FEWEST_FOLDS:
        raise SessionError(
            f"a thermal fit needs frames at {_FEWEST_FOLDS} chamber temperatures or more, found {len(set_points)}"
        )
    folds = {degC: equations(instants.where(instants.chamber_degC == degC)) for degC in set_points}
    sessions = np.unique(instants.session).tolist()
    nights = {index: equations(instants.where(instants.session == index)) for index in sessions}
    return _Problem(trained, equations(instants), folds, nights)


def _tried(problem: _Problem, family: Family) -> _Tried | None:
    """The family with the time constants of least BIC; None when the instants do not determine any."""
    ridge = RIDGE_WITH_PLAYS if family.plays else RIDGE
    best: tuple[float, Terms] | None = None
    for terms in family.forms:
        try:
            bic = solve_thermal(problem.whole, problem.columns(terms), ridge).bic
        except np.linalg.LinAlgError:
            return None
        if best is None or bic < best[0]:
            best = bic, terms
    if best is None:
        return None
    try:
        return _Tried(best[1], ridge, best[0], _held_out(problem, best[1], ridge))
    except np.linalg.LinAlgError:
        return None


def _held_out(problem: _Problem, terms: Terms, ridge: float) -> Float:
    """Residuals (M, 2) of the fold rows, each from a fit that has not seen its set-point."""
    return _residuals(problem, terms, ridge, problem.folds, problem.trained.fold_rows.chamber_degC)


def _residuals(
    problem: _Problem, terms: Terms, ridge: float, folds: Mapping[Any, Equations], of_row: NDArray[Any]
) -> Float:
    """Residuals (M, 2) of the fold rows, each from a fit without its own of the folds (M,)."""
    trained, columns = problem.trained, problem.columns(terms)
    rows = trained.fold_rows
    residual = rows.displacement_px.copy()
    for key, fold in folds.items():
        coefficients = solve_thermal(problem.whole - fold, columns, ridge).coefficients
        here = of_row == key
        amounts = trained.features[rows.frame[here]][:, columns] @ coefficients.T
        moved = motions(rows.measured_px[here], trained.observations.image_size)
        residual[here] -= np.einsum("nak,nk->na", moved, amounts)
    return residual


def _discrepancy_px(problem: _Problem, one: _Tried) -> Float:
    """(2,): of set-points left out; of several nights also of nights left out, which shows what of the drift does not
    repeat between them, the larger of the two."""
    trained, rest = problem.trained, problem.trained.at_rest
    rows = trained.fold_rows.where(rest)
    found = discrepancy_px(rows, one.held_out[rest])
    night = trained.observations.session[rows.frame]
    nights = {index: fold for index, fold in problem.nights.items() if _others_know(rows.chamber_degC, night, index)}
    if not nights:
        return found
    try:
        left = _residuals(problem, one.terms, one.ridge, nights, trained.observations.session[trained.fold_rows.frame])
    except np.linalg.LinAlgError:
        return found
    squares = left[rest] ** 2 - rows.variance_px2
    each = np.array([squares[night == index].mean(axis=0) for index in nights])
    return np.maximum(found, np.sqrt(np.maximum(each.mean(axis=0), 0.0)))


def _others_know(chamber_degC: Float, night: NDArray[np.int64], index: int) -> bool:
    """Whether the other nights were at all set-points of this one, and at most of all: else without it a fit has to
    extrapolate."""
    own, others = set(chamber_degC[night == index].tolist()), set(chamber_degC[night != index].tolist())
    return bool(own) and own <= others and len(others) >= _MOST_OF * len(own | others)


def _candidate(trained: Training, one: _Tried, chosen: bool) -> Candidate:
    rest = trained.at_rest
    rows = trained.fold_rows.where(rest)
    squares = fold_means(rows, one.held_out[rest] ** 2)
    i, j = np.sqrt(squares.mean(axis=0))
    return Candidate(
        form="thermal",
        name=form_name(one.terms),
        terms=MOTIONS * len(one.terms),
        rms_px=(float(i), float(j)),
        bic=one.bic,
        chosen=chosen,
        fold_chamber_degC=tuple(np.unique(rows.chamber_degC).tolist()),
        fold_rms_px=tuple((float(i), float(j)) for i, j in np.sqrt(squares)),
    )


def _model(problem: _Problem, one: _Tried, heating_K: float, candidates: tuple[Candidate, ...]) -> ThermalModel:
    trained = problem.trained
    observations = trained.observations
    columns = problem.columns(one.terms)
    solution = solve_thermal(problem.whole, columns, one.ridge)
    count = MOTIONS * len(columns)
    camera_degC = _extent(trained.states.camera_degC[np.unique(trained.rows.frame)])
    found = ThermalModel(
        facts=facts_of(observations, trained.fold_rows.where(trained.at_rest), camera_degC, trained.origin.camera_degC),
        terms=one.terms,
        reference_ambient_degC=trained.origin.ambient_degC,
        self_heating_K=heating_K,
        reference_features=trained.reference_features[columns],
        coefficients=solution.coefficients,
        coefficient_covariance=solution.covariance.reshape(count, count),
        discrepancy_px=_discrepancy_px(problem, one),
        valid=_range(trained, one.terms),
        has_warm_up=any(term.kind is Kind.POWER_LAG for term in trained.terms),
        candidates=candidates,
    )
    largest, usual = _leverages(found, trained)
    valid = replace(found.valid, leverage=largest, history_s=_history_s(found), usual_leverage=usual)
    return replace(found, valid=valid)


def _leverages(model: ThermalModel, trained: Training) -> tuple[float, float]:
    """The largest of a training state, and the mean at set-points, each counting the same."""
    largest = float(model.leverage(trained.states.where(np.unique(trained.rows.frame))).max())
    rows = trained.fold_rows.where(trained.at_rest)
    return largest, float(fold_means(rows, model.leverage(trained.states)[rows.frame, None]).mean())


def _history_s(model: ThermalModel) -> float:
    """How long until what was guessed of the thermal state moves the image by less than the model is uncertain."""
    limit_px = max(float(np.hypot(*model.discrepancy_px)), _LEAST_PX)
    moved = motions(model.facts.hull_px, model.facts.image_size)
    lags = [index for index, term in enumerate(model.terms) if term.kind in _GUESSED]
    sizes_px = np.array([np.linalg.norm(moved @ model.coefficients[:, k], axis=1).mean() for k in lags])
    sizes_px *= [_GUESSED[model.terms[k].kind] for k in lags]
    taus_s = np.array([model.terms[k].parameter for k in lags])
    for after_s in np.arange(0.0, SETTLED_TAUS * max(taus_s, default=0.0), _STEP_S).tolist():
        if np.sqrt(((sizes_px * np.exp(-after_s / taus_s)) ** 2).sum()) < limit_px:
            return float(after_s)
    return float(SETTLED_TAUS * max(taus_s, default=0.0))


def _range(trained: Training, terms: Terms) -> ThermalRange:
    """What the training frames covered; the slowest time constant of the chosen terms stands for the ambient."""
    states = trained.states.where(np.unique(trained.rows.frame))
    taus = [term.parameter for term in terms if term.parameter > 0 and term.kind is not Kind.PLAY]
    slowest = states.memory.taus_s.index(max(taus)) if taus else 0
    return ThermalRange(
        ambient_degC=_extent(states.ambient_lag_degC[:, slowest]),
        rate_K_per_h=_extent(states.rate_K_per_h),
        least_on_s=float(states.on_s.min()),
    )


def _extent(values: Float) -> tuple[float, float]:
    return float(values.min()), float(values.max())
