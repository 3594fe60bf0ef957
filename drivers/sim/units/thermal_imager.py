"""A thermal imager that looks at the camera under test and stores a radiometric JPEG every so often."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from thermostand.drivers.sim.fakes import PICTURES, Bench, fake
from thermostand.drivers.sim.units.modbus import Timeline
from thermostand.drivers.sim.units.radiometric import HEIGHT, WIDTH, Shot, jpeg_of
from thermostand.foundation.clock import NS_PER_S, seconds_ns

SERIAL_NUMBER = "49001234"
SPOT_RADIUS_px = 8
CUT_bytes = 30_000
NOISE_K = 0.05


class Sight(Timeline, Protocol):
    """What it sees; temperatures at grid time."""

    chamber_degC: float
    lens_degC: float
    body_degC: float
    sensor_degC: float


class FakeThermalImager:
    """Drops a picture into `folder` every period_s; None makes a folder that `close` removes.

    spots: where lens, housing and back are seen, x and y in px; other names are seen as cold as the air. Faults:
    stopped; cut (each file is the first part of one, and completed when that is mended); plain (pictures without
    temperatures); damaged (the counts lack their end); clock_s (its clock is ahead by this); serial_number (another
    imager's pictures); again (the last picture once more, under a new name); unplugged (the folder is gone).
    """

    def __init__(
        self, sight: Sight, folder: Path | None, spots: Mapping[str, tuple[int, int]], seed: int, period_s: float = 60.0
    ) -> None:
        self._sight = sight
        self._own = Path(tempfile.mkdtemp(prefix="imager-")) if folder is None else None
        self.folder = folder or self._own or Path()
        self.folder.mkdir(parents=True, exist_ok=True)
        self._spots = dict(spots)
        self._noise = np.random.default_rng(seed)
        self._period_ns = seconds_ns(period_s)
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
        shot = Shot(celsius, time_ns / NS_PER_S + self.clock_s, self.serial_number, self.labels, emissivity=0.95)
        return jpeg_of(shot, is_damaged=self.damaged)

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
    bench.found_at(name, str(imager.folder), imager.close)
    return imager
