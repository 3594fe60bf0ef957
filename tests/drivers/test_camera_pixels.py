"""Packed pixels: known bytes of each layout, and sizes of odd counts."""

import numpy as np
import pytest

from thermostand.drivers.wires.aravis import unpack_pixels
from thermostand.drivers.wires.camera_settings import PixelFormat, frame_bytes

# 0x123 and 0xABC of 12 bits, 0x123 and 0x2BC of 10, as the standards draw them.
LAYOUTS: list[tuple[PixelFormat, str, list[int]]] = [
    ("Mono8", "01 ff", [0x01, 0xFF]),
    ("Mono10", "23 01 bc 02", [0x123, 0x2BC]),
    ("Mono12", "23 01 bc 0a", [0x123, 0xABC]),
    ("Mono16", "34 12 ff ff", [0x1234, 0xFFFF]),
    ("Mono12Packed", "12 c3 ab", [0x123, 0xABC]),
    ("Mono12p", "23 c1 ab", [0x123, 0xABC]),
    ("Mono10Packed", "48 03 af", [0x123, 0x2BC]),
    ("Mono10p", "23 f1 3a 40 c0", [0x123, 0x2BC, 0x003, 0x301]),
]


@pytest.mark.parametrize(("pixel_format", "data", "pixels"), LAYOUTS, ids=[layout[0] for layout in LAYOUTS])
def test_each_layout_gives_the_cameras_own_values(pixel_format: PixelFormat, data: str, pixels: list[int]):
    raw = np.frombuffer(bytes.fromhex(data), np.uint8)
    image = unpack_pixels(pixel_format, raw, (1, len(pixels)))
    assert image.tolist() == [pixels]
    assert image.dtype == (np.uint8 if pixel_format == "Mono8" else np.uint16)
    assert frame_bytes(pixel_format, len(pixels)) == len(raw)


@pytest.mark.parametrize(
    ("pixel_format", "count", "size"),
    [
        ("Mono8", 3, 3),
        ("Mono16", 3, 6),
        ("Mono12p", 3, 5),
        ("Mono12Packed", 3, 5),
        ("Mono10p", 3, 4),
        ("Mono10p", 5, 7),
    ],
)
def test_an_odd_count_of_pixels_ends_within_a_group(pixel_format: PixelFormat, count: int, size: int):
    assert frame_bytes(pixel_format, count) == size
    image = unpack_pixels(pixel_format, np.full(size, 0xFF, np.uint8), (1, count))
    assert image.shape == (1, count)
