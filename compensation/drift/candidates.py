"""What was tried, how well it did at temperatures left out, and which is in use: the table of a model's choice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from pydantic import model_validator

from thermostand.compensation.drift.displacements import Displacements
from thermostand.compensation.history.thermal_history import Float
from thermostand.foundation.documents import Document

Pair = tuple[float, float]

# With two the variance has one degree of freedom, for which Student's factor is 6.5.
FEWEST_BETWEEN = 3
NEGLIGIBLE_PX = 0.0005
"""Worse by less than anybody measures."""


class Candidate(Document):
    """One form and what leave-temperatures-out says of it; a fold is one chamber set-point with all its visits.

    form: paper or thermal. name: in words. terms: coefficients of both coordinates together. rms_px: held-out RMS along
    I and J, all folds counting the same; fold_rms_px: of each fold. moving_rms_px: of frames on the way to set-points
    and after switching on, held out as well, of the one in use, where such were recorded. chosen: whether it is the
    best of its form.
    """

    form: str
    name: str
    terms: int
    rms_px: Pair
    moving_rms_px: Pair | None = None
    chosen: bool
    fold_chamber_degC: tuple[float, ...]
    fold_rms_px: tuple[Pair, ...]

    @model_validator(mode="after")
    def _check_consistent(self) -> Candidate:
        check_folds(self.fold_chamber_degC, self.fold_rms_px)
        return self

    @property
    def fold_squares(self) -> Float:
        """(folds,): mean square of both coordinates, px^2."""
        return (np.array(self.fold_rms_px) ** 2).sum(axis=1)

    @property
    def squares_between(self) -> Float:
        """(folds,): of the set-points between others, by which forms and families are chosen."""
        return self.fold_squares[find_interior(np.array(self.fold_chamber_degC))]


def check_folds(fold_chamber_degC: tuple[float, ...], fold_rms_px: tuple[Pair, ...]) -> None:
    """ValueError when there are not as many of one as of the other."""
    if len(fold_chamber_degC) != len(fold_rms_px):
        raise ValueError(f"fold_rms_px: {len(fold_rms_px)} for {len(fold_chamber_degC)} set-points")


def make_pair(values: Float) -> Pair:
    """Make a pair of an array of shape (2,)."""
    i, j = values.tolist()
    return i, j


def compute_rms_px(deviations: Float) -> Pair:
    """RMS of deviations (M, 2) along I and J."""
    return make_pair(np.sqrt((deviations**2).mean(axis=0)))


def compute_moving_rms_px(residual: Float) -> Pair | None:
    """RMS of residuals (M, 2) of frames that were not at rest; None where there are none."""
    return compute_rms_px(residual) if len(residual) else None


def average_folds(rows: Displacements, values: Float) -> Float:
    """Means (folds, 2) of values (M, 2) over each chamber set-point."""
    return np.array([values[rows.chamber_degC == fold].mean(axis=0) for fold in np.unique(rows.chamber_degC)])


def find_interior(chamber_degC: Float) -> NDArray[np.bool_]:
    """(M,): set-points that have others on both sides; all, when fewer than three have.

    Without the coldest or the warmest a fit has to extrapolate, which the model is flagged for and need not claim to
    do: such folds say little of how well it predicts where it may be used.
    """
    inner = (chamber_degC > chamber_degC.min()) & (chamber_degC < chamber_degC.max())
    return inner if len(np.unique(chamber_degC[inner])) >= FEWEST_BETWEEN else np.ones(len(chamber_degC), bool)


def compute_discrepancy_px(rows: Displacements, held_out: Float) -> Float:
    """(2,): RMS of the held-out residuals (M, 2) of set-points between others, each counting the same, after the noise
    of the markers is taken off; 0 when noise explains all.

    It is a standard deviation known from n folds only. Student's t for n - 1 degrees of freedom instead of the normal
    distribution makes the 95 % interval right again: a factor of 1.15 for 10 folds, 2.2 for 3.
    """
    inner = find_interior(rows.chamber_degC)
    squares = average_folds(rows.where(inner), (held_out**2 - rows.variance_px2)[inner])
    return compute_student_factor(len(squares)) * np.sqrt(np.maximum(squares.mean(axis=0), 0))


def compute_student_factor(folds: int) -> float:
    """The 95 % quantile of Student's t over that of the normal distribution (Cornish-Fisher, third order, 3 % off at 2
    degrees of freedom, 1 % at 3)."""
    freedom, z = max(folds - 1, 2), 1.959964
    first = (z**2 + 1) / 4
    second = (5 * z**4 + 16 * z**2 + 3) / 96
    third = (3 * z**6 + 19 * z**4 + 17 * z**2 - 15) / 384
    return 1 + first / freedom + second / freedom**2 + third / freedom**3


def list_equivalent_to_best(fold_squares: Sequence[Float]) -> list[int]:
    """The candidates whose held-out mean square is within one standard error of the best, the best included.

    The standard error is that of the difference, fold by fold: what is common to both (a set-point that is hard for
    every candidate) does not count.
    """
    squares = np.array(fold_squares)
    best = int(np.argmin(squares.mean(axis=1)))
    found: list[int] = []
    for index, own in enumerate(squares):
        worse = own - squares[best]
        if index == best or worse.mean() <= worse.std(ddof=1) / np.sqrt(len(worse)):
            found.append(index)
    return found
