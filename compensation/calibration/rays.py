"""The 'real camera': each pixel sees along a line of its own, and no centre of projection is assumed.

    (X, Y) = a(i, j) + Z b(i, j)

in the camera's frame; a and b are polynomials of total degree 3 to 5 in the pixel's coordinates scaled to [-1, 1], as
Chebyshev products. Linear least squares to the markers at their adjusted poses. Where no marker was seen it means
nothing: ask `inside`.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Delaunay

from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.pinhole import Pinhole
from thermostand.foundation.errors import CalibrationError

DEGREES = (3, 4, 5)  # of the polynomials tried; held-out positions choose among them
# A bound only: Newton's steps end when they are below _PROJECTED_PX.
_PROJECTIONS = 20
_PROJECTED_PX = 1e-9  # far below any marker's noise


@dataclass(frozen=True, slots=True, eq=False)
class RayLens:
    """coefficients (2, 2, K): X and Y; a (mm) and b at the middle distance; terms of `exponents(degree)`.

    covariance (2K, 2K): of the a and b coefficients, the same for X and Y, mm^2. range_mm: least and greatest Z of the
    markers; the lines are written about its middle, in units of half of it: (X, Y) = a + ((Z - middle)/half) b.
    hull_px (H, 2): convex hull of the markers' images. nearest: the pinhole, a start for projections.
    """

    degree: int
    coefficients: Float
    covariance: Float
    range_mm: tuple[float, float]
    hull_px: Float
    nearest: Pinhole

    def inside(self, pixels: Float) -> NDArray[np.bool_]:
        """(...): whether pixels (..., 2) are within the hull of the calibration's markers."""
        return Delaunay(self.hull_px).find_simplex(pixels) >= 0

    def lines(self, pixels: Float) -> tuple[Float, Float]:
        """A point (..., 2), X and Y in mm at Z = 0, and dX/dZ, dY/dZ (..., 2) of each pixel's line."""
        terms = self._compute_terms(pixels)
        middle, half = self._span
        at_middle, slope = (terms @ self.coefficients[:, part].T for part in (0, 1))
        return at_middle - middle / half * slope, slope / half

    def compute_slopes(self, pixels: Float) -> Float:
        """X/Z and Y/Z (..., 2) of the lines at the middle of the range."""
        start, slope = self.lines(pixels)
        return start / self._span[0] + slope

    def compute_misfit(self, points_mm: Float, pixels: Float) -> Float:
        """Distance (..., 2) of points from the pixels' lines, across Z, divided by a pixel's size there: px."""
        start, slope = self.lines(pixels)
        off = points_mm[..., :2] - start - points_mm[..., 2:] * slope
        return _solve(self._compute_pixel_size(pixels, points_mm[..., 2]), off[..., None])[..., 0]

    def compute_point_jacobian(self, points_mm: Float, pixels: Float) -> Float:
        """Derivative (..., 2, 3) of the misfit with respect to the points, px/mm."""
        _, slope = self.lines(pixels)
        identity = np.broadcast_to(np.eye(2), (*slope.shape[:-1], 2, 2))
        moves = np.concatenate([identity, -slope[..., None]], axis=-1)
        return _solve(self._compute_pixel_size(pixels, points_mm[..., 2]), moves)

    def project(self, points_mm: Float) -> Float:
        """The pixels (..., 2) whose lines pass through points (..., 3); Newton's method."""
        pixels = self.nearest.project(points_mm)
        for _ in range(_PROJECTIONS):
            change = self.compute_misfit(points_mm, pixels)
            pixels = pixels + change
            if np.abs(change).max() < _PROJECTED_PX:
                return pixels
        raise CalibrationError("the ray model has no line through a point: it is far outside the calibrated volume")

    @property
    def _span(self) -> tuple[float, float]:
        low, high = self.range_mm
        return (low + high) / 2, (high - low) / 2

    def _compute_terms(self, pixels: Float) -> Float:
        return compute_chebyshev_terms(_scale_pixels(pixels, self.nearest.image_size), self.degree)

    def _compute_pixel_size(self, pixels: Float, depth_mm: Float) -> Float:
        """Derivative (..., 2, 2) of a line's X, Y at Z = depth with respect to the pixel, mm/px."""
        middle, half = self._span
        width = np.array(self.nearest.image_size) / 2
        by_x, by_y = compute_chebyshev_slopes(_scale_pixels(pixels, self.nearest.image_size), self.degree)
        part = ((depth_mm - middle) / half)[..., None]
        columns = [
            (terms @ self.coefficients[:, 0].T + part * (terms @ self.coefficients[:, 1].T)) / size
            for terms, size in zip((by_x, by_y), width, strict=True)
        ]
        return np.stack(columns, axis=-1)


def fit_rays(
    degree: int, pixels: Float, points_mm: Float, sigma_px: Float, nearest: Pinhole, hull_px: Float
) -> RayLens:
    """Fit lines to points (M, 3) of the camera's frame seen at pixels (M, 2), sigma_px (M,) each.

    The weights take a pixel as Z/f mm. CalibrationError when the points do not determine the polynomials.
    """
    depth = points_mm[:, 2]
    span = (float(depth.min()), float(depth.max()))
    middle, half = (span[0] + span[1]) / 2, (span[1] - span[0]) / 2
    terms = compute_chebyshev_terms(_scale_pixels(pixels, nearest.image_size), degree)
    weight = float(nearest.focal_px.mean()) / depth / sigma_px
    design = np.hstack([terms, ((depth - middle) / half)[:, None] * terms]) * weight[:, None]
    if len(design) <= design.shape[1] or np.linalg.matrix_rank(design) < design.shape[1]:
        raise CalibrationError(f"{len(design)} marker centres do not determine a ray model of degree {degree}")
    covariance = _solve(design.T @ design, np.eye(design.shape[1]))
    found = covariance @ (design.T @ (points_mm[:, :2] * weight[:, None]))
    count = terms.shape[1]
    coefficients = np.stack([found[:count].T, found[count:].T], axis=1)
    return RayLens(degree, coefficients, covariance, span, hull_px, nearest)


def _solve(matrices: Float, values: Float) -> Float:
    return np.asarray(np.linalg.solve(matrices, values), np.float64)


def list_exponents(degree: int) -> list[tuple[int, int]]:
    """(p, q) of the products T_p(x) T_q(y) with p + q <= degree."""
    return [(p, total - p) for total in range(degree + 1) for p in range(total, -1, -1)]


def compute_chebyshev_terms(scaled: Float, degree: int) -> Float:
    """T_p(x) T_q(y) (..., K) of scaled pixels (..., 2)."""
    values = _compute_chebyshev(scaled, degree)
    return np.stack([values[p][..., 0] * values[q][..., 1] for p, q in list_exponents(degree)], axis=-1)


def compute_chebyshev_slopes(scaled: Float, degree: int) -> tuple[Float, Float]:
    """Derivatives of the terms (..., K) with respect to x and to y."""
    values, slopes = _compute_chebyshev(scaled, degree), _compute_chebyshev_derivatives(scaled, degree)
    pairs = list_exponents(degree)
    by_x = np.stack([slopes[p][..., 0] * values[q][..., 1] for p, q in pairs], axis=-1)
    by_y = np.stack([values[p][..., 0] * slopes[q][..., 1] for p, q in pairs], axis=-1)
    return by_x, by_y


def _scale_pixels(pixels: Float, image_size: tuple[int, int]) -> Float:
    size = np.array(image_size)
    return (pixels - (size - 1) / 2) / (size / 2)


def _compute_chebyshev(x: Float, degree: int) -> list[Float]:
    """T_0 .. T_degree: T_n = 2 x T_n-1 - T_n-2."""
    values = [np.ones_like(x), x]
    while len(values) <= degree:
        values.append(2 * x * values[-1] - values[-2])
    return values


def _compute_chebyshev_derivatives(x: Float, degree: int) -> list[Float]:
    """T_0' .. T_degree': T_n' = 2 T_n-1 + 2 x T_n-1' - T_n-2'."""
    values = _compute_chebyshev(x, degree)
    slopes = [np.zeros_like(x), np.ones_like(x)]
    while len(slopes) <= degree:
        slopes.append(2 * values[len(slopes) - 1] + 2 * x * slopes[-1] - slopes[-2])
    return slopes
