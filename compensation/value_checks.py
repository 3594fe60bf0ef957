"""What numbers in a file from elsewhere must be, before anything is computed with them.

Each `check_` raises a ValueError that begins with the place in the file.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import Field

from thermostand.compensation.drift_runtime import MOST_CORNERS, MOST_IMAGES, COLDEST_degC, HOTTEST_degC

LARGEST_SIDE_px = 100_000  # four times the largest sensors that are sold
_FARTHEST_mm = 1e6

Float = NDArray[np.float64]
Pair = tuple[float, float]
Side = Annotated[int, Field(gt=0, le=LARGEST_SIDE_px)]
Size = tuple[Side, Side]
Length = Annotated[float, Field(ge=-_FARTHEST_mm, le=_FARTHEST_mm)]
Degrees = Annotated[float, Field(ge=COLDEST_degC, le=HOTTEST_degC)]
NotNegative = Annotated[float, Field(ge=0)]
Hull = Annotated[tuple[Pair, ...], Field(min_length=3, max_length=MOST_CORNERS)]

_ASYMMETRY, _NEGATIVE = 1e-6, 1e-6
"""Deviations of correlations that rounding explains. The covariances of 3 drawn sessions have positive eigenvalues
only, of at least 4.5e-6; a type prior and the calibrations of the tests pass."""


def check_shape(name: str, values: object, shape: tuple[int, ...]) -> Float:
    """Return the values as an array of this shape, or refuse them."""
    try:
        array = np.array(values, np.float64)
    except ValueError as error:
        raise ValueError(f"{name}: rows of different lengths") from error
    if array.shape != shape:
        raise ValueError(f"{name}: shape {array.shape} instead of {shape}")
    return array


def check_covariance(name: str, covariance: Float) -> None:
    """Check covariances (n, n) or (..., n, n): no variance below 0, symmetric and positive semidefinite within
    rounding. Judged by the correlations: parameters of different units have variances of different sizes."""
    size = covariance.shape[-1]
    for matrix in covariance.reshape(-1, size, size):
        variance = np.diagonal(matrix)
        if (variance < 0).any():
            at = int(np.argmin(variance))
            raise ValueError(f"{name}: the variance in row {at} is {variance[at]:.3g}, and none is below 0")
        sigma = np.sqrt(variance)
        scale = np.where(sigma > 0, sigma, np.inf)
        correlation = matrix / scale[:, None] / scale
        if np.abs(correlation - correlation.T).max(initial=0.0) > _ASYMMETRY:
            raise ValueError(f"{name}: not symmetric, as a covariance is")
        if (matrix[sigma == 0] != 0).any() or np.linalg.eigvalsh((correlation + correlation.T) / 2)[
            0
        ] < -_NEGATIVE * size:
            raise ValueError(f"{name}: not positive semidefinite, as a covariance is")


def check_degC(name: str, values: ArrayLike) -> None:
    """Temperatures, NaN where one is not known."""
    given = np.asarray(values, np.float64).ravel()
    wrong = np.flatnonzero(~(np.isnan(given) | ((given >= COLDEST_degC) & (given <= HOTTEST_degC))))
    if len(wrong):
        raise ValueError(f"{name}: {given[wrong[0]]:g} degC in place {wrong[0]} (from 0); is it in another unit?")


def check_centres(name: str, centres_px: Float, image_size: tuple[int, int]) -> None:
    """(F, N, 2), NaN where a marker is missing; px from the middle of the first pixel."""
    off = (centres_px < -1.0) | (centres_px > np.array(image_size, np.float64))
    if off.any():
        frame, marker, _ = np.argwhere(off)[0]
        x_px, y_px = centres_px[frame, marker]
        raise ValueError(
            f"{name}: marker {marker} of frame {frame} is at ({x_px:g}, {y_px:g}) px, outside the image of "
            f"{image_size[0]} x {image_size[1]}; px count from the middle of the image's first pixel"
        )


def check_within_image(name: str, moves_px: ArrayLike, image_size: tuple[int, int]) -> None:
    """moves_px: how far something moves a point, px."""
    greatest, side = float(np.max(np.abs(moves_px))), max(image_size)
    if not greatest <= side:
        raise ValueError(
            f"{name}: they move points by {greatest:.3g} px; the image has {side}, and what moves a point further "
            "than that corrects nothing"
        )


def check_terms(name: str, terms_px: ArrayLike, image_size: tuple[int, int]) -> None:
    """terms_px: the terms of a correction without their signs, added up, px (drift_runtime.MOST_IMAGES)."""
    greatest, side = float(np.max(terms_px)), max(image_size)
    if not greatest <= MOST_IMAGES * side:
        raise ValueError(
            f"{name}: terms of {greatest:.3g} px, for an image of {side}; no fit has terms of {MOST_IMAGES} images"
        )


def check_order(name: str, low_high: Pair) -> None:
    """Check that the ends of a range are in order."""
    if not low_high[0] <= low_high[1]:
        raise ValueError(f"{name}: not low, high")
