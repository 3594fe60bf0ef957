"""Normal equations of motions times features, and their solutions: any subset of features, any fold left out."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from compensation.drift.instants import Instants
from compensation.drift.terms import MOTIONS
from compensation.history.states import Float

Columns = NDArray[np.int64]

RIDGE, RIDGE_WITH_PLAYS = 1e-7, 1e-5
"""Relative to the mean of the diagonal: keeps features that hardly differ from running away."""


@dataclass(frozen=True, slots=True, eq=False)
class Equations:
    """normal (8, H, 8, H), moment (8, H) of `instants` instants, and the square sum of what they measured."""

    normal: Float
    moment: Float
    square: float
    instants: int

    def __sub__(self, fold: Equations) -> Equations:
        """Without the instants of a fold."""
        return Equations(
            self.normal - fold.normal,
            self.moment - fold.moment,
            self.square - fold.square,
            self.instants - fold.instants,
        )


@dataclass(frozen=True, slots=True, eq=False)
class ThermalSolution:
    """coefficients (8, H), px; covariance (8, H, 8, H), px^2, times chi^2 per degree of freedom: the weights
    of instants are relative. bic: Bayesian information criterion, less is better."""

    coefficients: Float
    covariance: Float
    bic: float


def equations(instants: Instants) -> Equations:
    """The weighted normal equations for all features."""
    count, features = instants.features.shape
    products = (instants.features[:, :, None] * instants.features[:, None, :]).reshape(count, -1)
    normal = instants.normal.reshape(count, -1).T @ products
    return Equations(
        normal.reshape(MOTIONS, MOTIONS, features, features).transpose(0, 2, 1, 3),
        instants.moment.T @ instants.features,
        instants.square,
        count,
    )


def solve_thermal(known: Equations, columns: Columns, ridge: float) -> ThermalSolution:
    """The fit with the features `columns`; LinAlgError when the instants do not determine it.

    BIC = n log(chi^2/n) + k log n with the n = 8 numbers that each instant gives and k coefficients.
    """
    count = MOTIONS * len(columns)
    if known.instants * MOTIONS <= count:
        raise np.linalg.LinAlgError(f"{known.instants} instants for {len(columns)} features")
    normal = known.normal[:, columns][:, :, :, columns].reshape(count, count)
    moment = known.moment[:, columns].ravel()
    damped = normal + ridge * np.trace(normal) / count * np.eye(count)
    inverse = np.linalg.inv(damped)
    solution = inverse @ moment
    chi2 = max(known.square - 2 * solution @ moment + solution @ normal @ solution, 1e-9)
    numbers = known.instants * MOTIONS
    shape = (MOTIONS, len(columns))
    return ThermalSolution(
        coefficients=solution.reshape(shape),
        covariance=(inverse * (chi2 / (numbers - count))).reshape(shape * 2),
        bic=numbers * math.log(chi2 / numbers) + count * math.log(numbers),
    )
