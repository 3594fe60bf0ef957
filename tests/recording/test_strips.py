"""PNGs whose rows are compressed in strips are ordinary PNGs, and what their index says is checked."""

import io
import struct
import zlib

import cv2
import numpy as np
import PIL.Image
from hypothesis import given
from hypothesis import strategies as st

from thermostand.recording.format.images import SIGNATURE, decode_png, encode_png, strip_places
from thermostand.recording.format.strips import KIND, Strips, index_of, strip_rows, strips_in

DTYPES = {np.uint8: 255, np.uint16: 65535}


@st.composite
def images(draw: st.DrawFn) -> np.ndarray:
    """From less than one strip to several, of noise or nearly even."""
    dtype = draw(st.sampled_from(list(DTYPES)))
    shape = draw(st.integers(1, 110)), draw(st.integers(1, 30))
    spread = draw(st.sampled_from([1, 12, DTYPES[dtype]]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    return (DTYPES[dtype] - rng.integers(0, spread, shape, endpoint=True)).astype(dtype)


@given(images())
def test_other_readers_see_the_same_pixels(image: np.ndarray):
    png = encode_png(image)
    with PIL.Image.open(io.BytesIO(png)) as seen:
        np.testing.assert_array_equal(np.asarray(seen), image)
    np.testing.assert_array_equal(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_UNCHANGED), image)


def test_a_strip_is_what_zlib_makes_one_block_of():
    assert [strip_rows(1 + width) for width in (2448, 640, 16_000, 2 * 2448)] == [13, 33, 9, 9]


@given(images())
def test_the_strips_are_where_the_index_says(image: np.ndarray):
    png = encode_png(image)
    places = strip_places(png)
    assert places is not None
    assert len(places.begins) == -(-len(image) // places.rows)
    for begin, end in zip(places.begins, places.ends, strict=True):
        assert png[begin - 4 : begin] == b"IDAT"
        assert png[end - 4 : end] == b"\0\0\xff\xff"  # an empty stored block


def test_images_with_windows_and_those_recorded_before_have_no_strips():
    image = np.zeros((40, 30), np.uint8)
    windows = np.array([[0, 0, 3, 4]], np.int32)
    before = cv2.imencode(".png", image)[1].tobytes()
    assert strip_places(encode_png(image, windows)) is strip_places(before) is None
    np.testing.assert_array_equal(decode_png(before)[0], image)


def test_an_index_that_cannot_be_is_none():
    right = index_of(Strips(9, [100, 90, 80]))
    assert strips_in(right, 20) == Strips(9, [100, 90, 80])
    wrong = [b"", right[:-1], right + b"\0", b"\0" * 20, struct.pack(">I", 0) + right[4:], index_of(Strips(9, []))]
    assert [strips_in(index, 20) for index in wrong] == [None] * len(wrong)
    assert strips_in(right, 28) is strips_in(right, 18) is None


@given(st.binary(max_size=40), st.booleans())
def test_an_index_of_anything_is_no_harm(index: bytes, is_near: bool):
    """Nor is one that is nearly right."""
    png = encode_png(np.zeros((40, 30), np.uint8))
    place = png.index(KIND)
    right = png[place + 4 : place + 4 + struct.unpack(">I", png[place - 4 : place])[0]]
    if is_near:
        index = right[: len(right) - len(index)] + index
    places = strip_places(with_index(png, index))
    assert places is None or places.ends[-1] < len(png) + len(index)


def with_index(png: bytes, index: bytes) -> bytes:
    """The PNG with other contents of its index, checksum right."""
    head, place = png[:33], len(SIGNATURE) + 25
    size = struct.unpack(">I", png[place : place + 4])[0]
    body = KIND + index
    return head + struct.pack(">I", len(index)) + body + struct.pack(">I", zlib.crc32(body)) + png[place + 12 + size :]
