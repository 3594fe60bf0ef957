"""The frames of one pose -> one centre per marker."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thermostand.compensation.calibration.least_squares import Float


@dataclass(frozen=True, slots=True, eq=False)
class MeanCentres:
    """centres_px (N, 2): weighted means, NaN for a marker that no frame has. covariance_px2 (N, 2, 2): of the means, as
    the frames' covariances predict. squares: whitened scatter of the frames about the means, degrees: its degrees of
    freedom."""

    centres_px: Float
    covariance_px2: Float
    squares: float
    degrees: int


def mean_centres(centres_px: Float, covariance_px2: Float) -> MeanCentres:
    """Of frames' centres (F, N, 2) and covariances (F, N, 2, 2); NaN where a frame lacks a marker."""
    good = np.isfinite(centres_px[:, :, 0])
    information = np.zeros_like(covariance_px2)
    information[good] = np.linalg.inv(covariance_px2[good])
    total = information.sum(axis=0)
    seen = good.any(axis=0)
    covariance = np.full(total.shape, np.nan)
    covariance[seen] = np.linalg.inv(total[seen])
    weighted = np.einsum("fnij,fnj->ni", information, np.where(good[:, :, None], centres_px, 0.0))
    mean = np.einsum("nij,nj->ni", covariance, weighted)
    off = np.where(good[:, :, None], centres_px - mean, 0.0)
    squares = float(np.einsum("fni,fnij,fnj->", off, information, off))
    return MeanCentres(mean, covariance, squares, 2 * int(good.sum() - seen.sum()))


def scatter_chi(means: list[MeanCentres]) -> float:
    """Scatter of the frames about their means over the scatter predicted; NaN when there is one frame each."""
    degrees = sum(mean.degrees for mean in means)
    return float(np.sqrt(sum(mean.squares for mean in means) / degrees)) if degrees else float("nan")
