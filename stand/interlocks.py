"""The guard's rules: pure functions of the latest readings and the time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from drivers.clock import NS_PER_S
from drivers.interface import Quality, Reading

Latest = Callable[[str], Reading | None]
Rule = Callable[[Latest, int], "Fault | None"]


@dataclass(frozen=True, slots=True)
class Fault:
    """Why the stand must be made safe."""

    rule: str
    text: str


def over_temperature(channel: str, max_degC: float) -> Rule:
    """`channel` reads above `max_degC`; a BAD or missing value is another rule's business."""

    def rule(latest: Latest, now_ns: int) -> Fault | None:
        reading = latest(channel)
        if reading is not None and reading.value > max_degC:
            return Fault(
                "over_temperature", f"{channel} is {reading.value:.2f} degC, above the limit of {max_degC} degC"
            )
        return None

    return rule


def trustworthy(channel: str, stale_after_s: float) -> Rule:
    """`channel` is BAD, STALE, older than `stale_after_s`, or was never read."""

    def rule(latest: Latest, now_ns: int) -> Fault | None:
        reading = latest(channel)
        if reading is None:
            return Fault("sensor_missing", f"{channel} has never been read")
        if reading.quality is Quality.BAD:
            return Fault("sensor_bad", f"{channel} is BAD: {reading.reason}")
        age_s = (now_ns - reading.time_ns) / NS_PER_S
        if age_s > stale_after_s:
            return Fault("sensor_stale", f"{channel} was last read {age_s:.1f} s ago, limit {stale_after_s} s")
        return None

    return rule


def safety_rules(max_degC: Mapping[str, float], trusted: tuple[str, ...], stale_after_s: float) -> tuple[Rule, ...]:
    """Over-temperature for each channel of `max_degC`, and trust in each channel of `trusted`."""
    hot = tuple(over_temperature(channel, limit) for channel, limit in max_degC.items())
    return hot + tuple(trustworthy(channel, stale_after_s) for channel in trusted)


def first_fault(rules: tuple[Rule, ...], latest: Latest, now_ns: int) -> Fault | None:
    """The first rule that objects."""
    return next((fault for rule in rules if (fault := rule(latest, now_ns)) is not None), None)
