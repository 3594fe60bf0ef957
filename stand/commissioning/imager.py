"""The thermal imager's folder: whether it is there, and what the newest picture in it is and shows."""

from __future__ import annotations

from pathlib import Path

from thermostand.drivers.devices.imager.radiometric_jpeg import NotRadiometric, RadiometricImage, parse
from thermostand.drivers.devices.imager.thermal_imager import ThermalImagerSettings, place_of, spot_degC
from thermostand.stand.commissioning.finding import Finding

_NAME = "imager"
_PICTURES = {".jpg", ".jpeg"}


def imager_finding(settings: ThermalImagerSettings) -> Finding:
    """Blocking: it reads a folder, and one picture."""
    folder = settings.folder
    try:
        newest = max(
            (file for file in folder.iterdir() if file.suffix.lower() in _PICTURES),
            key=lambda file: file.stat().st_mtime_ns,
            default=None,
        )
        data = None if newest is None else newest.read_bytes()
    except OSError as error:
        to_do = "is its card or the share mounted at imager.folder, and may this user read it?"
        return Finding(_NAME, "link", "failed", f"{folder} cannot be read ({error.strerror})", to_do)
    if newest is None or data is None:
        text = f"{folder} is there, with no picture in it"
        return Finding(_NAME, "reading", "unverified", text, "take one and check again: a run waits for the first")
    try:
        image = parse(data)
    except NotRadiometric as error:
        text = f"the newest picture, {newest.name}, has no temperatures: {error}"
        return Finding(_NAME, "reading", "failed", text, "set the imager to radiometric JPEG")
    return _of_picture(settings, newest, image)


def _of_picture(settings: ThermalImagerSettings, file: Path, image: RadiometricImage) -> Finding:
    which = f"{image.model}, serial number {image.serial_number}"
    if settings.serial_number not in (None, image.serial_number):
        text = f"the newest picture, {file.name}, is of a {which}, expected {settings.serial_number}"
        return Finding(_NAME, "identity", "failed", text, "compare imager.serial_number with the imager's label")
    height, width = image.counts.shape
    seen: dict[str, object] = {}
    for name, spot in settings.spots.items():
        mean_degC = spot_degC(image, spot)
        if mean_degC is None:
            x, y = place_of(image, spot)
            text = f"the 3 x 3 px of the spot {name} at {x}, {y} px are not within its {width} x {height} px"
            return Finding(_NAME, "settings", "failed", text, f"correct imager.spots.{name}")
        seen[name] = round(mean_degC, 1)
    texts = ", ".join(f"{name} {degC} degC" for name, degC in seen.items())
    return Finding(_NAME, "reading", "ok", f"{which}; its newest picture, {file.name}, shows {texts}", data=seen)
