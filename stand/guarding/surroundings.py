"""What could warm the chamber's air other than its heater: the laboratory and the granite inside, as far as they are
measured; a granite without a thermometer by the air that it follows."""

from __future__ import annotations

import math
from collections.abc import Callable

from thermostand.foundation.clock import NS_PER_S
from thermostand.stand.fault import Readings, value_of

Surroundings = Callable[[Readings, int], tuple[float, ...]]  # degC at an instant, NaN what is not known


def measured(*channels: str) -> Surroundings:
    """What these channels read."""
    return lambda readings, now_ns: tuple(value_of(readings, channel) for channel in channels)


class Following:
    """A body that follows `air` with a lag. It begins as warm as the air may have been before anybody looked, so that
    an error of the begin excuses too much and never too little; unknown air leaves it as it is."""

    def __init__(self, air: str, lag_s: float, warmest_degC: float) -> None:
        self._air = air
        self._lag_s = lag_s
        self._degC = warmest_degC
        self._looked_ns: int | None = None

    def __call__(self, readings: Readings, now_ns: int) -> tuple[float, ...]:
        """As Surroundings: where it has come to by now."""
        air_degC, before_ns = value_of(readings, self._air), self._looked_ns
        self._looked_ns = now_ns
        if before_ns is not None and not math.isnan(air_degC):
            share = 1.0 - math.exp(-max(0, now_ns - before_ns) / NS_PER_S / self._lag_s)
            self._degC += share * (air_degC - self._degC)
        return (self._degC,)


def together(*each: Surroundings) -> Surroundings:
    """All of them."""
    return lambda readings, now_ns: tuple(value for one in each for value in one(readings, now_ns))
