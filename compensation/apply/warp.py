"""Images as they would have been at the reference temperature.

For measurement correct the centres, not the image; a warped image is for software that wants pixels. The result is
float32: rounding it to 8 bits afterwards costs what it costs (about 0.3 DN), and is the user's choice.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compensation.apply.spline import Image, coefficients, read_rows

Float = NDArray[np.float64]
Shift = Callable[[Float], Float]
"""Points (N, 2) px of the measured image -> their displacement (N, 2), px, to the reference."""

LATTICE_PX = 16
_ROUNDS = 4  # the shift changes by some 1e-4 px per px: each round gains four digits


def warp(image: Image, shift: Shift) -> NDArray[np.float32]:
    """The grey image (height, width) with each of its points moved by `shift`, float32 (height, width).

    Cubic B-spline; what was outside the image is its mirror image. The shift is evaluated every 16 px and bilinear in
    between (0.1 mpx for a drift that bends by 0.5 px over the image). NaN in the shift is refused: ValueError.
    """
    height, width = image.shape
    grid_x, grid_y = (np.arange(0, size + LATTICE_PX, LATTICE_PX, dtype=np.float64) for size in (width, height))
    lattice = np.stack(np.meshgrid(grid_x, grid_y), axis=-1)
    offset = source_offset(shift, lattice.reshape(-1, 2)).reshape(lattice.shape).astype(np.float32)
    if not np.isfinite(offset).all():
        raise ValueError("the shift is not finite everywhere in the image")
    out = np.empty((height, width), np.float32)
    from_x, from_y = np.ascontiguousarray(offset[:, :, 0]), np.ascontiguousarray(offset[:, :, 1])
    read_rows(coefficients(image), from_x, from_y, LATTICE_PX, out)
    return out


def source_offset(shift: Shift, xy_px: Float) -> Float:
    """Where a point that is seen at (N, 2) px at the reference is in the measured image, less those points: the shift
    maps measured to reference, so it is inverted by fixed-point steps."""
    offset = np.zeros_like(xy_px)
    for _ in range(_ROUNDS):
        offset = -shift(xy_px + offset)
    return offset
