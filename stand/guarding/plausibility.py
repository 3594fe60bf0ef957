"""The guard's rules that need a memory: is what the chamber does what heat, or none, can do?

Each is a pure step, (memory, readings, time) -> (memory, fault), and `remembering` makes a rule of it.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

from thermostand.foundation.clock import NS_PER_S, seconds_ns
from thermostand.foundation.events import SENSOR, guard_rule
from thermostand.foundation.readings import Reading
from thermostand.stand.config.guard_section import CoolingConfig, HeaterOffConfig, HeatingConfig
from thermostand.stand.fault import Fault, Readings, in_doubt, value_of
from thermostand.stand.guarding.interlocks import Rule
from thermostand.stand.guarding.surroundings import Surroundings

HEATER_NOT_WARMING = guard_rule("heater_not_warming", "heat is given and the air does not warm")
WARMING_WHILE_OFF = guard_rule("warming_while_off", "the air warms though nothing heats")
COOLING_IN_VAIN = guard_rule("cooling_in_vain", "cold is given and the air does not cool")
SENSOR_STUCK = guard_rule("sensor_stuck", "a temperature stays exactly where it is while another moves", SENSOR)
Memory = TypeVar("Memory")


def remembering(step: Callable[[Memory | None, Readings, int], tuple[Memory | None, Fault | None]]) -> Rule:
    """A rule that hands each step's memory to the next; it begins with None."""
    memory: Memory | None = None

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
        """After one more look."""
        reading = readings.known(self._channel)
        if reading is not None and reading is not self._seen and not math.isnan(reading.value):
            self._seen = reading
            self._values.append(reading.value)
        last = list(self._values)
        return 2 * max((abs(c - 2 * b + a) for a, b, c in zip(last, last[1:], last[2:], strict=False)), default=0.0)


@dataclass(frozen=True, slots=True)
class Heating:
    """Where the check of one stretch of heating stands."""

    set_point_degC: float
    checked_ns: int
    goal_degC: float
    deadline_ns: int
    error_K_s: float = 0.0
    approaching: bool = True
    first_goal: bool = True


def heating(
    last: Heating | None, limits: HeatingConfig, set_point_degC: float, pv_degC: float, now_ns: int
) -> Heating | None:
    """The check after one more look at a heater that is on; None near the set-point, where all is well.

    Klipper's verify_heater (klippy/extras/verify_heater.py): the first goal follows a falling temperature down, each
    goal reached clears the error, a missed deadline ends the approach, and then the error decides. Unlike there, a goal
    reached late is one: a chamber's window is long.
    """
    lacking_K = set_point_degC - limits.hysteresis_K - pv_degC
    if not lacking_K > 0:
        return None
    goal_degC, deadline_ns = pv_degC + limits.gain_K, now_ns + seconds_ns(limits.window_s)
    if last is None or last.set_point_degC != set_point_degC:
        return Heating(set_point_degC, now_ns, goal_degC, deadline_ns)
    if pv_degC >= last.goal_degC:
        return Heating(set_point_degC, now_ns, goal_degC, deadline_ns, first_goal=False)
    return replace(
        last,
        checked_ns=now_ns,
        error_K_s=last.error_K_s + lacking_K * (now_ns - last.checked_ns) / NS_PER_S,
        approaching=last.approaching and now_ns < last.deadline_ns,
        goal_degC=min(last.goal_degC, goal_degC) if last.first_goal else last.goal_degC,
    )


def heater_not_warming(limits: HeatingConfig, regulator: str, permit: str) -> Rule:
    """`regulator` heats, the relay `permit` lets the heat through, and the temperature does not rise: a dead heater, an
    open thermal cut-out, a detached sensor.

    Only a high output with the permit on is looked at: cooling, a resting compressor, or one that runs against little
    heat, are no fault.
    """
    mv_heat, set_point, pv = (f"{regulator}.{quantity}" for quantity in ("mv_heat", "sp", "pv"))

    def step(last: Heating | None, readings: Readings, now_ns: int) -> tuple[Heating | None, Fault | None]:
        if not (value_of(readings, mv_heat) >= limits.output_percent and value_of(readings, permit) == 1):
            return None, None
        pv_degC = value_of(readings, pv)
        state = heating(last, limits, value_of(readings, set_point), pv_degC, now_ns)
        if state is None or state.approaching or state.error_K_s < limits.max_error_K_s:
            return state, None
        text = f"{pv} {pv_degC:.1f} degC has not risen by {limits.gain_K} K in {limits.window_s:g} s of heating"
        return state, Fault(HEATER_NOT_WARMING, f"{text} towards {state.set_point_degC:.1f} degC")

    return remembering(step)


@dataclass(frozen=True, slots=True)
class Off:
    """Heat is off since `since_ns`; the lowest air, as `channel` shows it, since it settled, None until then."""

    since_ns: int
    channel: str
    lowest_degC: float | None = None


def warming_while_off(
    limits: HeaterOffConfig, air: str, regulator: str, permit: str, surroundings: Surroundings
) -> Rule:
    """The air rises though the regulator's output is 0 or the permit is off: a welded relay or a shorted SSR.

    The heater's power cannot be seen. What else can warm the air, the laboratory and what was warm before, cannot bring
    it above itself: so it must have risen, above the set-point, and above the warmest of `surroundings` that is known.
    """
    mv_heat, set_point, running = (f"{regulator}.{quantity}" for quantity in ("mv_heat", "sp", "running"))
    scatter = {channel: Scatter(channel) for channel in (air, f"{regulator}.pv")}

    def is_heat(readings: Readings, air_degC: float, around_degC: tuple[float, ...]) -> bool:
        if value_of(readings, running) == 1 and air_degC <= value_of(readings, set_point):
            return False
        known = [air_degC - degC for degC in around_degC if not math.isnan(degC)]
        return bool(known) and min(known) > limits.above_surroundings_K

    def step(last: Off | None, readings: Readings, now_ns: int) -> tuple[Off | None, Fault | None]:
        around_degC = surroundings(readings, now_ns)  # at each look, for one that follows the air
        scatters_K = {channel: each.most_K(readings) for channel, each in scatter.items()}
        if not (value_of(readings, mv_heat) <= 0 or value_of(readings, permit) == 0):
            return None, None
        channel = next((each for each in scatter if not in_doubt(readings, each)), air)
        air_degC = value_of(readings, channel)
        if last is None or last.channel != channel:
            return Off(now_ns, channel), None
        if math.isnan(air_degC) or now_ns - last.since_ns < seconds_ns(limits.settle_s):
            return last, None
        lowest_degC = air_degC if last.lowest_degC is None else min(last.lowest_degC, air_degC)
        state = Off(last.since_ns, channel, lowest_degC)
        if air_degC - lowest_degC >= limits.rise_K + scatters_K[channel] and is_heat(readings, air_degC, around_degC):
            text = f"{channel} has risen from {lowest_degC:.2f} to {air_degC:.2f} degC with the heater off"
            return state, Fault(WARMING_WHILE_OFF, text)
        return state, None

    return remembering(step)


@dataclass(frozen=True, slots=True)
class CompressorRun:
    """The compressor has run without heat since `since_ns`, when the air was at these, as both probes show it."""

    since_ns: int
    air_degC: tuple[float, float]


def cooling_in_vain(
    limits: CoolingConfig, air: str, regulator: str, compressor: str, surroundings: Surroundings
) -> Rule:
    """The compressor runs, the regulator's heating output is 0, and yet the air, which nothing around it warms, does
    not fall: a welded relay that heats as much as is cooled, or a compressor that does not cool. The two look alike.

    Below its surroundings the chamber may need all its cold to stay where it is, and no judgement is possible.
    """
    mv_heat = f"{regulator}.mv_heat"

    def step(last: CompressorRun | None, readings: Readings, now_ns: int) -> tuple[CompressorRun | None, Fault | None]:
        air_degC, around_degC = value_of(readings, air), surroundings(readings, now_ns)
        is_alone = all(degC < air_degC - limits.margin_K for degC in around_degC)
        cools = value_of(readings, compressor) == 1 and value_of(readings, mv_heat) <= 0
        if not (cools and is_alone):
            return None, None
        both_degC = (air_degC, value_of(readings, f"{regulator}.pv"))
        if last is None or any(
            now <= before - limits.fall_K for now, before in zip(both_degC, last.air_degC, strict=True)
        ):
            return CompressorRun(now_ns, both_degC), None
        if now_ns - last.since_ns < seconds_ns(limits.window_s):
            return last, None
        text = (
            f"{air} stays at {air_degC:.2f} degC though the compressor has run for {limits.window_s:g} s without heat"
        )
        return last, Fault(COOLING_IN_VAIN, text)

    return remembering(step)


@dataclass(frozen=True, slots=True)
class Constant:
    """A value that has not changed since `since_ns`, and what another sensor read then."""

    value: float
    since_ns: int
    other: float


def stuck_while_other_moves(channel: str, other: str, moved_K: float, after_s: float) -> Rule:
    """`channel` has been exactly constant for at least `after_s`, in which `other`, in the same air, went `moved_K`
    beyond its scatter; one that is in doubt goes nowhere.

    The regulator shows 0.1 K and holds that for an hour, while its output goes from one end to the other to do so:
    neither a constant value nor an output that moves proves a stuck probe, a second sensor does.
    """
    scatter = Scatter(other)

    def step(last: Constant | None, readings: Readings, now_ns: int) -> tuple[Constant | None, Fault | None]:
        value, other_value, scatter_K = value_of(readings, channel), value_of(readings, other), scatter.most_K(readings)
        if last is None or value != last.value or in_doubt(readings, other):
            return Constant(value, now_ns, other_value), None
        went_K = abs(other_value - last.other)
        if now_ns - last.since_ns < seconds_ns(after_s) or not went_K >= moved_K + scatter_K:
            return last, None
        return last, Fault(SENSOR_STUCK, f"{channel} stays at {value} while {other} went by {went_K:.2f} K")

    return remembering(step)
