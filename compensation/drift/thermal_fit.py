"""What instants teach of the terms' coefficients, each motion by itself.

amount = features . c + wander + noise. The coefficients c of each group of terms are Gaussian about 0, as wide as makes
the night most likely (its evidence: Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, sections 2.1
and 5.4): a camera that no play moves gets coefficients of plays near 0, and a state unlike those of the night an
uncertain answer. The wander (Ornstein-Uhlenbeck) is of fixings that slip or settle again; without it a hundred frames
of one dwell would count as a hundred answers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from thermostand.compensation.drift.condensed import Index, Instants
from thermostand.compensation.drift.terms import MOTIONS, Term
from thermostand.compensation.history.states import Float

_WANDERS, _WANDER_TAUS_S = (1.0, 2.0, 4.0), (1800.0, 7200.0)
"""Standard deviation of the wander over that of an instant's noise."""
_USUAL, _UNSURE = math.log(20.0), 3.0
"""A coefficient is expected to be 20 times the noise, within a factor of e^3: a weak prior on the widths."""
_UNSAID = 1.25
"""One night shows states in one order only, and its most likely widths and terms are taken for the true ones: on other
nights answers are off by this much more than their posterior says (24 drawn cameras, docs/decisions.md)."""
_WIDTHS, _NOISES = (math.log(1e-3), math.log(1e4)), (0.0, math.log(1e4))
_ROUNDS = 60


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    """Normal equations of the features (H, H), moments (H, 8) and square sums (8,) of the amounts, weighted with the
    precision of wander and noise; count of instants, log determinant of their covariance."""

    gram: Float
    moment: Float
    square: Float
    count: int
    log_determinant: float


@dataclass(frozen=True, slots=True, eq=False)
class _Weighting:
    """One size and time constant of the wander. precision (I, I) of wander and noise, in units of the noise."""

    wander: float
    precision: Float
    log_determinant: float


@dataclass(frozen=True, slots=True, eq=False)
class _Believed:
    """Of one motion. widths (H,): of the prior, noise: of an instant, both in units of the noise that markers have."""

    weighting: _Weighting
    widths: Float
    noise: float


@dataclass(frozen=True, slots=True, eq=False)
class Learned:
    """coefficients (8, H), px, and their covariance (8, H, H), px^2. wander_px2 (8,): variance of what wanders."""

    instants: Instants
    coefficients: Float
    covariance: Float
    wander_px2: Float
    _scale_px: Float
    _believed: tuple[_Believed, ...]

    def without(self, left_out: NDArray[np.bool_]) -> Float:
        """(8, H): what the instants teach without some of them (I,), with the same prior and noise."""
        found = np.empty_like(self.coefficients)
        rows = np.flatnonzero(left_out)
        amounts = self.instants.amounts_px / self._scale_px
        for motion, own in enumerate(self._believed):
            known = _equations(self.instants.features, amounts, own.weighting, rows)
            found[motion] = _solved(known, motion, own)[0] * self._scale_px[motion]
        return found

    def doubt(self, fold: Float) -> Float:
        """(8, H, H), px^2: how much the coefficients hang on any one of the folds (I,), NaN in none; the jackknife's
        variance (Efron and Tibshirani, An Introduction to the Bootstrap, 1993, chapter 11). What no term explains, a
        dead zone of a part that nobody measures, pulls each of them its own way, and the posterior knows nothing of it.
        """
        each = np.array([self.without(fold == value) for value in np.unique(fold[np.isfinite(fold)])])
        away = each - each.mean(axis=0)
        return np.einsum("kmg,kmh->mgh", away, away) * (len(each) - 1) / len(each)


def learn(instants: Instants, terms: Sequence[Term]) -> Learned:
    """The most likely prior and noise of each motion, and what they make of these instants."""
    groups = list(dict.fromkeys(term.width for term in terms))
    group = np.array([groups.index(term.width) for term in terms])
    scale_px = np.sqrt(np.median(instants.variance_px2, axis=0))
    amounts = instants.amounts_px / scale_px
    best: list[tuple[float, Float, _Weighting] | None] = [None] * MOTIONS
    for weighting in _weightings(instants, (instants.variance_px2 / scale_px**2).mean(axis=1)):
        known = _equations(instants.features, amounts, weighting)
        for motion, before in enumerate(best):
            start = np.append(np.full(len(groups), _USUAL), 0.0) if before is None else before[1]
            value, found = _most_likely(known, motion, group, start)
            if before is None or value < before[0]:
                best[motion] = value, found, weighting
    believed = tuple(
        _Believed(weighting, np.exp(found[group]), math.exp(found[-1])) for _, found, weighting in filter(None, best)
    )
    solved = [
        _solved(_equations(instants.features, amounts, own.weighting), motion, own)
        for motion, own in enumerate(believed)
    ]
    return Learned(
        instants,
        np.array([coefficients for coefficients, _ in solved]) * scale_px[:, None],
        np.array([covariance for _, covariance in solved]) * (_UNSAID * scale_px[:, None, None]) ** 2,
        np.array([(own.noise * own.weighting.wander) ** 2 for own in believed]) * scale_px**2,
        scale_px,
        believed,
    )


def _weightings(instants: Instants, variance: Float) -> Iterator[_Weighting]:
    apart_s = np.abs(instants.time_s[:, None] - instants.time_s)
    same = instants.session[:, None] == instants.session
    for wander, tau_s in [(0.0, 1.0), *product(_WANDERS, _WANDER_TAUS_S)]:
        covariance = np.diag(variance) + wander**2 * np.where(same, np.exp(-apart_s / tau_s), 0.0)
        half = np.linalg.inv(np.linalg.cholesky(covariance))
        yield _Weighting(wander, half.T @ half, -2 * float(np.log(np.diagonal(half)).sum()))


def _equations(features: Float, amounts: Float, weighting: _Weighting, left_out: Index | None = None) -> _Equations:
    """Without the instants that are left out: the precision of the others is B - B_rf B_ff^-1 B_fr."""
    weighted, projected = weighting.precision @ features, weighting.precision @ amounts
    gram, moment, square = features.T @ weighted, features.T @ projected, (amounts * projected).sum(axis=0)
    count = len(features)
    if left_out is not None:
        own = np.linalg.inv(weighting.precision[np.ix_(left_out, left_out)]) @ weighted[left_out]
        gram, moment = gram - weighted[left_out].T @ own, moment - own.T @ projected[left_out]
        count -= len(left_out)
    return _Equations(gram, moment, square, count, weighting.log_determinant)


def _solved(known: _Equations, motion: int, own: _Believed) -> tuple[Float, Float]:
    """Coefficients (H,) and their covariance (H, H), in units of the noise."""
    precision = own.widths[:, None] * known.gram * own.widths / own.noise**2 + np.eye(len(own.widths))
    inverse = np.linalg.inv(precision)
    coefficients = inverse @ (own.widths * known.moment[:, motion]) / own.noise**2
    return own.widths * coefficients, own.widths[:, None] * inverse * own.widths


def _most_likely(known: _Equations, motion: int, group: Index, start: Float) -> tuple[float, Float]:
    """The least negative log evidence, and the logarithms of widths of each group and noise that have it."""
    moment, square, groups = known.moment[:, motion], float(known.square[motion]), len(start) - 1

    def negative(logs: Float) -> tuple[float, Float]:
        widths, per_noise = np.exp(logs[group]), math.exp(-2 * logs[-1])
        explained = widths[:, None] * known.gram * widths * per_noise
        inverse = np.linalg.inv(explained + np.eye(len(group)))
        projected = widths * moment * per_noise
        found = inverse @ projected
        free = np.diagonal(inverse)
        beyond = (logs[:-1] - _USUAL) / _UNSURE
        value = (
            0.5 * float(square * per_noise - projected @ found)
            - 0.5 * float(np.linalg.slogdet(inverse)[1])
            + known.count * float(logs[-1])
            + 0.5 * (known.log_determinant + float(beyond @ beyond))
        )
        of_widths = np.bincount(group, 1 - free - found**2, groups) + beyond / _UNSURE
        left = square * per_noise - 2 * projected @ found + found @ explained @ found
        return value, np.append(of_widths, known.count - left - (len(group) - free.sum()))

    limits = [_WIDTHS] * groups + [_NOISES]
    result = minimize(negative, start, jac=True, method="L-BFGS-B", bounds=limits, options={"maxiter": _ROUNDS})
    return float(result.fun), np.asarray(result.x, np.float64)
