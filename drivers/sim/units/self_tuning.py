"""What an E5CC does while it tunes itself: a limit cycle about the set point, and the constants that come of it.

The manual describes the cycle (100 or 40 % of the outputs, about the set point) and that the constants are stored at
its end. It says neither the formula nor the hysteresis: here those of Ziegler and Nichols, and 0.2 K.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

HYSTERESIS_K = 0.2
SWITCHINGS = 6  # the first swing is not yet periodic: two periods after it


@dataclass(frozen=True, slots=True)
class Cycle:
    """Where the limit cycle is: whether it heats, when it switched, and the lowest and highest PV - SP since."""

    heats: bool
    switched_s: tuple[float, ...] = ()
    extremes_K: tuple[float, ...] = ()
    extreme_K: float = 0.0

    @property
    def is_over(self) -> bool:
        """Whether it has shown enough."""
        return len(self.switched_s) >= SWITCHINGS


class Constants(NamedTuple):
    """Band in K for 100 % of the heat, times in s."""

    band_K: float
    integral_s: float
    derivative_s: float


def begin(error_K: float) -> Cycle:
    """At a PV that is error_K above the set point."""
    return Cycle(heats=error_K < 0, extreme_K=error_K)


def step(cycle: Cycle, error_K: float, time_s: float) -> Cycle:
    """After a while at this PV - SP."""
    extreme_K = (min if cycle.heats else max)(cycle.extreme_K, error_K)
    switches = error_K > HYSTERESIS_K if cycle.heats else error_K < -HYSTERESIS_K
    if not switches:
        return replace(cycle, extreme_K=extreme_K)
    return Cycle(not cycle.heats, (*cycle.switched_s, time_s), (*cycle.extremes_K, extreme_K), error_K)


def constants(cycle: Cycle, swing_percent: float) -> Constants:
    """Of a cycle that is over, whose output went that far from one end to the other."""
    period_s = (cycle.switched_s[-1] - cycle.switched_s[-5]) / 2
    amplitude_K = (max(cycle.extremes_K[-4:]) - min(cycle.extremes_K[-4:])) / 2
    effective_K = math.sqrt(max(amplitude_K**2 - HYSTERESIS_K**2, 1e-4))
    ultimate_percent_per_K = 2 * swing_percent / (math.pi * effective_K)
    return Constants(100 / (0.6 * ultimate_percent_per_K), period_s / 2, period_s / 8)
