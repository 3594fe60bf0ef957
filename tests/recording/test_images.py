"""Images of every depth to messages and back, and what happens to those that are damaged or made to do harm."""

import io
import math
import struct
import zlib

import numpy as np
import PIL.Image
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from hypothesis import strategies as st

from thermostand.foundation.errors import SessionError
from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import (
    IMAGE_CLASS,
    SIGNATURE,
    decode_image,
    decode_png,
    encode_image,
    encode_png,
)

TIME_NS = 1_767_290_400_123_456_789
DEPTHS = {"8 bit": ("u1", 255), "10 bit": ("<u2", 1023), "12 bit": ("<u2", 4095), "16 bit, big-endian": (">u2", 65535)}
ENCODINGS = ("png", "raw", "roi")
SMALL = np.random.default_rng(5).integers(0, 256, (9, 14), np.uint8)
WINDOWS = np.array([[0, 0, 3, 4], [2, 1, 12, 8]], np.int32)


def frame(image, windows=None):
    return Frame("camera.image", image, TIME_NS, 0.1, 0.0, 41.0, 7, 1, windows=windows)


def schema(encoding):
    return IMAGE_CLASS[encoding].DESCRIPTOR.full_name


def there_and_back(image, encoding):
    return decode_image(schema(encoding), encode_image(frame(image), encoding))


def chunks(png):
    place = len(SIGNATURE)
    while place < len(png):
        size = struct.unpack(">I", png[place : place + 4])[0]
        yield png[place + 4 : place + 8], png[place + 8 : place + 8 + size]
        place += 12 + size


def png_of(parts):
    return SIGNATURE + b"".join(
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body)) for kind, body in parts
    )


@st.composite
def images(draw):
    dtype, most = draw(st.sampled_from(sorted(DEPTHS.values())))
    shape = draw(st.tuples(st.integers(1, 40), st.integers(1, 40)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    least = draw(st.sampled_from([0, most // 2, most - 3]))
    return rng.integers(least, most, shape, np.dtype(dtype).newbyteorder("="), endpoint=True).astype(dtype)


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(image=images())
def test_images_are_lossless_at_every_depth_and_byte_order(encoding, image):
    channel, decoded, windows = there_and_back(image, encoding)
    assert channel == "camera.image"
    assert windows is None
    assert decoded.dtype == image.dtype.newbyteorder("=")
    np.testing.assert_array_equal(decoded, image)


@pytest.mark.parametrize("depth", DEPTHS)
@pytest.mark.parametrize("windows", [None, WINDOWS])
def test_another_png_reader_sees_the_same_samples(depth, windows):
    dtype, most = DEPTHS[depth]
    image = np.random.default_rng(2).integers(0, most, (9, 14), endpoint=True).astype(dtype)
    message = CompressedImage.FromString(encode_image(frame(image, windows), "png"))
    assert (message.format, message.timestamp.ToNanoseconds()) == ("png", TIME_NS)
    with PIL.Image.open(io.BytesIO(message.data)) as seen:
        assert seen.mode == ("L" if dtype == "u1" else "I;16")
        np.testing.assert_array_equal(np.asarray(seen), image)
        noted = seen.text  # read by Pillow once the pixels are loaded
    assert noted == ({} if windows is None else {"Windows": "0,0,3,4;2,1,12,8"})


def test_raw_samples_of_sixteen_bit_are_little_endian():
    message = RawImage.FromString(encode_image(frame(np.array([[0x1234, 1]], ">u2")), "raw"))
    assert (message.encoding, message.step, message.data) == ("mono16", 4, b"\x34\x12\x01\x00")


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_a_part_of_a_larger_image_is_recorded_as_it_looks(encoding):
    part = np.arange(100, dtype=np.uint8).reshape(10, 10)[2:8, 1:9:2]
    np.testing.assert_array_equal(there_and_back(part, encoding).pixels, part)


def gaussian_entropy_bit(sigma_DN):
    """Of a normal value rounded to whole DN: its mean between two of them."""
    edges = [0.5 * math.erfc(-(k - 0.25) / sigma_DN / math.sqrt(2)) for k in range(-200, 202)]
    return -sum(p * math.log2(p) for p in np.diff(edges) if p > 0)


@pytest.mark.parametrize(
    ("dtype", "sigma_DN", "least_part"),
    [
        (np.uint8, 1.0, 0.80),
        (np.uint8, 1.5, 0.84),
        (np.uint8, 2.0, 0.86),
        (np.uint16, 3.0, 0.58),
        (np.uint16, 24.0, 0.65),
    ],
)
def test_png_of_sensor_noise_comes_near_the_entropy(dtype, sigma_DN, least_part):
    bits = 8 * np.dtype(dtype).itemsize
    rows, columns = np.mgrid[:512, :612]
    light = (120 if bits == 8 else 2000) * (1 + 1e-4 * columns - 5e-5 * rows)
    image = np.round(np.random.default_rng(7).normal(light, sigma_DN)).astype(dtype)
    ratio = image.nbytes / len(encode_png(image))
    assert least_part < ratio / (bits / gaussian_entropy_bit(sigma_DN)) < 1


@pytest.mark.parametrize("encoding", ENCODINGS)
@pytest.mark.parametrize(
    "image", [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), np.zeros((0, 4), np.uint8)]
)
def test_an_image_of_another_kind_is_a_programming_mistake(image, encoding):
    with pytest.raises(ValueError, match="uint8 or uint16 of shape"):
        encode_image(frame(image), encoding)


def test_windows_come_back_with_the_image():
    decoded = decode_image("foxglove.CompressedImage", encode_image(frame(SMALL, WINDOWS), "png"))
    assert decoded.windows.dtype == np.int32
    np.testing.assert_array_equal(decoded.windows, WINDOWS)
    np.testing.assert_array_equal(decoded.pixels, SMALL)


@pytest.mark.parametrize("bad", [[[0, 0, 15, 9]], [[-1, 0, 3, 3]], [[3, 3, 0, 3]], [[2**31 - 1, 0, 2**31 - 1, 1]], []])
def test_windows_outside_the_image_are_a_programming_mistake(bad):
    with pytest.raises(ValueError, match="window"):
        encode_png(SMALL, np.array(bad, np.int32).reshape(-1, 4))


def test_a_raw_image_cannot_have_windows():
    with pytest.raises(ValueError, match="record it as png"):
        encode_image(frame(SMALL, WINDOWS), "raw")


def bad_messages():
    good = RawImage.FromString(encode_image(frame(np.zeros((4, 6), np.uint8)), "raw"))
    short = RawImage(width=6, height=4, step=6, encoding="mono8", data=good.data[:-1])
    colour = RawImage(width=6, height=4, step=18, encoding="rgb8", data=bytes(72))
    nothing = RawImage(width=0, height=0, step=0, encoding="mono8")
    for message in (short, colour, nothing, CompressedImage(format="png", data=b"no png"), CompressedImage()):
        yield type(message).DESCRIPTOR.full_name, message.SerializeToString()
    yield "foxglove.RawImage", b"\xff\xff\xff"
    yield "foxglove.Grid", good.SerializeToString()


@pytest.mark.parametrize(("schema", "data"), list(bad_messages()))
def test_a_damaged_message_is_a_session_error(schema, data):
    with pytest.raises(SessionError):
        decode_image(schema, data)


def test_no_flipped_bit_and_no_cut_is_delivered_as_an_image():
    png = encode_png(SMALL, WINDOWS)
    flips = [png[:i] + bytes([png[i] ^ 1 << bit]) + png[i + 1 :] for i in range(len(png)) for bit in range(8)]
    for damaged in flips + [png[:size] for size in range(len(png))]:
        with pytest.raises(SessionError):
            decode_png(damaged)


def header(width=14, height=9, *rest):
    return b"IHDR", struct.pack(">IIBBBBB", width, height, *(rest or (8, 0, 0, 0, 0)))


END = (b"IEND", b"")
PIXELS = (b"IDAT", b"".join(body for kind, body in chunks(encode_png(SMALL)) if kind == b"IDAT"))
ROWS = zlib.decompress(PIXELS[1])


def text(value):
    return b"tEXt", b"Windows\0" + value


@pytest.mark.parametrize(
    ("parts", "says"),
    {
        "a million pixels square": ([header(10**6, 10**6), PIXELS, END], "claims 1000000 x 1000000 px"),
        "120 megabytes of nothing": ([header(10_000, 6_000, 16, 0, 0, 0, 0), PIXELS, END], "too little data"),
        "no width": ([header(0, 9), PIXELS, END], "claims 0 x 9 px"),
        "colour": ([header(14, 9, 8, 2, 0, 0, 0), PIXELS, END], "plain grey"),
        "two bit": ([header(14, 9, 2, 0, 0, 0, 0), PIXELS, END], "plain grey"),
        "interlaced": ([header(14, 9, 8, 0, 0, 0, 1), PIXELS, END], "plain grey"),
        "short header": ([(b"IHDR", b"abc"), PIXELS, END], "another length"),
        "no header": ([PIXELS, END], "header"),
        "two headers": ([header(), header(), PIXELS, END], "header"),
        "no end": ([header(), PIXELS], "cut off"),
        "no pixels": ([header(), END], "too little data"),
        "nothing": ([END], "header"),
        "garbage for pixels": ([header(), (b"IDAT", b"x" * 99), END], "damaged or too few"),
        "half the pixels": ([header(), (b"IDAT", zlib.compress(ROWS[:60])), END], "damaged or too few"),
        "a filter that does not exist": ([header(), (b"IDAT", zlib.compress(b"\x09" + ROWS[1:])), END], "damaged"),
        "empty windows": ([header(), text(b""), PIXELS, END], "not understood"),
        "words for windows": ([header(), text(b"0,0,all,9"), PIXELS, END], "not understood"),
        "a window of three": ([header(), text(b"0,0,3"), PIXELS, END], "not understood"),
        "a trailing semicolon": ([header(), text(b"0,0,3,4;"), PIXELS, END], "not understood"),
        "digits that are none": ([header(), text("٣,0,3,4".encode()), PIXELS, END], "not understood"),
        "a negative window": ([header(), text(b"-1,0,3,4"), PIXELS, END], "not understood"),
        "a huge number": ([header(), text(b"9" * 5000 + b",0,3,4"), PIXELS, END], "not understood"),
        "a window outside": ([header(), text(b"0,0,15,9"), PIXELS, END], "outside the image of 14 x 9 px"),
        "a window without size": ([header(), text(b"1,1,0,4"), PIXELS, END], "has no size"),
        "too many windows": ([header(), text(b"0,0,3,4;" * 20_000 + b"0,0,3,4"), PIXELS, END], "1 to 10000"),
        "far too many windows": ([header(), text(b"0,0,3,4;" * 900_000 + b"0,0,3,4"), PIXELS, END], "not understood"),
        "windows twice": ([header(), text(b"0,0,3,4"), text(b"0,0,3,4"), PIXELS, END], "twice"),
    }.values(),
)
def test_a_png_made_to_mislead_is_refused_with_a_reason(parts, says):
    with pytest.raises(SessionError, match=says):
        decode_png(png_of(parts))


@pytest.mark.parametrize(
    "extra",
    [(b"gAMA", struct.pack(">I", 30_000)), (b"tRNS", b"\0\x07"), (b"acTL", struct.pack(">II", 9, 0)), (b"eXIf", b"MM")],
)
def test_chunks_that_could_change_the_pixels_are_passed_over(extra):
    pixels, windows = decode_png(png_of([header(), extra, text(b"2,1,12,8"), PIXELS, END]) + b"trailing bytes")
    np.testing.assert_array_equal(pixels, SMALL)
    np.testing.assert_array_equal(windows, [[2, 1, 12, 8]])


@given(st.binary(max_size=80), st.sampled_from([b"", SIGNATURE, png_of([header()])]))
def test_random_bytes_are_a_session_error(data, before):
    with pytest.raises(SessionError):
        decode_png(before + data)
