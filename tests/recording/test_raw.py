import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import decode_image, encode_raw

TIME_NS = 1_767_290_400_123_456_789


def frame(image, windows=None):
    return Frame("camera.image", image, TIME_NS, 0.1, 0.0, 40.0, 1, 1, windows=windows)


def noise(shape, dtype):
    return np.random.default_rng(1).integers(0, np.iinfo(dtype).max, shape, dtype)


@pytest.mark.parametrize("shape", [(1, 1), (1, 127), (1, 128), (300, 200), (2048, 2448)])
@pytest.mark.parametrize(("dtype", "name"), [(np.uint8, "mono8"), (np.uint16, "mono16")])
def test_the_bytes_are_those_protobuf_writes(shape, dtype, name):
    image = noise(shape, dtype)
    message = RawImage(frame_id="camera.image", height=shape[0], width=shape[1], encoding=name)
    message.timestamp.FromNanoseconds(TIME_NS)
    message.step = shape[1] * image.itemsize
    message.data = image.tobytes()
    encoded = encode_raw(frame(image))
    assert encoded == message.SerializeToString(deterministic=True)
    np.testing.assert_array_equal(decode_image("foxglove.RawImage", encoded).pixels, image)


@pytest.mark.parametrize("view", [np.s_[::2], np.s_[:, ::3], np.s_[::-1, ::-1], np.s_[5:9, 7:20]])
def test_a_view_of_a_larger_image_and_pixels_in_network_order_are_recorded_as_they_look(view):
    image = noise((60, 80), np.uint16)
    for looked_at in (image[view], image.T[view], image.astype(">u2")[view]):
        np.testing.assert_array_equal(decode_image("foxglove.RawImage", encode_raw(frame(looked_at))).pixels, looked_at)


@pytest.mark.parametrize(
    ("image", "windows", "reason"),
    [
        (np.zeros((4, 4, 3), np.uint8), None, "of shape"),
        (np.zeros((0, 4), np.uint8), None, "of shape"),
        (np.zeros((4, 4), np.float32), None, "uint8 or uint16"),
        (np.zeros((4, 4), np.uint8), np.array([[0, 0, 2, 2]], np.int32), "windows"),
    ],
)
def test_what_the_message_cannot_hold_is_a_value_error(image, windows, reason):
    with pytest.raises(ValueError, match=reason):
        encode_raw(frame(image, windows))
