"""Pixels as they come over the wire: formats by their GenICam names, and packed ones unpacked.

Bit layouts: GigE Vision 1.2, section 27 (Mono10Packed, Mono12Packed), PFNC 2.1, section 6 (Mono10p, Mono12p).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

PixelFormat = Literal[
    "Mono8", "Mono10", "Mono12", "Mono16", "Mono10Packed", "Mono12Packed", "Mono10p", "Mono12p"
]  # packed: two pixels in three bytes; p: as many as fit, without gaps
BITS_PER_PIXEL: dict[PixelFormat, int] = {
    "Mono8": 8,
    "Mono10": 16,
    "Mono12": 16,
    "Mono16": 16,
    "Mono10Packed": 12,
    "Mono12Packed": 12,
    "Mono10p": 10,
    "Mono12p": 12,
}

Pixels = NDArray[np.uint8] | NDArray[np.uint16]


def frame_bytes(pixel_format: PixelFormat, count: int) -> int:
    """Bytes of `count` pixels, the last one begun counted as whole."""
    return -(-count * BITS_PER_PIXEL[pixel_format] // 8)


def unpacked(pixel_format: PixelFormat, data: NDArray[np.uint8], shape: tuple[int, int]) -> Pixels:
    """The image of `shape` (height, width) in `data` (frame_bytes of them): uint8, or uint16 with the camera's own
    values (0..1023 of 10 bits, 0..4095 of 12)."""
    count = shape[0] * shape[1]
    if pixel_format == "Mono8":
        return data.reshape(shape)
    if BITS_PER_PIXEL[pixel_format] == 16:
        return data.view("<u2").reshape(shape)
    if pixel_format == "Mono10p":
        return _of_10_bits(data, count).reshape(shape)
    return _of_three_bytes(pixel_format, data, count).reshape(shape)


def _of_three_bytes(pixel_format: PixelFormat, data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Two pixels in three bytes, the middle one shared."""
    first, middle, last = _groups(data, 3)
    pairs = np.empty((len(first), 2), np.uint16)
    if pixel_format == "Mono12p":  # the first pixel's low bits come first
        pairs[:, 0] = first | (middle & 0xF) << 8
        pairs[:, 1] = middle >> 4 | last << 4
    elif pixel_format == "Mono12Packed":  # high bits in the outer bytes
        pairs[:, 0] = first << 4 | middle & 0xF
        pairs[:, 1] = last << 4 | middle >> 4
    else:  # Mono10Packed
        pairs[:, 0] = first << 2 | middle & 0x3
        pairs[:, 1] = last << 2 | middle >> 4 & 0x3
    return pairs.reshape(-1)[:count]


def _of_10_bits(data: NDArray[np.uint8], count: int) -> NDArray[np.uint16]:
    """Four pixels in five bytes, low bits first."""
    groups = _groups(data, 5)
    pixels = np.empty((len(groups[0]), 4), np.uint16)
    for i in range(4):
        pixels[:, i] = (groups[i] >> 2 * i | groups[i + 1] << 8 - 2 * i) & 0x3FF
    return pixels.reshape(-1)[:count]


def _groups(data: NDArray[np.uint8], size: int) -> NDArray[np.uint16]:
    """Shape (size, groups): the bytes of each group of `size`, the last one filled up with zeros."""
    whole = np.zeros(-(-len(data) // size) * size, np.uint16)
    whole[: len(data)] = data
    return whole.reshape(-1, size).T
