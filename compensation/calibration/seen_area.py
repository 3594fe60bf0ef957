"""Where of the picture a calibration has seen markers: elsewhere its lens is an extrapolation, and nothing is known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.drift.hull import distances_px

NOT_SEEN = "not seen here (no marker was near, so nothing is known of the lens)"
_BEYOND = 0.1
"""Of the hull's mean radius. Measured on 24 drawn lenses (f 1000 to 7246 px, markers within 35 to 100 % of the
picture; ripples of 0 to 50 mpx that the lens model cannot follow): up to here errors are 1.3 times as many sigma as
among the markers, beyond 0.4 they are 5 times as many."""


def seen(pixels: Float, hull_px: Float) -> NDArray[np.bool_]:
    """(...): whether pixels (..., 2) are among the markers, whose hull (H, 2) is, or near them."""
    radius_px = float(np.linalg.norm(hull_px - hull_px.mean(axis=0), axis=1).mean())
    inside_px = distances_px(pixels.reshape(-1, 2), hull_px).min(axis=1).reshape(pixels.shape[:-1])
    return np.asarray(inside_px >= -_BEYOND * radius_px)
