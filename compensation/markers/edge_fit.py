"""Sub-pixel centres of round markers: the edge model is fitted to the pixels along each outline.

Gauss-Newton with the weights of the noise model. All markers of a chunk advance together; the pixels are gathered
again when the outline has left the band or turned out more blurred than it was thought to be.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import IntFlag

import numpy as np
from numpy.typing import NDArray

from compensation.markers.edge_model import (
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
    SIGMA,
    Band,
    EdgeState,
    Float,
    geometry,
    normal_equations,
    set_start_levels,
)
from compensation.markers.noise import Image, Noise, full_scale_DN

_BAND_SIGMA = 7.0
"""Half width of the fitted band in blurs. Scatter of the centres over the Cramer-Rao limit, even light, R = 35 px:
1.19 with 5, 1.15 with 5.5, 1.10 with 7, 1.08 with 8; the time grows in proportion."""
_LEAST_BAND_PX = 3.5
_BAND_TOLERANCE = 0.1
_SLOPES_FROM_PX = 6.0
"""Below this radius a plane and the edge cannot be told apart: ground and disc are then constant."""
_PIXELS_PER_PARAMETER = 5
_SATURATED_PART = 0.1
_CLIPPED_PART = 0.25
_CONVERGED_PX = 2e-3
_GREATEST_STEP_PX = 3.0
_GREATEST_BEND = 0.3
_SLOPES = [BX, BY, FX, FY]
_LEAST_SIGMA_PX = 0.1
_LEAST_CONTRAST_SIGMA = 2.0
_STEPS = 8
_GATHERINGS = 3
_PIXELS_PER_CHUNK = 20_000
"""Markers are fitted in chunks whose arrays stay in the processor's cache."""


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


@dataclass(frozen=True, slots=True, eq=False)
class EdgeFit:
    """state: what was fitted. covariance_px2: (N, 2, 2), noise times chi^2. chi: (N,), 1 when the noise model explains
    the residuals. flags: (N,) uint8 of Flag. Markers that failed keep their start values, with NaN covariance and chi.
    """

    state: EdgeState
    covariance_px2: Float
    chi: Float
    flags: NDArray[np.uint8]


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """What one gathering of pixels led to. failed: flags of markers without a solution. stale: the pixels were not the
    right ones, gather again.
    """

    state: EdgeState
    normal: Float
    chi: Float
    failed: NDArray[np.int64]
    stale: NDArray[np.bool_]
    band: Band


def fit_edges(image: Image, start: EdgeState, noise: Noise, reach: Float) -> EdgeFit:
    """Fit every marker of `start`. `reach` (N,): how many radii from the centre a marker's pixels may lie, so that its
    band ends half way to the neighbours. The image is only read.
    """
    ceiling = full_scale_DN(image) - 1
    parts = [_fit_chunk(image, start[which], noise, reach[which], ceiling) for which in _chunks(start)]
    return EdgeFit(
        EdgeState(np.concatenate([part.state.parameters for part in parts]), start.scale_px),
        np.concatenate([part.covariance_px2 for part in parts]),
        np.concatenate([part.chi for part in parts]),
        np.concatenate([part.flags for part in parts]),
    )


def _chunks(start: EdgeState) -> Iterator[NDArray[np.intp]]:
    """Consecutive markers, few enough for the cache."""
    band_px = np.maximum(_BAND_SIGMA * start.parameters[:, SIGMA], _LEAST_BAND_PX)
    pixels = float(np.max(4 * np.pi * start.radii_px() * np.minimum(band_px, start.radii_px())))
    size = max(1, int(_PIXELS_PER_CHUNK / max(pixels, 1)))
    for first in range(0, len(start.scale_px), size):
        yield np.arange(first, min(first + size, len(start.scale_px)))


def _fit_chunk(image: Image, start: EdgeState, noise: Noise, reach: Float, ceiling: int) -> EdgeFit:
    solution = _solved(_gather(image, start, reach, ceiling), start, noise, np.zeros(len(reach), dtype=np.int64))
    for _ in range(_GATHERINGS - 1):
        if not solution.stale.any():
            break
        band = _gather(image, solution.state, reach, ceiling)
        solution = _solved(band, solution.state, noise, solution.failed)
    return _judged(solution, start)


def _judged(solution: _Solution, start: EdgeState) -> EdgeFit:
    """The fit, without the markers that have no solution or found another one than theirs."""
    strayed = _strayed(start, solution.state)
    failed = solution.failed | np.where(strayed & (solution.failed == 0), Flag.DIVERGED, 0)
    bad, band = failed != 0, solution.band
    covariance = np.linalg.inv(_damped(solution.normal))[:, :2, :2] * (solution.chi**2)[:, None, None]
    return EdgeFit(
        EdgeState(np.where(bad[:, None], start.parameters, solution.state.parameters), start.scale_px),
        np.where(bad[:, None, None], np.nan, covariance),
        np.where(bad, np.nan, solution.chi),
        (failed | np.where(band.saturated, Flag.SATURATED, 0) | np.where(band.cut, Flag.BORDER, 0)).astype(np.uint8),
    )


def _solved(band: Band, state: EdgeState, noise: Noise, failed: NDArray[np.int64]) -> _Solution:
    """Gauss-Newton on one gathering of pixels, until every marker rests."""
    p, scale = state.parameters.copy(), state.scale_px
    free = _free(state)
    if np.isnan(p[:, B0:]).any():
        set_start_levels(p, scale, band)
    failed = failed | np.where(band.used.sum(axis=1) < _PIXELS_PER_PARAMETER * free.sum(axis=1), Flag.TOO_FEW, 0)
    normal, right, chi = normal_equations(p, scale, band, noise, free)
    for _ in range(_STEPS):
        step = _limited(_newton_step(normal, right), p, scale)
        failed = failed | np.where((failed == 0) & ~_possible(p + step, noise), Flag.DIVERGED, 0)
        p = np.where(failed[:, None] != 0, p, p + step)
        # g'd is how much of the sum of squares the step gains: less than a pixel's share once all twelve have settled.
        resting = (np.hypot(step[:, CX], step[:, CY]) < _CONVERGED_PX) & (np.sum(right * step, axis=1) < chi**2)
        if np.all((failed != 0) | resting):
            break
        normal, right, chi = normal_equations(p, scale, band, noise, free)
    failed = failed | np.where((failed == 0) & _strayed(state, EdgeState(p, scale)), Flag.DIVERGED, 0)
    reached = EdgeState(np.where(failed[:, None] != 0, state.parameters, p), scale)
    return _Solution(reached, normal, chi, failed, _moved_off(state, reached, band) & (failed == 0), band)


def _strayed(start: EdgeState, state: EdgeState) -> NDArray[np.bool_]:
    """Markers that ended more than a radius from where they began, or at more than twice or less than half the size."""
    moved = np.linalg.norm(state.centres_px() - start.centres_px(), axis=1)
    ratio = state.half_extents_px() / start.half_extents_px()
    return (moved > start.radii_px()) | (ratio.max(axis=1) > 2) | (ratio.min(axis=1) < 0.5)


def _possible(p: Float, noise: Noise) -> NDArray[np.bool_]:
    """Whether the parameters are those of an ellipse with an edge that stands out of the noise."""
    ellipse = (p[:, M11] > 0) & (p[:, M11] * p[:, M22] > p[:, M12] ** 2)
    edge = np.abs(p[:, B0] - p[:, F0]) > _LEAST_CONTRAST_SIGMA * np.sqrt(noise.variance_DN2(p[:, B0]))
    return np.isfinite(p).all(axis=1) & ellipse & edge & (p[:, SIGMA] >= _LEAST_SIGMA_PX)


def _free(state: EdgeState) -> NDArray[np.bool_]:
    """Which of its parameters are fitted for each marker, (N, 12)."""
    free = np.ones(state.parameters.shape, dtype=bool)
    free[:, _SLOPES] = (state.radii_px() >= _SLOPES_FROM_PX)[:, None]
    return free


def _moved_off(gathered: EdgeState, state: EdgeState, band: Band) -> NDArray[np.bool_]:
    """Markers whose band, gathered at `gathered`, does not lie along the outline or has not the width its blur asks
    for. Gathering again also makes the result independent of the start.
    """
    sigma = state.parameters[:, SIGMA]
    moved = np.linalg.norm(state.centres_px() - gathered.centres_px(), axis=1)
    grown = np.abs(state.half_extents_px() - gathered.half_extents_px()).max(axis=1)
    wanted = np.maximum(_BAND_SIGMA * sigma, _LEAST_BAND_PX)
    return (np.abs(wanted - band.width_px) > _BAND_TOLERANCE * band.width_px) | (moved + grown > sigma)


def _gather(image: Image, state: EdgeState, reach: Float, ceiling: int) -> Band:
    """The pixels within the band of each marker's outline. Saturated ones are left out (glare), unless they are a
    quarter of the ground or of the disc: then the picture is overexposed, and clipping shifts the outline but not
    the centre.
    """
    p = state.parameters
    width = np.maximum(_BAND_SIGMA * p[:, SIGMA], _LEAST_BAND_PX)
    extent = state.half_extents_px()
    least = state.radii_px() ** 2 / extent.max(axis=1)
    half = np.ceil(extent * np.minimum(1 + width / least, reach)[:, None] + 1).max(axis=0).astype(int)
    middle = np.rint(p[:, :2]).astype(int)
    columns = middle[:, 0, None] + np.arange(-half[0], half[0] + 1)
    rows = middle[:, 1, None] + np.arange(-half[1], half[1] + 1)
    place = geometry(p[:, :, None, None], state.scale_px[:, None, None], columns[:, None, :], rows[:, :, None])
    wanted = (np.abs(place.distance_px) < width[:, None, None]) & (reach[:, None, None] > place.F)
    height, breadth = image.shape
    inside = ((rows >= 0) & (rows < height))[:, :, None] & ((columns >= 0) & (columns < breadth))[:, None, :]
    value = image[np.clip(rows, 0, height - 1)[:, :, None], np.clip(columns, 0, breadth - 1)[:, None, :]]
    seen = wanted & inside
    burnt = seen & (value >= ceiling)
    outside = place.distance_px > 0
    clipped = np.where(outside, _clipped(burnt, seen & outside), _clipped(burnt, seen & ~outside))
    chosen = seen & (~burnt | clipped)
    return Band(
        *_packed(chosen, columns[:, None, :], rows[:, :, None], value),
        width_px=width,
        saturated=burnt.sum(axis=(1, 2)) > _SATURATED_PART * seen.sum(axis=(1, 2)),
        cut=np.any(wanted & ~inside, axis=(1, 2)),
    )


def _clipped(burnt: NDArray[np.bool_], side: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """For each marker, (N, 1, 1), whether this side of its outline is too bright for the exposure."""
    count = (burnt & side).sum(axis=(1, 2), keepdims=True)
    return count > _CLIPPED_PART * side.sum(axis=(1, 2), keepdims=True)


def _packed(
    chosen: NDArray[np.bool_], columns: NDArray[np.intp], rows: NDArray[np.intp], value: NDArray[np.unsignedinteger]
) -> tuple[Float, Float, Float, Float]:
    """Columns, rows, values and a 1 for each chosen pixel of a marker, at the front of the marker's row."""
    marker = np.nonzero(chosen)[0]
    counts = np.bincount(marker, minlength=len(chosen))
    slot = np.arange(len(marker)) - (np.cumsum(counts) - counts)[marker]
    shape = (len(chosen), max(int(counts.max()), 1))
    packed = np.zeros((4, *shape))
    for out, grid in zip(packed, (columns, rows, value, np.array(1)), strict=True):
        out[marker, slot] = np.broadcast_to(grid, chosen.shape)[chosen]
    return packed[0], packed[1], packed[2], packed[3]


def _limited(step: Float, p: Float, scale: Float) -> Float:
    """The step, shortened where it would throw the centre or the outline too far, or the blur."""
    far = np.hypot(step[:, CX], step[:, CY]) / np.minimum(_GREATEST_STEP_PX, 0.5 * scale)
    bent = np.abs(step[:, M11 : M22 + 1]).max(axis=1) / (_GREATEST_BEND * 0.5 * (p[:, M11] + p[:, M22]))
    step = step / np.maximum(1, np.maximum(far, bent))[:, None]
    step[:, SIGMA] = np.clip(step[:, SIGMA], -0.4 * p[:, SIGMA], 0.5 * p[:, SIGMA])
    return step


def _newton_step(normal: Float, right: Float) -> Float:
    return np.asarray(np.linalg.solve(_damped(normal), right[:, :, None])[:, :, 0], dtype=np.float64)


def _damped(normal: Float) -> Float:
    """The normal matrices made safely invertible: 1e-9 of the diagonal added."""
    index = np.arange(normal.shape[1])
    out = normal.copy()
    diagonal = out[:, index, index]
    out[:, index, index] = diagonal * (1 + 1e-9) + 1e-12
    return out
