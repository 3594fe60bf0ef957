"""Where a camera shows its own temperature, and reading it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermostand.drivers.framing.aravis_library import AravisError
from thermostand.drivers.wires.aravis import GigeDevice
from thermostand.drivers.wires.camera_errors import is_silence
from thermostand.drivers.wires.camera_settings import TemperatureFeature
from thermostand.drivers.wires.genicam_feature_names import TEMPERATURE_ENTRIES, TEMPERATURES
from thermostand.foundation.readings import Cause

VERSION = 0x0000  # the bootstrap register that each camera has (GigE Vision 1.2, section 28)


@dataclass(frozen=True, slots=True)
class NoTemperature:
    """Why a camera's temperature is read nowhere. cause: "wire" when the camera did not answer for it."""

    reason: str
    cause: Cause = "device"


def find_temperature(device: GigeDevice, wanted: TemperatureFeature | None) -> TemperatureFeature | NoTemperature:
    """The place to read the temperature from, its selector set.

    AravisError when the camera does not answer for anything: then nothing is known about it.
    """
    try:
        places = [wanted] if wanted else _list_usual_features(device)
    except AravisError as error:
        return _make_no_temperature(device, "where its temperature is", error)
    for place in places:
        try:
            if place.feature is not None and not device.available(place.feature):
                continue
            if place.selector is not None and place.entry is not None:
                device.set_string(place.selector, place.entry)  # once: selector and value are two transactions
        except AravisError as error:
            return _make_no_temperature(device, _describe_place(place), error, _describe_offered(device, place))
        return place
    names = [wanted.feature or ""] if wanted else [feature for feature, _ in TEMPERATURES]
    return NoTemperature(f"the camera has no {' and no '.join(names)}")


def _make_no_temperature(device: GigeDevice, what: str, error: AravisError, offered: str = "") -> NoTemperature:
    """The error again when it is not for these features alone that the camera does not answer."""
    text = f"{what} cannot be read ({error}){offered}"
    if not is_silence(error):
        return NoTemperature(text)
    try:
        device.read_register(VERSION)
    except AravisError:
        raise error from None
    return NoTemperature(text, "wire")


def _list_usual_features(device: GigeDevice) -> list[TemperatureFeature]:
    """The makes' features, each with the entry nearest to the sensor that this camera's selector offers."""
    places: list[TemperatureFeature] = []
    for feature, selector in TEMPERATURES:
        offered = device.entries(selector) if selector and device.available(selector) else ()
        entry = next((entry for entry in TEMPERATURE_ENTRIES if entry in offered), None)
        places.append(TemperatureFeature(feature=feature, selector=selector if entry else None, entry=entry))
    return places


def describe_place(device: GigeDevice, place: TemperatureFeature) -> str:
    """Where that is, and what the camera offers for its selector, in words."""
    return f"{_describe_place(place)}{_describe_offered(device, place)}"


def _describe_place(place: TemperatureFeature) -> str:
    if place.feature is None:
        return f"register {place.register_address or 0:#x}"
    return place.feature if place.selector is None else f"{place.feature} of {place.selector} {place.entry!r}"


def _describe_offered(device: GigeDevice, place: TemperatureFeature) -> str:
    """What the camera offers for the selector, as the end of a sentence; "" when there is none, or it does not say."""
    try:
        entries = device.entries(place.selector) if place.selector is not None else ()
    except AravisError:
        return ""
    return f"; for {place.selector} the camera offers {', '.join(entries)}" if entries else ""


def read_temperature(device: GigeDevice, place: TemperatureFeature) -> tuple[float, str, Cause]:
    """Temperature in degC and ""; or NaN, the reason and its cause. Never raises: a run continues without it."""
    try:
        if place.register_address is not None:
            value_degC = (device.read_register(place.register_address) & place.mask) * place.scale + place.offset
        else:
            value_degC = device.get_number(place.feature or "")
    except AravisError as error:
        return math.nan, str(error), "wire" if is_silence(error) else "device"
    if value_degC == 0.0:  # what a faulty firmware shows; a sensor next to its own electronics is warmer
        return math.nan, "the camera shows exactly 0 degC", "device"
    if not place.min_degC <= value_degC <= place.max_degC:
        return math.nan, f"{value_degC:g} degC is outside {place.min_degC:g}..{place.max_degC:g}", "device"
    return value_degC, "", ""
