"""Sub-pixel centres of round markers: the edge model is fitted to the pixels along each outline.

Gauss-Newton with the weights of the noise model, one marker after the other, in machine code.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from thermostand.markers import edge_model, newton, pixels, sandwich, sectors
from thermostand.markers.compiled import digest, entry
from thermostand.markers.edge_model import PARAMETERS, SIGMA, EdgeState, Float, Variance
from thermostand.markers.newton import (
    DIVERGED,
    LEAST_BAND_PX,
    SETTLED,
    TOO_FEW,
    Work,
    inverse,
    mean_radius,
    no_belief,
    settle,
)
from thermostand.markers.noise import Noise
from thermostand.markers.pixels import Picture, Pixels, empty_pixels
from thermostand.markers.sandwich import SAMPLED_MARKERS, centre_scatter, clusters_of
from thermostand.markers.sectors import misfits

_SATURATED_PART = 0.1


class Flag(IntFlag):
    """What is wrong with a marker; 0 is nothing. MISSING: it has no centre; other flags may say why."""

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
    model explains the residuals; misfit: (N,), the same sector by sector; levels: (N,), that of ground and disc beside
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
        """Of the centres (N, 2, 2)."""
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
    covariance, quality, scatter, flags = (
        np.empty((count, PARAMETERS, PARAMETERS)),
        np.empty((count, 3)),
        np.empty((count, 2, 2)),
        np.empty(count, np.uint8),
    )
    # A copy of `reach`: read-only memory would be another type to the compiler.
    _fit_all(
        image, parameters, start.scale_px, np.array(reach, np.float64),
        (noise.floor_DN2, noise.slope_DN), image.full_scale_DN - 1, empty_pixels(room(image, start, band_sigma)),
        band_sigma, max(1, count // sampled),
        covariance, quality, scatter, flags,
    )  # fmt: skip
    return EdgeFit(
        EdgeState(parameters, start.scale_px), covariance, quality[:, 0], quality[:, 1], quality[:, 2], scatter, flags
    )


def room(image: Picture, start: EdgeState, band_sigma: float) -> int:
    """Pixels of the largest marker with its band, when it turns out half as large again and six times as blurred."""
    side = 3 * start.half_extents_px() + 12 * np.maximum(band_sigma * start.parameters[:, SIGMA, None], LEAST_BAND_PX)
    return int(min(np.nanmax(np.prod(side + 3, axis=1), initial=1), image.shape[0] * image.shape[1]))


def _compiled_fit(sources: str) -> Callable[..., None]:
    @entry
    def fit_all(
        image: Picture,
        parameters: Float,
        scale: Float,
        reach: Float,
        noise: Variance,
        ceiling: int,
        pixels: Pixels,
        band_sigma: float,
        every: int,
        covariance: Float,
        quality: Float,
        scatter: Float,
        flags: NDArray[np.uint8],
    ) -> None:
        """Fit each row of `parameters` in place; chi and misfits into `quality` (N, 3)."""
        _ = sources
        work = Work(np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS))
        belief = no_belief()
        scatter[:] = math.nan
        for n in range(len(scale)):
            p = parameters[n].copy()
            outcome = settle(image, p, scale[n], reach[n], noise, ceiling, pixels, work, belief, band_sigma)
            flags[n] = _BORDER * outcome.cut + _SATURATED * (outcome.burnt > _SATURATED_PART * outcome.seen)
            if outcome.status == SETTLED:
                unscaled = inverse(work)
                for i in range(PARAMETERS):
                    parameters[n, i] = p[i]
                    for j in range(PARAMETERS):
                        covariance[n, i, j] = unscaled[i, j] * outcome.variance
                quality[n, 0] = math.sqrt(outcome.variance)
                quality[n, 1], quality[n, 2] = misfits(pixels, p)
                if n % every == 0:
                    clusters = clusters_of(mean_radius(p, scale[n]))
                    robust, independent = centre_scatter(pixels, p, scale[n], noise, unscaled, clusters)
                    for axis in range(2):
                        scatter[n, 0, axis] = robust[axis]
                        scatter[n, 1, axis] = independent[axis] * outcome.variance
            else:
                covariance[n], quality[n] = math.nan, math.nan
                flags[n] += _TOO_FEW * (outcome.status == TOO_FEW) + _DIVERGED * (outcome.status == DIVERGED)

    return fit_all


_fit_all = _compiled_fit(digest(pixels, edge_model, newton, sandwich, sectors))
