"""What a flat interface between warm and cold air does to a ray from the camera to the target.

The camera looks through air of index n1 to an interface at L1, square to the axis, then through laboratory air of n2 to
the target at D. A ray that leaves at theta to reach radius r = D tan(theta) arrives at r + shift (Snell):

    n1 sin(theta) = n2 sin(theta2)        shift = (D - L1)(tan(theta2) - tan(theta))

Nearly a pure scale, (1 - L1/D)(n1/n2 - 1): what is left is below 0.1 um at 180 mm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def shift_mm(radius_mm: Float | float, distance_mm: float, interface_mm: float, n1: float, n2: float) -> Float:
    """How much further out the ray arrives, mm, for radii of any shape; negative when n1 < n2 (warm camera)."""
    tangent = np.asarray(radius_mm, dtype=np.float64) / distance_mm
    sine = n1 / n2 * tangent / np.sqrt(1 + tangent**2)
    return (distance_mm - interface_mm) * (sine / np.sqrt(1 - sine**2) - tangent)


def tilted_shift_mm(tilt_rad: float, distance_mm: float, interface_mm: float, n1: float, n2: float) -> float:
    """The common shift of the whole image by an interface that is turned by tilt_rad: what it does to the axis."""
    return (distance_mm - interface_mm) * float(np.tan(tilt_rad - np.arcsin(n1 / n2 * np.sin(tilt_rad))))


def appears_px(
    offset_px: Float, focal_px: float, distance_mm: float, interface_mm: float, n1: float, n2: float
) -> Float:
    """How far an image point (..., 2), px from the principal point, is moved: outwards when the camera's air is warm.

    The ray that reaches the target's point left at a smaller radius by `shift_mm`, to first order in it.
    """
    radius_px = np.linalg.norm(offset_px, axis=-1, keepdims=True)
    radius_mm = radius_px / focal_px * distance_mm
    moved_px = -shift_mm(radius_mm, distance_mm, interface_mm, n1, n2) / distance_mm * focal_px
    return offset_px * moved_px / np.where(radius_px > 0, radius_px, 1.0)
