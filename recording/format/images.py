"""A frame as two messages of one chunk: its description, and its image as foxglove.RawImage.

Pixels stay as the camera gave them, 8 bits (mono8) or 16 (mono16, the low byte first), and the chunk is compressed by
zstd, which every MCAP viewer knows. At level 1 it takes 5 MP of the demo's frames in 6 ms and gives them back in 3, at
1.22 times the bytes of the best PNG, which takes 45 and 11 ms; of 12 bits it is 1.05 times. Higher levels cost three
times the time for 2 % of the bytes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple, cast

import numpy as np
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import SessionError
from thermostand.foundation.image_limit import describe_size_fault
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format.messages import (
    FRAME_META_CLASS,
    FrameMeta,
    encode_frame_meta,
    encode_varint,
    make_timestamp,
)

ImageArray = NDArray[np.uint8] | NDArray[np.uint16]
Windows = NDArray[np.int32]

FrameEncoding = Literal["zstd", "raw", "roi"]
"""zstd, raw: whole images in chunks that are compressed, or not. roi: compressed, of the markers' surroundings."""

IMAGE_SCHEMA: str = RawImage.DESCRIPTOR.full_name
META_SCHEMA: str = FRAME_META_CLASS.DESCRIPTOR.full_name
# Measured on 5 MP frames of the demo: 7.6 ms of a processor in, 2.6 out, 2.87 MB of 5.0. Levels 2 and 3 are 2 % smaller
# and take 3 to 7 times as long; noise of 1.5 DN without vignetting is the worst case, 1.78 times a PNG.
ZSTD_LEVEL = 1
MOST_WINDOWS = 10_000  # more than any target has markers
# A sixteenth of the pixels; the median of a ground is known from far fewer. Round number; nothing was measured.
FILL_STEP_px = 4  # the median is taken of every fourth pixel of every fourth row

_DTYPE = {"mono8": np.dtype(np.uint8), "mono16": np.dtype("<u2")}
_LENGTH_DELIMITED, _VARINT, _FIXED64, _FIXED32 = 2, 0, 1, 5  # wire types of protobuf
_DATA_TAG = bytes([RawImage.DATA_FIELD_NUMBER << 3 | _LENGTH_DELIMITED])


class FrameTopics(NamedTuple):
    """The topics of one camera: `/camera/meta` and `/camera/image`."""

    meta: str
    image: str


def name_frame_topics(channel: str) -> FrameTopics:
    """The topics of the frames of a channel, `camera.image`."""
    place = "/" + channel.removesuffix(".image").replace(".", "/")
    return FrameTopics(f"{place}/meta", f"{place}/image")


@dataclass(frozen=True, slots=True)
class FrameContext:
    """What is known of a frame besides its image: when it was published, what for and at which set-point (NaN:
    unknown), and the last reading of each temperature and position."""

    published_ns: int
    role: str = ""
    chamber_degC: float = math.nan
    readings: tuple[Reading, ...] = ()


def encode_meta(frame: Frame, known: FrameContext) -> bytes:
    """The frame's description. ValueError when its windows are not within the image."""
    image = _check_grey(frame.image)
    if frame.windows is not None:
        _check_windows(frame.windows, image.shape)
    height, width = image.shape
    meta = FrameMeta(
        channel=frame.channel,
        time_ns=frame.time_ns,
        published_ns=known.published_ns,
        step_id=frame.step_id,
        role=known.role,
        chamber_degC=known.chamber_degC,
        block_id=frame.block_id,
        camera_ticks=frame.camera_ticks,
        exposure_s=frame.exposure_s,
        gain_dB=frame.gain_dB,
        camera_degC=frame.camera_degC,
        dropped=frame.dropped,
        flags=frame.flags,
        width=width,
        height=height,
        significant_bits=frame.significant_bits or 8 * image.itemsize,
        windows=b"" if frame.windows is None else frame.windows.astype("<i4").tobytes(),
    )
    return encode_frame_meta(meta, known.readings)


def encode_image(frame: Frame) -> bytes:
    """The frame's image as a foxglove.RawImage, its fields in order of their numbers as protobuf writes them, with the
    pixels copied once: protobuf would copy 5 MB three times, and fresh memory for it costs as much as compressing it.

    ValueError when the image is not uint8 or uint16 of shape (height, width).
    """
    image = _check_grey(frame.image)
    name = {1: "mono8", 2: "mono16"}[image.itemsize]
    pixels = np.ascontiguousarray(image, _DTYPE[name])
    height, width = image.shape
    before = RawImage(
        timestamp=make_timestamp(frame.time_ns), width=width, height=height, encoding=name, step=width * image.itemsize
    )
    behind = RawImage(frame_id=frame.channel)
    return b"".join(
        (before.SerializeToString(), _DATA_TAG, encode_varint(pixels.nbytes), pixels.data, behind.SerializeToString())
    )


def _check_grey(image: ImageArray) -> ImageArray:
    if image.ndim != 2 or image.size == 0 or image.dtype.name not in ("uint8", "uint16"):
        raise ValueError(f"an image is uint8 or uint16 of shape (height, width), not {image.dtype} {image.shape}")
    return image


def decode_image(data: bytes | memoryview) -> ImageArray:
    """The pixels (height, width) of a foxglove.RawImage, which stay in `data` where the machine has the same byte
    order; SessionError when it is none of ours."""
    try:
        pixels, others = _split_pixels(memoryview(data))
        raw = RawImage.FromString(others)
    except (ValueError, IndexError, DecodeError) as error:
        raise SessionError(f"an image message cannot be read ({error})") from error
    dtype = _DTYPE.get(raw.encoding)
    if dtype is None:
        raise SessionError(f"a recorded image has the encoding {raw.encoding[:40]!r}; mono8 and mono16 are known")
    if fault := describe_size_fault(raw.width, raw.height):
        raise SessionError(f"a recorded image {fault}")
    row_bytes = raw.width * dtype.itemsize
    if raw.step != row_bytes or len(pixels) != row_bytes * raw.height:
        raise SessionError(f"a raw image of {raw.width} x {raw.height} px has {len(pixels)} bytes")
    image = np.frombuffer(pixels, dtype).reshape(raw.height, raw.width)
    return cast(ImageArray, image.astype(dtype.newbyteorder("="), copy=False))


def _split_pixels(message: memoryview) -> tuple[memoryview, bytes]:
    """The pixels of an image message, not copied, and all its other fields; ValueError or IndexError when it is cut."""
    pixels, others, at, size = message[:0], bytearray(), 0, 0
    while at < len(message):
        begin = at
        tag, at = _read_varint(message, at)
        match tag & 7:
            case 2:
                size, at = _read_varint(message, at)
                at += size
            case 0:
                _, at = _read_varint(message, at)
            case 1:
                at += 8
            case 5:
                at += 4
            case kind:
                raise ValueError(f"a field of kind {kind}")
        if at > len(message):
            raise ValueError("a field is cut off")
        if tag == _DATA_TAG[0]:
            pixels = message[at - size : at]
        else:
            others += message[begin:at]
    return pixels, bytes(others)


def _read_varint(message: memoryview, at: int) -> tuple[int, int]:
    """The number there, and where it ends."""
    number = 0
    for shift in range(0, 70, 7):
        byte = message[at]
        number |= (byte & 0x7F) << shift
        at += 1
        if byte < 0x80:
            return number, at
    raise ValueError("a number is too long")


def decode_windows(meta: FrameMeta) -> Windows | None:
    """The windows (n, 4) of a frame, None when all of it is there; SessionError when they cannot be right."""
    if not meta.windows:
        return None
    try:
        windows = np.frombuffer(meta.windows, "<i4").reshape(-1, 4).astype(np.int32)
        _check_windows(windows, (meta.height, meta.width))
    except ValueError as error:
        raise SessionError(f"the windows of a recorded image cannot be right: {error}") from error
    return windows


def _check_windows(windows: Windows, shape: tuple[int, ...]) -> None:
    """ValueError unless there is at least one window and all are within an image of shape (height, width); they may
    overlap."""
    if windows.ndim != 2 or windows.shape[1] != 4 or not 0 < len(windows) <= MOST_WINDOWS:
        raise ValueError(f"windows are 1 to {MOST_WINDOWS} rows of x, y, width, height, not {windows.shape}")
    corners, sizes = windows[:, :2].astype(np.int64), windows[:, 2:].astype(np.int64)
    if (corners < 0).any() or (sizes < 1).any() or (corners + sizes > shape[1::-1]).any():
        raise ValueError(f"a window lies outside the image of {shape[1]} x {shape[0]} px, or has no size")


def encode_png(image: ImageArray) -> bytes:
    """The image (height, width) as a PNG, for other programs. ValueError when it is not uint8 or uint16."""
    import cv2  # a program that writes none need not wait for OpenCV

    done, png = cv2.imencode(".png", _check_grey(image))
    if not done:
        raise SessionError(f"OpenCV could not make a PNG of an image of {image.shape[1]} x {image.shape[0]} px")
    return png.tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class _WholeFrame:
    """Result of the last whole frame that was searched; windows: None when none were found. fill_DN: its median, so
    that the edges of the windows do not look like edges of markers."""

    time_ns: int
    kind: tuple[object, ...]
    windows: Windows | None
    fill_DN: int


class MarkerWindows:
    """Keeps the parts of images that matter, and now and then all of one; frames in order of time, one thread at a
    time. What is left out is evidence (dust, glare, a marker that was taken for another), so this is a choice and not
    the default.

    A frame stays whole and is searched for windows when it is the first one of its channel, of another size, type
    or step than that channel's before, or `whole_every_s` after the last search (on the frames' own time). When
    windows were found, the frames up to the next search keep only those, all other pixels have one value; else they
    are whole.
    """

    def __init__(self, find_windows: Callable[[ImageArray], Windows | None], whole_every_s: float = 60.0) -> None:
        self.tell: Callable[[str], None] = lambda text: None  # of a search that failed; set by the recording
        self._find_windows = find_windows
        self._whole_every_ns = to_ns(whole_every_s)
        self._wholes: dict[str, _WholeFrame] = {}  # channel -> its last whole frame

    def __call__(self, frame: Frame) -> Frame:
        """The frame as it is to be recorded; one that is partial already stays as it is."""
        if frame.windows is not None:
            return frame
        whole, kind = self._wholes.get(frame.channel), (frame.step_id, frame.image.shape, frame.image.dtype)
        if whole is None or whole.kind != kind or not 0 <= frame.time_ns - whole.time_ns < self._whole_every_ns:
            fill_DN = int(np.median(frame.image[::FILL_STEP_px, ::FILL_STEP_px]))
            self._wholes[frame.channel] = _WholeFrame(frame.time_ns, kind, self._search_windows(frame.image), fill_DN)
            return frame
        return frame if whole.windows is None else _partial(frame, whole.windows, whole.fill_DN)

    def _search_windows(self, image: ImageArray) -> Windows | None:
        try:
            return self._find_windows(image)
        except Exception as error:  # noqa: BLE001 - the frames stay whole, and that is never wrong
            self.tell(f"frames are recorded whole: the search for markers failed ({type(error).__name__}: {error})")
            return None


def _partial(frame: Frame, windows: Windows, fill_DN: int) -> Frame:
    """The frame with `fill_DN` in every pixel outside the windows."""
    image = np.full_like(frame.image, fill_DN)
    for x, y, width, height in windows.tolist():
        image[y : y + height, x : x + width] = frame.image[y : y + height, x : x + width]
    return replace(frame, image=image, windows=windows)


def select_frame_readings(readings: Iterable[Reading]) -> tuple[Reading, ...]:
    """Select the readings that describe a frame: temperatures and positions."""
    return tuple(reading for reading in readings if reading.unit in ("degC", "mm", "deg"))
