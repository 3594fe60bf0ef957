"""Images as they would have been at the reference temperature.

For measurement correct the centres, not the image; a warped image is for software that wants pixels. The result is
float32: rounding it to 8 bits afterwards costs what it costs (about 0.3 DN), and is the user's choice.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from compensation.apply.resample import BLOCK_px, Image, resample
from compensation.drift_runtime import source_offset

Float = NDArray[np.float64]
Shift = Callable[[Float], Float]
"""Points (N, 2) px of the measured image -> their displacement (N, 2), px, to the reference."""


def warp(image: Image, shift: Shift) -> NDArray[np.float32]:
    """The grey image (height, width) with each of its points moved by `shift`, float32 (height, width).

    What was outside the image is its mirror image. The shift is evaluated every 16 px and bilinear in between (0.1 mpx
    for a drift that bends by 0.5 px over the image). NaN in the shift, and one that changes by more than a pixel within
    16, is refused: ValueError.
    """
    height, width = image.shape
    grid_x, grid_y = (np.arange(0, size + BLOCK_px, BLOCK_px, dtype=np.float64) for size in (width, height))
    lattice = np.stack(np.meshgrid(grid_x, grid_y), axis=-1)
    offset = source_offset(shift, lattice.reshape(-1, 2)).reshape(lattice.shape).astype(np.float32)
    if not np.isfinite(offset).all():
        raise ValueError("the shift is not finite everywhere in the image")
    from_x, from_y = np.ascontiguousarray(offset[:, :, 0]), np.ascontiguousarray(offset[:, :, 1])
    return resample(image, from_x, from_y)
