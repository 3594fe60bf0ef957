"""Sub-pixel centres of round markers: the edge model is fitted to the pixels along each outline.

Gauss-Newton with the weights of the noise model, one marker after the other, in machine code.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntFlag
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from thermostand.markers import edge_model, newton, pixels, sandwich, sectors
from thermostand.markers.edge_model import PARAMETERS, SIGMA, EdgeState, Float, allocate_work
from thermostand.markers.jit import compile_entry, compute_digest
from thermostand.markers.newton import (
    DIVERGED,
    LEAST_BAND_PX,
    SETTLED,
    TOO_FEW,
    Setting,
    Starts,
    compute_inverse,
    compute_mean_radius,
    make_flat_prior,
    settle,
)
from thermostand.markers.noise import Noise
from thermostand.markers.pixels import Picture, allocate_pixels
from thermostand.markers.sandwich import SAMPLED_MARKERS, compute_centre_scatter, count_clusters
from thermostand.markers.sectors import compute_misfits

_SATURATED_PART = 0.1  # round number; nothing was measured


class Flag(IntFlag):
    """What is wrong with a marker; 0 is nothing.

    Attributes
    ----------
    MISSING
        It has no centre; other flags may say why.
    """

    OK = 0
    POOR_FIT = 1
    """The residuals are larger than the noise explains."""
    SATURATED = 2
    """More than a tenth of the band was saturated and left out."""
    BORDER = 4
    """The surroundings, or the disc itself, reach beyond the image."""
    TOO_FEW = 8
    """Fewer than 5 usable pixels per parameter."""
    DIVERGED = 16
    """No ellipse explains the pixels."""
    MISSING = 32
    """No centre: nothing like the marker was seen in its place, or not enough of it."""
    REFITTED = 64
    """A part of it does not look like the others; the centre and its covariance come from the rest (refit.py)."""


_BORDER, _SATURATED, _TOO_FEW, _DIVERGED = map(int, (Flag.BORDER, Flag.SATURATED, Flag.TOO_FEW, Flag.DIVERGED))


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """state: what was fitted. covariance: of its parameters (N, 12, 12), noise times chi^2. chi: (N,), 1 when the noise
    model explains the residuals; misfit: (N,), the same sector by sector; levels: (N,), that of ground and disc next to
    the outline (sectors.py). scatter: (N, 2, 2), the centre's cluster-robust variances and those of independent
    residuals, px^2, NaN for markers that were not looked at for this (sandwich.py). flags: (N,) uint8 of Flag.
    Markers that failed keep their start values, with NaN in the others.
    """

    state: EdgeState
    covariance: Float
    chi: Float
    misfit: Float
    levels: Float
    scatter: Float
    flags: NDArray[np.uint8]

    @property
    def covariance_px2(self) -> Float:
        """The covariances of the centres (N, 2, 2)."""
        return self.covariance[:, :2, :2]


def fit_edges(
    image: Picture,
    start: EdgeState,
    noise: Noise,
    reach: Float,
    band_sigma: float = 9.0,
    sampled: int = SAMPLED_MARKERS,
) -> EdgeFit:
    """Fit every marker of `start`. `reach` (N, 2): from where to where, in radii from the centre, a marker's pixels may
    lie, so that its band ends half way to its hole and to the neighbours. band_sigma: half width of the band, blurs.
    sampled: about how many markers are looked at for `scatter`. The image is only read.
    """
    count = len(start.scale_px)
    parameters = np.ascontiguousarray(start.parameters).copy()
    found = _Fitted(
        covariance=np.empty((count, PARAMETERS, PARAMETERS)),
        quality=np.empty((count, 3)),
        scatter=np.empty((count, 2, 2)),
        flags=np.empty(count, np.uint8),
    )
    # A copy of `reach`: read-only memory would be another type to the compiler.
    starts = Starts(parameters, start.scale_px, np.array(reach, np.float64))
    _fit_all(make_setting(image, start, noise, band_sigma), starts, max(1, count // sampled), found)
    chi, misfit, levels = found.quality.T
    return EdgeFit(
        state=EdgeState(parameters, start.scale_px),
        covariance=found.covariance,
        chi=chi,
        misfit=misfit,
        levels=levels,
        scatter=found.scatter,
        flags=found.flags,
    )


class _Fitted(NamedTuple):
    """What is found of N markers besides their parameters; quality (N, 3): chi and misfits."""

    covariance: Float
    quality: Float
    scatter: Float
    flags: NDArray[np.uint8]


def make_setting(image: Picture, start: EdgeState, noise: Noise, band_sigma: float) -> Setting:
    """Make the setting of fits from `start`."""
    pixels = allocate_pixels(_compute_capacity(image, start, band_sigma))
    variance = noise.floor_DN2, noise.slope_DN
    return Setting(image, variance, image.full_scale_DN - 1, band_sigma, pixels, allocate_work())


def _compute_capacity(image: Picture, start: EdgeState, band_sigma: float) -> int:
    """Pixels of the largest marker with its band, when it turns out half as large again and six times as blurred."""
    side = 3 * start.half_extents_px() + 12 * np.maximum(band_sigma * start.parameters[:, SIGMA, None], LEAST_BAND_PX)
    return int(min(np.nanmax(np.prod(side + 3, axis=1), initial=1), image.shape[0] * image.shape[1]))


def _compile_fit(sources: str) -> Callable[..., None]:
    @compile_entry
    def fit_all(setting: Setting, starts: Starts, every: int, found: _Fitted) -> None:
        """Fit each row of the parameters in place. every: how many markers apart those are that are looked at for
        `scatter`."""
        _ = sources
        belief, pixels, noise = make_flat_prior(), setting.pixels, setting.noise
        covariance, quality, scatter, flags = found
        scatter[:] = math.nan
        for n in range(len(starts.scale)):
            p, scale = starts.parameters[n].copy(), starts.scale[n]
            outcome = settle(setting, p, scale, starts.reach[n], belief)
            flags[n] = _BORDER * outcome.cut + _SATURATED * (outcome.burnt > _SATURATED_PART * outcome.seen)
            if outcome.status == SETTLED:
                unscaled = compute_inverse(setting.work)
                for i in range(PARAMETERS):
                    starts.parameters[n, i] = p[i]
                    for j in range(PARAMETERS):
                        covariance[n, i, j] = unscaled[i, j] * outcome.variance
                quality[n, 0] = math.sqrt(outcome.variance)
                quality[n, 1], quality[n, 2] = compute_misfits(pixels, p)
                if n % every == 0:
                    clusters = count_clusters(compute_mean_radius(p, scale))
                    robust, independent = compute_centre_scatter(pixels, p, scale, noise, unscaled, clusters)
                    for axis in range(2):
                        scatter[n, 0, axis] = robust[axis]
                        scatter[n, 1, axis] = independent[axis] * outcome.variance
            else:
                covariance[n], quality[n] = math.nan, math.nan
                flags[n] += _TOO_FEW * (outcome.status == TOO_FEW) + _DIVERGED * (outcome.status == DIVERGED)

    return fit_all


_fit_all = _compile_fit(compute_digest(pixels, edge_model, newton, sandwich, sectors))
