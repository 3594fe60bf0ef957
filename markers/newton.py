"""Gauss-Newton on one marker: from a start to the parameters that explain its pixels best."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thermostand.markers.edge_model import (
    B0,
    BX,
    BY,
    CX,
    CY,
    F0,
    FX,
    FY,
    M11,
    M12,
    M22,
    PARAMETERS,
    SIGMA,
    Float,
    Variance,
    Work,
    build_normal_equations,
)
from thermostand.markers.jit import compile_part
from thermostand.markers.pixels import SHARE, VALUE, Gathered, Limits, Picture, Pixels, U, V, gather
from thermostand.markers.sectors import SECTORS, Bools, count_kept, make_all_kept, mask_sectors

# With a blur of 0.5 px the narrow band would be 2.25 px wide, and the levels of ground and disc hang on few pixels.
LEAST_BAND_PX = 3.5
# Chosen on rendered scenes: 2.57 mpx and 7.2 ms with 4.5, 2.44 and 8.0 with 5, 2.40 and 10.9 with 6. With 4.25 refits
# under glare moved by 1.5 mpx.
CORE_SIGMA = 5.0
"""The blurs from the outline within which a pixel helps to locate it; the density is 1e-4 of its maximum beyond."""
# The band is gathered again when its width has changed by more: 0.45 of the 4.6 ms of a followed frame.
_BAND_TOLERANCE = 0.05
_MOVE_TOLERANCE_SIGMA = 0.25  # of the edge's blur: the band still holds the edge then; not measured
_SLOPES_FROM_PX = 6.0
"""Below this radius a plane and the edge cannot be separated: ground and disc are then constant."""
# Sixty pixels for twelve parameters. Round number; nothing was measured.
_PIXELS_PER_PARAMETER = 5
_FAR_PX = 1.0  # round number; nothing was measured
_NEAR_PX, _NEAR_GAIN = 0.02, 50.0
"""After a step not longer, and with no more gain in variances of a pixel, J'WJ is what it was, to 1 %: chance moves the
parameters by as much from one frame to the next."""
_SHORT_PX, _SHORT_GAIN = 2e-4, 0.02
"""Only so short a step is the last one with a J'WJ from before."""
# A marker scatters by about 2.4 mpx in a rendered frame; so ended, centres are 0.7 to 1.3e-3 mpx from the fully
# converged ones.
_CONVERGED_PX = 2e-3
# A longer step leaves the band in which the derivative holds.
_GREATEST_STEP_PX = 3.0
_GREATEST_BEND = 0.3  # of the mean: more turns an ellipse into another one; not measured
_LEAST_SIGMA_PX = 0.1  # less than the pixel's own blur of 0.29 px: no edge
_LEAST_CONTRAST_SIGMA = 2.0  # below it a start is given up; twice this counts as a marker
# A bound only: two steps are enough for a followed marker, eight for a first one.
_STEPS = 24
_GATHERINGS = 12  # a bound only

SETTLED, TOO_FEW, DIVERGED = range(3)


class Outcome(NamedTuple):
    """status: SETTLED or why not. variance: chi^2, the residuals' variance over the expected one. seen, burnt, cut: of
    the last gathering."""

    status: int
    variance: float
    seen: int
    burnt: int
    cut: bool


class Setting(NamedTuple):
    """What all markers of an image are fitted with. ceiling: DN, from which on pixels are saturated. band_sigma: half
    width of the band, blurs. pixels, work: work arrays for one marker."""

    image: Picture
    noise: Variance
    ceiling: int
    band_sigma: float
    pixels: Pixels
    work: Work


class Starts(NamedTuple):
    """N markers to be fitted: parameters (N, 12), set in place; scale (N,); reach (N, 2): from where to where their
    pixels may lie, in radii."""

    parameters: Float
    scale: Float
    reach: Float


class Prior(NamedTuple):
    """What is known before looking: sectors `kept` (36,), the others are not looked at; m11, m12, m22 and sigma (4,),
    with weights (4,), 1 / variance, 0 where nothing is known."""

    kept: Bools
    mean: Float
    weight: Float


@compile_part
def make_flat_prior() -> Prior:
    """All sectors count, and any shape is as likely as any other."""
    return Prior(make_all_kept(), np.zeros(4), np.zeros(4))


@compile_part
def settle(setting: Setting, p: Float, scale: float, reach: Float, belief: Prior) -> Outcome:
    """Fit `p` (12,) to the image in place. The pixels are gathered again when the outline has left them or turned out
    more blurred than it was thought to be, which also makes the result independent of the start. reach (2,): from where
    to where its pixels may lie, in radii."""
    start, gathered_at = p.copy(), p.copy()
    pixels, work, noise, band_sigma = setting.pixels, setting.work, setting.noise, setting.band_sigma
    far = math.isnan(p[B0])
    gathered = gather_band(setting, p, scale, compute_limits(p, scale, reach, far, band_sigma), belief)
    gatherings, variance, is_near = 1, math.nan, False
    if far:
        set_start_levels(pixels, p, scale)
    fixed = compute_mean_radius(p, scale) < _SLOPES_FROM_PX
    for _ in range(_STEPS):
        variance, step = compute_next_step(setting, p, scale, belief, fixed, is_near)
        if math.isnan(variance):
            return Outcome(TOO_FEW, math.nan, gathered.seen, gathered.burnt, gathered.cut)
        for i in range(PARAMETERS):
            p[i] += step[i]
        if not is_possible(p, noise) or has_strayed(start, p, scale, 1.5):
            return Outcome(DIVERGED, math.nan, gathered.seen, gathered.burnt, gathered.cut)
        length, gained = math.hypot(step[CX], step[CY]), compute_gain(work, step)
        far = length > _FAR_PX
        is_last = is_short(length, gained / variance, is_near)
        # The last step takes J'WJ from the one before, scaled by the blurs' ratio; without the scaling centres are off
        # by 2e-2 mpx.
        is_near = not is_near and length < _NEAR_PX and gained < _NEAR_GAIN * variance
        if is_near:
            sharpen(work, (p[SIGMA] - step[SIGMA]) / p[SIGMA])
        if gatherings < _GATHERINGS and has_moved_off(gathered_at, p, scale, band_sigma):
            gathered = gather_band(setting, p, scale, compute_limits(p, scale, reach, far, band_sigma), belief)
            gathered_at = p.copy()
            gatherings += 1
            is_near = False
            if gathered.seen < 0:
                return Outcome(DIVERGED, math.nan, gathered.seen, gathered.burnt, gathered.cut)
        elif is_last:
            break
    if has_strayed(start, p, scale, 1.0):
        return Outcome(DIVERGED, math.nan, gathered.seen, gathered.burnt, gathered.cut)
    return Outcome(SETTLED, variance, gathered.seen, gathered.burnt, gathered.cut)


@compile_part
def compute_next_step(
    setting: Setting, p: Float, scale: float, belief: Prior, fixed: bool, is_near: bool
) -> tuple[float, Float]:
    """The variance of a pixel about the model, NaN when there are too few for it, and the step (12,) from `p`. fixed:
    the levels have no slopes. is_near: J'WJ is that of the step before."""
    free, work = PARAMETERS - 4 * fixed, setting.work
    squares, weights = build_normal_equations(setting.pixels, p, scale, setting.noise, work, is_near)
    if weights < _PIXELS_PER_PARAMETER * free:
        return math.nan, p
    add_prior(work, p, belief, is_near)
    if fixed:
        hold_slopes(work)
    return squares / (weights - free), limit_step(solve_newton_step(work), p, scale)


@compile_part
def is_short(length_px: float, gain: float, is_near: bool) -> bool:
    """Return whether a step is the last one. gain: in variances of a pixel, less than one's share once all twelve
    parameters have settled."""
    if is_near:
        return length_px < _SHORT_PX and gain < _SHORT_GAIN
    return length_px < _CONVERGED_PX and gain < 1


@compile_part
def gather_band(setting: Setting, p: Float, scale: float, limits: Limits, belief: Prior) -> Gathered:
    """Gather the pixels round the outline of `p`, without those of sectors that are not kept."""
    gathered = gather(setting.image, p[:SIGMA], scale, limits, setting.ceiling, setting.pixels)
    if count_kept(belief.kept) < SECTORS:
        mask_sectors(setting.pixels, p, belief.kept)
    return gathered


@compile_part
def add_prior(work: Work, p: Float, belief: Prior, is_in_normal: bool) -> None:
    """Pull the shape and the blur to what they are believed to be."""
    for i in range(4):
        if not is_in_normal:
            work.normal[M11 + i, M11 + i] += belief.weight[i]
        work.right[M11 + i] += belief.weight[i] * (belief.mean[i] - p[M11 + i])


@compile_part
def compute_limits(p: Float, scale: float, reach: Float, far: bool, band_sigma: float) -> Limits:
    """The limits of the pixels that are looked at, in F, along the shorter axis; the longer one has more. far: the
    outline is not known well enough to say what is far from it, so that all belong to the core."""
    least = compute_mean_radius(p, scale) ** 2 / compute_long_axis(p, scale)
    width = max(band_sigma * p[SIGMA], LEAST_BAND_PX) / least
    core = width if far else min(CORE_SIGMA * p[SIGMA] / least, width)
    return Limits(max(1 - width, reach[0]), max(1 - core, reach[0]), 1 + core, min(1 + width, reach[1]))


@compile_part
def compute_mean_radius(p: Float, scale: float) -> float:
    """Geometric mean of the semi-axes, px."""
    return scale / (p[M11] * p[M22] - p[M12] * p[M12]) ** 0.25


@compile_part
def compute_long_axis(p: Float, scale: float) -> float:
    """The longer semi-axis, px."""
    half = 0.5 * (p[M11] + p[M22])
    return scale / math.sqrt(half - math.sqrt(max(half * half - p[M11] * p[M22] + p[M12] * p[M12], 0.0)))


@compile_part
def set_start_levels(pixels: Pixels, p: Float, scale: float) -> None:
    """Set the levels to the means on either side of the outline."""
    sums, counts = np.zeros(2), np.zeros(2)
    counts[:] = 1e-12
    cx, cy = p[CX] - pixels.origin[0], p[CY] - pixels.origin[1]
    for region in range(3):
        table = pixels.table[region]
        for slot in range(pixels.counts[region]):
            x, y = (table[U, slot] - cx) / scale, (table[V, slot] - cy) / scale
            side = 1 if p[M11] * x * x + 2 * p[M12] * x * y + p[M22] * y * y > 1 else 0
            sums[side] += table[SHARE, slot] * table[VALUE, slot]
            counts[side] += table[SHARE, slot]
    p[B0:] = 0
    p[F0], p[B0] = sums[0] / counts[0], sums[1] / counts[1]


@compile_part
def sharpen(work: Work, ratio: float) -> None:
    """Make J'WJ that of a blur so many times smaller: what is known of the outline goes with the edge's steepness."""
    for i in range(SIGMA + 1):
        for j in range(SIGMA + 1):
            work.normal[i, j] *= ratio


@compile_part
def hold_slopes(work: Work) -> None:
    """Make the slopes of the levels stay as they are."""
    for i in (BX, BY, FX, FY):
        for j in range(PARAMETERS):
            work.normal[i, j] = work.normal[j, i] = 1.0 * (i == j)
        work.right[i] = 0


@compile_part
def solve_newton_step(work: Work) -> Float:
    """The step that solves J'WJ step = J'We, by the Cholesky decomposition of the matrix with a unit diagonal."""
    factor, size = _cholesky(work.normal)
    step = work.right.copy()
    _solve(factor, size, step)
    return step


@compile_part
def compute_gain(work: Work, step: Float) -> float:
    """Return what a step takes from the sum of squared residuals."""
    total = 0.0
    for i in range(PARAMETERS):
        total += work.right[i] * step[i]
    return total


@compile_part
def compute_inverse(work: Work) -> Float:
    """The inverse of J'WJ (12, 12)."""
    factor, size = _cholesky(work.normal)
    columns = np.zeros((PARAMETERS, PARAMETERS))
    for i in range(PARAMETERS):
        columns[i, i] = 1
        _solve(factor, size, columns[i])
    return columns


@compile_part
def _cholesky(normal: Float) -> tuple[Float, Float]:
    """Lower factor of `normal` divided by `size` on both sides, and that size, the root of the diagonal. 1e-9 on the
    diagonal keeps parameters that nothing is known about where they are."""
    size, factor = np.empty(PARAMETERS), np.empty((PARAMETERS, PARAMETERS))
    for i in range(PARAMETERS):
        size[i] = math.sqrt(normal[i, i] + 1e-12)
    for i in range(PARAMETERS):
        for j in range(i + 1):
            rest = normal[i, j] / (size[i] * size[j])
            for k in range(j):
                rest -= factor[i, k] * factor[j, k]
            factor[i, j] = rest / factor[j, j] if j < i else math.sqrt(max(rest + 1e-9, 1e-12))
    return factor, size


@compile_part
def _solve(factor: Float, size: Float, right: Float) -> None:
    """Replace `right` by the solution of the equations whose factor and size are given."""
    for i in range(PARAMETERS):
        right[i] /= size[i]
        for k in range(i):
            right[i] -= factor[i, k] * right[k]
        right[i] /= factor[i, i]
    for i in range(PARAMETERS - 1, -1, -1):
        for k in range(i + 1, PARAMETERS):
            right[i] -= factor[k, i] * right[k]
        right[i] /= factor[i, i]
    for i in range(PARAMETERS):
        right[i] /= size[i]


@compile_part
def limit_step(step: Float, p: Float, scale: float) -> Float:
    """The step, shortened where it would throw the centre or the outline too far, or the blur."""
    far = math.hypot(step[CX], step[CY]) / min(_GREATEST_STEP_PX, 0.5 * scale)
    bend = max(abs(step[M11]), abs(step[M12]), abs(step[M22]))
    shorten = max(1.0, far, bend / (_GREATEST_BEND * 0.5 * (p[M11] + p[M22])))
    for i in range(PARAMETERS):
        step[i] /= shorten
    # So that no step takes the blur through zero.
    step[SIGMA] = min(max(step[SIGMA], -0.4 * p[SIGMA]), 0.5 * p[SIGMA])
    return step


@compile_part
def is_possible(p: Float, noise: Variance) -> bool:
    """Return whether the parameters are those of an ellipse with an edge that stands out of the noise."""
    edge = abs(p[B0] - p[F0]) > _LEAST_CONTRAST_SIGMA * math.sqrt(noise[0] + noise[1] * max(p[B0], 0.0))
    ellipse = p[M11] > 0 and p[M11] * p[M22] > p[M12] * p[M12]
    finite = True
    for value in p:
        finite = finite and math.isfinite(value)
    return finite and ellipse and edge and p[SIGMA] >= _LEAST_SIGMA_PX


@compile_part
def has_strayed(start: Float, p: Float, scale: float, radii: float) -> bool:
    """Return whether it is more than some radii from where it began, or more than twice or less than half the size."""
    before, after = compute_half_extents(start, scale), compute_half_extents(p, scale)
    ratio_x, ratio_y = after[0] / before[0], after[1] / before[1]
    moved = math.hypot(p[CX] - start[CX], p[CY] - start[CY]) > radii * compute_mean_radius(start, scale)
    return moved or max(ratio_x, ratio_y) > 2 or min(ratio_x, ratio_y) < 0.5


@compile_part
def has_moved_off(gathered_at: Float, p: Float, scale: float, band_sigma: float) -> bool:
    """Return whether the pixels gathered for one outline are not the right ones for another."""
    before, after = compute_half_extents(gathered_at, scale), compute_half_extents(p, scale)
    moved = math.hypot(p[CX] - gathered_at[CX], p[CY] - gathered_at[CY])
    grown = max(abs(after[0] - before[0]), abs(after[1] - before[1]))
    widths = max(band_sigma * gathered_at[SIGMA], LEAST_BAND_PX), max(band_sigma * p[SIGMA], LEAST_BAND_PX)
    return abs(widths[1] - widths[0]) > _BAND_TOLERANCE * widths[0] or moved + grown > _MOVE_TOLERANCE_SIGMA * p[SIGMA]


@compile_part
def compute_half_extents(p: Float, scale: float) -> tuple[float, float]:
    """Return half width and half height of the ellipse's bounding box, px."""
    determinant = p[M11] * p[M22] - p[M12] * p[M12]
    return scale * math.sqrt(p[M22] / determinant), scale * math.sqrt(p[M11] / determinant)
