"""The image message of /camera/image: lossless PNG or raw, in Foxglove's schemas, and back to an array."""

from __future__ import annotations

from typing import Literal, NamedTuple, cast

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from drivers.interface import Frame, SessionError
from stand.recording.messages import timestamp

CAMERA_IMAGE = "/camera/image"

ImageArray = NDArray[np.uint8] | NDArray[np.uint16]
ImageEncoding = Literal["png", "raw"]


class DecodedImage(NamedTuple):
    """A recorded image: pixels of shape (height, width); windows as in drivers.interface.Frame."""

    channel: str
    pixels: ImageArray
    windows: NDArray[np.int32] | None = None


IMAGE_CLASS: dict[ImageEncoding, type[Message]] = {"png": CompressedImage, "raw": RawImage}
GREY_TYPES = ("uint8", "uint16")
RAW_DTYPE = {"mono8": np.dtype(np.uint8), "mono16": np.dtype("<u2")}


def png_parameters() -> list[int]:
    """Level 1, Huffman only: noise has no repeats to find, so the search for them costs time and bytes. The average
    filter halves the time again; OpenCV before 4.12 cannot choose it."""
    parameters = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    if hasattr(cv2, "IMWRITE_PNG_FILTER_AVG"):
        parameters += [cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG]
    return parameters


PNG_PARAMETERS = png_parameters()


def encode_image(frame: Frame, encoding: ImageEncoding) -> bytes:
    """The frame's image as a message; uint8 or uint16 of shape (height, width), else ValueError."""
    image = frame.image
    if image.ndim != 2 or image.dtype.name not in GREY_TYPES:
        raise ValueError(f"an image is uint8 or uint16 of shape (height, width), not {image.dtype} {image.shape}")
    stamp = timestamp(frame.time_ns)
    if encoding == "png":
        _, png = cv2.imencode(".png", image, PNG_PARAMETERS)
        return CompressedImage(
            timestamp=stamp, frame_id=frame.channel, data=png.tobytes(), format="png"
        ).SerializeToString()
    height, width = image.shape
    name = "mono8" if image.itemsize == 1 else "mono16"
    data = image.astype(RAW_DTYPE[name], copy=False).tobytes()
    return RawImage(
        timestamp=stamp,
        frame_id=frame.channel,
        width=width,
        height=height,
        encoding=name,
        step=width * image.itemsize,
        data=data,
    ).SerializeToString()


def decode_image(schema: str, data: bytes) -> DecodedImage:
    """The image in a message of that schema; SessionError when it is not an image."""
    try:
        if schema == CompressedImage.DESCRIPTOR.full_name:
            compressed = CompressedImage.FromString(data)
            return DecodedImage(compressed.frame_id, _from_png(compressed.data))
        if schema == RawImage.DESCRIPTOR.full_name:
            raw = RawImage.FromString(data)
            return DecodedImage(raw.frame_id, _from_raw(raw))
    except DecodeError as error:
        raise SessionError(f"an image message cannot be read ({error})") from error
    raise SessionError(f"images of schema {schema} are not known")


def _from_png(data: bytes) -> ImageArray:
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED) if data else None
    except cv2.error as error:
        raise SessionError(f"a recorded image is not a PNG ({error})") from error
    if image is None or image.ndim != 2 or image.dtype.name not in GREY_TYPES:
        raise SessionError("a recorded image is not a grey PNG of 8 or 16 bit")
    return cast(ImageArray, image)


def _from_raw(raw: RawImage) -> ImageArray:
    dtype = RAW_DTYPE.get(raw.encoding)
    if dtype is None:
        raise SessionError(f"a recorded image has the encoding {raw.encoding!r}; mono8 and mono16 are known")
    row_bytes = raw.width * dtype.itemsize
    if raw.step != row_bytes or len(raw.data) != row_bytes * raw.height:
        raise SessionError(f"a raw image of {raw.width} x {raw.height} px has {len(raw.data)} bytes")
    return cast(ImageArray, np.frombuffer(raw.data, dtype).reshape(raw.height, raw.width))
