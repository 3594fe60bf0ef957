"""Checked before the first step: the camera's own temperature, without which no frame is of use."""

from __future__ import annotations

from thermostand.drivers.devices.protocols import Camera
from thermostand.foundation.clock import Clock, seconds_ns
from thermostand.foundation.errors import Refused
from thermostand.foundation.events import NO_CAMERA_TEMPERATURE
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import Quality

_TRIES, _PAUSE_S = 3, 1.0


async def check_temperature(camera: Camera, hub: Hub, clock: Clock) -> None:
    """The camera, which is open, shows its temperature, or is configured to have none, which is reported.

    Refused, with the feature and what the camera offers, when three readings in a row are BAD.
    """
    if not camera.settings.has_temperature:
        hub.publish(NO_CAMERA_TEMPERATURE.at(clock.now_ns()))
        return
    (reading,) = await camera.read()
    for _ in range(_TRIES - 1):
        if reading.quality is not Quality.BAD:
            return
        await clock.sleep_until(clock.now_ns() + seconds_ns(_PAUSE_S))
        (reading,) = await camera.read()
    if reading.quality is Quality.BAD:
        place = await camera.temperature_place()
        keys = f"cameras.{camera.name}"
        remedy = f"correct {keys}.temperature in the configuration, or say {keys}.has_temperature: false there"
        where = f" ({place})" if place else ""
        raise Refused(camera.name, f"its temperature is BAD before the first step: {reading.reason}{where}; {remedy}")
