"""A thermal imager that stores radiometric JPEGs into a folder: what its pictures say of a few named spots.

It takes pictures by itself, or by hand; the folder is looked into once a poll (memory cards and network folders tell
nobody of new files). It measures to 2 K: for how a housing warms, not for how warm it is.
"""

from __future__ import annotations

import asyncio
import hashlib
import math
import os
import stat
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import AfterValidator, Field

from thermostand.drivers.devices.device_check import DeviceCheck, Finding
from thermostand.drivers.devices.imager.radiometric_jpeg import NotRadiometric, RadiometricImage, is_whole, parse
from thermostand.drivers.devices.imager.radiometry import compute_temperatures_degC
from thermostand.drivers.devices.kinds import DeviceKind, DriverContext
from thermostand.drivers.settings import DeviceName, Identity, Polled
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import Unreachable
from thermostand.foundation.events import (
    CLOCK_SET_BACK,
    NO_PICTURE,
    PICTURE_LEFT_OUT,
    PICTURE_TAKEN,
    PICTURES_BACK,
    PICTURES_LOST,
)
from thermostand.foundation.items import Event, Item, Original
from thermostand.foundation.readings import Channel, Quality, Reading, bad_reading
from thermostand.foundation.workers import WorkerThread

_SUFFIXES = (".jpg", ".jpeg")
_LARGEST_BYTES = 20_000_000  # round number; nothing was measured
_MOST_AT_ONCE = 20  # files of one poll: after a pause, hundreds may wait
_KNOWN_HASHES = 10_000  # a picture a minute for a week
_SET_BACK_S = 120.0  # more than a picture takes from the imager into the folder, beyond the quickest of them
_NONE_YET = "no picture yet"


def _absolute(path: Path) -> Path:
    if not str(path).isprintable():
        raise ValueError("expected a path of printable characters")
    return path.absolute()


class SpotSettings(Document):
    """The place of one spot: the middle of 3 x 3 px, counted from 0 at the top left, or the imager's own measurement
    spot that is labelled `label`, where the picture has it. emissivity: of what is seen there."""

    x_px: int = Field(ge=0, le=4095)
    y_px: int = Field(ge=0, le=4095)
    label: str = Field(default="", max_length=32)
    emissivity: float = Field(default=0.95, gt=0.05, le=1)


def locate_spot(image: RadiometricImage, spot: SpotSettings) -> tuple[int, int]:
    """Return where a spot is in a picture, x and y in px."""
    here = spot.x_px, spot.y_px
    return image.spots.get(spot.label, here) if spot.label else here


def measure_spot_degC(image: RadiometricImage, spot: SpotSettings) -> float | None:
    """The mean of the 3 x 3 px of a spot; NaN where the counts are of no temperature, None when they are not all within
    the picture."""
    (x, y), (height, width) = locate_spot(image, spot), image.counts.shape
    if not (1 <= x < width - 1 and 1 <= y < height - 1):
        return None
    around = image.counts[y - 1 : y + 2, x - 1 : x + 2]
    return float(compute_temperatures_degC(around, image.planck, image.around, spot.emissivity).mean())


class ThermalImagerSettings(Polled):
    """folder: where its pictures arrive. serial_number: of the imager; pictures of another one are not read, none takes
    any. settled_s: for so long a file must not have changed. incomplete_s: a file without its end is given up after
    that. stale_after_s: without a new picture for so long its readings are STALE."""

    folder: Annotated[Path, AfterValidator(_absolute)]
    serial_number: str | None = Field(default=None, pattern=r"^[ -~]{1,16}$")
    spots: dict[DeviceName, SpotSettings] = Field(min_length=1, max_length=16)
    poll_s: float = Field(default=2.0, gt=0, le=3600)
    settled_s: float = Field(default=2.0, ge=0, le=600)
    incomplete_s: float = Field(default=60.0, ge=1, le=86400)
    stale_after_s: float = Field(default=900.0, gt=0, le=86400)


@dataclass(frozen=True, slots=True)
class _FileStamp:
    """A file as the folder shows it; another size or time of change is another file."""

    size: int
    changed_ns: int


@dataclass(slots=True)
class _SeenFile:
    """A file since it looks like `stamp`. settled: nothing more is to be done with it."""

    stamp: _FileStamp
    first_ns: int
    since_ns: int
    settled: bool = False


class ThermalImager:
    """Readings `<spot>` in degC, and `clock_offset`, s by which the imager's clock is behind the stand's.

    Its own time stays as it is: the instant of a reading is that time plus the offset, the least by which any picture
    came later than its own clock says, since that clock was last set. publish: takes each picture as it came, and
    events.
    """

    def __init__(
        self, name: str, settings: ThermalImagerSettings, clock: Clock, publish: Callable[[Item], None]
    ) -> None:
        self.name = name
        self.identity: Identity | None = None  # of the imager whose picture was read last
        self._settings = settings
        self._clock = clock
        self._publish = publish
        self._worker: WorkerThread | None = None
        self._files: dict[str, _SeenFile] | None = None  # before the folder was there for the first time
        self._lost = ""
        self._hashes: dict[str, str] = {}  # of the pictures that were taken, in order -> their names
        self._offset_s = math.inf
        self._late: tuple[int, float] | None = (
            None  # when a picture was found that came too late for the offset, and by what
        )
        self._latest: tuple[Reading, ...] = ()
        self._latest_ns = 0
        self._is_stale = False
        self._last: tuple[Reading, ...] = ()

    async def open(self) -> None:
        """Look into the folder, which may come later; the pictures that are there first are none of this stand's."""
        if self._worker is None:
            self._worker = WorkerThread(self.name, self._clock)
        self._latest_ns = self._clock.now_ns()
        listed = await self._worker.call(self._list_pictures)
        if not isinstance(listed, str):
            self._begin(listed)

    async def close(self) -> None:
        """Release the thread; may be called twice."""
        lane, self._worker = self._worker, None
        if lane is not None:
            lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """Return what the last picture says, once; STALE when it is older than stale_after_s, BAD before the first, and
        while the folder is gone (a card pulled out, a share not mounted)."""
        if self._worker is None:
            raise Unreachable(self.name, "not open")
        listed = await self._worker.call(self._list_pictures)
        now_ns = self._clock.now_ns()
        self._report_folder(listed if isinstance(listed, str) else "", now_ns)
        if isinstance(listed, str):
            before, self._last = self._last, self._make_bad_readings(listed, now_ns)
            return () if [each.reason for each in before] == [each.reason for each in self._last] else self._last
        if self._files is None:
            self._begin(listed)
        for name in self._select_settled(listed, now_ns):
            for item in await self._worker.call(self._take_picture, name, now_ns):
                self._publish(item)
        self._report_age(now_ns)
        before, self._last = self._last, self._get_readings(now_ns)
        return () if before == self._last else self._last

    def _get_readings(self, now_ns: int) -> tuple[Reading, ...]:
        if not self._latest:
            if self._last and all(reading.reason == _NONE_YET for reading in self._last):
                return self._last
            return self._make_bad_readings(_NONE_YET, now_ns)
        if not self._is_stale:
            return self._latest
        reason = f"no picture for {self._settings.stale_after_s / 60:g} min"
        return tuple(
            reading
            if reading.quality is Quality.BAD
            else Reading(reading.channel, reading.value, reading.unit, reading.time_ns, Quality.STALE, reason)
            for reading in self._latest
        )

    def _make_bad_readings(self, reason: str, now_ns: int) -> tuple[Reading, ...]:
        channels = _channels_of(self._settings)
        return tuple(bad_reading(f"{self.name}.{each.name}", each.unit, now_ns, reason) for each in channels)

    def _begin(self, listed: dict[str, _FileStamp]) -> None:
        self._files = {name: _SeenFile(stamp, 0, 0, settled=True) for name, stamp in listed.items()}

    def _report_folder(self, lost: str, now_ns: int) -> None:
        """An event when the folder is lost, or is there again."""
        if lost and not self._lost:
            self._publish(PICTURES_LOST.at(now_ns, device=self.name, reason=lost))
        elif self._lost and not lost:
            self._publish(PICTURES_BACK.at(now_ns, device=self.name))
        self._lost = lost

    def _select_settled(self, listed: dict[str, _FileStamp], now_ns: int) -> list[str]:
        """The files that have not changed for settled_s, in order of their names."""
        self._files = {name: seen for name, seen in (self._files or {}).items() if name in listed}
        for name, stamp in listed.items():
            seen = self._files.get(name)
            if seen is None:
                self._files[name] = _SeenFile(stamp, now_ns, now_ns)
            elif seen.stamp != stamp:
                self._files[name] = _SeenFile(stamp, seen.first_ns if not seen.settled else now_ns, now_ns)
        settled_ns = to_ns(self._settings.settled_s)
        due = [name for name, seen in self._files.items() if not seen.settled and now_ns - seen.since_ns >= settled_ns]
        return sorted(due)[:_MOST_AT_ONCE]

    def _report_age(self, now_ns: int) -> None:
        is_stale = now_ns - self._latest_ns > to_ns(self._settings.stale_after_s)
        if is_stale and not self._is_stale:
            minutes = self._settings.stale_after_s / 60
            self._publish(NO_PICTURE.at(self._clock.now_ns(), device=self.name, minutes=minutes))
        self._is_stale = is_stale

    # Below: in the lane's thread.

    def _list_pictures(self) -> dict[str, _FileStamp] | str:
        """The pictures in the folder by name; why there are none."""
        listed: dict[str, _FileStamp] = {}
        try:
            with os.scandir(self._settings.folder) as entries:
                for entry in entries:
                    if not entry.name.lower().endswith(_SUFFIXES) or not entry.name.isprintable():
                        continue
                    try:
                        found = entry.stat()
                    except OSError:
                        continue  # gone since
                    if stat.S_ISREG(found.st_mode):
                        listed[entry.name] = _FileStamp(found.st_size, found.st_mtime_ns)
        except OSError as error:
            return f"{self._settings.folder} cannot be listed ({error.strerror}); is it mounted?"
        return listed

    def _take_picture(self, name: str, now_ns: int) -> list[Item]:
        """Return what a settled file gives: a picture and what was found, or why not; nothing while it may still
        grow."""
        seen = (self._files or {})[name]
        try:
            data = self._content(name)
            if not is_whole(data):
                if now_ns - seen.since_ns < to_ns(self._settings.incomplete_s):
                    return []
                raise NotRadiometric(f"its end is missing, and nothing was added for {self._settings.incomplete_s:g} s")
            seen.settled = True
            digest = hashlib.sha256(data).hexdigest()
            if digest in self._hashes:
                return []
            image = parse(data)
            wanted = self._settings.serial_number
            if wanted is not None and image.serial_number != wanted:
                raise NotRadiometric(f"it is of imager {image.serial_number or 'without number'}, not of {wanted}")
        except OSError:
            return []  # not readable now; it is asked again
        except NotRadiometric as error:
            seen.settled = True  # until it changes
            return [PICTURE_LEFT_OUT.at(now_ns, device=self.name, file=name, reason=str(error))]
        self._hashes[digest] = name
        while len(self._hashes) > _KNOWN_HASHES:
            del self._hashes[next(iter(self._hashes))]
        clock_events = self._follow_clock(image.camera_s, seen.first_ns, now_ns) if image.camera_s > 0 else []
        taken = self._store_readings(name, digest, image, seen.first_ns, now_ns)
        return [Original(now_ns, self.name, name, data), *clock_events, taken]

    def _content(self, name: str) -> bytes:
        with (self._settings.folder / name).open("rb") as file:
            data = file.read(_LARGEST_BYTES + 1)
        if len(data) > _LARGEST_BYTES:
            raise NotRadiometric(f"it has more than {_LARGEST_BYTES} bytes")
        return data

    def _follow_clock(self, camera_s: float, first_ns: int, now_ns: int) -> list[Item]:
        """The offset with this picture. Old pictures that are copied here come late, too; two that were found as far
        apart as they were taken are new ones of a clock that was set back, which is an event."""
        lag_s = first_ns / NS_PER_S - camera_s
        if lag_s <= self._offset_s + _SET_BACK_S:
            self._offset_s, self._late = min(self._offset_s, lag_s), None
            return []
        apart_s = 2 * self._settings.poll_s + 1.0
        # One late picture may be an old one that somebody copied into the folder; only two in a row show a clock set
        # back.
        if self._late is None or abs(lag_s - self._late[1]) > apart_s:
            self._late = first_ns, lag_s
        if first_ns - self._late[0] <= to_ns(apart_s):
            return []
        by_s, self._offset_s, self._late = round(lag_s - self._offset_s), min(lag_s, self._late[1]), None
        return [CLOCK_SET_BACK.at(now_ns, device=self.name, by_s=by_s)]

    def _store_readings(self, name: str, digest: str, image: RadiometricImage, first_ns: int, now_ns: int) -> Event:
        """Keep its readings, and say what they were made of."""
        vendor, _, model = image.model.partition(" ")
        self.identity = Identity(vendor, model, image.serial_number, image.software)
        time_ns = first_ns
        if image.camera_s > 0:
            time_ns = min(now_ns, to_ns(image.camera_s + self._offset_s))
        readings = [*self._spots(image, time_ns), self._offset(time_ns)]
        if time_ns >= self._latest_ns or not self._latest:
            self._latest, self._latest_ns, self._is_stale = tuple(readings), max(time_ns, self._latest_ns), False
        around = image.around
        plain = compute_temperatures_degC(image.counts, image.planck, around, image.emissivity)
        data: dict[str, object] = {
            "device": self.name,
            "file": name,
            "sha256": digest,
            "model": image.model,
            "serial_number": image.serial_number,
            "camera_s": image.camera_s,
            "found_ns": first_ns,
            "emissivity_of_imager": image.emissivity,
            "emissivity": {spot: settings.emissivity for spot, settings in self._settings.spots.items()},
            "distance_m": around.air.distance_m,
            "reflected_K": around.reflected_K,
            "atmosphere_K": around.air.temperature_K,
            "humidity": around.air.humidity,
            "window_K": around.window_K,
            "window_transmission": around.window_transmission,
        }
        if np.isfinite(plain).any():
            data |= {"lowest_degC": float(np.nanmin(plain)), "highest_degC": float(np.nanmax(plain))}
        return PICTURE_TAKEN.at(now_ns, **data)

    def _spots(self, image: RadiometricImage, time_ns: int) -> Iterator[Reading]:
        height, width = image.counts.shape
        for spot, settings in self._settings.spots.items():
            channel = f"{self.name}.{spot}"
            mean_degC = measure_spot_degC(image, settings)
            if mean_degC is None:
                x, y = locate_spot(image, settings)
                yield bad_reading(channel, "degC", time_ns, f"({x}, {y}) is not within the {width} x {height} px")
            elif math.isfinite(mean_degC):
                yield Reading(channel, mean_degC, "degC", time_ns)
            else:
                yield bad_reading(channel, "degC", time_ns, "the counts there are of no temperature")

    def _offset(self, time_ns: int) -> Reading:
        channel = f"{self.name}.clock_offset"
        if math.isinf(self._offset_s):
            return bad_reading(channel, "s", time_ns, "its pictures have no time")
        return Reading(channel, self._offset_s, "s", time_ns)


def _make(name: str, settings: ThermalImagerSettings, around: DriverContext) -> ThermalImager:
    return ThermalImager(name, settings, around.clock, around.publish)


def check_folder(settings: ThermalImagerSettings) -> Finding:
    """Blocking: it reads a folder, and one picture."""
    folder = settings.folder
    try:
        newest = max(
            (file for file in folder.iterdir() if file.suffix.lower() in _SUFFIXES),
            key=lambda file: file.stat().st_mtime_ns,
            default=None,
        )
        data = None if newest is None else newest.read_bytes()
    except OSError as error:
        to_do = "is its card or the share mounted at imager.folder, and may this user read it?"
        return Finding("imager", "link", "failed", f"{folder} cannot be read ({error.strerror})", to_do)
    if newest is None or data is None:
        text = f"{folder} is there, with no picture in it"
        return Finding("imager", "reading", "unverified", text, "take one and check again: a run waits for the first")
    try:
        image = parse(data)
    except NotRadiometric as error:
        text = f"the newest picture, {newest.name}, has no temperatures: {error}"
        return Finding("imager", "reading", "failed", text, "set the imager to radiometric JPEG")
    return _describe_picture(settings, newest, image)


def _describe_picture(settings: ThermalImagerSettings, file: Path, image: RadiometricImage) -> Finding:
    which = f"{image.model}, serial number {image.serial_number}"
    if settings.serial_number not in (None, image.serial_number):
        text = f"the newest picture, {file.name}, is of a {which}, expected {settings.serial_number}"
        return Finding("imager", "identity", "failed", text, "compare imager.serial_number with the imager's label")
    height, width = image.counts.shape
    seen: dict[str, object] = {}
    for name, spot in settings.spots.items():
        mean_degC = measure_spot_degC(image, spot)
        if mean_degC is None:
            x, y = locate_spot(image, spot)
            text = f"the 3 x 3 px of the spot {name} at {x}, {y} px are not within its {width} x {height} px"
            return Finding("imager", "settings", "failed", text, f"correct imager.spots.{name}")
        seen[name] = round(mean_degC, 1)
    texts = ", ".join(f"{name} {degC} degC" for name, degC in seen.items())
    return Finding("imager", "reading", "ok", f"{which}; its newest picture, {file.name}, shows {texts}", data=seen)


async def _check(look: DeviceCheck) -> None:
    """Check, without opening it, what its folder has, and what the newest picture shows."""
    look.add(await asyncio.to_thread(check_folder, look.settings))


def _channels_of(settings: ThermalImagerSettings) -> tuple[Channel, ...]:
    """Each spot, and how far its clock is off."""
    return (*(Channel(spot, "degC", "temperature") for spot in settings.spots), Channel("clock_offset", "s", "time"))


KIND = DeviceKind(
    name="imager",
    settings=ThermalImagerSettings,
    make=_make,
    channels=lambda imager, of_section, map_of: _channels_of(imager),
    section="imager",
    device="imager",
    rank=60,
    address_key="folder",
    check=_check,
)
