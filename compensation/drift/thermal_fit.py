"""Observations -> thermal model: every term there is, weighed by the session's own evidence (below), and what
that leaves at set-points, and in sessions, that were left out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from thermostand.compensation.drift.candidates import (
    Candidate,
    Pair,
    average_folds,
    compute_discrepancy_px,
    compute_moving_rms_px,
    make_pair,
)
from thermostand.compensation.drift.claims import BetweenSessions, Claims, Question, estimate_claims
from thermostand.compensation.drift.displacements import Displacements
from thermostand.compensation.drift.model_facts import collect_facts
from thermostand.compensation.drift.terms import MOTIONS, Term, build_state_spec, compute_motions, list_usual_terms
from thermostand.compensation.drift.thermal_model import ThermalModel, ThermalRange, format_form_name
from thermostand.compensation.drift.training_data import (
    Index,
    Instants,
    Training,
    build_training,
    estimate_self_heating_K,
)
from thermostand.compensation.drift_runtime import SETTLED_TAUS, Follower, compiled
from thermostand.compensation.history.thermal_history import Float
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

# An Ornstein-Uhlenbeck process stands for fixings that move by themselves; chosen with the widths on 16 drawn cameras
# (numbers 3000 on). The likeliest of the seven is taken, so the grid only has to span what occurs.
_OU_NOISES, _OU_TIME_CONSTANTS_S = (1.0, 2.0, 4.0), (1800.0, 7200.0)
"""Standard deviation of the wander over that of an instant's noise."""
_PRIOR_LOG_WIDTH, _PRIOR_LOG_SIGMA = math.log(20.0), 3.0
"""A coefficient is expected to be 20 times the noise, within a factor of e^3: a weak prior on the widths."""
_LOG_WIDTH_LIMITS, _LOG_NOISE_LIMITS = (math.log(1e-3), math.log(1e4)), (0.0, math.log(1e4))
# A bound only: the optimiser's own criteria end it.
_ROUNDS = 60


@dataclass(frozen=True, slots=True, eq=False)
class _NormalEquations:
    """Normal equations of the features (H, H), moments (H, 8) and square sums (8,) of the amounts, weighted with the
    precision of wander and noise; count of instants, log determinant of their covariance."""

    gram: Float
    moment: Float
    square: Float
    count: int
    log_determinant: float


@dataclass(frozen=True, slots=True, eq=False)
class _OuNoiseModel:
    """One size and time constant of the wander. precision (I, I) of wander and noise, in units of the noise."""

    ou_noise: float
    precision: Float
    log_determinant: float


@dataclass(frozen=True, slots=True, eq=False)
class _Hyperparameters:
    """The hyperparameters of one motion. widths (H,): of the prior, noise: of an instant, both in units of the noise
    that markers have."""

    weighting: _OuNoiseModel
    widths: Float
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Posterior:
    """coefficients (8, H), px, and their covariance (8, H, H), px^2. prior_px (8, H): standard deviation of each before
    anything was seen. ou_noise_px2 (8,): variance of what wanders."""

    instants: Instants
    coefficients: Float
    covariance: Float
    prior_px: Float
    ou_noise_px2: Float
    _scale_px: Float
    _hyperparameters: tuple[_Hyperparameters, ...]

    def fit_without(self, left_out: NDArray[np.bool_]) -> tuple[Float, Float]:
        """Coefficients (8, H), px, and their covariance (8, H, H), px^2: what the instants teach without some of them
        (I,), with the same prior and noise."""
        coefficients, covariance = np.empty_like(self.coefficients), np.empty_like(self.covariance)
        rows = np.flatnonzero(left_out)
        amounts = self.instants.amounts_px / self._scale_px
        for motion, own in enumerate(self._hyperparameters):
            known = _build_normal_equations(self.instants.features, amounts, own.weighting, rows)
            found, uncertain = _solve(known, motion, own)
            coefficients[motion] = found * self._scale_px[motion]
            covariance[motion] = uncertain * self._scale_px[motion] ** 2
        return coefficients, covariance


def fit_posterior(instants: Instants, terms: Sequence[Term]) -> Posterior:
    """The most likely prior and noise of each motion, and what they make of these instants."""
    groups = list(dict.fromkeys(term.width for term in terms))
    group = np.array([groups.index(term.width) for term in terms])
    scale_px = np.sqrt(np.median(instants.variance_px2, axis=0))
    amounts = instants.amounts_px / scale_px
    best: list[tuple[float, Float, _OuNoiseModel] | None] = [None] * MOTIONS
    for weighting in _iterate_noise_models(instants, (instants.variance_px2 / scale_px**2).mean(axis=1)):
        known = _build_normal_equations(instants.features, amounts, weighting)
        for motion, before in enumerate(best):
            start = np.append(np.full(len(groups), _PRIOR_LOG_WIDTH), 0.0) if before is None else before[1]
            value, found = _maximise_evidence(known, motion, group, start)
            if before is None or value < before[0]:
                best[motion] = value, found, weighting
    believed = tuple(
        _Hyperparameters(weighting, np.exp(found[group]), math.exp(found[-1]))
        for _, found, weighting in filter(None, best)
    )
    solved = [
        _solve(_build_normal_equations(instants.features, amounts, own.weighting), motion, own)
        for motion, own in enumerate(believed)
    ]
    return Posterior(
        instants,
        np.array([coefficients for coefficients, _ in solved]) * scale_px[:, None],
        np.array([covariance for _, covariance in solved]) * scale_px[:, None, None] ** 2,
        np.array([own.widths for own in believed]) * scale_px[:, None],
        np.array([(own.noise * own.weighting.ou_noise) ** 2 for own in believed]) * scale_px**2,
        scale_px,
        believed,
    )


def _iterate_noise_models(instants: Instants, variance: Float) -> Iterator[_OuNoiseModel]:
    apart_s = np.abs(instants.time_s[:, None] - instants.time_s)
    same = instants.session[:, None] == instants.session
    for wander, tau_s in [(0.0, 1.0), *product(_OU_NOISES, _OU_TIME_CONSTANTS_S)]:
        covariance = np.diag(variance) + wander**2 * np.where(same, np.exp(-apart_s / tau_s), 0.0)
        half = np.linalg.inv(np.linalg.cholesky(covariance))
        yield _OuNoiseModel(wander, half.T @ half, -2 * float(np.log(np.diagonal(half)).sum()))


def _build_normal_equations(
    features: Float, amounts: Float, weighting: _OuNoiseModel, left_out: Index | None = None
) -> _NormalEquations:
    """Return the precision of the other instants without those that are left out: B - B_rf B_ff^-1 B_fr."""
    weighted, projected = weighting.precision @ features, weighting.precision @ amounts
    gram, moment, square = features.T @ weighted, features.T @ projected, (amounts * projected).sum(axis=0)
    count = len(features)
    if left_out is not None:
        own = np.linalg.inv(weighting.precision[np.ix_(left_out, left_out)]) @ weighted[left_out]
        gram, moment = gram - weighted[left_out].T @ own, moment - own.T @ projected[left_out]
        count -= len(left_out)
    return _NormalEquations(gram, moment, square, count, weighting.log_determinant)


def _solve(known: _NormalEquations, motion: int, own: _Hyperparameters) -> tuple[Float, Float]:
    """Coefficients (H,) and their covariance (H, H), in units of the noise."""
    precision = own.widths[:, None] * known.gram * own.widths / own.noise**2 + np.eye(len(own.widths))
    inverse = np.linalg.inv(precision)
    coefficients = inverse @ (own.widths * known.moment[:, motion]) / own.noise**2
    return own.widths * coefficients, own.widths[:, None] * inverse * own.widths


def _maximise_evidence(known: _NormalEquations, motion: int, group: Index, start: Float) -> tuple[float, Float]:
    """The least negative log evidence, and the logarithms of widths of each group and noise that have it."""
    moment, square, groups = known.moment[:, motion], float(known.square[motion]), len(start) - 1

    def negative(logs: Float) -> tuple[float, Float]:
        widths, per_noise = np.exp(logs[group]), math.exp(-2 * logs[-1])
        explained = widths[:, None] * known.gram * widths * per_noise
        inverse = np.linalg.inv(explained + np.eye(len(group)))
        projected = widths * moment * per_noise
        found = inverse @ projected
        free = np.diagonal(inverse)
        beyond = (logs[:-1] - _PRIOR_LOG_WIDTH) / _PRIOR_LOG_SIGMA
        value = (
            0.5 * float(square * per_noise - projected @ found)
            - 0.5 * float(np.linalg.slogdet(inverse)[1])
            + known.count * float(logs[-1])
            + 0.5 * (known.log_determinant + float(beyond @ beyond))
        )
        of_widths = np.bincount(group, 1 - free - found**2, groups) + beyond / _PRIOR_LOG_SIGMA
        left = square * per_noise - 2 * projected @ found + found @ explained @ found
        return value, np.append(of_widths, known.count - left - (len(group) - free.sum()))

    limits = [_LOG_WIDTH_LIMITS] * groups + [_LOG_NOISE_LIMITS]
    result = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": _ROUNDS})
    return float(result.fun), np.asarray(result.x, np.float64)


_FEWEST_FOLDS = 3  # as in candidates.FEWEST_BETWEEN
# Round number; nothing was measured. With fewer common set-points the comparison of sessions would be an extrapolation.
_MOST_OF = 0.8
_INITIAL_ERROR_K = 5.0
"""How wrong the first guess may be: of where the camera has been, and of its self-heating."""
# Of the complex-step derivative: the smaller the better, since nothing is subtracted.
_TINY = 1e-20
_LEAST_PX, _STEP_S = 0.003, 300.0


@dataclass(frozen=True, slots=True, eq=False)
class _ThermalFit:
    """What was learned from. rows: of the frames at set-points; held_out, predicted_px2 (M, 2): their residuals, px,
    each from what the others teach, and the variance of these by that. moving (M, 2): such residuals of frames that
    were not at rest."""

    trained: Training
    learned: Posterior
    rows: Displacements
    held_out: Float
    predicted_px2: Float
    moving: Float


def fit_thermal(observations: Observations) -> ThermalModel:
    """The model of the REFERENCE, FIT and WARM_UP frames; SessionError when the sessions cannot support it."""
    terms = list_usual_terms()
    memory = build_state_spec(terms, estimate_self_heating_K(observations))
    return _make_model(_fit_training(build_training(observations, terms, memory)), memory.self_heating_K)


def cross_validate_thermal(model: ThermalModel, observations: Observations) -> tuple[Displacements, Float]:
    """The rows at set-points of other observations, and their residuals (M, 2), each from a new fit of the same terms
    that has not seen its set-point."""
    taught = _fit_training(build_training(observations, model.terms, model.memory))
    return taught.rows, taught.held_out


def _fit_training(trained: Training) -> _ThermalFit:
    instants = trained.condense()
    set_points = np.unique(instants.chamber_degC[np.isfinite(instants.chamber_degC)]).tolist()
    if len(set_points) < _FEWEST_FOLDS:
        raise SessionError(
            f"a thermal fit needs frames at {_FEWEST_FOLDS} chamber temperatures or more, found {len(set_points)}"
        )
    learned = fit_posterior(instants, trained.terms)
    rows, moving = trained.fold_rows.where(trained.at_rest), trained.moving_rows
    left = _compute_held_out_residuals(trained, learned, rows, instants.chamber_degC, rows.chamber_degC)
    folds = trained.assign_folds(instants.frame), trained.assign_folds(moving.frame)
    return _ThermalFit(trained, learned, rows, *left, _compute_held_out_residuals(trained, learned, moving, *folds)[0])


def _compute_held_out_residuals(
    trained: Training, learned: Posterior, rows: Displacements, of_instant: NDArray[np.float64], of_row: Float
) -> tuple[Float, Float]:
    """Residuals (M, 2), px, of the rows, each from what is learned without the instants (I,) of its own fold (M,), and
    the variance (M, 2), px^2, that the posterior without them has there."""
    residual, variance = rows.displacement_px.copy(), np.empty_like(rows.displacement_px)
    for fold in np.unique(of_row).tolist():
        (coefficients, covariance), here = learned.fit_without(of_instant == fold), of_row == fold
        found = trained.features[rows.frame[here]]
        moved = compute_motions(rows.measured_px[here], trained.observations.image_size)
        residual[here] -= np.einsum("nak,nk->na", moved, found @ coefficients.T)
        variance[here] = _compute_shift_variance(found, covariance, moved)
    return residual, variance


def _compute_shift_variance(features: Float, covariance: Float, motions: Float) -> Float:
    """(N, 2), px^2, of N points with features (N, H) and motions (N, 2, 8), for coefficients' covariance (8, H, H)."""
    of_motions = np.einsum("nh,mhk,nk->nm", features, covariance, features, optimize=True)
    return np.einsum("nam,nm->na", motions**2, of_motions)


def _compute_model_discrepancy_px(taught: _ThermalFit) -> Float:
    """(2,): of set-points left out, or what wanders, the larger of both."""
    return np.maximum(compute_discrepancy_px(taught.rows, taught.held_out), _compute_wander_px(taught))


def _compute_wander_px(taught: _ThermalFit) -> Float:
    """(2,): standard deviation of what wanders, RMS over the markers."""
    moved = compute_motions(taught.rows.measured_px, taught.trained.observations.image_size)
    return np.sqrt((moved**2 @ taught.learned.ou_noise_px2).mean(axis=0))


def _compute_left_out_sessions(taught: _ThermalFit) -> Float:
    """(N,): mean square that a fit of the other sessions leaves of each session, noise taken off, over what that fit's
    posterior says. It shows what of the drift does not repeat between them. Only sessions that can be compared have
    one."""
    trained, rows = taught.trained, taught.rows
    session_index = trained.observations.session[rows.frame].astype(float)
    covered = [
        index
        for index in np.unique(session_index).tolist()
        if _is_covered_by_others(rows.chamber_degC, session_index, index)
    ]
    if not covered:
        return np.zeros(0)
    own = rows.where(np.isin(session_index, covered))
    session_index = trained.observations.session[own.frame].astype(float)
    left, predicted = _compute_held_out_residuals(
        trained, taught.learned, own, taught.learned.instants.session.astype(float), session_index
    )
    squares = left**2 - own.variance_px2
    found = [squares[session_index == index].mean() / predicted[session_index == index].mean() for index in covered]
    return np.maximum(found, 0.0)


def _is_covered_by_others(chamber_degC: Float, session_index: Float, index: float) -> bool:
    """Return whether the other sessions were at all set-points of this one, and at most of all: otherwise a fit without
    it has to extrapolate."""
    own, others = set(chamber_degC[session_index == index].tolist()), set(chamber_degC[session_index != index].tolist())
    return bool(own) and own <= others and len(others) >= _MOST_OF * len(own | others)


def _make_candidate(taught: _ThermalFit) -> Candidate:
    rows, terms = taught.rows, taught.trained.terms
    squares = average_folds(rows, taught.held_out**2)
    return Candidate(
        form="thermal",
        name=format_form_name(terms),
        terms=MOTIONS * len(terms),
        rms_px=make_pair(np.sqrt(squares.mean(axis=0))),
        moving_rms_px=compute_moving_rms_px(taught.moving),
        chosen=True,
        fold_chamber_degC=tuple(np.unique(rows.chamber_degC).tolist()),
        fold_rms_px=tuple(map(make_pair, np.sqrt(squares))),
    )


def _make_model(taught: _ThermalFit, heating_K: float) -> ThermalModel:
    trained, learned, sessions = taught.trained, taught.learned, _compute_left_out_sessions(taught)
    claims = estimate_claims(taught.rows, taught.held_out, taught.predicted_px2, _compute_wander_px(taught), sessions)
    camera_degC = _compute_extent(trained.states.camera_degC[np.unique(trained.rows.frame)])
    found = ThermalModel(
        facts=collect_facts(trained.observations, taught.rows, camera_degC, trained.origin.camera_degC),
        terms=trained.terms,
        reference_ambient_degC=trained.origin.ambient_degC,
        self_heating_K=heating_K,
        reference_features=trained.reference_features,
        coefficients=learned.coefficients,
        coefficient_covariance=learned.covariance,
        leverage_matrix=learned.covariance[0] + learned.covariance[1],
        discrepancy_px=_compute_model_discrepancy_px(taught),
        valid=_compute_range(trained),
        has_warm_up=bool(trained.observations.of(Role.WARM_UP).any()),
        candidates=(_make_candidate(taught),),
        claims=claims,
        prior_px=learned.prior_px,
        between_sessions=BetweenSessions(_compute_more_px(taught, claims), len(sessions)),
    )
    largest = float(found.compute_leverage(trained.states.where(np.unique(trained.rows.frame))).max())
    return replace(found, valid=replace(found.valid, leverage=largest, history_s=_compute_history_s(found)))


def _compute_more_px(taught: _ThermalFit, claims: Claims) -> Pair:
    """What another session adds, along I and J: RMS over the rows at set-points."""
    moved = compute_motions(taught.rows.measured_px, taught.trained.observations.image_size)
    features = taught.trained.features[taught.rows.frame]
    variance_px2 = _compute_shift_variance(features, taught.learned.covariance, moved).mean(axis=0)
    more = max(claims.factors[Question.ANOTHER] - claims.factors[Question.WITHIN], 0.0)
    return make_pair(np.sqrt(more * variance_px2))


def _compute_history_s(model: ThermalModel) -> float:
    """Return how long until what was guessed of the thermal state moves the image by less than the model is uncertain.
    A guess is wrong by the same for all lags."""
    limit_px = max(float(np.hypot(*model.discrepancy_px)), _LEAST_PX)
    moved = compute_motions(model.facts.hull_px, model.facts.image_size)
    guesses = [
        _propagate_initial_error(model, np.array(wrong_K))
        for wrong_K in ((_INITIAL_ERROR_K, _INITIAL_ERROR_K), (_INITIAL_ERROR_K, 0.0))
    ]
    longest_s = SETTLED_TAUS * model.memory.longest_s
    for after_s in np.arange(0.0, longest_s, _STEP_S).tolist():
        left = [model.coefficients @ wrong @ np.exp(-after_s / taus_s) for wrong, taus_s in guesses]
        if math.hypot(*(float(np.linalg.norm(moved @ amounts, axis=1).mean()) for amounts in left)) < limit_px:
            return float(after_s)
    return float(longest_s)


def _propagate_initial_error(model: ThermalModel, wrong_K: Float) -> tuple[Float, Float]:
    """(H, L): how wrong the features are at the reference, to first order, by each of L lags when a state was guessed
    with the camera and the air wrong by so much; and how slowly each lag forgets it (L,)."""
    follower = Follower(model.memory.parts)
    inputs = np.array([model.origin.camera_degC, model.origin.ambient_degC]) + 1j * _TINY * wrong_K
    rest: Any = np.array(follower.rest([*inputs, 1.0]))  # a derivative is the imaginary part by a tiny imaginary step
    lags = [place for place, _, is_play, _ in follower.parts if not is_play]
    values = np.repeat(rest.real[:, None].astype(complex), len(lags), axis=1)
    values[lags, np.arange(len(lags))] += 1j * rest.imag[lags]
    zero = np.zeros(len(lags))
    found = [compiled(model.origin.bind(term.feature), follower.at)(values) + zero for term in model.terms]
    return np.imag(found) / _TINY, follower.taus_s


def _compute_range(trained: Training) -> ThermalRange:
    """Return what the training frames covered; the quickest lag stands for the ambient."""
    states = trained.states.where(np.unique(trained.rows.frame))
    return ThermalRange(
        ambient_degC=_compute_extent(states.of([states.memory.ambient_lag])),
        least_on_s=float(states.on_s.min()),
    )


def _compute_extent(values: Float) -> tuple[float, float]:
    return float(values.min()), float(values.max())
