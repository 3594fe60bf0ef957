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

from thermostand.markers.band import NARROW_SIGMA, WIDE_EXCESS, WIDE_SIGMA, Strangeness, excess_px2, strangeness
from thermostand.markers.bootstrap import Candidates, disc_sizes_px, find_candidates
from thermostand.markers.edge_fit import EdgeFit, Flag, fit_edges
from thermostand.markers.edge_model import B0, F0, SIGMA, EdgeState
from thermostand.markers.expected import expected_edges, implied_edges
from thermostand.markers.following import has_followed, rows_round, still_there
from thermostand.markers.grid import (
    DetectionError,
    Identified,
    expected_px,
    fit_homography,
    identify,
    pitch_px,
    project,
)
from thermostand.markers.light import under_common_light
from thermostand.markers.noise import Image, Noise
from thermostand.markers.pixels import Mask, Picture, picture_of
from thermostand.markers.refit import refit_edges
from thermostand.markers.sandwich import SAMPLED_MARKERS
from thermostand.markers.target import Target

__all__ = [
    "Detection",
    "DetectionError",
    "Flag",
    "Image",
    "Noise",
    "detect",
    "follow",
    "grey_image",
    "nothing_found",
    "rows_to_follow",
]

Float = NDArray[np.float64]

_POOR_CHI = 1.25
_POOR_MISFIT = 1.6
"""Of 36 sectors less the numbers of the ellipse, or of a plane: chance reaches it once in a million markers."""
_LEAST_CONTRAST_SIGMA = 5.0
_SIZE_TOLERANCE = 1.35
_PLACE_TOLERANCE_PITCH = 0.2
_FLAT_PART = 0.25
"""Of the tolerance: when all are so near to the homography, nothing has to be bent to tell which are in their place."""


@dataclass(frozen=True, slots=True, eq=False)
class Detection:
    """The N markers of a target in one image, marker n at index n - 1.

    centres_px: (N, 2) float64 (x, y), NaN without a centre. covariance_px2: (N, 2, 2), NaN likewise. flags: (N,) uint8
    of Flag, 0 when nothing is wrong. chi: (N,), residual over expected noise; 1 is right, NaN without a centre.
    homography: (3, 3), target mm -> px. state: the fitted edges, the start of the next frame. growth: (2,), by what the
    variances along x and y exceed, or fall below, those of residuals that are independent of each other (sandwich.py).
    excess_px2: (2,), what misfit of ground and disc adds to them, px^2. band_sigma: half width of the band of pixels
    fitted, in blurs (band.py). The next frame keeps these two. is_doubtful: the noise model does not describe the
    picture (compression, texture, print, flicker): the covariance is an estimate from how its residuals hang together.
    is_orientation_assumed: nothing says which way up the target is (Target.orientation): half a turn looks the same.
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
    is_doubtful: bool
    is_orientation_assumed: bool = False

    @property
    def found(self) -> int:
        """How many markers have a centre."""
        return int(np.isfinite(self.centres_px[:, 0]).sum())


def _unwatched(part: float) -> None:
    """No progress is shown."""


def detect(
    image: NDArray[np.uint8] | NDArray[np.uint16],
    target: Target,
    previous: Detection | None = None,
    noise: Noise | None = None,
    watch: Callable[[float], None] = _unwatched,
) -> Detection:
    """The target's markers in a grey (height, width) or colour (height, width, 3; B G R) image, which is only read.

    previous: the frame before, for speed and to keep the orientation; when the target has moved too far it is searched
    for again. noise: the camera's; without it covariances come from the residuals, and chi is relative to this image's
    median marker. watch: gets the part of a search that is done, 0 to 1. Raises DetectionError when the target cannot
    be identified beyond doubt.
    """
    grey = picture_of(grey_image(image))
    if previous is not None:
        followed = _follow(grey, target, previous, noise)
        if followed is not None:
            return followed
    homography = None if previous is None else previous.homography
    found = _search(grey_image(image), grey, target, homography, noise, watch)
    return replace(found, is_orientation_assumed=target.is_orientation_assumed)


def rows_to_follow(previous: Detection, target: Target, height: int) -> Mask:
    """The rows (height,) of the next frame that `follow` looks at, if all goes on as before."""
    reach = _reach(target)[:, 1]
    return rows_round(previous.state, np.isfinite(previous.chi), reach, previous.band_sigma, height)


def follow(
    image: NDArray[np.uint8], rows: Mask, target: Target, previous: Detection, noise: Noise | None = None
) -> Detection | None:
    """What `detect` finds by going on from `previous`, from an image (height, width) of which only `rows` are there.
    None where that takes more of it, or another way, to find out: `detect` does it in the whole image."""
    picture = picture_of(image, rows)
    followed = _follow(picture, target, previous, noise)
    return None if picture.missed[0] else followed


def _follow(picture: Picture, target: Target, previous: Detection, noise: Noise | None) -> Detection | None:
    if len(previous.flags) != target.count:
        raise ValueError(f"the previous detection has {len(previous.flags)} markers, the target {target.count}")
    if not still_there(picture, previous.state, np.isfinite(previous.chi), _reach(target)[:, :1]):
        return None
    sampled = target.count if previous.is_doubtful else SAMPLED_MARKERS
    with suppress(DetectionError):
        tracked = _fit_in_band(picture, target, previous.state, noise, previous.band_sigma, sampled)
        if tracked is not None and has_followed(tracked[0].centres_px, previous.centres_px):
            found = _doubted(tracked[0], previous.excess_px2)
            return replace(found, is_orientation_assumed=target.is_orientation_assumed)
    return None


def nothing_found(target: Target) -> Detection:
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
        is_doubtful=False,
    )


def grey_image(image: NDArray[np.uint8] | NDArray[np.uint16]) -> Image:
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
    sizes_px = list(disc_sizes_px(target, grey.shape))
    for tried, size_px in enumerate(sizes_px):
        watch(tried / len(sizes_px))
        candidates = find_candidates(grey, target, size_px)
        try:
            identified = identify(candidates, target, previous, grey.shape)
            return _first_fit(picture, target, candidates, identified, noise)
        except DetectionError as error:
            if nearest is None or error.found > nearest.found:
                nearest = error
    raise nearest or DetectionError(
        f"an image of {grey.shape[1]} x {grey.shape[0]} pixels is too small for {target.columns}x{target.rows} markers"
    )


def _first_fit(
    picture: Picture, target: Target, candidates: Candidates, identified: Identified, noise: Noise | None
) -> Detection:
    """Fit from the homography's ellipses, put where the candidates are and scaled to the size they have."""
    start = expected_edges(identified.homography, target)
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
    if not wide.is_doubtful:
        return wide
    again = _fit_in_band(picture, target, wide.state, noise, NARROW_SIGMA, target.count)
    if again is None:
        return wide
    narrow, narrow_fit = again
    excess = excess_px2(fit, narrow_fit, wide.growth, (wide.flags == 0) & (narrow.flags == 0))
    possible = _doubted(wide, WIDE_EXCESS * excess), _doubted(narrow, excess)
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
    fit = fit_edges(picture, start, model, _reach(target), band_sigma, sampled)
    good = np.isfinite(fit.chi) & _has_contrast(fit.state, target, model)
    if good.sum() < target.least_markers:
        return None
    homography = fit_homography(target.coordinates_mm()[good], fit.state.centres_px()[good])
    expected = expected_edges(homography, target)
    placed = good & _in_its_place(fit.state, homography, expected, target, good) & _within_image(fit.state, picture)
    if placed.sum() < target.least_markers:
        return None
    if placed.sum() < good.sum():
        homography = fit_homography(target.coordinates_mm()[placed], fit.state.centres_px()[placed])
        expected = expected_edges(homography, target)
    detection, strange = _judged(fit, placed, homography, expected, band_sigma, relative=noise is None)
    if sampled < target.count and strange.is_suspect():
        return _fit_in_band(picture, target, fit.state, noise, band_sigma, target.count)
    return _refitted(detection, fit, picture, target, model), fit


def _doubted(detection: Detection, excess: Float) -> Detection:
    """The detection with `excess` (2,), px^2, added to the variances of its centres. Where there is any, residuals that
    hang together over the whole marker hide from `growth`: below 1 it is not believed."""
    growth = np.where(excess > 0, np.maximum(detection.growth, 1), detection.growth)
    covariance = _grown(detection.covariance_px2, growth / detection.growth) + np.diag(excess)
    doubtful = detection.is_doubtful or bool(np.any(excess > 0))
    return replace(detection, covariance_px2=covariance, growth=growth, excess_px2=excess, is_doubtful=doubtful)


def _judged(
    fit: EdgeFit, good: NDArray[np.bool_], homography: Float, expected: EdgeState, band_sigma: float, relative: bool
) -> tuple[Detection, Strangeness]:
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
    centres, covariance = under_common_light(fit, believed)
    strange = strangeness(fit, believed)
    found = Detection(
        centres_px=np.where(good[:, None], centres, np.nan),
        covariance_px2=np.where(good[:, None, None], _grown(covariance, strange.growth), np.nan),
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
        is_doubtful=strange.is_doubtful(),
    )
    return found, strange


def _grown(covariance: Float, growth: Float) -> Float:
    """Covariances (N, 2, 2) whose variances grow and whose correlations stay."""
    return covariance * np.sqrt(np.outer(growth, growth))


def _refitted(detection: Detection, fit: EdgeFit, picture: Picture, target: Target, noise: Noise) -> Detection:
    """The detection with its poor markers measured again from what looks clean of them, where that is enough."""
    clean = detection.flags == 0
    poor = np.flatnonzero((detection.flags & (Flag.POOR_FIT | Flag.BORDER | Flag.MISSING)) == Flag.POOR_FIT)
    implied = implied_edges(detection.state, detection.homography, target, clean, poor)
    if implied is None:
        return detection
    usual = float(np.median(fit.chi[clean]))
    scaled = Noise(noise.floor_DN2 * usual**2, noise.slope_DN * usual**2)
    patience = float(np.median(fit.misfit[clean])) / usual
    again = refit_edges(
        picture, implied.state, implied.spread, scaled, _reach(target)[poor], patience, detection.band_sigma
    )
    credible = (again.chi < _POOR_CHI) & _has_contrast(again.state, target, scaled)
    which = poor[credible]
    for whole, part in (
        (detection.centres_px, again.state.centres_px()),
        (detection.covariance_px2, _grown(again.covariance_px2, np.maximum(detection.growth, 1))),
        (detection.chi, again.chi),
        (detection.state.parameters, again.state.parameters),
        (detection.state.scale_px, again.state.scale_px),
    ):
        whole[which] = part[credible]
    detection.flags[which] ^= np.uint8(Flag.POOR_FIT | Flag.REFITTED)
    return detection


def _reach_of(target: Target) -> Float:
    """Read-only: from where to where, in radii, a marker's pixels lie (N, 2): half way to the nearest other edge."""
    centres, radii = target.coordinates_mm(), target.diameters_mm() / 2
    gap = np.linalg.norm(centres[:, None] - centres[None], axis=2) - radii[:, None] - radii[None]
    np.fill_diagonal(gap, np.inf)
    inwards = np.where(target.is_donut(), (1 + np.sqrt(target.hole_part)) / 2, 0.0)
    reach = np.stack([inwards, 1 + gap.min(axis=1) / (2 * radii)], axis=1)
    reach.flags.writeable = False
    return reach


_reach = cast("Callable[[Target], Float]", lru_cache(maxsize=16)(_reach_of))
"""The same for each frame of a target."""


def _has_contrast(state: EdgeState, target: Target, noise: Noise) -> NDArray[np.bool_]:
    """Whether the discs stand out of the ground, in the right direction."""
    sign = 1 if target.polarity == "dark" else -1
    level = np.maximum(state.parameters[:, B0], state.parameters[:, F0])
    return sign * state.contrast_DN() > _LEAST_CONTRAST_SIGMA * np.sqrt(noise.variance_DN2(level))


def _in_its_place(
    state: EdgeState, homography: Float, expected: EdgeState, target: Target, good: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Whether each ellipse has about the place and the size that the other markers imply."""
    limit_px = _PLACE_TOLERANCE_PITCH * pitch_px(homography, target)
    off_px = np.linalg.norm(state.centres_px() - project(homography, target.coordinates_mm()), axis=1)
    if np.any(off_px[good] > _FLAT_PART * limit_px):  # a wide lens, or a wrong one among them
        known = np.where(good[:, None], state.centres_px(), np.nan)
        bent_px = expected_px(target.coordinates_mm(), known, homography)
        off_px = np.linalg.norm(state.centres_px() - bent_px, axis=1)
    ratio = state.radii_px() / expected.radii_px()
    ratio = ratio / np.median(ratio[good])
    return (off_px < limit_px) & (ratio < _SIZE_TOLERANCE) & (ratio > 1 / _SIZE_TOLERANCE)


def _within_image(state: EdgeState, picture: Picture) -> NDArray[np.bool_]:
    """Whether the whole outline is in the image, give or take its blur."""
    height, width = picture.shape
    margin = state.half_extents_px() - state.parameters[:, SIGMA, None]
    centres = state.centres_px()
    return np.all((centres - margin >= -0.5) & (centres + margin <= [width - 0.5, height - 0.5]), axis=1)
