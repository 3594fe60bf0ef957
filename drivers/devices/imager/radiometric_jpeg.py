"""FLIR's radiometric JPEG: an FFF block in APP1 segments. Bytes in, counts and constants out; no I/O.

Source: the public tag tables of ExifTool. Seen in files of E40 cameras of 2012 (counts, little endian, one segment) and
2015 (a PNG with swapped bytes, two segments).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.devices.imager.radiometry import Air, Planck, RadiometricSurroundings
from thermostand.foundation.image_limit import describe_size_fault

_START, _END = b"\xff\xd8", b"\xff\xd9"
_APP1, _SCAN, _END_OF_IMAGE = 0xE1, 0xDA, 0xD9
_FLIR = b"FLIR\0"
_HEADER_SIZE, _ENTRY_SIZE, _MOST_ENTRIES = 0x40, 32, 256
_VERSIONS = range(100, 200)
_RAW, _CAMERA, _MEASUREMENTS = 1, 32, 33
_RAW_HEADER_SIZE, _PNG = 32, b"\x89PNG"
_SPOT = 1  # tool of a measurement
_CAMERA_SIZE = 912  # up to the end of its clock
_FIXED_PART = 36  # of a measurement, before its parameters


class NotRadiometric(ValueError):
    """These bytes are no radiometric JPEG; the text says why."""


@dataclass(frozen=True, slots=True)
class RadiometricImage:
    """counts: shape (height, width). camera_s: the camera's own clock, s since 1970 as it stands there, 0 when it does
    not say. spots: its own measurement spots (x, y in px) by their labels."""

    counts: NDArray[np.uint16]
    planck: Planck
    around: RadiometricSurroundings
    emissivity: float
    model: str
    serial_number: str
    software: str
    camera_s: float
    spots: Mapping[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])


def is_whole(data: bytes) -> bool:
    """Return whether a JPEG file has both its ends; a camera may fill up with zeros behind it."""
    return data.startswith(_START) and data.rstrip(b"\0").endswith(_END)


def parse(data: bytes) -> RadiometricImage:
    """The image in a whole file; NotRadiometric."""
    try:
        return _parse_records(_parse_directory(_join_block(data)))
    except struct.error as error:
        raise NotRadiometric(f"a record is cut short ({error})") from error


def _iterate_segments(data: bytes) -> Iterator[bytes]:
    """The contents of the APP1 segments before the picture itself."""
    at = 2
    while at + 4 <= len(data):
        if data[at] != 0xFF:
            raise NotRadiometric("its segments do not follow each other")
        marker, size = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if marker in (_SCAN, _END_OF_IMAGE):
            return
        if size < 2:
            raise NotRadiometric("a segment has no length")
        if marker == _APP1:
            yield data[at + 4 : at + 2 + size]
        at += 2 + size


def _join_block(data: bytes) -> bytes:
    """The FFF block, put together from its numbered segments."""
    if not data.startswith(_START):
        raise NotRadiometric("it is no JPEG")
    pieces: dict[int, bytes] = {}
    lasts: set[int] = set()
    for segment in _iterate_segments(data):
        if segment.startswith(_FLIR) and len(segment) >= 8:
            if segment[6] in pieces:
                raise NotRadiometric(f"it has its segment {segment[6]} twice")
            pieces[segment[6]] = segment[8:]
            lasts.add(segment[7])
    if not pieces:
        raise NotRadiometric("a JPEG without temperatures: store radiometric images on the camera")
    if lasts != {len(pieces) - 1} or set(pieces) != set(range(len(pieces))):
        raise NotRadiometric(f"of its segments up to {max(lasts)} there are {sorted(pieces)}")
    return b"".join(pieces[number] for number in sorted(pieces))


def _parse_directory(block: bytes) -> dict[int, tuple[int, bytes]]:
    """Type -> subtype and content of the first record of each type."""
    if block[:4] not in (b"FFF\0", b"AFF\0"):
        raise NotRadiometric("its block is no FFF")
    order = next((order for order in "><" if struct.unpack_from(f"{order}I", block, 0x14)[0] in _VERSIONS), "")
    if not order:
        raise NotRadiometric("its FFF block is of an unknown version")
    directory, count = struct.unpack_from(f"{order}II", block, 0x18)
    if count > _MOST_ENTRIES or directory < _HEADER_SIZE:
        raise NotRadiometric(f"its directory has {count} entries at {directory}")
    found: dict[int, tuple[int, bytes]] = {}
    for number in range(count):
        kind, subtype, _, _, offset, length = struct.unpack_from(
            f"{order}HHIIII", block, directory + number * _ENTRY_SIZE
        )
        if kind in (_RAW, _CAMERA, _MEASUREMENTS) and kind not in found:
            if offset + length > len(block):
                raise NotRadiometric(f"its record {kind} ends behind the block")
            found[kind] = subtype, block[offset : offset + length]
    return found


def _parse_records(records: Mapping[int, tuple[int, bytes]]) -> RadiometricImage:
    if _RAW not in records or _CAMERA not in records:
        raise NotRadiometric("it lacks the counts or the camera's constants")
    counts = _counts(records[_RAW][1])
    info = records[_CAMERA][1]
    if len(info) < _CAMERA_SIZE:
        raise NotRadiometric(f"the camera's constants have {len(info)} bytes")

    def real(offset: int) -> float:
        return struct.unpack_from("<f", info, offset)[0]

    def text(offset: int, size: int) -> str:
        return info[offset : offset + size].split(b"\0")[0].decode("ascii", "replace").strip()

    planck = Planck(real(88), real(780), real(92), real(96), struct.unpack_from("<i", info, 776)[0])
    if not (planck.R1 > 0 and planck.R2 > 0 and planck.B > 0):
        raise NotRadiometric(f"its constants are R1 {planck.R1:g}, R2 {planck.R2:g}, B {planck.B:g}")
    air = Air(real(36), real(44), real(60), real(112), real(116), real(120), real(124), real(128))
    around = RadiometricSurroundings(air, real(40), real(48), real(52))
    seconds, milliseconds = struct.unpack_from("<II", info, 900)
    spots = _spots(records[_MEASUREMENTS][1]) if _MEASUREMENTS in records else {}
    names = text(212, 32), text(260, 16), text(276, 16)
    return RadiometricImage(counts, planck, around, real(32), *names, seconds + milliseconds / 1000, spots)


def _counts(record: bytes) -> NDArray[np.uint16]:
    """The raw record: 16 bits a pixel, in the byte order of its header, or a PNG whose samples are swapped."""
    if len(record) < _RAW_HEADER_SIZE:
        raise NotRadiometric("its counts have no header")
    order = "<" if record[:2] == b"\x02\0" else ">"
    two, width, height = struct.unpack_from(f"{order}HHH", record)
    if two != 2:
        raise NotRadiometric("its counts have an unknown header")
    if fault := describe_size_fault(width, height):
        raise NotRadiometric(f"its image {fault}")
    body = record[_RAW_HEADER_SIZE:]
    if body.startswith(_PNG):
        return _from_png(body, width, height)
    if len(body) < 2 * width * height:
        raise NotRadiometric(f"{len(body)} bytes of counts for {width} x {height} px")
    return np.frombuffer(body, f"{order}u2", width * height).reshape(height, width).astype(np.uint16)


def _from_png(body: bytes, width: int, height: int) -> NDArray[np.uint16]:
    if struct.unpack_from(">II", body, 16) != (width, height):  # before memory is allocated for it
        raise NotRadiometric("its PNG is of another size than it says")
    import cv2  # half a second that other devices need not wait for

    decoded = cv2.imdecode(np.frombuffer(body, np.uint8), cv2.IMREAD_UNCHANGED)
    if decoded is None or decoded.dtype != np.uint16 or decoded.shape != (height, width):
        raise NotRadiometric("its PNG cannot be decoded")
    return np.asarray(decoded, np.uint16).byteswap()


def _spots(record: bytes) -> dict[str, tuple[int, int]]:
    """Tolerant, for the layout was found out by the public: what is no spot is left out."""
    spots: dict[str, tuple[int, int]] = {}
    at = 12
    while at + _FIXED_PART <= len(record) and (size := record[at]) >= _FIXED_PART:
        parameters, label_size, tool = record[at + 4], record[at + 6], record[at + 10]
        label_at = at + _FIXED_PART + parameters
        if tool == _SPOT and parameters >= 4 and label_at <= len(record):
            label = record[label_at : label_at + label_size].decode("utf-16-le", "replace").split("\0")[0]
            spots[label] = struct.unpack_from("<HH", record, at + _FIXED_PART)
        at += size
    return spots
