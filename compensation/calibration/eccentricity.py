"""The centre of a disc's image is not the image of its centre: how far they are apart, and the centres put right.

Before the camera is known the target's homography stands for it; with a camera the outlines are projected. A disc of
8 mm at 1 m and 30 deg is off by 41 mpx per coordinate; the homography alone leaves 3 mpx where the lens distorts.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from compensation.calibration.least_squares import Float
from compensation.markers.grid import fit_homography, project

Project = Callable[[Float], Float]
"""Points (..., 3) of the camera frame, mm -> pixels (..., 2)."""

_ROUNDS = 3
_OUTLINE_POINTS = 32
_OUTLINE_RADIUS = float(np.sqrt(3 / (2 + np.cos(2 * np.pi / _OUTLINE_POINTS))))
"""Of the polygon over the disc's: both then have the same second moment over area, which is what moves the centroid."""


def shifts_by_homography(centres_px: Float, points_mm: Float, diameters_mm: Float) -> Float:
    """Centre of the ellipse minus image of the centre (N, 2), px; NaN where the marker has no centre.

    The conic of a circle of radius r is Q = [[1, 0, -X], [0, 1, -Y], [-X, -Y, X^2 + Y^2 - r^2]], its image
    H^-T Q H^-1. The homography is that of the corrected centres, so a few rounds are made.
    """
    seen = np.isfinite(centres_px[:, 0])
    plane = points_mm[:, :2]
    shifts = np.zeros_like(centres_px)
    for _ in range(_ROUNDS):
        homography = fit_homography(plane[seen], (centres_px - shifts)[seen])
        shifts = _ellipse_centres(homography, plane, diameters_mm / 2) - project(homography, plane)
    return np.where(seen[:, None], shifts, np.nan)


def shifts_by_camera(
    projection: Project, rotation: Float, translation_mm: Float, points_mm: Float, diameters_mm: Float
) -> Float:
    """Centroid of the disc's image minus image of the centre (..., N, 2), px, for poses (..., 3, 3) and (..., 3).

    The outline is projected as a polygon; its centroid is Green's: A = sum(c)/2, (sum (p_i + p_i+1) c)/(6 A) with
    c = x_i y_i+1 - x_i+1 y_i.
    """
    angle = 2 * np.pi / _OUTLINE_POINTS * np.arange(_OUTLINE_POINTS)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=1)
    outline_mm = points_mm[:, None] + _OUTLINE_RADIUS * diameters_mm[:, None, None] / 2 * circle
    target_mm = np.concatenate([outline_mm, points_mm[:, None]], axis=1)
    seen_mm = np.einsum("...ij,nkj->...nki", rotation, target_mm) + translation_mm[..., None, None, :]
    pixels = projection(seen_mm)
    here = pixels[..., :-1, :] - pixels[..., -1:, :]  # about the image of the centre: small products
    after = np.roll(here, -1, axis=-2)
    cross = here[..., 0] * after[..., 1] - after[..., 0] * here[..., 1]
    moment = np.sum((here + after) * cross[..., None], axis=-2)
    return moment / (3 * np.sum(cross, axis=-1)[..., None])


def _ellipse_centres(homography: Float, plane_mm: Float, radii_mm: Float) -> Float:
    x, y = plane_mm.T
    circle = np.tile(np.eye(3), (len(x), 1, 1))
    circle[:, 0, 2] = circle[:, 2, 0] = -x
    circle[:, 1, 2] = circle[:, 2, 1] = -y
    circle[:, 2, 2] = x**2 + y**2 - radii_mm**2
    back = np.linalg.inv(homography)
    conic = back.T @ circle @ back
    return np.asarray(-np.linalg.solve(conic[:, :2, :2], conic[:, :2, 2, None])[:, :, 0], np.float64)
