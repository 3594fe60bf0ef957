"""The guard's rules: pure functions of the latest readings and the time."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from drivers.clock import NS_PER_S
from drivers.interface import Quality, Reading


class Readings(Protocol):
    """What a rule may look at; the hub is one."""

    def latest(self, channel: str) -> Reading | None:
        """The last reading, whatever its quality."""
        ...

    def last_good_ns(self, channel: str) -> int | None:
        """When the channel last gave a GOOD reading."""
        ...


Rule = Callable[[Readings, int], "Fault | None"]


@dataclass(frozen=True, slots=True)
class Fault:
    """Why the stand must be made safe."""

    rule: str
    text: str


def over_temperature(channel: str, max_degC: float) -> Rule:
    """`channel` reads above `max_degC`; a BAD or missing value is another rule's business."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.latest(channel)
        if reading is not None and reading.value > max_degC:
            return Fault(
                "over_temperature", f"{channel} is {reading.value:.2f} degC, above the limit of {max_degC} degC"
            )
        return None

    return rule


def trustworthy(channel: str, stale_after_s: float) -> Rule:
    """`channel` was never read, is BAD, or was last GOOD more than `stale_after_s` ago: a poll or two may be STALE."""

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        reading = readings.latest(channel)
        if reading is None:
            return Fault("sensor_missing", f"{channel} has never been read")
        if reading.quality is Quality.BAD:
            return Fault("sensor_bad", f"{channel} is BAD: {reading.reason}")
        good_ns = readings.last_good_ns(channel)
        age_s = math.inf if good_ns is None else (now_ns - good_ns) / NS_PER_S
        if age_s > stale_after_s:
            return Fault("sensor_stale", f"{channel} was last good {age_s:.1f} s ago, limit {stale_after_s} s")
        return None

    return rule


def safety_rules(max_degC: Mapping[str, float], trusted: tuple[str, ...], stale_after_s: float) -> tuple[Rule, ...]:
    """Over-temperature for each channel of `max_degC`, and trust in each channel of `trusted`."""
    hot = tuple(over_temperature(channel, limit) for channel, limit in max_degC.items())
    return hot + tuple(trustworthy(channel, stale_after_s) for channel in trusted)


def first_fault(rules: tuple[Rule, ...], readings: Readings, now_ns: int) -> Fault | None:
    """The first rule that objects."""
    return next((fault for rule in rules if (fault := rule(readings, now_ns)) is not None), None)
