"""Pixels as a camera sends them: 8 bits of the scene in any of its formats (GigE Vision 1.2, section 27; PFNC 2.1)."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.sim.gige.gvsp import PixelFormat

_BITS = {PixelFormat.MONO10: 10, PixelFormat.MONO12: 12, PixelFormat.MONO16: 16}
_IN_THREE_BYTES = {PixelFormat.MONO10PACKED: 10, PixelFormat.MONO12PACKED: 12}
_GAPLESS = {PixelFormat.MONO10P: 10, PixelFormat.MONO12P: 12}


def encoded(image: NDArray[np.uint8], pixel_format: PixelFormat) -> bytes:
    """The bytes of an image, its 8 bits as the upper ones of each pixel."""
    if pixel_format in _BITS:
        return (image.astype("<u2") << _BITS[pixel_format] - 8).astype("<u2").tobytes()
    if pixel_format in _IN_THREE_BYTES:
        bits = _IN_THREE_BYTES[pixel_format]
        return _in_three_bytes((image.reshape(-1).astype(np.uint16) << bits - 8).astype(np.uint16), bits)
    if pixel_format in _GAPLESS:
        bits = _GAPLESS[pixel_format]
        values = image.reshape(-1, 1).astype(np.uint16) << bits - 8
        return np.packbits(values >> np.arange(bits, dtype=np.uint16) & 1, bitorder="little").tobytes()
    return image.tobytes()


def _in_three_bytes(values: NDArray[np.uint16], bits: int) -> bytes:
    """Two pixels in three bytes: upper 8 bits, both lower parts (the first's in the lower half), upper 8 bits."""
    low = bits - 8
    pairs = np.append(values, np.zeros(len(values) % 2, np.uint16)).reshape(-1, 2)
    shared = (pairs[:, 0] & (1 << low) - 1) | (pairs[:, 1] & (1 << low) - 1) << 4
    packed = np.stack([pairs[:, 0] >> low, shared, pairs[:, 1] >> low], axis=1).astype(np.uint8).tobytes()
    return packed[: -(-len(values) * 12 // 8)]


def binned(image: NDArray[np.uint8], across: int, down: int) -> NDArray[np.uint8]:
    """The mean of so many pixels across and down in the place of each; what does not fill one at the edges is left
    out."""
    if across == down == 1:
        return image
    height, width = image.shape[0] // down, image.shape[1] // across
    parts = image[: height * down, : width * across].reshape(height, down, width, across)
    return parts.mean(axis=(1, 3)).round().astype(np.uint8)
