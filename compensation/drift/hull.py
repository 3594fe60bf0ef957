"""The convex hull of points of the image, and how far inside it others are."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull, QhullError

from thermostand.compensation.history.thermal_history import Float

MARGIN_PX = 1.0
"""The markers themselves move by this much over the calibrated temperatures."""

_LEAST_WIDTH_PX = 5.0
"""Markers in one line, too, span a few px across it when they drift; a second row of them is many px away."""


def compute_convex_hull(points: Float) -> Float:
    """The corners (H, 2) of points (M, 2), in the sense that turns x towards y, from the leftmost on; points that span
    no area are their own corners."""
    try:
        corners = points[ConvexHull(points).vertices]
    except QhullError:
        return np.unique(points, axis=0)
    return np.roll(corners, -int(np.lexsort(corners.T[::-1])[0]), axis=0)


def is_area(hull_px: Float) -> bool:
    """Return whether the corners (H, 2) are those of a convex polygon, in the sense that turns x towards y, and not so
    thin that it may be a line."""
    sides = np.linalg.norm(np.roll(hull_px, -1, axis=0) - hull_px, axis=1)
    if len(hull_px) < 3 or sides.min() == 0:
        return False
    distances = compute_distances_px(hull_px, hull_px)
    return bool(distances.min() > -MARGIN_PX and distances.max(axis=0).min() > _LEAST_WIDTH_PX)


def compute_distances_px(xy_px: Float, hull_px: Float) -> Float:
    """Return how far points (N, 2) are inside each side of the hull (H, 2), shape (N, H); negative is outside."""
    sides = np.roll(hull_px, -1, axis=0) - hull_px
    along = sides / np.linalg.norm(sides, axis=1, keepdims=True)
    offset = xy_px[:, None] - hull_px
    return along[:, 0] * offset[:, :, 1] - along[:, 1] * offset[:, :, 0]
