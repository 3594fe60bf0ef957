"""The guard's rules that need a memory: is what the chamber does what heat, or none, can do?

Each is a pure step, (memory, readings, time) -> (memory, fault), and `make_stateful_rule` makes a rule of it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import guard_rule
from thermostand.foundation.readings import Reading
from thermostand.stand.config.guard_section import CoolingConfig, HeaterOffConfig
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value, is_suspect

WARMING_WHILE_OFF = guard_rule("warming_while_off", "the air warms though nothing heats")
COOLING_IN_VAIN = guard_rule("cooling_in_vain", "cold is given and the air does not cool")
# Five lags of the element; half of it leaves 9 % of its heat.
_OFF_SETTLE_S, _ABOVE_SURROUNDINGS_K = 120.0, 5.0
"""So long after the heat went off its element, lag 25 s, and the walls may still warm the air; so far above all that
surrounds it, nothing but heat keeps it."""
_MARGIN_K = 2.0  # above its surroundings: nearer, what is warm around may balance the cold
RuleState = TypeVar("RuleState")

# What could warm the air other than its heater: the laboratory and the granite inside, as far as they are measured; a
# granite without a thermometer by the air that it follows.
WarmAround = Callable[[Readings, int], tuple[float, ...]]  # degC at an instant, NaN what is not known


def read_channels(*channels: str) -> WarmAround:
    """Return what these channels read."""
    return lambda readings, now_ns: tuple(get_value(readings, channel) for channel in channels)


class FollowingBody:
    """A body that follows `air` with a lag. It begins as warm as the air may have been before anybody looked, so that
    an error of the begin excuses too much and never too little; unknown air leaves it as it is."""

    # An error of the begin excuses too much for about two hours; it never trips a good session.
    def __init__(self, air: str, lag_s: float, warmest_degC: float) -> None:
        self._air = air
        self._lag_s = lag_s
        self._degC = warmest_degC
        self._looked_ns: int | None = None

    def __call__(self, readings: Readings, now_ns: int) -> tuple[float, ...]:
        """Return where the body has come to by now, as WarmAround does."""
        air_degC, before_ns = get_value(readings, self._air), self._looked_ns
        self._looked_ns = now_ns
        if before_ns is not None and not math.isnan(air_degC):
            share = 1.0 - math.exp(-max(0, now_ns - before_ns) / NS_PER_S / self._lag_s)
            self._degC += share * (air_degC - self._degC)
        return (self._degC,)


def combine_surroundings(*each: WarmAround) -> WarmAround:
    """All of them."""
    return lambda readings, now_ns: tuple(value for one in each for value in one(readings, now_ns))


def make_stateful_rule(
    step: Callable[[RuleState | None, Readings, int], tuple[RuleState | None, Fault | None]],
) -> Rule:
    """A rule that hands each step's memory to the next; it begins with None."""
    memory: RuleState | None = None

    def rule(readings: Readings, now_ns: int) -> Fault | None:
        nonlocal memory
        memory, fault = step(memory, readings, now_ns)
        return fault

    return rule


class Scatter:
    """How far apart single readings of a channel may be though what it measures does not move: twice the largest second
    difference of its last dozen readings, which is 0.2 K at full heat and 9 K with a noise of 1 K."""

    def __init__(self, channel: str) -> None:
        self._channel = channel
        self._seen: Reading | None = None
        self._values: deque[float] = deque(maxlen=14)

    def most_K(self, readings: Readings) -> float:
        """Take one more look; return twice the largest second difference of the last readings, K."""
        reading = readings.known(self._channel)
        if reading is not None and reading is not self._seen and not math.isnan(reading.value):
            self._seen = reading
            self._values.append(reading.value)
        last = list(self._values)
        return 2 * max((abs(c - 2 * b + a) for a, b, c in zip(last, last[1:], last[2:], strict=False)), default=0.0)


@dataclass(frozen=True, slots=True)
class HeatOff:
    """Heat is off since `since_ns`; the lowest air, as `channel` shows it, since it settled, None until then."""

    since_ns: int
    channel: str
    lowest_degC: float | None = None


def forbid_warming_while_off(
    limits: HeaterOffConfig, air: str, regulator: str, permit: str, surroundings: WarmAround
) -> Rule:
    """The air rises though the regulator's output is 0 or the permit is off: a welded relay or a shorted SSR.

    The heater's power cannot be seen. What else can warm the air, the laboratory and what was warm before, cannot bring
    it above itself: so it must have risen, above the set-point, and above the warmest of `surroundings` that is known.
    """
    mv_heat, set_point, running = (f"{regulator}.{quantity}" for quantity in ("mv_heat", "sp", "running"))
    scatter = {channel: Scatter(channel) for channel in (air, f"{regulator}.pv")}

    def is_heat(readings: Readings, air_degC: float, around_degC: tuple[float, ...]) -> bool:
        if get_value(readings, running) == 1 and air_degC <= get_value(readings, set_point):
            return False
        known = [air_degC - degC for degC in around_degC if not math.isnan(degC)]
        return bool(known) and min(known) > _ABOVE_SURROUNDINGS_K

    def step(last: HeatOff | None, readings: Readings, now_ns: int) -> tuple[HeatOff | None, Fault | None]:
        around_degC = surroundings(readings, now_ns)  # at each look, for one that follows the air
        scatters_K = {channel: each.most_K(readings) for channel, each in scatter.items()}
        if not (get_value(readings, mv_heat) <= 0 or get_value(readings, permit) == 0):
            return None, None
        channel = next((each for each in scatter if not is_suspect(readings, each)), air)
        air_degC = get_value(readings, channel)
        if last is None or last.channel != channel:
            return HeatOff(now_ns, channel), None
        if math.isnan(air_degC) or now_ns - last.since_ns < to_ns(_OFF_SETTLE_S):
            return last, None
        lowest_degC = air_degC if last.lowest_degC is None else min(last.lowest_degC, air_degC)
        state = HeatOff(last.since_ns, channel, lowest_degC)
        if air_degC - lowest_degC >= limits.rise_K + scatters_K[channel] and is_heat(readings, air_degC, around_degC):
            text = f"{channel} has risen from {lowest_degC:.2f} to {air_degC:.2f} degC with the heater off"
            return state, Fault(WARMING_WHILE_OFF, text)
        return state, None

    return make_stateful_rule(step)


@dataclass(frozen=True, slots=True)
class CompressorRun:
    """The compressor has run without heat since `since_ns`, when the air was at these, as both probes show it."""

    since_ns: int
    air_degC: tuple[float, float]


def require_cooling_response(
    limits: CoolingConfig, air: str, regulator: str, compressor: str, surroundings: WarmAround
) -> Rule:
    """The compressor runs, the regulator's heating output is 0, and yet the air, which nothing around it warms, does
    not fall: a welded relay that heats as much as is cooled, or a compressor that does not cool. The two look alike.

    Below its surroundings the chamber may need all its cold to stay where it is, and no judgement is possible.
    """
    mv_heat = f"{regulator}.mv_heat"

    def step(last: CompressorRun | None, readings: Readings, now_ns: int) -> tuple[CompressorRun | None, Fault | None]:
        air_degC, around_degC = get_value(readings, air), surroundings(readings, now_ns)
        is_alone = all(degC < air_degC - _MARGIN_K for degC in around_degC)
        cools = get_value(readings, compressor) == 1 and get_value(readings, mv_heat) <= 0
        if not (cools and is_alone):
            return None, None
        both_degC = (air_degC, get_value(readings, f"{regulator}.pv"))
        if last is None or any(
            now <= before - limits.fall_K for now, before in zip(both_degC, last.air_degC, strict=True)
        ):
            return CompressorRun(now_ns, both_degC), None
        if now_ns - last.since_ns < to_ns(limits.window_s):
            return last, None
        text = (
            f"{air} stays at {air_degC:.2f} degC though the compressor has run for {limits.window_s:g} s without heat"
        )
        return last, Fault(COOLING_IN_VAIN, text)

    return make_stateful_rule(step)
