"""Estimates an unpowered camera's temperature from its last reading and a time constant."""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.events import COOL_DOWN_UNSURE, COOLED_DOWN
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import Quality, Reading

_LOOK_S = 10.0  # round number; nothing was measured


@dataclass(frozen=True, slots=True)
class CameraTemperature:
    """The camera's temperature, degC, at an instant (ns)."""

    camera_degC: float
    time_ns: int

    def after(self, time_ns: int, air_degC: float, time_constant_s: float) -> CameraTemperature:
        """Return the temperature at `time_ns`, when the air has been at `air_degC` meanwhile: the excess over it has
        decayed exponentially."""
        decayed = math.exp(-(time_ns - self.time_ns) / NS_PER_S / time_constant_s)
        return CameraTemperature(air_degC + (self.camera_degC - air_degC) * decayed, time_ns)


def get_last_temperature(reading: Reading | None) -> CameraTemperature | None:
    """The last temperature of a camera that is about to be switched off; None when it gave none."""
    if reading is None or reading.quality is not Quality.GOOD:
        return None
    return CameraTemperature(reading.value, reading.time_ns)


async def cool_down(
    cooling: CameraTemperature | None, band_K: float, time_constant_s: float, max_s: float, hub: Hub, clock: Clock
) -> None:
    """Wait until the camera is within `band_K` of the air near it, or `max_s` is over.

    `cooling` is the camera's temperature when it was switched off; without one all of `max_s` is waited for. The events
    "cooled_down" and "cool_down_unsure" (a warning) say how it ended.
    """
    begin_ns = clock.now_ns()
    deadline_ns = begin_ns + to_ns(max_s)
    if cooling is None:
        await clock.sleep_until(deadline_ns)
        text = f"the camera gave no temperature before it was switched off; waited {max_s:g} s"
        hub.publish(COOL_DOWN_UNSURE.at(clock.now_ns(), text))
        return
    while True:
        now_ns, air = clock.now_ns(), hub.latest("thermometers.air")
        excess_K = math.inf
        if air is not None and air.quality is Quality.GOOD:
            cooling = cooling.after(now_ns, air.value, time_constant_s)
            excess_K = cooling.camera_degC - air.value
        if abs(excess_K) <= band_K or now_ns >= deadline_ns:
            break
        await clock.sleep_until(min(deadline_ns, now_ns + to_ns(_LOOK_S)))
    waited_s = (now_ns - begin_ns) / NS_PER_S
    if abs(excess_K) <= band_K:
        hub.publish(COOLED_DOWN.at(now_ns, waited_s=waited_s, excess_K=excess_K, band_K=band_K))
        return
    found = f"after {waited_s:.0f} s the camera should be {excess_K:+.2f} K from the air"
    if math.isinf(excess_K):
        found = "the air near the camera is not measured"
    hub.publish(COOL_DOWN_UNSURE.at(now_ns, f"{found}; continuing outside {band_K:g} K"))
