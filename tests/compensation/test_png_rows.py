"""PNG frames decoded for the fit are the frames, whatever filter their rows have, and damaged ones are refused."""

import struct
import zlib

import cv2
import numpy as np
import pytest

from compensation.finding.png_rows import decode_rows
from foundation.errors import SessionError
from recording.format.images import decode_png, encode_png

FILTERS = {
    "none": cv2.IMWRITE_PNG_FILTER_NONE,
    "left": cv2.IMWRITE_PNG_FILTER_SUB,
    "above": cv2.IMWRITE_PNG_FILTER_UP,
    "average": cv2.IMWRITE_PNG_FILTER_AVG,
    "paeth": cv2.IMWRITE_PNG_FILTER_PAETH,
    "all": cv2.IMWRITE_PNG_ALL_FILTERS,
}
GREATEST = {"uint8": 255, "uint16": 65535}


def image(dtype: str, shape: tuple[int, int] = (61, 83)) -> np.ndarray:
    """Smooth, with noise, and with everything from black to white."""
    rng = np.random.default_rng(2)
    ramp = np.linspace(0, 1, shape[0] * shape[1]).reshape(shape) ** 2 + rng.normal(0, 0.05, shape)
    return np.round(np.clip(ramp, 0, 1) * GREATEST[dtype]).astype(dtype)


@pytest.mark.parametrize("dtype", GREATEST)
@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_is_undone(name: str, dtype: str):
    done, data = cv2.imencode(".png", image(dtype), [cv2.IMWRITE_PNG_FILTER, FILTERS[name]])
    assert done
    decoded = decode_rows(data.tobytes())
    assert decoded.dtype.name == dtype
    assert np.array_equal(decoded, image(dtype))


@pytest.mark.parametrize("dtype", GREATEST)
def test_what_the_recorder_writes_is_read_as_its_reader_reads_it(dtype: str):
    for windows in (None, np.array([[5, 6, 20, 30]], np.int32)):
        png = encode_png(image(dtype), windows)
        assert np.array_equal(decode_rows(png), decode_png(png)[0])
    assert np.array_equal(decode_rows(encode_png(image(dtype, (1, 1)))), image(dtype, (1, 1)))


def rewritten(filtered: bytes) -> bytes:
    """The PNG of the image with other filtered rows, checksums right."""
    png = encode_png(image("uint8"))
    compressed = zlib.compress(filtered)
    chunk = b"IDAT" + compressed
    tail = struct.pack(">I", zlib.crc32(chunk)) + b"\0\0\0\0IEND\xaeB\x60\x82"
    return png[:33] + struct.pack(">I", len(compressed)) + chunk + tail


def test_damaged_pixels_are_refused():
    rows = b"".join(b"\0" + bytes(row) for row in image("uint8"))
    assert np.array_equal(decode_rows(rewritten(rows)), image("uint8"))
    for wrong in (rows[:-1], rows + b"\0", b""):
        with pytest.raises(SessionError, match="a recorded image cannot be decoded"):
            decode_rows(rewritten(wrong))
    with pytest.raises(SessionError, match="a row has an unknown filter"):
        decode_rows(rewritten(b"\5" + rows[1:]))
    png = encode_png(image("uint8"))
    with pytest.raises(SessionError, match="a checksum is wrong"):
        decode_rows(png[:60] + bytes([png[60] ^ 1]) + png[61:])
    with pytest.raises(SessionError, match="not a PNG"):
        decode_rows(b"GIF89a")
