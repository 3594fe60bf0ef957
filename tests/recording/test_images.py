"""Frames of every depth to messages and back, and what happens to those that are damaged or made to do harm."""

import io
from dataclasses import replace

import numpy as np
import PIL.Image
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given
from hypothesis import strategies as st

from tests.recording.frame_records import encode_description, make_frame_records
from thermostand.foundation.errors import SessionError
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format.images import (
    FrameContext,
    decode_image,
    decode_windows,
    encode_image,
    encode_meta,
    encode_png,
    name_frame_topics,
)
from thermostand.recording.format.messages import (
    FRAME_META_CLASS,
    decode_frame_meta,
    decode_frame_table,
    encode_frame_table,
)

TIME_NS = 1_767_290_400_123_456_789
DEPTHS = {"8 bit": ("u1", 255), "10 bit": ("<u2", 1023), "12 bit": ("<u2", 4095), "16 bit, big-endian": (">u2", 65535)}
SMALL = np.random.default_rng(5).integers(0, 256, (9, 14), np.uint8)
WINDOWS = np.array([[0, 0, 3, 4], [2, 1, 12, 8]], np.int32)


def frame(image, windows=None):
    return Frame("camera.image", image, TIME_NS, 0.1, 0.0, 41.0, 7, 1, windows=windows)


@st.composite
def images(draw):
    dtype, most = draw(st.sampled_from(sorted(DEPTHS.values())))
    shape = draw(st.tuples(st.integers(1, 40), st.integers(1, 40)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    least = draw(st.sampled_from([0, most // 2, most - 3]))
    return rng.integers(least, most, shape, np.dtype(dtype).newbyteorder("="), endpoint=True).astype(dtype)


@given(image=images())
def test_images_are_lossless_at_every_depth_and_byte_order(image):
    decoded = decode_image(encode_image(frame(image)))
    assert decoded.dtype == image.dtype.newbyteorder("=")
    np.testing.assert_array_equal(decoded, image)


@pytest.mark.parametrize("shape", [(1, 1), (1, 127), (1, 128), (300, 200), (2048, 2448)])
@pytest.mark.parametrize(("dtype", "name"), [(np.uint8, "mono8"), (np.uint16, "mono16")])
def test_the_bytes_are_those_protobuf_writes(shape, dtype, name):
    image = np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape, dtype)
    message = RawImage(frame_id="camera.image", height=shape[0], width=shape[1], encoding=name)
    message.timestamp.FromNanoseconds(TIME_NS)
    message.step = shape[1] * image.itemsize
    message.data = image.tobytes()
    encoded = encode_image(frame(image))
    assert encoded == message.SerializeToString(deterministic=True)
    np.testing.assert_array_equal(decode_image(encoded), image)


@pytest.mark.parametrize("view", [np.s_[::2], np.s_[:, ::3], np.s_[::-1, ::-1], np.s_[5:9, 7:20]])
def test_a_view_of_a_larger_image_and_pixels_in_network_order_are_recorded_as_they_look(view):
    image = np.random.default_rng(1).integers(0, 65535, (60, 80), np.uint16)
    for looked_at in (image[view], image.T[view], image.astype(">u2")[view]):
        np.testing.assert_array_equal(decode_image(encode_image(frame(looked_at))), looked_at)


def test_raw_samples_of_sixteen_bit_are_little_endian():
    message = RawImage.FromString(encode_image(frame(np.array([[0x1234, 1]], ">u2"))))
    assert (message.encoding, message.step, message.data) == ("mono16", 4, b"\x34\x12\x01\x00")


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4, 3), np.uint8), np.zeros((4, 4), np.float32), np.zeros((0, 4), np.uint8)]
)
@pytest.mark.parametrize("encode", [encode_image, encode_description])
def test_an_image_of_another_kind_is_a_programming_mistake(image, encode):
    with pytest.raises(ValueError, match="uint8 or uint16 of shape"):
        encode(frame(image))


def test_a_frame_is_described_with_what_was_known_when_it_was_published():
    air, door = Reading("thermometers.air", 20.5, "degC", 7), Reading("linear.position", 4.0, "mm", 8)
    known = FrameContext(TIME_NS + 9, "fit", 31.0, (air, door))
    data = encode_meta(replace(frame(SMALL), step_id="capture-1", flags=("unsettled",), significant_bits=8), known)
    meta = decode_frame_meta(data)
    assert (meta.channel, meta.time_ns, meta.published_ns, meta.block_id) == ("camera.image", TIME_NS, TIME_NS + 9, 7)
    assert (meta.step_id, meta.role, meta.chamber_degC, meta.flags) == ("capture-1", "fit", 31.0, ("unsettled",))
    assert (meta.width, meta.height, meta.significant_bits) == (14, 9, 8)
    readings = FRAME_META_CLASS.FromString(data).readings
    assert [(each.channel, each.value, each.unit, each.time_ns) for each in readings] == [
        ("thermometers.air", 20.5, "degC", 7),
        ("linear.position", 4.0, "mm", 8),
    ]


@pytest.mark.parametrize(("dtype", "bits"), [(np.uint8, 8), (np.uint16, 16)])
def test_without_a_word_of_the_camera_all_bits_are_significant(dtype, bits):
    assert decode_frame_meta(encode_description(frame(SMALL.astype(dtype)))).significant_bits == bits


def test_each_camera_has_topics_of_its_own():
    assert name_frame_topics("camera.image") == ("/camera/meta", "/camera/image")
    assert name_frame_topics("side.image") == ("/side/meta", "/side/image")
    assert [record.topic for record in make_frame_records(replace(frame(SMALL), channel="side.image"))] == [
        "/side/meta",
        "/side/image",
    ]


def test_windows_come_back_with_the_description():
    windows = decode_windows(decode_frame_meta(encode_description(frame(SMALL, WINDOWS))))
    assert windows is not None
    assert windows.dtype == np.int32
    np.testing.assert_array_equal(windows, WINDOWS)
    assert decode_windows(decode_frame_meta(encode_description(frame(SMALL)))) is None


BAD_WINDOWS = [[[0, 0, 15, 9]], [[-1, 0, 3, 3]], [[3, 3, 0, 3]], [[2**31 - 1, 0, 2**31 - 1, 1]]]


@pytest.mark.parametrize("bad", [*BAD_WINDOWS, []])
def test_windows_outside_the_image_are_a_programming_mistake(bad):
    with pytest.raises(ValueError, match="window"):
        encode_description(frame(SMALL, np.array(bad, np.int32).reshape(-1, 4)))


@pytest.mark.parametrize("bad", [*(np.array(bad, "<i4").tobytes() for bad in BAD_WINDOWS), b"123"])
def test_recorded_windows_that_cannot_be_right_are_a_session_error(bad):
    meta = replace(decode_frame_meta(encode_description(frame(SMALL, WINDOWS))), windows=bad)
    with pytest.raises(SessionError, match="windows of a recorded"):
        decode_windows(meta)


def test_the_table_of_frames_has_every_description():
    descriptions = [
        encode_description(replace(frame(SMALL), block_id=number, step_id=number * "x")) for number in range(300)
    ]
    assert repr(decode_frame_table(encode_frame_table(descriptions))) == repr(
        list(map(decode_frame_meta, descriptions))
    )
    for damaged in (encode_frame_table(descriptions)[:-1], b"\xff"):
        with pytest.raises(SessionError, match="table of frames"):
            decode_frame_table(damaged)


def bad_messages():
    good = RawImage.FromString(encode_image(frame(np.zeros((4, 6), np.uint8))))
    whole = good.SerializeToString()
    for size in range(61):  # behind that stands the channel's name alone
        yield whole[:size]
    short = RawImage(width=6, height=4, step=6, encoding="mono8", data=good.data[:-1])
    colour = RawImage(width=6, height=4, step=18, encoding="rgb8", data=bytes(72))
    nothing = RawImage(width=0, height=0, step=0, encoding="mono8")
    huge = RawImage(width=4_000_000, height=4_000_000, step=4_000_000, encoding="mono8")
    for message in (short, colour, nothing, huge, CompressedImage(format="png", data=b"no png"), CompressedImage()):
        yield message.SerializeToString()
    yield from (b"\xff\xff\xff", b"\xff" * 12, b"\x32\xff\xff\xff\xff\xff\xff\xff\xff\x7f", b"\x0b")


@pytest.mark.parametrize("data", list(bad_messages()))
def test_a_damaged_message_is_a_session_error(data):
    with pytest.raises(SessionError):
        decode_image(data)


@given(st.binary(max_size=80))
def test_random_bytes_are_a_session_error(data):
    with pytest.raises(SessionError):
        decode_image(data)


@pytest.mark.parametrize("depth", DEPTHS)
def test_another_png_reader_sees_the_same_samples(depth):
    dtype, most = DEPTHS[depth]
    image = np.random.default_rng(2).integers(0, most, (9, 14), endpoint=True).astype(np.dtype(dtype).newbyteorder("="))
    with PIL.Image.open(io.BytesIO(encode_png(image))) as seen:
        assert seen.mode == ("L" if dtype == "u1" else "I;16")
        np.testing.assert_array_equal(np.asarray(seen), image)
