"""The two kinds of memory a camera has: a body that follows slowly, and a joint with play."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]


def lagged(follower: Float, held: float, dt_s: float, taus_s: Float) -> Float:
    """First-order followers (K,) after dt_s of a constant input, exactly: z + (s - z)(1 - exp(-dt/tau))."""
    return follower - (held - follower) * np.expm1(-dt_s / taus_s)


def played(position: Float, driver: float, radii: Float) -> Float:
    """Prandtl-Ishlinskii plays (P,): each stays where it is until the driver is further away than its radius."""
    return np.clip(position, driver - radii, driver + radii)
