"""Looks for a step in a series of values that otherwise follow a thermal state, with noise and a slow wander.

The values (K,) at K instants are Gaussian: features times amounts drawn from a wide distribution, a place that wanders
(Ornstein-Uhlenbeck, 2 h), and white noise. How large these are is chosen for each series by its likelihood, from a
grid, with and without a step: so a step has to explain what neither the thermal state nor the camera's usual wander
explains (Rasmussen and Williams, Gaussian Processes for Machine Learning, 2006, section 2.7).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import product

import numpy as np
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from thermostand.compensation.history.states import Float

_WANDER_H = 2.0
_AMOUNTS_PX = (0.03, 0.15, 0.6)
_WANDERS_PX = (0.0, 0.002, 0.006, 0.02)
_NOISES_PX = (0.0005, 0.0015, 0.004, 0.012)
_WIDE_PX = 3.0
"""What is known of a step that was found, before it is estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class Scan:
    """gain (B,): by how much the log likelihood grows with a step at each of B boundaries. amount_px, sigma_px (B,): of
    that step, and its standard uncertainty."""

    gain: Float
    amount_px: Float
    sigma_px: Float


@dataclass(frozen=True, slots=True, eq=False)
class Whitened:
    """The grid's covariances (G, K, K) as inverse Cholesky factors, and their log determinants (G,); steps (G, K, B):
    the candidates, whitened."""

    inverse: Float
    log_determinant: Float
    steps: Float


def whitened(features: Float, hours: Float, variance_px2: Float, steps: Float, known: Float) -> Whitened:
    """features (K, H), about 1. hours (K,): of the instants. variance_px2 (K,): of the values' own noise. steps (K, B):
    the candidates, 0 or 1. known (K, S): steps that were found already."""
    inverses: list[Float] = []
    for covariance, _ in _grid(features, hours, variance_px2, known):
        lower = np.linalg.cholesky(covariance)
        inverses.append(np.asarray(solve_triangular(lower, np.eye(len(hours)), lower=True)))
    inverse = np.array(inverses)
    log_determinant = -2 * np.log(np.diagonal(inverse, axis1=1, axis2=2)).sum(axis=1)
    return Whitened(inverse, log_determinant, inverse @ steps)


def scan(white: Whitened, values_px: Float) -> Scan:
    """Of values (K,)."""
    own = white.inverse @ values_px
    without = -0.5 * ((own**2).sum(axis=1) + white.log_determinant)
    along = np.einsum("gkb,gk->gb", white.steps, own)
    square = (white.steps**2).sum(axis=1)
    with_step = without[:, None] + 0.5 * along**2 / square
    best = with_step.argmax(axis=0)
    at = np.arange(square.shape[1])
    return Scan(
        gain=with_step[best, at] - without.max(),
        amount_px=along[best, at] / square[best, at],
        sigma_px=1 / np.sqrt(square[best, at]),
    )


def unexplained(features: Float, hours: Float, variance_px2: Float, known: Float, values_px: Float) -> Float:
    """(K,): what neither the thermal state nor the known steps explain of values (K,), without their own noise: wander
    and scatter, as expected with the likeliest of the grid's covariances."""
    best, found = -np.inf, np.zeros(len(hours))
    for covariance, of_rest in _grid(features, hours, variance_px2, known):
        factor = cho_factor(covariance, lower=True)
        weights = np.asarray(cho_solve(factor, values_px))
        likelihood = float(-0.5 * values_px @ weights - np.log(np.diagonal(factor[0])).sum())
        if likelihood > best:
            best, found = likelihood, of_rest @ weights
    return found


def _grid(features: Float, hours: Float, variance_px2: Float, known: Float) -> Iterator[tuple[Float, Float]]:
    """Covariances (K, K) of values, and of the part that is wander and scatter."""
    of_features = features @ features.T
    of_wander = np.exp(-np.abs(hours[:, None] - hours) / _WANDER_H)
    fixed = _WIDE_PX**2 * (known @ known.T + 1) + np.diag(variance_px2)
    for amount, wander, noise in product(_AMOUNTS_PX, _WANDERS_PX, _NOISES_PX):
        of_rest = wander**2 * of_wander + noise**2 * np.eye(len(hours))
        yield fixed + amount**2 * of_features + of_rest, of_rest
