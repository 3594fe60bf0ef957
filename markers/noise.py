"""How much the value of a pixel scatters, and the largest value it can have."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.uint8] | NDArray[np.uint16]
"""Grey image, shape (height, width), [row, column]."""
Float = NDArray[np.float64]
Float32 = NDArray[np.float32]

_DEPTHS_bit = (8, 10, 12, 14, 16)
# Round number; nothing was measured.
_BINS = 16
_LEAST_PIXELS = 1000  # a variance of each of 16 bins is then known to 18 %
_EDGE_px = 7  # further from an edge than any blur in use; not measured
_MEAN_px = 5  # a mean of 25 px in two images has 1/7 of a pixel's noise
_MEANS_PER_DN = 2 * _MEAN_px**2
"""Of two images of whole DN, over squares of so many pixels."""
_FLAT_PART = 0.02  # of the picture's range; not measured
_FLAT_SIGMA = 0.5  # of the noise that the mean suggests; not measured
_ROUNDING_DN2 = 1 / 12  # of a uniform distribution one DN wide
_TINY_DN = 1e-9


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


def find_full_scale_DN(image: Image) -> int:
    """Largest value a pixel can have, found from the picture, as files and frames do not carry the pixel format.

    255 of 8 bits. Of 16: 2^k - 1 for the smallest k of `_DEPTHS_bit` that holds the brightest pixel, as cameras fill
    them from below (Mono10, Mono12); less the bits that no pixel uses where they fill them from above (Mono16 of a
    12-bit sensor: 65520).
    """
    if image.dtype == np.uint8:
        return 255
    brightest = int(image.max())
    depth = next(depth for depth in _DEPTHS_bit if brightest < 1 << depth)
    if depth < _DEPTHS_bit[-1]:
        return (1 << depth) - 1
    used = int(np.bitwise_or.reduce(image, axis=None))
    return (1 << depth) - (used & -used)


def estimate_noise(images: Sequence[Image], windows: NDArray[np.int32] | None = None) -> Noise | None:
    """The photon-transfer curve of a camera from images of the same scene: the variance of pixels against their mean.

    Half the variance of the difference between two images; of neighbours in a row, so that light which changed evenly
    does not count. Pixels near edges, which drift, and saturated ones are left out. windows: x, y, width, height
    (n, 4) of the parts that are images at all. None when there are fewer than two images of one shape and type, or
    too few such pixels.
    """
    pairs = [
        _pair_samples(one, two, windows)
        for one, two in pairwise(images)
        if (one.shape, one.dtype) == (two.shape, two.dtype)
    ]
    if not pairs:
        return None
    signal, noise = (np.concatenate(values) for values in zip(*pairs, strict=True))
    if len(signal) < _LEAST_PIXELS:
        return None
    bins = np.array_split(_sort_indices(signal), _BINS)
    means = np.array([signal[part].astype(np.float64).mean() for part in bins])
    variances = np.maximum([_compute_clipped_variance(noise[part].astype(np.float64)) for part in bins], _ROUNDING_DN2)
    return _fit_line(means, variances)


def _sort_indices(signal: Float32) -> NDArray[np.int64]:
    """np.argsort(signal, kind="stable"). The means of 8-bit pixels have few values, whose numbers NumPy sorts by their
    digits: a third of the time for millions of them."""
    numbers = np.rint(signal * _MEANS_PER_DN)
    if numbers.max() <= np.iinfo(np.uint16).max:
        keys = numbers.astype(np.uint16)
        values = np.zeros(int(keys.max()) + 1, np.float32)
        values[keys] = signal
        if np.array_equal(values[keys], signal):
            return np.argsort(keys, kind="stable")
    return np.argsort(signal, kind="stable")


def _pair_samples(one: Image, two: Image, windows: NDArray[np.int32] | None) -> tuple[Float32, Float32]:
    """Signal, and a sample of the noise of one pixel, for pairs of neighbours on even ground."""
    mean = cv2.blur(cv2.addWeighted(one, 0.5, two, 0.5, 0, dtype=cv2.CV_32F), (_MEAN_px, _MEAN_px))
    box = np.ones((_EDGE_px, _EDGE_px), np.uint8)
    change = cv2.dilate(mean, box) - cv2.erode(mean, box)
    flat = change < _FLAT_PART * float(mean.max() - mean.min()) + _FLAT_SIGMA * float(np.sqrt(np.median(mean) + 1))
    flat &= np.maximum(one, two) < find_full_scale_DN(one) - 1
    if windows is not None:
        inside = np.zeros(one.shape, bool)
        for x, y, width, height in windows:
            inside[y : y + height, x : x + width] = True
        flat &= inside
    even = slice(0, one.shape[1] // 2 * 2, 2)
    odd = slice(1, one.shape[1] // 2 * 2, 2)
    chosen = flat[:, even] & flat[:, odd]
    difference: Float32 = np.subtract(one, two, dtype=np.float32)
    return (
        mean[:, even][chosen].astype(np.float32),
        np.divide(difference[:, even][chosen] - difference[:, odd][chosen], 2, dtype=np.float32),
    )


def _compute_clipped_variance(values: Float) -> float:
    """Variance without what is beyond five standard deviations: a hot pixel, a moving speck of dust."""
    for _ in range(2):
        values = values[np.abs(values) <= 5 * values.std() + _TINY_DN]
    return float(np.mean(values**2))


def _fit_line(means: Float, variances: Float) -> Noise:
    """The straight line through the variances, each as uncertain as it is large; neither part is below what it can
    be."""
    weight = 1 / variances
    design = np.stack([np.ones_like(means), means], axis=1) * weight[:, None]
    read_variance, slope = np.linalg.lstsq(design, variances * weight, rcond=None)[0]
    if slope < 0:
        return Noise(float(np.mean(variances)), 0.0)
    if read_variance < _ROUNDING_DN2:
        through = np.sum((variances - _ROUNDING_DN2) * means * weight**2) / max(np.sum((means * weight) ** 2), _TINY_DN)
        return Noise(_ROUNDING_DN2, max(float(through), 0.0))
    return Noise(float(read_variance), float(slope))
