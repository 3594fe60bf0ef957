"""A thermal imager that looks at the camera under test and stores a radiometric JPEG every so often."""

from __future__ import annotations

import math
import shutil
import struct
import tempfile
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.sim.fakes import PICTURES, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.foundation.clock import NS_PER_S, to_ns

# Writes radiometric JPEGs as a FLIR E40 stores them. Source: the public tag tables of ExifTool.
#
# Records in the order camera, palette, measurements, counts; 14 directory entries, the rest of them empty. The counts
# are those of a surface of one emissivity that reflects surroundings of 20 degC, seen through no air: transmission 1.


WIDTH, HEIGHT = 160, 120
ENTRIES = 14
CHUNK = 65_524  # bytes of the block in a full segment
R1, R2, B, F, O = 15401.146, 0.0111986, 1406.3, 1.0, -6063  # noqa: E741 - FLIR's names
KELVIN = 273.15
AMBIENT_K = 20.0 + KELVIN


@dataclass(frozen=True)
class RadiometricShot:
    """celsius: shape (HEIGHT, WIDTH). taken_s: the camera's clock. spots: label -> x, y. png: the counts as a PNG with
    its bytes swapped, as cameras of 2015 have it."""

    celsius: NDArray[np.float64]
    taken_s: float
    serial_number: str = "49001234"
    spots: Mapping[str, tuple[int, int]] = field(default_factory=dict[str, tuple[int, int]])
    png: bool = False
    emissivity: float = 1.0


def compute_counts(celsius: NDArray[np.float64], emissivity: float = 1.0) -> NDArray[np.uint16]:
    """Return what the sensor counts."""
    own, routes = (R1 / (R2 * (np.exp(B / kelvin) - F)) - O for kelvin in (celsius + KELVIN, np.float64(AMBIENT_K)))
    radiance = emissivity * own + (1 - emissivity) * routes
    return np.clip(np.rint(radiance), 0, 65535).astype(np.uint16)


def make_jpeg(shot: RadiometricShot, *, is_damaged: bool = False) -> bytes:
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


def _block(shot: RadiometricShot) -> bytes:
    records = [
        (32, 0, 0x6F, _camera(shot)),
        (34, 0, 0, bytes(784)),
        (33, 0, 0x105, _measurements(shot.spots)),
        (1, 3 if shot.png else 2, 0x65, _raw(compute_counts(shot.celsius, shot.emissivity), shot.png)),
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


def _camera(shot: RadiometricShot) -> bytes:
    reals = {32: shot.emissivity, 36: 1.0, 40: AMBIENT_K, 44: AMBIENT_K, 48: AMBIENT_K, 52: 1.0, 60: 0.5}
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


SERIAL_NUMBER = "49001234"
SPOT_RADIUS_px = 8
CUT_bytes = 30_000
NOISE_K = 0.05


class FakeThermalImager:
    """Drops a picture into `folder` every period_s; None makes a folder that `close` removes.

    spots: where lens, housing and back are seen, x and y in px; other names are seen as cold as the air. Faults:
    stopped; cut (each file is the first part of one, and completed when that is mended); plain (pictures without
    temperatures); damaged (the counts lack their end); clock_s (its clock is ahead by this); serial_number (another
    imager's pictures); again (the last picture once more, under a new name); unplugged (the folder is gone).
    """

    def __init__(
        self, sight: Plant, folder: Path | None, spots: Mapping[str, tuple[int, int]], seed: int, period_s: float = 60.0
    ) -> None:
        self._sight = sight
        self._own = Path(tempfile.mkdtemp(prefix="imager-")) if folder is None else None
        self.folder = folder or self._own or Path()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._spots = dict(spots)
        self._noise = np.random.default_rng(seed)
        self._period_ns = to_ns(period_s)
        self._due_ns = 0
        self._number = 0
        self._last = b""
        self._rest: tuple[Path, bytes] | None = None
        self.serial_number = SERIAL_NUMBER
        self.labels: dict[str, tuple[int, int]] = {}  # its own measurement spots
        self.stopped = self.plain = self.damaged = self.again = False
        self.clock_s = 0.0
        self._cut = self._unplugged = False
        sight.on_step.append(self._on_step)

    @property
    def cut(self) -> bool:
        """Whether files are left half."""
        return self._cut

    @cut.setter
    def cut(self, cut: bool) -> None:
        self._cut = cut
        if not cut and self._rest is not None:
            path, rest = self._rest
            self._rest = None
            with path.open("ab") as file:
                file.write(rest)

    @property
    def unplugged(self) -> bool:
        """Whether the folder is gone."""
        return self._unplugged

    @unplugged.setter
    def unplugged(self, unplugged: bool) -> None:
        if unplugged != self._unplugged:
            away = self.folder.with_name(f"{self.folder.name}.away")
            (self.folder if unplugged else away).rename(away if unplugged else self.folder)
            self._unplugged = unplugged

    def close(self) -> None:
        """Remove a folder of its own."""
        self.unplugged = False
        if self._own is not None:
            shutil.rmtree(self._own, ignore_errors=True)

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        if time_ns < self._due_ns:
            return
        is_first, self._due_ns = not self._due_ns, time_ns + self._period_ns
        if not (is_first or self.stopped or self._unplugged):
            self._store(self._last if self.again and self._last else self._picture(time_ns))

    def _store(self, data: bytes) -> None:
        self._number += 1
        path = self.folder / f"FLIR{self._number:04d}.jpg"
        self._last = data
        if self._cut:
            self._rest = path, data[CUT_bytes:]
        path.write_bytes(data[:CUT_bytes] if self._cut else data)

    def _picture(self, time_ns: int) -> bytes:
        celsius = self._scene()
        if self.plain:
            return cv2.imencode(".jpg", np.clip(celsius, 0, 255).astype(np.uint8))[1].tobytes()
        shot = RadiometricShot(
            celsius, time_ns / NS_PER_S + self.clock_s, self.serial_number, self.labels, emissivity=0.95
        )
        return make_jpeg(shot, is_damaged=self.damaged)

    def _scene(self) -> NDArray[np.float64]:
        sight = self._sight
        seen = {
            "lens": sight.lens_degC,
            "housing": sight.body_degC + 0.3 * (sight.sensor_degC - sight.body_degC),
            "back": sight.body_degC,
        }
        celsius = sight.chamber_degC + self._noise.normal(0.0, NOISE_K, (HEIGHT, WIDTH))
        rows, columns = np.ogrid[:HEIGHT, :WIDTH]
        for name, (x, y) in self._spots.items():
            near = (columns - x) ** 2 + (rows - y) ** 2 <= SPOT_RADIUS_px**2
            celsius[near] += seen.get(name, sight.chamber_degC) - sight.chamber_degC
        return celsius


@fake("imager", rank=PICTURES)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeThermalImager:
    """folder: None for one of its own. It sees each spot where the stand looks for it."""
    folder = None if settings["folder"] is None else Path(settings["folder"])
    spots = {spot: (each["x_px"], each["y_px"]) for spot, each in settings["spots"].items()}
    imager = FakeThermalImager(bench.plant, folder, spots, bench.seed)
    bench.register_address(name, str(imager.folder), imager.close)
    return imager
