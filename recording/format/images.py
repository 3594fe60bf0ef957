"""The image message of /camera/image: lossless PNG or raw, in Foxglove's schemas, and back to an array.

Every reader opens the PNGs, whose rows are in strips (strips.py); they note which windows are real when the rest of the
image is filled. Level 1 and Huffman codes only: noise has no repeats to find. What decides the size is the row filter,
by how much noise it adds to the noise: the average of the left and the upper neighbour adds half the variance (0.29 bit
per px), one neighbour alone as much again (0.5 bit). Of 5 MP with noise of sigma 1.5 DN the average filter makes
2.56 : 1 in 35 ms, the one to the left 2.42 : 1 in 29 ms; the choice row by row, which OpenCV makes when it is given no
filter, comes to 2.57 : 1 as well, in 68 ms. The noise allows 3.01 : 1.

Samples of 16 bit are filtered byte by byte, and the average is then wrong wherever two neighbours differ in the upper
byte: the row above is best (12 bit, sigma 3, 8 and 24 DN: 2.60, 2.04 and 1.62 : 1; the noise allows 4.40, 3.17 and
2.41). Both bytes share one Huffman code, which costs most of the difference. Moving 12 bit up to 16 (sBIT) would make
it 2.31, 2.07 and 1.75, so samples stay what the camera said. A filled image is coded with runs.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from typing import Literal, NamedTuple, cast

import deflate
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError, Message
from numpy.typing import NDArray

from thermostand.foundation.errors import SessionError
from thermostand.foundation.image_limit import size_fault
from thermostand.foundation.readings import Frame
from thermostand.recording.format.messages import timestamp
from thermostand.recording.format.strips import KIND as STRIPS
from thermostand.recording.format.strips import compressed, index_of, strips_in

CAMERA_IMAGE = "/camera/image"

ImageArray = NDArray[np.uint8] | NDArray[np.uint16]
Windows = NDArray[np.int32]

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

WINDOWS_KEYWORD = b"Windows"
MOST_WINDOWS = 10_000

SIGNATURE = b"\x89PNG\r\n\x1a\n"
HEADER = struct.Struct(">IIBBBBB")  # width, height, bit depth, colour type, compression, filter, interlace
_CHUNK_HEAD = struct.Struct(">I4s")  # length of the contents, kind
_CHUNK_CRC = struct.Struct(">I")
_CHUNK_BYTES = _CHUNK_HEAD.size + _CHUNK_CRC.size
_BEHIND_STRIPS = _CHUNK_CRC.size + 2 * _CHUNK_BYTES
_WRONG_CHECKSUM = "a recorded image is damaged: a checksum is wrong"
HEADER_END = len(SIGNATURE) + 8 + HEADER.size + 4
GREATEST_DEFLATION = 1032  # deflate cannot make less than 1 byte of so many
WINDOWS_TEXT = re.compile(rb"\d{1,9},\d{1,9},\d{1,9},\d{1,9}(;\d{1,9},\d{1,9},\d{1,9},\d{1,9})*", re.ASCII)


def encode_image(frame: Frame, encoding: ImageEncoding) -> bytes:
    """The frame's image as a message, with its windows when it has some.

    ValueError when the image is not uint8 or uint16 of shape (height, width), its windows are not within it, or it
    has windows and is to be raw, which has no place to say so.
    """
    if encoding == "raw":
        return encode_raw(frame)
    image = _grey(frame)
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
    image = _grey(frame)
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


def _grey(frame: Frame) -> ImageArray:
    image = frame.image
    if image.ndim != 2 or image.size == 0 or image.dtype.name not in GREY_TYPES:
        raise ValueError(f"an image is uint8 or uint16 of shape (height, width), not {image.dtype} {image.shape}")
    return image


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


class Header(NamedTuple):
    """The first chunk (PNG specification, 11.2.1)."""

    width_px: int
    height_px: int
    bit_depth: int
    colour_type: int
    compression: int
    filtering: int
    interlace: int

    @property
    def inflated_bytes(self) -> int:
        """What the pixel data must inflate to: a filter byte and the samples, row by row."""
        return self.height_px * (1 + self.width_px * self.bit_depth // 8)


def encode_png(image: ImageArray, windows: Windows | None = None) -> bytes:
    """The image, shape (height, width), as a PNG. windows: x, y, width, height of the parts that are real, px, shape
    (n, 4); they are noted in a text chunk. ValueError when windows are not within the image."""
    native = cast(ImageArray, image.astype(image.dtype.newbyteorder("="), copy=False))
    return _in_strips(native) if windows is None else _in_windows(native, windows)


def _in_strips(image: ImageArray) -> bytes:
    rows = np.ascontiguousarray(image, image.dtype.newbyteorder(">")).view(np.uint8)
    strips, parts = compressed(rows.reshape(len(image), -1), image.itemsize)
    header = HEADER.pack(image.shape[1], image.shape[0], 8 * image.itemsize, 0, 0, 0, 0)
    chunks = [(b"IHDR", header), (STRIPS, index_of(strips)), *((b"IDAT", part) for part in parts), (b"IEND", b"")]
    return b"".join([SIGNATURE, *(piece for kind, body in chunks for piece in _pieces(kind, body))])


def _in_windows(image: ImageArray, windows: Windows) -> bytes:
    import cv2  # here and below: a program that reads no image need not wait for OpenCV; a recorder imports it at once

    check_windows(windows, image.shape)
    parameters = [
        *(cv2.IMWRITE_PNG_COMPRESSION, 1),
        *(cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_RLE),
        *(cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_AVG if image.itemsize == 1 else cv2.IMWRITE_PNG_FILTER_UP),
    ]
    done, png = cv2.imencode(".png", image, parameters)
    if not done:
        raise SessionError(f"OpenCV could not make a PNG of an image of {image.shape[1]} x {image.shape[0]} px")
    data = png.tobytes()
    text = b";".join(b"%d,%d,%d,%d" % tuple(window) for window in windows.tolist())
    return data[:HEADER_END] + b"".join(_pieces(b"tEXt", WINDOWS_KEYWORD + b"\0" + text)) + data[HEADER_END:]


def check_windows(windows: Windows, shape: tuple[int, ...]) -> None:
    """ValueError unless there is at least one window and all are within an image of shape (height, width); they may
    overlap."""
    if windows.ndim != 2 or windows.shape[1] != 4 or not 0 < len(windows) <= MOST_WINDOWS:
        raise ValueError(f"windows are 1 to {MOST_WINDOWS} rows of x, y, width, height, not {windows.shape}")
    corners, sizes = windows[:, :2].astype(np.int64), windows[:, 2:].astype(np.int64)
    if (corners < 0).any() or (sizes < 1).any() or (corners + sizes > shape[1::-1]).any():
        raise ValueError(f"a window lies outside the image of {shape[1]} x {shape[0]} px, or has no size")


def decode_png(data: bytes) -> tuple[ImageArray, Windows | None]:
    """The image, shape (height, width), and its windows as in `encode_png`; None when all of it is real.

    SessionError when it is not a whole, undamaged grey PNG of 8 or 16 bit; a size that the data cannot fill is refused
    before any memory is asked for.
    """
    import cv2

    header, windows, plain, _ = _taken_apart(data)
    try:
        image = cv2.imdecode(np.frombuffer(plain, np.uint8), cv2.IMREAD_UNCHANGED)
    except (cv2.error, MemoryError) as error:
        raise SessionError(f"a recorded image cannot be decoded ({error})") from error
    if image is None or image.shape != header[1::-1] or image.itemsize * 8 != header.bit_depth:
        raise SessionError("a recorded image cannot be decoded: its compressed pixels are damaged or too few")
    return cast(ImageArray, image), windows


def pixel_data(data: bytes) -> tuple[Header, bytes]:
    """Header and compressed pixels, checked as `decode_png` checks them, for callers that decode them themselves."""
    header, _, _, pixels = _taken_apart(data)
    return header, b"".join(pixels)


class StripPlaces(NamedTuple):
    """rows: of a strip; the last one may have fewer. begins, ends: (n,) int64, of the compressed bytes of each strip in
    the PNG."""

    header: Header
    rows: int
    begins: NDArray[np.int64]
    ends: NDArray[np.int64]


def strip_places(data: bytes) -> StripPlaces | None:
    """Where the strips of a PNG are; None when it has none, or they are not where its index says. The header's and the
    index' checksums are right; those of the strips are `check_strip`'s. SessionError as in `decode_png`."""
    header: Header | None = None
    index, at = b"", len(SIGNATURE)
    for kind, body, whole in _chunks(data):
        at += len(whole)
        if kind == b"IHDR" and header is None:
            header = _header(body)
        elif kind == STRIPS:
            index = bytes(body)
        elif kind in (b"IDAT", b"IEND"):
            break
    strips = None if header is None else strips_in(index, header.height_px)
    if header is None or strips is None:
        return None
    lengths = np.array(strips.lengths, np.int64)
    ends = at + np.cumsum(lengths + _CHUNK_BYTES) - _CHUNK_CRC.size
    if header.inflated_bytes > GREATEST_DEFLATION * lengths.sum() or ends[-1] + _BEHIND_STRIPS > len(data):
        return None
    return StripPlaces(header, strips.rows, ends - lengths, ends)


def check_strip(data: bytes, begin: int, end: int) -> bool:
    """Whether an IDAT has just these contents; SessionError when their checksum is wrong."""
    if _CHUNK_HEAD.unpack_from(data, begin - _CHUNK_HEAD.size) != (end - begin, b"IDAT"):
        return False
    if deflate.crc32(memoryview(data)[begin - 4 : end]) != _CHUNK_CRC.unpack_from(data, end)[0]:
        raise SessionError(_WRONG_CHECKSUM)
    return True


def _taken_apart(data: bytes) -> tuple[Header, Windows | None, bytes, list[memoryview]]:
    """Header, windows, the PNG without any chunk that could change the pixels or ask for memory (gamma, transparency,
    animation, profiles), and the parts of its compressed pixels."""
    header: Header | None = None
    windows: Windows | None = None
    kept: list[memoryview] = []
    pixels: list[memoryview] = []
    for kind, body, whole in _chunks(data):
        if (kind == b"IHDR") == (header is not None):
            raise SessionError("a recorded image is not a PNG: its header is not the first chunk, or there are two")
        if header is None:
            header = _header(body)
        elif kind == b"IDAT":
            pixels.append(body)
        elif kind == b"tEXt" and bytes(body[:8]) == WINDOWS_KEYWORD + b"\0":
            if windows is not None:
                raise SessionError("a recorded image says twice which windows of it are real")
            windows = _windows(bytes(body[8:]), header)
        if kind in (b"IHDR", b"IDAT", b"IEND"):
            kept.append(whole)
    if header is None or header.inflated_bytes > GREATEST_DEFLATION * sum(map(len, pixels)):
        raise SessionError("a recorded image cannot be decoded: it has too little data for its size")
    is_plain = len(SIGNATURE) + sum(map(len, kept)) == len(data)
    return header, windows, data if is_plain else SIGNATURE + b"".join(kept), pixels


def _chunks(data: bytes) -> Iterator[tuple[bytes, memoryview, memoryview]]:
    """Kind, contents and the whole of each chunk up to the end mark, checksums verified."""
    if not data.startswith(SIGNATURE):
        raise SessionError("a recorded image is not a PNG")
    view, begin, kind = memoryview(data), len(SIGNATURE), b""
    while kind != b"IEND":
        if begin + 12 > len(data):
            raise SessionError("a recorded image is cut off")
        size, kind = _CHUNK_HEAD.unpack_from(data, begin)
        end = begin + 12 + size
        if end > len(data):
            raise SessionError("a recorded image is cut off")
        if deflate.crc32(view[begin + 4 : end - 4]) != _CHUNK_CRC.unpack_from(data, end - 4)[0]:
            raise SessionError(_WRONG_CHECKSUM)
        yield kind, view[begin + 8 : end - 4], view[begin:end]
        begin = end


def _header(body: memoryview) -> Header:
    if len(body) != HEADER.size:
        raise SessionError("a recorded image is not a PNG: its header has another length")
    header = Header(*HEADER.unpack(body))
    if header.colour_type != 0 or header.bit_depth not in (8, 16) or any(header[4:]):
        raise SessionError("a recorded image is not a plain grey PNG of 8 or 16 bit")
    if fault := size_fault(header.width_px, header.height_px):
        raise SessionError(f"a recorded image {fault}")
    return header


def _windows(text: bytes, header: Header) -> Windows:
    if len(text) > 40 * MOST_WINDOWS or WINDOWS_TEXT.fullmatch(text) is None:
        raise SessionError(f"the windows of a recorded image are not understood: {text[:40].decode('latin-1')!r}")
    windows = np.array([window.split(b",") for window in text.split(b";")]).astype(np.int32)
    try:
        check_windows(windows, (header.height_px, header.width_px))
    except ValueError as error:
        raise SessionError(f"the windows of a recorded image cannot be right: {error}") from error
    return windows


def _pieces(kind: bytes, body: bytes) -> tuple[bytes, bytes, bytes]:
    """Length and kind, contents, checksum of a chunk (PNG specification, 5.3)."""
    return _CHUNK_HEAD.pack(len(body), kind), body, _CHUNK_CRC.pack(deflate.crc32(body, deflate.crc32(kind)))
