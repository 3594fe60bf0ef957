"""A raw image as foxglove.RawImage, with its pixels copied once: protobuf would copy 5 MB three times, and the fresh
memory for it costs more than the disk."""

from __future__ import annotations

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage

from foundation.readings import Frame
from recording.format.messages import timestamp

ENCODING = {"uint8": ("mono8", "u1"), "uint16": ("mono16", "<u2")}  # of the pixels: name in the message, in memory
_LENGTH_DELIMITED = 2  # wire type of protobuf's bytes
_DATA_TAG = bytes([RawImage.DATA_FIELD_NUMBER << 3 | _LENGTH_DELIMITED])


def encode_raw(frame: Frame) -> bytes:
    """The frame's image as a serialized message, its fields in order of their numbers as protobuf writes them.

    ValueError when the image is not uint8 or uint16 of shape (height, width), or has windows, which the message cannot
    tell of.
    """
    image = frame.image
    if image.ndim != 2 or image.size == 0 or image.dtype.name not in ENCODING:
        raise ValueError(f"an image is uint8 or uint16 of shape (height, width), not {image.dtype} {image.shape}")
    if frame.windows is not None:
        raise ValueError("a raw image cannot say which windows of it are real: record it as png")
    name, dtype = ENCODING[image.dtype.name]
    pixels = np.ascontiguousarray(image, dtype)
    height, width = image.shape
    before = RawImage(
        timestamp=timestamp(frame.time_ns), width=width, height=height, encoding=name, step=width * image.itemsize
    )
    behind = RawImage(frame_id=frame.channel)
    return b"".join(
        (before.SerializeToString(), _DATA_TAG, _varint(pixels.nbytes), pixels.data, behind.SerializeToString())
    )


def _varint(number: int) -> bytes:
    """Protobuf's encoding of a length: seven bits a byte, the lowest first, the top bit set on all but the last."""
    encoded = bytearray()
    while number > 0x7F:
        encoded.append(number & 0x7F | 0x80)
        number >>= 7
    encoded.append(number)
    return bytes(encoded)
