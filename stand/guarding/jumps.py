"""A temperature that goes further from one reading to the next than any air or stone can."""

from __future__ import annotations

from dataclasses import dataclass

from foundation.clock import NS_PER_S, seconds_ns
from foundation.readings import Quality
from stand.fault import Fault, Readings
from stand.guarding.interlocks import Rule
from stand.guarding.plausibility import remembering


@dataclass(frozen=True, slots=True)
class _Seen:
    """The last GOOD reading, and what was to be said of it."""

    value: float
    time_ns: int
    fault: Fault | None = None


def jumped(channel: str, jump_K: float, within_s: float) -> Rule:
    """`channel` went by more than `jump_K` from one GOOD reading to the next, at most `within_s` later; objects until
    the reading after that one."""

    def step(last: _Seen | None, readings: Readings, now_ns: int) -> tuple[_Seen | None, Fault | None]:
        reading = readings.latest(channel)
        if reading is None or reading.quality is not Quality.GOOD:
            return last, None
        if last is None or not 0 < reading.time_ns - last.time_ns <= seconds_ns(within_s):
            fault = last.fault if last is not None and reading.time_ns == last.time_ns else None
            return _Seen(reading.value, reading.time_ns, fault), fault
        fault, went_K = None, reading.value - last.value
        if abs(went_K) > jump_K:
            after_s = (reading.time_ns - last.time_ns) / NS_PER_S
            went = f"{channel} went by {went_K:+.2f} K within {after_s:.3g} s, to {reading.value:.2f} degC"
            text = f"{went}: look at its cable"
            fault = Fault("sensor_jumped", text)
        return _Seen(reading.value, reading.time_ns, fault), fault

    return remembering(step)
