"""Levenberg-Marquardt for whitened residuals of anything that can be linearised and stepped.

Residuals have unit variance, so the inverse of the normal matrix at the solution is the covariance of the parameters.
Normal equations: with 34 positions of 54 markers a step has some 240 parameters, which are solved for in a millisecond.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve

from thermostand.foundation.errors import CalibrationError

Float = NDArray[np.float64]
State = TypeVar("State")

# A bound only: a fit that takes as many steps does not converge.
_STEPS = 200
_FIRST_DAMPING = 1e-6  # nearly Gauss-Newton from the first step on, since OpenCV and the poses give the start
_GREATEST_DAMPING = 1e8  # steps are then too short to lower anything: the fit has failed
_CONVERGED = 1e-7
"""Expected fall of the sum of squares, relative to it (or to 1): a small part of any parameter's standard deviation."""


@dataclass(frozen=True, slots=True, eq=False)
class Solution(Generic[State]):
    """The state with the least sum of squares `cost`, and the covariance (n, n) of steps away from it."""

    state: State
    cost: float
    covariance: Float


# SciPy's solvers step one vector and end by relative changes; here a step turns rotations in place, and ends by the
# expected fall of the sum of squares.
def minimise(
    start: State,
    residuals: Callable[[State], Float],
    equations: Callable[[State, Float], tuple[Float, Float]],
    step: Callable[[State, Float], State],
) -> Solution[State]:
    """Minimise the sum of squares of residuals r (m,).

    equations: J' J (n, n) and J' r (n,) of a state and its residuals, with their derivatives J (m, n) with respect to
    `step`'s vector; see `make_equations`.

    CalibrationError when it does not converge, or when some parameter leaves all residuals unchanged.
    """
    state, damping = start, _FIRST_DAMPING
    current = residuals(state)
    for _ in range(_STEPS):
        normal, gradient = equations(state, current)
        scale = _compute_scale(normal)
        while True:
            change = -scale * _solve_damped(normal * scale[:, None] * scale, gradient * scale, damping)
            cost = float(current @ current)
            expected = -float(change @ (2 * gradient + normal @ change))
            if expected <= _CONVERGED * max(cost, 1.0):
                return Solution(state, cost, _invert(normal, scale))
            tried = step(state, change)
            after = residuals(tried)
            gain = (cost - float(after @ after)) / expected
            if gain > 0:
                break
            damping = max(10 * damping, 1e-3)
            if damping > _GREATEST_DAMPING:
                raise CalibrationError("the fit does not converge: every step makes the residuals larger")
        state, current = tried, after
        damping *= max(0.1, 1 - (2 * gain - 1) ** 3)  # Nielsen's rule: trust as far as the prediction held
    raise CalibrationError(f"the fit does not converge in {_STEPS} steps")


def make_equations(jacobian: Callable[[State], Float]) -> Callable[[State, Float], tuple[Float, Float]]:
    """The equations of derivatives (m, n) that are written out."""

    def equations(state: State, residuals: Float) -> tuple[Float, Float]:
        slopes = jacobian(state)
        return slopes.T @ slopes, slopes.T @ residuals

    return equations


def compute_whiteners(covariance: Float) -> Float:
    """Matrices (..., n, n) that give vectors of these covariances (..., n, n) unit variance."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)), np.float64)


def update_discrepancy(sigma2_px2: float, discrepancy_px: float, excess: float) -> float:
    """The discrepancy with which the squares would be as expected if residuals stayed as they are. excess: the squares
    over their expectation. sigma2_px2: variance of the detection."""
    return float(np.sqrt(max(0.0, (sigma2_px2 + discrepancy_px**2) * excess - sigma2_px2)))


def compute_normalised_lengths(residuals_px: Float, covariance_px2: Float, discrepancy_px: float) -> Float:
    """(M,): lengths of residuals (M, 2) in units of what noise (M, 2, 2) and discrepancy make likely."""
    inverse = np.linalg.inv(covariance_px2 + discrepancy_px**2 * np.eye(2))
    return np.sqrt(np.einsum("mi,mij,mj->m", residuals_px, inverse, residuals_px))


def _compute_scale(normal: Float) -> Float:
    diagonal = np.diag(normal)
    if not np.all(np.isfinite(diagonal)) or np.any(diagonal <= 0):
        raise CalibrationError("the observations do not determine all parameters")
    return 1 / np.sqrt(diagonal)


def _solve_damped(scaled: Float, gradient: Float, damping: float) -> Float:
    """The damped step; damping grows until the matrix is positive definite."""
    identity = np.eye(len(scaled))
    while damping <= _GREATEST_DAMPING:
        try:
            return cho_solve(cho_factor(scaled + damping * identity), gradient)
        except LinAlgError:
            damping = max(10 * damping, 1e-12)
    raise CalibrationError("the observations do not determine all parameters")


def _invert(normal: Float, scale: Float) -> Float:
    try:
        factor = cho_factor(normal * scale[:, None] * scale)
    except LinAlgError as error:
        raise CalibrationError("the observations do not determine all parameters") from error
    inverse = cho_solve(factor, np.eye(len(normal)))
    return inverse * scale[:, None] * scale
