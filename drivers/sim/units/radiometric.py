"""Writes radiometric JPEGs as a FLIR E40 stores them. Source: the public tag tables of ExifTool.

Records in the order camera, palette, measurements, counts; 14 directory entries, the rest of them empty. The counts are
those of a surface of one emissivity that reflects a room of 20 degC, seen through no air: transmission 1.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

WIDTH, HEIGHT = 160, 120
ENTRIES = 14
CHUNK = 65_524  # bytes of the block in a full segment
R1, R2, B, F, O = 15401.146, 0.0111986, 1406.3, 1.0, -6063  # noqa: E741 - FLIR's names
KELVIN = 273.15
ROOM_K = 20.0 + KELVIN


@dataclass(frozen=True)
class Shot:
    """celsius: shape (HEIGHT, WIDTH). taken_s: the camera's clock. spots: label -> x, y. png: the counts as a PNG with
    its bytes swapped, as cameras of 2015 have it."""

    celsius: NDArray[np.float64]
    taken_s: float
    serial_number: str = "49001234"
    spots: Mapping[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    png: bool = False
    emissivity: float = 1.0


def counts_of(celsius: NDArray[np.float64], emissivity: float = 1.0) -> NDArray[np.uint16]:
    """What the sensor counts."""
    own, room = (R1 / (R2 * (np.exp(B / kelvin) - F)) - O for kelvin in (celsius + KELVIN, np.float64(ROOM_K)))
    radiance = emissivity * own + (1 - emissivity) * room
    return np.clip(np.rint(radiance), 0, 65535).astype(np.uint16)


def jpeg_of(shot: Shot, *, is_damaged: bool = False) -> bytes:
    """The file; a damaged one lacks the end of its counts."""
    shown = np.clip((shot.celsius - shot.celsius.min()) / max(np.ptp(shot.celsius), 0.1) * 255, 0, 255)
    encoded, picture = cv2.imencode(".jpg", shown.astype(np.uint8))
    if not encoded:
        raise ValueError("the picture cannot be encoded")
    plain = picture.tobytes()
    behind_app0 = 4 + int.from_bytes(plain[4:6], "big")
    return plain[:behind_app0] + _segments(_block(shot)[: -1000 if is_damaged else None]) + plain[behind_app0:]


def _segments(block: bytes) -> bytes:
    pieces = [block[begin : begin + CHUNK] for begin in range(0, len(block), CHUNK)]
    return b"".join(
        b"\xff\xe1" + struct.pack(">H", len(piece) + 10) + b"FLIR\0\x01" + bytes([number, len(pieces) - 1]) + piece
        for number, piece in enumerate(pieces)
    )


def _block(shot: Shot) -> bytes:
    records = [
        (32, 0, 0x6F, _camera(shot)),
        (34, 0, 0, bytes(784)),
        (33, 0, 0x105, _measurements(shot.spots)),
        (1, 3 if shot.png else 2, 0x65, _raw(counts_of(shot.celsius, shot.emissivity), shot.png)),
    ]
    begin = 0x40 + ENTRIES * 32
    directory, body = b"", b""
    for number, (kind, subtype, version, content) in enumerate(records, 1):
        offset = begin + len(body)
        directory += struct.pack(">HHIIIIIII", kind, subtype, version, number, offset, len(content), 0, 0, 0)
        body += content
    head = b"FFF\0" + bytes(16) + struct.pack(">III", 100, 0x40, ENTRIES) + struct.pack(">I", 5)
    return head.ljust(0x40, b"\0") + directory.ljust(ENTRIES * 32, b"\0") + body


def _raw(counts: NDArray[np.uint16], png: bool) -> bytes:
    height, width = counts.shape
    head = struct.pack("<9H", 2, width, height, 0, 0, 0, width - 1, 0, height - 1).ljust(32, b"\0")
    if not png:
        return head + counts.astype("<u2").tobytes()
    encoded, data = cv2.imencode(".png", counts.byteswap())
    if not encoded:
        raise ValueError("the counts cannot be encoded")
    return head + data.tobytes()


def _camera(shot: Shot) -> bytes:
    reals = {32: shot.emissivity, 36: 1.0, 40: ROOM_K, 44: ROOM_K, 48: ROOM_K, 52: 1.0, 60: 0.5}
    reals |= {88: R1, 92: B, 96: F, 128: 1.0, 436: 25.0, 780: R2}  # alpha and beta are 0, X is 1: clear air
    record = bytearray(2476)
    for offset, value in reals.items():
        struct.pack_into("<f", record, offset, value)
    struct.pack_into("<i", record, 776, O)
    for offset, text in (
        (212, "FLIR E40"),
        (244, "49001-1001"),
        (260, shot.serial_number),
        (276, "4.2"),
        (368, "FOL18"),
    ):
        record[offset : offset + len(text)] = text.encode()
    whole = math.floor(shot.taken_s)
    struct.pack_into("<IIh", record, 900, whole, round((shot.taken_s - whole) * 1000), 0)
    struct.pack_into("<H", record, 1124, 30)
    return bytes(record)


def _measurements(spots: Mapping[str, tuple[int, int]]) -> bytes:
    """Spots, and at the end an entry of length 0."""
    record = struct.pack("<HHH", 1, 12, 36).ljust(12, b"\0")
    for label, (x, y) in spots.items():
        text = (label + "\0").encode("utf-16-le")
        entry = bytearray(36)
        entry[0], entry[4], entry[6], entry[10] = 36 + 4 + len(text), 4, len(text), 1
        record += bytes(entry) + struct.pack("<HH", x, y) + text
    return record + bytes(36)
