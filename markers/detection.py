"""Image -> identified marker centres with covariance and flags.

    detection = detect(image, target)                         # first frame: search, identify, fit
    detection = detect(image, target, previous=detection)     # next frames: fit from the frame before

Pixels: integer coordinates are pixel centres, (0, 0) is the first one, x to the right, y down; arrays [row, column].
The centre is that of the outline in the image, an ellipse: in a Detection, in the drift model, and as an observation of
a calibration. For a tilted target, or under distortion, this is not the image of the disc's centre (about 40 mpx for
8 mm discs at 1 m and 30 deg). Drift leaves the difference as it is, to first order; calibration and poses compute it
from the camera; for everything else `eccentricity.disc_centres` takes it off by what the markers show.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.markers.candidate_search import Candidates, find_candidates, iterate_disc_sizes_px
from thermostand.markers.edge_fit import EdgeFit, Flag, fit_edges
from thermostand.markers.edge_model import B0, CX, CY, F0, M11, M12, M22, PARAMETERS, SIGMA, EdgeState, Float
from thermostand.markers.grid_identification import (
    DetectionError,
    Identified,
    compute_pitch_px,
    fit_homography,
    identify,
)
from thermostand.markers.homography import predict_px, project
from thermostand.markers.newton import LEAST_BAND_PX
from thermostand.markers.noise import Image, Noise
from thermostand.markers.pixels import Mask, Picture, make_picture
from thermostand.markers.refit import refit_edges
from thermostand.markers.sandwich import SAMPLED_MARKERS, compute_variance_growth, compute_variance_ratio
from thermostand.markers.target import Target

# How wide a band of pixels round the outlines is fitted, and what its width says about the centres' errors.
#
# Where the model holds, the levels of ground and disc are known best from a wide band: 1.01 of the Cramer-Rao limit,
# and 1.09..1.16 from a narrow one. A real ground is no plane: grain, texture and shadows move the centre, the further
# out they are looked at the more. Fits in both bands tell (Hausman): with independent noise their centres differ by no
# more than their variances do,
#
#     mean (c_wide - c_narrow)^2 = var_narrow - var_wide
#
# and what is beyond that is misfit. It grows about in proportion to the width, so it is as large as what is left in the
# centres of a band of half the width, and a quarter of the squared misfit of the wide one.

# Chosen on rendered scenes: half widths of 5, 8 and 12 blurs leave 1.12, 1.04 and 1.01 times the Cramer-Rao limit, at a
# cost in proportion.
WIDE_SIGMA, NARROW_SIGMA = 9.0, 4.5
"""Half widths of the band in blurs."""
WIDE_EXCESS = (WIDE_SIGMA / NARROW_SIGMA) ** 2
# With a limit of 1.4 alone 0.6 % of clean frames were suspect, but only 56 % of those with JPEG of quality 90.
_GROWTH_LIMIT, _SUSPECT_GROWTH_LIMIT = 1.4, 1.3
"""Along x or y alone, as rows that flicker have it."""
# With it 1 of 200 frames of noise alone is suspect, 47 of 48 of JPEG 90 and of JPEG 80, and all of gamma, rows and
# grain (`python -m tests.bench claimed_variances`). Half of it is 1.4 sigma from noise, and twice above most of JPEG
# 90.
_CORRELATION_LIMIT, _SUSPECT_CORRELATION_LIMIT = 0.35, 0.3
"""Growth along x and y and of the levels' variance: each scatters by itself where there is only noise, and they grow
together where residuals hang together: 0.05 +- 0.09 by noise alone (54 markers), 0.59 +- 0.12 by JPEG of quality 90."""
_CHANCE_SIGMAS = 3.0  # standard deviations of what chance makes of the sum
_LEVELS_LIMIT = 1.3  # the figures above are with it
_BEYOND_CHANCE = 1.5
"""Of a mean square over a frame's markers, 54 of them: chance reaches it once in a hundred frames."""


@dataclass(frozen=True, slots=True, eq=False)
class ResidualCorrelation:
    """How much the residuals of a frame hang together, each 0 (levels: 1) where there is noise alone. along: growth of
    variance along x or y, the larger. together: that of x and y, their mean, and of the levels. chance: standard
    deviation of `together`'s first part. levels: root mean square of the sectors' levels. growth: (2,), of the
    variances along x and y (sandwich.py)."""

    growth: Float
    along: float
    together: float
    chance: float
    levels: float

    def exceeds_noise_model(self) -> bool:
        """Return whether what is seen is not what the noise model describes. Of 100 frames of noise alone at most
        one."""
        limit = max(_CORRELATION_LIMIT, _CHANCE_SIGMAS * self.chance)
        return self.along > _GROWTH_LIMIT - 1 or self.together > limit or self.levels > _LEVELS_LIMIT

    def is_suspect(self) -> bool:
        """Return whether it may be suspect, if this is from a sample of the markers: then it takes all to decide."""
        return (
            self.along > _SUSPECT_GROWTH_LIMIT - 1
            or self.together > _SUSPECT_CORRELATION_LIMIT
            or self.levels > _LEVELS_LIMIT
        )


def measure_residual_correlation(fit: EdgeFit, clean: NDArray[np.bool_]) -> ResidualCorrelation:
    """Measure how the residuals of the `clean` (N,) markers are correlated."""
    if not clean.any():
        return ResidualCorrelation(np.ones(2), 0.0, 0.0, 0.0, 1.0)
    levels = float(np.median(fit.levels[clean] / fit.chi[clean]))
    ratio, chance = compute_variance_ratio(fit.scatter, clean)
    growth = compute_variance_growth(ratio, chance)
    together = float(ratio.mean()) - 1 + levels**2 - 1
    return ResidualCorrelation(growth, float(growth.max()) - 1, together, float(np.linalg.norm(chance)) / 2, levels)


def compute_excess_px2(wide: EdgeFit, narrow: EdgeFit, growth: Float, clean: NDArray[np.bool_]) -> Float:
    """Compute by what the mean squared difference of the centres (x, y) exceeds that of independent noise, px^2, 0
    where it may be chance. growth: of the wide fit. clean: (N,), markers without a flag in both."""
    if not clean.any():
        return np.zeros(2)
    difference = np.mean((wide.state.centres_px() - narrow.state.centres_px())[clean] ** 2, axis=0)
    same_noise = ((wide.chi / narrow.chi) ** 2)[clean, None]
    variances = [np.diagonal(fit.covariance_px2, axis1=1, axis2=2)[clean] for fit in (wide, narrow)]
    expected = np.maximum(np.mean(same_noise * variances[1] - variances[0], axis=0), 0) * growth
    return np.where(difference > _BEYOND_CHANCE * expected, difference - expected, 0.0)


# The ellipses that a target's markers should be in the image, by the target's plane and by the other markers.

# A start; the band follows the fitted blur. Kept at the start, a frame of psf 2.2 px has 1.52 times the Cramer-Rao
# limit.
_FIRST_BLUR_PX = 1.2
_LEAST_PEERS = 8
"""Markers that a shape is predicted from, with three coefficients each."""


@dataclass(frozen=True, slots=True, eq=False)
class PredictedEdges:
    """state: the edges of K markers. spread: (K, 4), standard deviations of their m11, m12, m22 and sigma."""

    state: EdgeState
    spread: Float


def project_edges(homography: Float, target: Target) -> EdgeState:
    """The image ellipses of the target's circles, levels unknown (NaN): conic C = H^-T Q H^-1 of each circle Q."""
    x, y = target.coordinates_mm().T
    radius = target.diameters_mm() / 2
    _require_in_front(homography, np.column_stack([x, y]), radius)
    circle = np.zeros((target.count, 3, 3))
    circle[:, [0, 1, 2], [0, 1, 2]] = np.stack([np.ones_like(x), np.ones_like(x), x**2 + y**2 - radius**2], axis=1)
    circle[:, 0, 2] = circle[:, 2, 0] = -x
    circle[:, 1, 2] = circle[:, 2, 1] = -y
    back = np.linalg.inv(homography)
    conic = back.T @ circle @ back
    centre = -np.linalg.solve(conic[:, :2, :2], conic[:, :2, 2, None])[:, :, 0]
    level = conic[:, 2, 2] + np.einsum("ni,ni->n", conic[:, :2, 2], centre)
    shape = -conic[:, :2, :2] / level[:, None, None]
    scale = np.linalg.det(shape) ** -0.25
    shape = shape * (scale**2)[:, None, None]
    parameters = np.full((target.count, 12), np.nan)
    parameters[:, [CX, CY]] = centre
    parameters[:, M11], parameters[:, M12], parameters[:, M22] = shape[:, 0, 0], shape[:, 0, 1], shape[:, 1, 1]
    parameters[:, SIGMA] = _FIRST_BLUR_PX
    return EdgeState(parameters, scale)


def _require_in_front(homography: Float, centres_mm: Float, radii_mm: Float) -> None:
    """DetectionError when the image's horizon goes between or through the discs: their outlines are no ellipses."""
    corners = np.array([(-1, -1), (-1, 1), (1, -1), (1, 1)])
    project(homography, (centres_mm[:, None] + radii_mm[:, None, None] * corners).reshape(-1, 2))


def predict_edges(
    state: EdgeState, homography: Float, target: Target, clean: NDArray[np.bool_], which: NDArray[np.intp]
) -> PredictedEdges | None:
    """Return what the `clean` (N,) markers of `state` say about those numbered `which` (K,), from 0.

    Shapes deviate from the homography's ellipses, and blurs from each other, linearly over the target; only markers of
    the same size are asked, as a print grows all its outlines by the same width. Levels are those of the nearest clean
    marker. None when there is nobody to ask.
    """
    diameters = target.diameters_mm()
    peers = [clean & (diameters == diameters[n]) for n in which]
    if not peers or min(np.count_nonzero(group) for group in peers) < _LEAST_PEERS:
        return None
    places = target.coordinates_mm()
    expected = project_edges(homography, target)
    known = np.where(clean[:, None], state.centres_px(), np.nan)
    expected.parameters[:, [CX, CY]] = predict_px(places, known, homography)
    in_scale = state.parameters[:, M11 : SIGMA + 1].copy()
    in_scale[:, :3] *= ((expected.scale_px / state.scale_px) ** 2)[:, None]
    deviation = in_scale - np.pad(expected.parameters[:, M11:SIGMA], ((0, 0), (0, 1)))
    design = np.column_stack([np.ones(target.count), places])
    implied, spread = expected[which], np.empty((len(which), 4))
    for row, (n, group) in enumerate(zip(which, peers, strict=True)):
        by_peers = design[n] @ np.linalg.pinv(design[group])
        scatter = deviation[group] - design[group] @ np.linalg.pinv(design[group]) @ deviation[group]
        variance = np.sum(scatter**2, axis=0) / (np.count_nonzero(group) - design.shape[1])
        spread[row] = np.sqrt(variance * (1 + by_peers @ by_peers))
        implied.parameters[row, SIGMA] = 0
        implied.parameters[row, M11 : SIGMA + 1] += by_peers @ deviation[group]
        nearest = np.flatnonzero(clean)[np.linalg.norm(places[clean] - places[n], axis=1).argmin()]
        implied.parameters[row, B0:] = state.parameters[nearest, B0:]
    return PredictedEdges(implied, spread)


# Whether a target is still where the frame before had it, and which rows of the picture it takes to follow it.

_FOLLOWED_PART = 0.9  # of the markers; round number, nothing was measured
_GREATEST_STEP_PX = 5.0  # drift between two frames is below 0.05 px
_PROBE_BLURS = 3.0  # from the outline: beyond it the edge has its full level
_PROBE_CONTRAST = 0.75  # of the contrast before; round number, nothing was measured
_TOWARDS = np.array([[function(k * np.pi / 8) for k in range(16)] for function in (np.cos, np.sin)])
_TWICE = 2 * _TOWARDS[0] * _TOWARDS[1]
_MOTION_MARGIN_PX, _UNSEEN_MARGIN_RADII = 4.0, 0.5
"""By what a marker may move, or its band grow, until rows are looked at that were not foreseen; of one that was not
seen, in radii: the search for it begins in its place and goes further."""


def is_still_in_place(picture: Picture, state: EdgeState, is_seen: Mask, inwards: Float) -> bool:
    """Return whether the markers (N,) that were seen still look as they did: a glance at 16 pixels on either side of
    each outline, not nearer to the centre than `inwards` (N, 1) radii. Much cheaper than a fit that ends nowhere
    because the target has moved."""
    m11, m12, m22 = (state.parameters[:, [each]] for each in (M11, M12, M22))
    radius = state.scale_px[:, None] / np.sqrt(m11 * _TOWARDS[0] ** 2 + m22 * _TOWARDS[1] ** 2 + m12 * _TWICE)
    margin = np.minimum(_PROBE_BLURS * state.parameters[:, [SIGMA]], np.minimum(0.6, 1 - inwards) * radius)
    along = np.stack([radius + margin, radius - margin])
    column, row = (
        np.clip(np.rint(state.parameters[:, [axis]] + along * _TOWARDS[axis]), 0, picture.shape[1 - axis] - 1)
        for axis in (CX, CY)
    )
    levels = picture.values_DN(row.astype(np.intp), column.astype(np.intp)).mean(axis=2)
    unchanged = (levels[0] - levels[1]) / state.contrast_DN() > _PROBE_CONTRAST
    return bool(unchanged[is_seen].mean() >= _FOLLOWED_PART)


def has_followed(now_px: Float, before_px: Float) -> bool:
    """Return whether centres (N, 2), NaN for missing ones, are of the same markers as before: about as many, and none
    far from where it was."""
    found, found_before = (int(np.isfinite(centres[:, 0]).sum()) for centres in (now_px, before_px))
    moved = np.linalg.norm(now_px - before_px, axis=1)
    return bool(found >= _FOLLOWED_PART * found_before and np.nanmax(moved) < _GREATEST_STEP_PX)


def find_fit_rows(state: EdgeState, is_seen: Mask, outwards: Float, band_sigma: float, height: int) -> Mask:
    """The rows (height,) that a fit from `state` looks at, in all likelihood: those of each marker's band, which ends
    `outwards` (N,) radii from the centre, and some more."""
    half_px, blur_px, mean_px = state.half_extents_px(), state.parameters[:, SIGMA], state.radii_px()
    squares = np.sum(half_px**2, axis=1)
    long_px = np.sqrt(0.5 * (squares + np.sqrt(np.maximum(squares**2 - 4 * mean_px**4, 0))))
    width = np.maximum(band_sigma * blur_px, LEAST_BAND_PX) * long_px / mean_px**2
    band_px = half_px[:, 1] * np.minimum(1 + width, outwards)
    reach_px = np.maximum(band_px, half_px[:, 1] + _PROBE_BLURS * blur_px)
    reach_px += np.where(
        is_seen, _MOTION_MARGIN_PX, np.maximum(_UNSEEN_MARGIN_RADII * half_px[:, 1], _MOTION_MARGIN_PX)
    )
    middle = state.centres_px()[:, 1]
    begins = np.clip(np.floor(middle - reach_px), 0, height).astype(int)
    ends = np.clip(np.ceil(middle + reach_px) + 1, 0, height).astype(int)
    edges = np.bincount(begins, minlength=height + 1) - np.bincount(ends, minlength=height + 1)
    return np.cumsum(edges[:height]) > 0


# The light that the discs and the ground between them have in common.
#
# Twelve parameters let the light slope otherwise on a disc than on the ground round it. Where it does, because light is
# scattered onto the image, fewer parameters put the centres wrong by twice the noise; where it does not, they cost 5 %
# of the accuracy, 7 % when blurred. All markers of a frame together show how much the two slopes differ, beyond what
# noise explains; each marker's slopes are then pulled together as far as that allows, and the centre goes with them:
#
#     r = low / high * slope(high) - slope(low)          DN per px, expected 0 +- w; w^2 = mean(r^2 - variance of r)
#     centre -= cov(centre, r) (cov(r) + w^2)^-1 r
#
# high and low are the levels of the lighter and of the darker side.

_LEAST_MARKERS = 20
"""So many determine w^2 to a quarter of the variance of r."""
_FULL_WEIGHT_CHI2, _ZERO_WEIGHT_CHI2 = 2.0, 5.0
"""A marker whose slopes differ by more (chi^2 of two) is pulled less and less, and then stays as it is: faint glare
that no flag shows would gain weight."""


def apply_common_light(fit: EdgeFit, clean: NDArray[np.bool_]) -> tuple[Float, Float]:
    """Centres (N, 2) px and their covariances (N, 2, 2), where the slopes of the `clean` (N,) markers are believed to
    differ no more than the frame shows; the others, and all where they are few, as they were fitted."""
    centres, covariance = fit.state.centres_px().copy(), fit.covariance_px2.copy()
    if np.count_nonzero(clean) < _LEAST_MARKERS:
        return centres, covariance
    state, whole = fit.state[np.flatnonzero(clean)], fit.covariance[clean]
    by_parameters = _compute_derivatives(state)
    differing = np.einsum("nij,nj->ni", by_parameters, state.parameters)
    shared = whole[:, :2] @ by_parameters.transpose(0, 2, 1)
    variance = by_parameters @ whole @ by_parameters.transpose(0, 2, 1)
    beyond = np.mean(differing**2 - np.diagonal(variance, axis1=1, axis2=2))
    inverse = np.linalg.inv(variance + max(float(beyond), 0.0) * np.eye(2))
    gain = shared @ inverse
    chi2 = np.einsum("ni,nij,nj->n", differing, inverse, differing)
    part = np.clip((_ZERO_WEIGHT_CHI2 - chi2) / (_ZERO_WEIGHT_CHI2 - _FULL_WEIGHT_CHI2), 0, 1)[:, None]
    centres[clean] -= part * np.einsum("nij,nj->ni", gain, differing)
    covariance[clean] -= (part * (2 - part))[:, :, None] * (gain @ shared.transpose(0, 2, 1))
    return centres, covariance


def _compute_derivatives(state: EdgeState) -> Float:
    """The derivatives of r by the parameters (N, 2, 12), but for those by the levels, which are known far better."""
    rows = np.arange(len(state.scale_px))
    ground, disc = state.parameters[:, B0], state.parameters[:, F0]
    high, low = np.where(ground > disc, B0, F0), np.where(ground > disc, F0, B0)
    share = np.maximum(np.minimum(ground, disc), 0) / np.maximum(ground, disc)
    derivatives = np.zeros((len(rows), 2, PARAMETERS))
    for axis in range(2):
        derivatives[rows, axis, high + 1 + axis] = share / state.scale_px
        derivatives[rows, axis, low + 1 + axis] = -1 / state.scale_px
    return derivatives


__all__ = [
    "Detection",
    "DetectionError",
    "Flag",
    "Image",
    "Noise",
    "detect",
    "follow",
    "convert_to_grey",
    "make_empty_detection",
    "predict_rows",
]

# In rendered scenes with glare and an occluder all 9 bad markers are above it, and no good one.
_POOR_CHI = 1.25
_POOR_MISFIT = 1.6
"""Of 36 sectors less the numbers of the ellipse, or of a plane: chance reaches it once in a million markers."""
_LEAST_CONTRAST_SIGMA = 5.0  # of one pixel: less is no disc but noise; round number, not measured
_SIZE_TOLERANCE = 1.35  # neighbours on one plate differ by perspective only; not measured
# As in the gate of identification (grid.py); half a pitch away lies the middle between two markers.
_PLACE_TOLERANCE_PITCH = 0.2
_FLAT_PART = 0.25
"""Of the tolerance: when all are so near to the homography, nothing has to be bent to tell which are in their place."""


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """The N markers of a target in one image, marker n at index n - 1.

    Attributes
    ----------
    centres_px
        (N, 2) float64 as (x, y), px; NaN without a centre.
    covariance_px2
        (N, 2, 2), px^2; NaN likewise.
    flags
        (N,) uint8, bits of `Flag`; 0 when nothing is wrong.
    chi
        (N,), residual over expected noise; 1 is right, NaN without a centre.
    homography
        (3, 3), from mm on the target to px.
    state
        The fitted edges, the start of the next frame.
    growth
        (2,), by what the variances along x and y exceed, or fall below, those of residuals that are independent of each
        other (sandwich.py).
    excess_px2
        (2,), what misfit of ground and disc adds to them, px^2.
    band_sigma
        Half width of the band of pixels fitted, in blurs; like `growth` it is kept for the next frame.
    is_suspect
        The noise model does not describe the picture (compression, texture, print, flicker): the covariance is an
        estimate from how its residuals are correlated.
    is_orientation_assumed
        Nothing says which way up the target is (`Target.orientation`): half a turn looks the same.
    """

    centres_px: Float
    covariance_px2: Float
    flags: NDArray[np.uint8]
    chi: Float
    homography: Float
    state: EdgeState
    growth: Float
    excess_px2: Float
    band_sigma: float
    is_suspect: bool
    is_orientation_assumed: bool = False

    @property
    def found(self) -> int:
        """How many markers have a centre."""
        return int(np.isfinite(self.centres_px[:, 0]).sum())


def _ignore_progress(part: float) -> None:
    """Show no progress."""


def detect(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    target: Target,
    previous: Detection | None = None,
    noise: Noise | None = None,
    watch: Callable[[float], None] = _ignore_progress,
) -> Detection:
    """Find the target's markers in an image, which is only read.

    Parameters
    ----------
    image : (height, width) or (height, width, 3), uint8 or uint16
        A grey image, or a colour image in the order B, G, R.
    target : Target
        The target to find.
    previous : Detection, optional
        The detection in the frame before, for speed and to keep the orientation. When the target has moved too far it
        is searched for again.
    noise : Noise, optional
        The camera's noise. Without it covariances come from the residuals, and chi is relative to this image's median
        marker.
    watch : callable
        Gets the part of a search that is done, 0 to 1.

    Returns
    -------
    Detection
        The markers, with their centres and covariances.

    Raises
    ------
    DetectionError
        When the target cannot be identified with certainty.
    """
    grey = make_picture(convert_to_grey(image))
    if previous is not None:
        followed = _follow(grey, target, previous, noise)
        if followed is not None:
            return followed
    homography = None if previous is None else previous.homography
    found = _search(convert_to_grey(image), grey, target, homography, noise, watch)
    return replace(found, is_orientation_assumed=target.is_orientation_assumed)


def predict_rows(previous: Detection, target: Target, height: int) -> Mask:
    """The rows (height,) of the next frame that `follow` looks at, if all goes on as before."""
    reach = _get_reach(target)[:, 1]
    return find_fit_rows(previous.state, np.isfinite(previous.chi), reach, previous.band_sigma, height)


def follow(
    image: NDArray[np.uint8], rows: Mask, target: Target, previous: Detection, noise: Noise | None = None
) -> Detection | None:
    """Return what `detect` finds by going on from `previous`, from an image (height, width) of which only `rows` are
    there. None where that takes more of it, or another way, to find out: `detect` does it in the whole image."""
    picture = make_picture(image, rows)
    followed = _follow(picture, target, previous, noise)
    return None if picture.missed[0] else followed


def _follow(picture: Picture, target: Target, previous: Detection, noise: Noise | None) -> Detection | None:
    if len(previous.flags) != target.count:
        raise ValueError(f"the previous detection has {len(previous.flags)} markers, the target {target.count}")
    if not is_still_in_place(picture, previous.state, np.isfinite(previous.chi), _get_reach(target)[:, :1]):
        return None
    sampled = target.count if previous.is_suspect else SAMPLED_MARKERS
    with suppress(DetectionError):
        tracked = _fit_in_band(picture, target, previous.state, noise, previous.band_sigma, sampled)
        if tracked is not None and has_followed(tracked[0].centres_px, previous.centres_px):
            found = _add_excess(tracked[0], previous.excess_px2)
            return replace(found, is_orientation_assumed=target.is_orientation_assumed)
    return None


def make_empty_detection(target: Target) -> Detection:
    """All markers missing: what an image without the target has instead of a detection."""
    count = target.count
    return Detection(
        centres_px=np.full((count, 2), np.nan),
        covariance_px2=np.full((count, 2, 2), np.nan),
        flags=np.full(count, Flag.MISSING, np.uint8),
        chi=np.full(count, np.nan),
        homography=np.full((3, 3), np.nan),
        state=EdgeState(np.full((count, 12), np.nan), np.full(count, np.nan)),
        growth=np.ones(2),
        excess_px2=np.zeros(2),
        band_sigma=WIDE_SIGMA,
        is_suspect=False,
    )


def convert_to_grey(image: NDArray[np.uint8] | NDArray[np.uint16]) -> Image:
    """The image itself when it is grey, else its luminance; raises ValueError for other shapes and types."""
    if image.dtype.name not in ("uint8", "uint16") or image.size == 0:
        raise ValueError(f"an image is uint8 or uint16 and not empty, not {image.dtype} {image.shape}")
    if image.ndim == 2:
        return image
    if image.ndim == 3 and image.shape[2] == 1:
        return image[:, :, 0]
    if image.ndim == 3 and image.shape[2] in (3, 4):
        code = cv2.COLOR_BGR2GRAY if image.shape[2] == 3 else cv2.COLOR_BGRA2GRAY
        return cv2.cvtColor(image, code)  # pyright: ignore[reportReturnType] - keeps the type of its input
    raise ValueError(f"an image has the shape (height, width) or (height, width, 3), not {image.shape}")


def _search(
    grey: Image,
    picture: Picture,
    target: Target,
    previous: Float | None,
    noise: Noise | None,
    watch: Callable[[float], None],
) -> Detection:
    """Look for the target at every scale it may have; the failure that came nearest is the one reported."""
    nearest: DetectionError | None = None
    sizes_px = list(iterate_disc_sizes_px(target, grey.shape))
    for tried, size_px in enumerate(sizes_px):
        watch(tried / len(sizes_px))
        candidates = find_candidates(grey, target, size_px)
        try:
            identified = identify(candidates, target, previous, grey.shape)
            return _fit_candidates(picture, target, candidates, identified, noise)
        except DetectionError as error:
            if nearest is None or error.found > nearest.found:
                nearest = error
    raise nearest or DetectionError(
        f"an image of {grey.shape[1]} x {grey.shape[0]} pixels is too small for {target.columns}x{target.rows} markers"
    )


def _fit_candidates(
    picture: Picture, target: Target, candidates: Candidates, identified: Identified, noise: Noise | None
) -> Detection:
    """Fit from the homography's ellipses, put where the candidates are and scaled to the size they have."""
    start = project_edges(identified.homography, target)
    seen = identified.candidate >= 0
    areas = candidates.areas_px2[identified.candidate[seen]]
    scale = float(np.median(np.sqrt(areas / np.pi) / start.radii_px()[seen]))
    start.parameters[seen, :2] = candidates.centres_px[identified.candidate[seen]]
    start = EdgeState(start.parameters, start.scale_px * scale)
    detection = _fit(picture, target, start, noise)
    if detection is None:
        raise DetectionError(
            f"found {seen.sum()} of {target.count} markers of {target.name}, but too few have a clean edge",
            int(seen.sum()),
        )
    return detection


def _fit(picture: Picture, target: Target, start: EdgeState, noise: Noise | None) -> Detection | None:
    """The fit in a wide band; where its residuals hang together, in a narrow one if that leaves less variance."""
    found = _fit_in_band(picture, target, start, noise, WIDE_SIGMA)
    if found is None:
        return None
    wide, fit = found
    if not wide.is_suspect:
        return wide
    again = _fit_in_band(picture, target, wide.state, noise, NARROW_SIGMA, target.count)
    if again is None:
        return wide
    narrow, narrow_fit = again
    excess = compute_excess_px2(fit, narrow_fit, wide.growth, (wide.flags == 0) & (narrow.flags == 0))
    possible = _add_excess(wide, WIDE_EXCESS * excess), _add_excess(narrow, excess)
    return min(possible, key=lambda one: float(np.nanmedian(np.trace(one.covariance_px2, axis1=1, axis2=2))))


def _fit_in_band(
    picture: Picture,
    target: Target,
    start: EdgeState,
    noise: Noise | None,
    band_sigma: float,
    sampled: int = SAMPLED_MARKERS,
) -> tuple[Detection, EdgeFit] | None:
    """The fit from `start`, judged; None when fewer markers than the target demands have a credible centre. sampled:
    how many markers say whether residuals hang together, at first."""
    model = noise or Noise()
    fit = fit_edges(picture, start, model, _get_reach(target), band_sigma, sampled)
    good = np.isfinite(fit.chi) & _has_contrast(fit.state, target, model)
    if good.sum() < target.least_markers:
        return None
    homography = fit_homography(target.coordinates_mm()[good], fit.state.centres_px()[good])
    expected = project_edges(homography, target)
    placed = good & _is_in_place(fit.state, homography, expected, target, good) & _is_within_image(fit.state, picture)
    if placed.sum() < target.least_markers:
        return None
    if placed.sum() < good.sum():
        homography = fit_homography(target.coordinates_mm()[placed], fit.state.centres_px()[placed])
        expected = project_edges(homography, target)
    detection, strange = _assess(fit, placed, homography, expected, band_sigma, relative=noise is None)
    if sampled < target.count and strange.is_suspect():
        return _fit_in_band(picture, target, fit.state, noise, band_sigma, target.count)
    return _refit_poor(detection, fit, picture, target, model), fit


def _add_excess(detection: Detection, excess: Float) -> Detection:
    """The detection with `excess` (2,), px^2, added to the variances of its centres. Where there is any, residuals that
    hang together over the whole marker hide from `growth`: below 1 it is not believed."""
    growth = np.where(excess > 0, np.maximum(detection.growth, 1), detection.growth)
    covariance = _grow_variances(detection.covariance_px2, growth / detection.growth) + np.diag(excess)
    suspect = detection.is_suspect or bool(np.any(excess > 0))
    return replace(detection, covariance_px2=covariance, growth=growth, excess_px2=excess, is_suspect=suspect)


def _assess(
    fit: EdgeFit, good: NDArray[np.bool_], homography: Float, expected: EdgeState, band_sigma: float, relative: bool
) -> tuple[Detection, ResidualCorrelation]:
    """The detection of a fit whose markers are `good` or missing; missing ones are `expected` where the others say."""
    chi, misfit = np.where(good, fit.chi, np.nan), np.where(good, fit.misfit, np.nan)
    usual = max(float(np.median(fit.chi[good])), 1e-9)
    # A print or a lens that the model does not know makes all markers worse; a bad one is worse than the others.
    poor = (chi > _POOR_CHI * (usual if relative else max(usual, 1.0))) | (
        misfit > _POOR_MISFIT * max(float(np.median(fit.misfit[good])), usual if relative else 1.0)
    )
    if relative:
        chi = chi / usual
    flags = np.where(good, fit.flags, fit.flags | Flag.MISSING) | np.where(poor, Flag.POOR_FIT, 0)
    scale = np.median(fit.state.radii_px()[good] / expected.radii_px()[good])
    parameters = expected.parameters.copy()
    parameters[:, SIGMA:] = np.median(fit.state.parameters[good][:, SIGMA:], axis=0)
    believed = good & ~poor
    centres, covariance = apply_common_light(fit, believed)
    strange = measure_residual_correlation(fit, believed)
    found = Detection(
        centres_px=np.where(good[:, None], centres, np.nan),
        covariance_px2=np.where(good[:, None, None], _grow_variances(covariance, strange.growth), np.nan),
        flags=flags.astype(np.uint8),
        chi=chi,
        homography=homography,
        state=EdgeState(
            np.where(good[:, None], fit.state.parameters, parameters),
            np.where(good, fit.state.scale_px, expected.scale_px * scale),
        ),
        growth=strange.growth,
        excess_px2=np.zeros(2),
        band_sigma=band_sigma,
        is_suspect=strange.exceeds_noise_model(),
    )
    return found, strange


def _grow_variances(covariance: Float, growth: Float) -> Float:
    """Covariances (N, 2, 2) whose variances grow and whose correlations stay."""
    return covariance * np.sqrt(np.outer(growth, growth))


def _refit_poor(detection: Detection, fit: EdgeFit, picture: Picture, target: Target, noise: Noise) -> Detection:
    """The detection with its poor markers measured again from what looks clean of them, where that is enough."""
    clean = detection.flags == 0
    poor = np.flatnonzero((detection.flags & (Flag.POOR_FIT | Flag.BORDER | Flag.MISSING)) == Flag.POOR_FIT)
    implied = predict_edges(detection.state, detection.homography, target, clean, poor)
    if implied is None:
        return detection
    usual = float(np.median(fit.chi[clean]))
    scaled = Noise(noise.floor_DN2 * usual**2, noise.slope_DN * usual**2)
    tolerance = float(np.median(fit.misfit[clean])) / usual
    again = refit_edges(
        picture,
        implied.state,
        implied.spread,
        scaled,
        _get_reach(target)[poor],
        tolerance=tolerance,
        band_sigma=detection.band_sigma,
    )
    credible = (again.chi < _POOR_CHI) & _has_contrast(again.state, target, scaled)
    which = poor[credible]
    for whole, part in (
        (detection.centres_px, again.state.centres_px()),
        (detection.covariance_px2, _grow_variances(again.covariance_px2, np.maximum(detection.growth, 1))),
        (detection.chi, again.chi),
        (detection.state.parameters, again.state.parameters),
        (detection.state.scale_px, again.state.scale_px),
    ):
        whole[which] = part[credible]
    detection.flags[which] ^= np.uint8(Flag.POOR_FIT | Flag.REFITTED)
    return detection


def _compute_reach(target: Target) -> Float:
    """Read-only: from where to where, in radii, a marker's pixels lie (N, 2): half way to the nearest other edge."""
    centres, radii = target.coordinates_mm(), target.diameters_mm() / 2
    gap = np.linalg.norm(centres[:, None] - centres[None], axis=2) - radii[:, None] - radii[None]
    np.fill_diagonal(gap, np.inf)
    inwards = np.where(target.is_donut(), (1 + np.sqrt(target.hole_part)) / 2, 0.0)
    reach = np.stack([inwards, 1 + gap.min(axis=1) / (2 * radii)], axis=1)
    reach.flags.writeable = False
    return reach


_get_reach = cast("Callable[[Target], Float]", lru_cache(maxsize=16)(_compute_reach))
"""The same for each frame of a target."""


def _has_contrast(state: EdgeState, target: Target, noise: Noise) -> NDArray[np.bool_]:
    """Return whether the discs stand out of the ground, in the right direction."""
    sign = 1 if target.polarity == "dark" else -1
    level = np.maximum(state.parameters[:, B0], state.parameters[:, F0])
    return sign * state.contrast_DN() > _LEAST_CONTRAST_SIGMA * np.sqrt(noise.variance_DN2(level))


def _is_in_place(
    state: EdgeState, homography: Float, expected: EdgeState, target: Target, good: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Return whether each ellipse has about the place and the size that the other markers imply."""
    limit_px = _PLACE_TOLERANCE_PITCH * compute_pitch_px(homography, target)
    off_px = np.linalg.norm(state.centres_px() - project(homography, target.coordinates_mm()), axis=1)
    if np.any(off_px[good] > _FLAT_PART * limit_px):  # a wide lens, or a wrong one among them
        known = np.where(good[:, None], state.centres_px(), np.nan)
        bent_px = predict_px(target.coordinates_mm(), known, homography)
        off_px = np.linalg.norm(state.centres_px() - bent_px, axis=1)
    ratio = state.radii_px() / expected.radii_px()
    ratio = ratio / np.median(ratio[good])
    return (off_px < limit_px) & (ratio < _SIZE_TOLERANCE) & (ratio > 1 / _SIZE_TOLERANCE)


def _is_within_image(state: EdgeState, picture: Picture) -> NDArray[np.bool_]:
    """Return whether the whole outline is in the image, give or take its blur."""
    height, width = picture.shape
    margin = state.half_extents_px() - state.parameters[:, SIGMA, None]
    centres = state.centres_px()
    return np.all((centres - margin >= -0.5) & (centres + margin <= [width - 0.5, height - 0.5]), axis=1)
