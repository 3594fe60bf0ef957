"""The image message of /camera/image: lossless PNG or raw, in Foxglove's schemas, and back to an array."""

from __future__ import annotations

from typing import Literal, NamedTuple, cast

import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from foundation.errors import SessionError
from foundation.image_limit import size_fault
from foundation.readings import Frame
from recording.format.messages import timestamp
from recording.format.png import ImageArray, decode_png, encode_png

CAMERA_IMAGE = "/camera/image"

ImageEncoding = Literal["png", "raw", "roi"]
"""roi: a PNG, too; which windows of an image are kept is decided by recording/format/roi.py."""


class DecodedImage(NamedTuple):
    """A recorded image: pixels of shape (height, width); windows as in foundation.readings.Frame."""

    channel: str
    pixels: ImageArray
    windows: NDArray[np.int32] | None = None


IMAGE_CLASS: dict[ImageEncoding, type[Message]] = {"png": CompressedImage, "raw": RawImage, "roi": CompressedImage}
GREY_TYPES = ("uint8", "uint16")
RAW_DTYPE = {"mono8": np.dtype(np.uint8), "mono16": np.dtype("<u2")}
_LENGTH_DELIMITED = 2  # wire type of protobuf's bytes
_DATA_TAG = bytes([RawImage.DATA_FIELD_NUMBER << 3 | _LENGTH_DELIMITED])


def encode_image(frame: Frame, encoding: ImageEncoding) -> bytes:
    """The frame's image as a message, with its windows when it has some.

    ValueError when the image is not uint8 or uint16 of shape (height, width), its windows are not within it, or it
    has windows and is to be raw, which has no place to say so.
    """
    if encoding == "raw":
        return encode_raw(frame)
    image = frame.image
    if image.ndim != 2 or image.size == 0 or image.dtype.name not in GREY_TYPES:
        raise ValueError(f"an image is uint8 or uint16 of shape (height, width), not {image.dtype} {image.shape}")
    return CompressedImage(
        timestamp=timestamp(frame.time_ns),
        frame_id=frame.channel,
        data=encode_png(image, frame.windows),
        format="png",
    ).SerializeToString()


def encode_raw(frame: Frame) -> bytes:
    """The frame's image as a foxglove.RawImage, its fields in order of their numbers as protobuf writes them, with the
    pixels copied once: protobuf would copy 5 MB three times, and the fresh memory for it costs more than the disk.

    ValueError when the image is not uint8 or uint16 of shape (height, width), or has windows, which the message cannot
    describe.
    """
    image = frame.image
    if image.ndim != 2 or image.size == 0 or image.dtype.name not in GREY_TYPES:
        raise ValueError(f"an image is uint8 or uint16 of shape (height, width), not {image.dtype} {image.shape}")
    if frame.windows is not None:
        raise ValueError("a raw image cannot say which windows of it are real: record it as png")
    name = {1: "mono8", 2: "mono16"}[image.itemsize]
    pixels = np.ascontiguousarray(image, RAW_DTYPE[name])
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


def decode_image(schema: str, data: bytes) -> DecodedImage:
    """The image in a message of that schema; SessionError when it is not an image."""
    try:
        if schema == CompressedImage.DESCRIPTOR.full_name:
            compressed = CompressedImage.FromString(data)
            return DecodedImage(compressed.frame_id, *decode_png(compressed.data))
        if schema == RawImage.DESCRIPTOR.full_name:
            raw = RawImage.FromString(data)
            return DecodedImage(raw.frame_id, _from_raw(raw))
    except DecodeError as error:
        raise SessionError(f"an image message cannot be read ({error})") from error
    raise SessionError(f"images of schema {schema} are not known")


def _from_raw(raw: RawImage) -> ImageArray:
    dtype = RAW_DTYPE.get(raw.encoding)
    if dtype is None:
        raise SessionError(f"a recorded image has the encoding {raw.encoding!r}; mono8 and mono16 are known")
    if fault := size_fault(raw.width, raw.height):
        raise SessionError(f"a recorded image {fault}")
    row_bytes = raw.width * dtype.itemsize
    data = raw.data  # protobuf copies it at every access
    if not data or raw.step != row_bytes or len(data) != row_bytes * raw.height:
        raise SessionError(f"a raw image of {raw.width} x {raw.height} px has {len(data)} bytes")
    pixels = np.frombuffer(data, dtype).reshape(raw.height, raw.width)
    return cast(ImageArray, pixels.astype(dtype.newbyteorder("="), copy=False))
