"""What was tried, how well it did at temperatures left out, and which is in use: the table of a model's choice."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from compensation.drift.displacements import Displacements
from compensation.history.states import Float
from foundation.documents import Document

Pair = tuple[float, float]


class Candidate(Document):
    """One form and what leave-temperatures-out says of it; a fold is one chamber set-point with all its visits.

    form: paper or thermal. name: in words. terms: coefficients of both coordinates together. rms_px: held-out RMS along
    I and J, all folds counting the same; fold_rms_px: of each fold. bic: None for the paper's form, which learns from
    other frames. chosen: whether it is the best of its form.
    """

    form: str
    name: str
    terms: int
    rms_px: Pair
    bic: float | None
    chosen: bool
    fold_chamber_degC: tuple[float, ...]
    fold_rms_px: tuple[Pair, ...]

    @property
    def fold_squares(self) -> Float:
        """(folds,): mean square of both coordinates, px^2."""
        return (np.array(self.fold_rms_px) ** 2).sum(axis=1)


def fold_means(rows: Displacements, values: Float) -> Float:
    """Means (folds, 2) of values (M, 2) over each chamber set-point."""
    return np.array([values[rows.chamber_degC == fold].mean(axis=0) for fold in np.unique(rows.chamber_degC)])


def discrepancy_px(rows: Displacements, held_out: Float) -> Float:
    """(2,): RMS of the held-out residuals, all folds counting the same, after the noise of the markers is taken off;
    0 when noise explains all."""
    return np.sqrt(np.maximum(fold_means(rows, held_out**2 - rows.variance_px2).mean(axis=0), 0))


def as_good_as_best(fold_squares: Sequence[Float]) -> list[int]:
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
