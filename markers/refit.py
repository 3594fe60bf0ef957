"""Markers under glare or partly covered: fitted again from what is left of their outline.

The disc is looked at in 36 sectors. Those that do not look like the model are dropped, worst first, until the rest
agrees with it. What the other markers say about the place, the shape and the blur holds the fit together meanwhile:
without it a covered part bends the ellipse to explain itself. Weights that lower single pixels (Tukey) are not used:
an occluder makes a clean contour of its own, which they follow.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from thermostand.markers import edge_model, newton, pixels, sectors
from thermostand.markers.edge_fit import make_setting
from thermostand.markers.edge_model import M11, PARAMETERS, SIGMA, EdgeState, Float, build_normal_equations
from thermostand.markers.jit import compile_entry, compile_part, compute_digest
from thermostand.markers.newton import (
    SETTLED,
    Prior,
    Setting,
    Starts,
    compute_inverse,
    compute_limits,
    gather_band,
    settle,
)
from thermostand.markers.noise import Noise
from thermostand.markers.pixels import Picture
from thermostand.markers.sectors import SECTORS, Bools, compute_sector_misfits, count_kept, make_all_kept

_LEAST_SECTORS = 13
"""35 %: with fewer the centre hangs on the shape that the other markers have."""
_GREATEST_MISFIT = 4.0  # standard deviations, as in sectors.py; not measured
# Chosen on rendered glare: a refit lowered errors of 248 and 501 mpx to 36 and 12.
_STRANGE = 3.0
_BEFORE_OTHERS = 0.5
"""Sectors this much as bad as the worst go together with it; the others may only suffer from the worst."""


@dataclass(frozen=True, slots=True, eq=False)
class Refit:
    """state: what was fitted. covariance_px2: (N, 2, 2), with what the last sectors that were dropped moved the
    centre by. chi: (N,) of the sectors kept. NaN, and the start values, where too little is left.
    """

    state: EdgeState
    covariance_px2: Float
    chi: Float


def refit_edges(
    image: Picture, start: EdgeState, spread: Float, noise: Noise, reach: Float, *, tolerance: float, band_sigma: float
) -> Refit:
    """Fit markers from the ellipses `start` that the others imply. spread: (N, 4), standard deviations of their m11,
    m12, m22 and sigma. noise: such that clean markers have chi 1. tolerance: how much more than noise clean markers'
    outlines deviate from ellipses, 1 for perfect ones. band_sigma: half width of the band, blurs."""
    count = len(start.scale_px)
    parameters = np.ascontiguousarray(start.parameters).copy()
    covariance, chi = np.empty((count, 2, 2)), np.empty(count)
    # A copy of `reach`: read-only memory would be another type to the compiler.
    starts = Starts(parameters, start.scale_px, np.array(reach, np.float64))
    setting = make_setting(image, start, noise, band_sigma)
    _refit_all(setting, starts, 1 / spread**2, _GREATEST_MISFIT * max(tolerance, 1.0), covariance, chi)
    return Refit(EdgeState(parameters, start.scale_px), covariance, chi)


@compile_part
def drop_strangers(kept: Bools, misfits: Float, greatest: float) -> None:
    """Drop what stands out before anything is fitted: a sheet over a third of the disc tilts both planes so much that
    good sectors look as bad as covered ones. Levels that the other markers get wrong are wrong everywhere."""
    limit = max(greatest, _STRANGE * _compute_median(misfits))
    for place in range(SECTORS):
        kept[place] = kept[place] and misfits[place] <= limit


@compile_part
def _compute_median(values: Float) -> float:
    """Return the median of an even number of values."""
    ordered = values.copy()
    for i in range(1, len(ordered)):
        for j in range(i, 0, -1):
            low, high = min(ordered[j - 1], ordered[j]), max(ordered[j - 1], ordered[j])
            ordered[j - 1], ordered[j] = low, high
    middle = len(ordered) // 2
    return 0.5 * (ordered[middle - 1] + ordered[middle])


@compile_part
def drop_worst(kept: Bools, misfits: Float, greatest: float) -> bool:
    """Return whether there were sectors to drop: the worst one above `greatest`, and those nearly as bad."""
    worst = 0.0
    for place in range(SECTORS):
        if kept[place]:
            worst = max(worst, misfits[place])
    if worst <= greatest:
        return False
    for place in range(SECTORS):
        if misfits[place] > max(greatest, _BEFORE_OTHERS * worst):
            kept[place] = False
    return True


@compile_part
def drop_neighbours(kept: Bools) -> None:
    """Drop the sectors next to dropped ones: glare has no edge, and what is left of it looks like a slope."""
    before = kept.copy()
    for place in range(SECTORS):
        kept[place] = before[place - 1] and before[place] and before[(place + 1) % SECTORS]


def _compile_refit(sources: str) -> Callable[..., None]:
    @compile_entry
    def refit_all(
        setting: Setting, starts: Starts, weight: Float, greatest: float, covariance: Float, chi: Float
    ) -> None:
        """Fit each row of the parameters in place. weight (N, 4): of what the other markers say. greatest: misfit of a
        sector that is kept."""
        _ = sources
        pixels, work = setting.pixels, setting.work
        for n in range(len(starts.scale)):
            p, scale, reach = starts.parameters[n].copy(), starts.scale[n], starts.reach[n]
            covariance[n], chi[n] = math.nan, math.nan
            belief = Prior(make_all_kept(), p[M11 : SIGMA + 1].copy(), weight[n])
            gather_band(setting, p, scale, compute_limits(p, scale, reach, False, setting.band_sigma), belief)
            build_normal_equations(pixels, p, scale, setting.noise, work, False)
            drop_strangers(belief.kept, compute_sector_misfits(pixels, p), greatest)
            searching = True
            while searching and count_kept(belief.kept) >= _LEAST_SECTORS:
                outcome = settle(setting, p, scale, reach, belief)
                if outcome.status != SETTLED:
                    break
                searching = drop_worst(belief.kept, compute_sector_misfits(pixels, p), greatest)
            if searching:
                continue
            before = p[:2].copy()
            drop_neighbours(belief.kept)
            if count_kept(belief.kept) < _LEAST_SECTORS:
                continue
            outcome = settle(setting, p, scale, reach, belief)
            if outcome.status == SETTLED:
                unscaled = compute_inverse(work)
                for i in range(PARAMETERS):
                    starts.parameters[n, i] = p[i]
                for i in range(2):
                    for j in range(2):
                        moved = (p[i] - before[i]) * (p[j] - before[j])
                        covariance[n, i, j] = unscaled[i, j] * max(outcome.variance, 1.0) + moved
                chi[n] = math.sqrt(outcome.variance)

    return refit_all


_refit_all = _compile_refit(compute_digest(pixels, edge_model, newton, sectors))
