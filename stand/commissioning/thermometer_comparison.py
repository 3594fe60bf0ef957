"""Thermometers against each other: in a chamber that has been at rest overnight they all show the same."""

from __future__ import annotations

import statistics

from thermostand.drivers.devices.protocols import Controller, Sensor
from thermostand.foundation.clock import Clock, seconds_ns
from thermostand.foundation.errors import DeviceError
from thermostand.foundation.readings import Quality
from thermostand.stand.commissioning.finding import Finding

_LOOKS, _PERIOD_S = 5, 0.3


async def each_other(thermometers: Sensor, regulator: Controller | None, warn_K: float, clock: Clock) -> Finding:
    """How far each is from the median of all, the regulator's own value among them; a warning beyond `warn_K`."""
    seen: dict[str, list[float]] = {}
    try:
        for _ in range(_LOOKS):
            readings = [*await thermometers.read(), *(await regulator.read() if regulator is not None else ())]
            for reading in readings:
                device, _, name = reading.channel.partition(".")
                is_pv = device != thermometers.name
                if reading.unit == "degC" and reading.quality is Quality.GOOD and (not is_pv or name == "pv"):
                    seen.setdefault(f"{device} {name}" if is_pv else name, []).append(reading.value)
            await clock.sleep_until(clock.now_ns() + seconds_ns(_PERIOD_S))
    except DeviceError as error:
        return Finding(thermometers.name, "each other", "failed", error.text, "check again once it answers")
    if len(seen) < 2:
        text = "fewer than two of them read, so nothing can be compared"
        return Finding(thermometers.name, "each other", "unverified", text)
    means = {name: statistics.fmean(values) for name, values in seen.items()}
    median_degC = statistics.median(means.values())
    apart_K = {name: mean_degC - median_degC for name, mean_degC in means.items()}
    data: dict[str, object] = {
        "median_degC": round(median_degC, 3),
        "apart_K": {name: round(value, 4) for name, value in apart_K.items()},
        "noise_K": {name: round(statistics.pstdev(values), 4) for name, values in seen.items()},
    }
    farthest = max(apart_K, key=lambda name: abs(apart_K[name]))
    text = f"{farthest} is {apart_K[farthest]:+.2f} K from the median of all ({median_degC:.2f} degC)"
    if abs(apart_K[farthest]) > warn_K:
        advice = "is the chamber at rest? else are two channels exchanged, or is its offset_K wrong?"
        return Finding(thermometers.name, "each other", "warning", text, advice, data)
    return Finding(thermometers.name, "each other", "ok", text, data=data)
