"""Where the middles of the discs are, when what was measured are the middles of their images.

Seen at an angle, the image of a disc is an ellipse whose centre is not the image of the disc's centre: the nearer half
looks larger. The difference is about f r^2 sin(t) cos(t) / D^2, 61 mpx for r = 4 mm at D = 1 m, f = 8772 px and
t = 30 deg. For a drift in the image it cancels to first order; for positions in space it does not.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.detection import Detection
from thermostand.markers.grid_identification import fit_homography, project
from thermostand.markers.homography import make_image_map
from thermostand.markers.target import Target

_ROUNDS = 3  # a correction changes its own map by a small part of itself only
_OUTLINE_POINTS = 96
_OUTLINE_RADIUS = math.sqrt(3 / (2 + math.cos(2 * math.pi / _OUTLINE_POINTS)))
"""Of the polygon over the disc's: both then have the same second moment over area, which is what moves the centroid."""

Float = NDArray[np.float64]


def compute_disc_centres_px(detection: Detection, target: Target) -> Float:
    """The images of the discs' centres (N, 2), NaN without a marker, by the map of the target's plane onto the image
    that the markers themselves show: a homography, bent as the lens bends it where 20 markers are seen.

    What the lens bends within a disc is in it, too: some mpx for k1 = -0.15 and discs of 70 px. The calibrated camera
    (`compute_ellipse_centre_offset_px`) needs no markers for it.
    """
    ellipses_px, target_mm = detection.centres_px, target.coordinates_mm()
    seen = np.isfinite(ellipses_px[:, 0])
    centres_px = ellipses_px
    for _ in range(_ROUNDS):  # the map is that of the centres that are being corrected with it
        homography = fit_homography(target_mm[seen], centres_px[seen])
        centres_px = ellipses_px - compute_ellipse_centre_offset_px(
            make_image_map(target_mm, centres_px, homography), target
        )
    return centres_px


def compute_disc_centres(detection: Detection, target: Target) -> tuple[Float, Float]:
    """`compute_disc_centres_px`, all NaN when the image has no target, and their covariance (N, 2, 2), px^2.

    The latter is that of the markers: what the noise of the map adds is below 1 %.
    """
    if not detection.found:
        return np.full_like(detection.centres_px, np.nan), detection.covariance_px2
    return compute_disc_centres_px(detection, target), detection.covariance_px2


def compute_disc_centres_by_homography_px(ellipses_px: Float, target_mm: Float, radii_mm: Float) -> Float:
    """The same from the ellipses' centres (N, 2), px, of discs at (N, 2) mm of the target's plane, radii (N,) mm."""
    seen = np.isfinite(ellipses_px[:, 0])
    centres_px = ellipses_px
    for _ in range(_ROUNDS):  # the homography is that of the centres that are being corrected with it
        homography = fit_homography(target_mm[seen], centres_px[seen])
        middle_px = project(homography, target_mm)
        centres_px = ellipses_px + middle_px - compute_ellipse_centres_px(homography, target_mm, radii_mm)
    return centres_px


def compute_ellipse_centres_px(homography: Float, centres_mm: Float, radii_mm: Float) -> Float:
    """Centres (N, 2) of the ellipses that circles of the plane become: conic C = H^-T Q H^-1 of each circle Q."""
    x, y = centres_mm.T
    circle = np.zeros((len(x), 3, 3))
    circle[:, 0, 0] = circle[:, 1, 1] = 1
    circle[:, 0, 2] = circle[:, 2, 0] = -x
    circle[:, 1, 2] = circle[:, 2, 1] = -y
    circle[:, 2, 2] = x**2 + y**2 - radii_mm**2
    back = np.linalg.inv(homography)
    conic = back.T @ circle @ back
    return np.asarray(-np.linalg.solve(conic[:, :2, :2], conic[:, :2, 2, None])[:, :, 0], np.float64)


def compute_ellipse_centre_offset_px(to_image: Callable[[Float], Float], target: Target) -> Float:
    """Centroid of each disc's image less the image of its centre (N, 2), for any camera: subtract it from measured
    centres. `to_image` maps points of the target's plane, (K, 2) mm, to px. The centroid is that of the projected
    outline, a polygon, by Green's theorem."""
    angle = np.arange(_OUTLINE_POINTS) * (2 * np.pi / _OUTLINE_POINTS)
    circle = _OUTLINE_RADIUS * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    centres_mm = target.coordinates_mm()
    outlines_mm = centres_mm[:, None] + target.diameters_mm()[:, None, None] / 2 * circle
    outlines_px = to_image(outlines_mm.reshape(-1, 2)).reshape(outlines_mm.shape)
    middles_px = to_image(centres_mm)
    return compute_centroid_offsets_px(outlines_px, middles_px)


def compute_centroid_offsets_px(outlines_px: Float, middles_px: Float) -> Float:
    """Centroids of polygons (..., K, 2) less the points (..., 2) in them, by Green's theorem:
    (sum (p_i + p_i+1) c_i) / (3 sum c_i), c_i = x_i y_i+1 - x_i+1 y_i, about the point so that the products are small.
    """
    one = outlines_px - middles_px[..., None, :]
    next_ = np.roll(one, -1, axis=-2)
    cross = one[..., 0] * next_[..., 1] - next_[..., 0] * one[..., 1]
    centroids = ((one + next_) * cross[..., None]).sum(axis=-2) / (3 * cross.sum(axis=-1))[..., None]
    return np.asarray(centroids, dtype=np.float64)
