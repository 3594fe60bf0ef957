"""The paper's P^n(I, J, T) (section 6.1) in numbers that a computer can solve.

A polynomial of total degree n in three variables, each scaled to [-1, 1], on products of Chebyshev polynomials
T_a(I) T_b(J) T_c(T) with a + b + c <= n. The space is that of the monomials I^a J^b T^c, so the fit is the same; the
condition number at n = 4 is about 60 where monomials in pixels and degC have 4e15.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

Float = NDArray[np.float64]

_WORST_CONDITION = 1e8
"""Beyond it the data do not determine the coefficients: too few temperatures, or markers in one line."""


@dataclass(frozen=True, slots=True)
class Scaling:
    """What becomes [-1, 1]: the image (width, height) in px and the calibrated range of the camera's temperature."""

    image_size: tuple[int, int]
    camera_degC: tuple[float, float]

    def scale(self, xy_px: Float, camera_degC: Float) -> tuple[Float, Float, Float]:
        """I, J and T, each (M,), from centres (M, 2) and temperatures (M,)."""
        width, height = self.image_size
        low, high = self.camera_degC
        return (
            2 * (xy_px[:, 0] + 0.5) / width - 1,
            2 * (xy_px[:, 1] + 0.5) / height - 1,
            (2 * camera_degC - low - high) / (high - low),
        )


def exponents(degree: int) -> list[tuple[int, int, int]]:
    """The (a, b, c) of the terms, in the order of the coefficients; (n+1)(n+2)(n+3)/6 of them."""
    numbers = range(degree + 1)
    return [(a, b, c) for a in numbers for b in numbers for c in numbers if a + b + c <= degree]


def design(xy_px: Float, camera_degC: Float, degree: int, scaling: Scaling) -> Float:
    """The terms (M, K) at centres (M, 2) and temperatures (M,)."""
    i, j, t = (chebyshev.chebvander(values, degree) for values in scaling.scale(xy_px, camera_degC))
    a, b, c = np.array(exponents(degree)).T
    return i[:, a] * j[:, b] * t[:, c]


@dataclass(frozen=True, slots=True, eq=False)
class Solution:
    """A weighted least-squares fit of one coordinate.

    coefficients (K,). covariance (K, K): (A' W A)^-1, times chi^2 per degree of freedom where that exceeds 1.
    condition: 2-norm condition number of the weighted terms.
    """

    coefficients: Float
    covariance: Float
    condition: float


def condense(terms: Float, values: Float, variance: Float) -> Float:
    """Rows [terms | values] (M, K + 1) with variances (M,) as a triangle of at most K + 1 rows that gives the same fit:
    the R of their weighted QR. So each group of rows is worked through once, however often it is then left out."""
    weight = 1 / np.sqrt(variance)
    return _triangle(np.column_stack([terms, values]) * weight[:, None])


def solve(triangles: Sequence[Float], count: int) -> Solution:
    """The fit of all the rows, `count` of them, that were condensed into the triangles; raises LinAlgError when they
    do not determine it."""
    r = _triangle(np.concatenate(triangles))
    terms = r.shape[1] - 1
    if min(count, len(r)) < terms:
        raise np.linalg.LinAlgError(f"{count} values for {terms} terms")
    singular = np.linalg.svd(r[:terms, :terms], compute_uv=False)
    if not singular[-1] * _WORST_CONDITION > singular[0]:
        raise np.linalg.LinAlgError(f"singular values from {singular[0]:.2g} to {singular[-1]:.2g}")
    inverse = cast(Float, np.linalg.inv(r[:terms, :terms]))
    chi2 = float((r[terms:, terms] ** 2).sum()) / max(count - terms, 1)
    return Solution(
        coefficients=inverse @ r[:terms, terms],
        covariance=inverse @ inverse.T * max(chi2, 1.0),
        condition=float(singular[0] / singular[-1]),
    )


def _triangle(rows: Float) -> Float:
    return cast(Float, np.linalg.qr(rows, mode="r"))  # for this mode numpy's stubs promise a pair
