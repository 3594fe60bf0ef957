"""How much the value of a pixel scatters, and the largest value it can have."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8] | NDArray[np.uint16]
"""Grey image, shape (height, width), [row, column]."""


@dataclass(frozen=True, slots=True)
class Noise:
    """Variance of one pixel: `floor_DN2 + slope_DN * signal`, in DN^2, signal in DN.

    floor_DN2: read noise squared plus 1/12 of quantisation. slope_DN: shot noise, 1 / (electrons per DN).
    """

    floor_DN2: float = 1.0 + 1 / 12
    slope_DN: float = 1 / 40

    def __post_init__(self) -> None:
        if not (self.floor_DN2 > 0 and self.slope_DN >= 0):
            raise ValueError(f"a noise model needs floor > 0 and slope >= 0, not {self.floor_DN2}, {self.slope_DN}")

    def variance_DN2(self, signal_DN: NDArray[np.float64]) -> NDArray[np.float64]:
        """Variance at this signal; negative signals count as 0."""
        return self.floor_DN2 + self.slope_DN * np.maximum(signal_DN, 0)


def full_scale_DN(image: Image) -> int:
    """Largest value a pixel can have: 255, or for 16 bits the smallest 2^k - 1 (k >= 8) not below the maximum."""
    if image.dtype == np.uint8:
        return 255
    return max(255, (1 << int(image.max()).bit_length()) - 1)
