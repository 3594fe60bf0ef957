"""How much heat was given, from the regulator's output and the heater's power, and whether the probes show it."""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import guard_rule
from thermostand.stand.config.chamber_section import ChamberConfig, HeatBalanceConfig
from thermostand.stand.guarding.plausibility import make_stateful_rule
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value

NO_HEAT_RESPONSE = guard_rule("no_heat_response", "the regulator heats hard, and a probe does not show it")
TOO_MUCH_HEAT = guard_rule("too_much_heat", "more heat was given within an hour than the chamber ever needs")
_LONGEST_LOOK_S = 60.0  # between two looks; what was given in a longer gap is not known
_BEFORE_S = 30.0  # a stretch of heat begins: from here on a fall counts
_MINUTE_S, _HOUR_S = 60.0, 3600.0
HARD_PERCENT = 50.0
"""More than any rest needs: at such an output the air must warm."""
# 60 s are 2.4 lags of the heater: 9 % are still to come. Half of it would leave 30 %.
_WINDOW_S, _SETTLE_S = 120.0, 60.0  # over which it must rise, once the heater's own lag of 25 s is over
# Half of it is 0.5 K above what good sessions do.
_FALL_K = 4.0  # from its highest; good sessions fall by 1.5 K, when a ramp passes a capture's open flap


def compute_heat_percent(readings: Readings, regulator: str, permit: str) -> float:
    """Return what of the heater's power is given, %: none only where it is known that the permit is off; 0 when
    unknown."""
    output = get_value(readings, f"{regulator}.mv_heat")
    return 0.0 if math.isnan(output) or get_value(readings, permit) == 0 else output


@dataclass(frozen=True, slots=True)
class HeatTotal:
    """Heat of the minutes that are over, (begin ns, Wh), oldest first, and of the one since `begun_ns`; each ends at
    the first look after 60 s, and may be longer."""

    begun_ns: int
    looked_ns: int
    running_Wh: float = 0.0
    minutes: tuple[tuple[int, float], ...] = ()


def limit_heat_energy(max_Wh_per_h: float, heater_W: float, regulator: str, permit: str) -> Rule:
    """Make the rule that trips on more heat within an hour than the chamber ever needs, regardless of the sensors."""

    def step(last: HeatTotal | None, readings: Readings, now_ns: int) -> tuple[HeatTotal | None, Fault | None]:
        if last is None:
            return HeatTotal(now_ns, now_ns), None
        looked_s = min((now_ns - last.looked_ns) / NS_PER_S, _LONGEST_LOOK_S)
        running_Wh = (
            last.running_Wh + compute_heat_percent(readings, regulator, permit) / 100 * heater_W * looked_s / 3600
        )
        if now_ns - last.begun_ns < to_ns(_MINUTE_S):
            return HeatTotal(last.begun_ns, now_ns, running_Wh, last.minutes), None
        since_ns = now_ns - to_ns(_HOUR_S)
        minutes = tuple(each for each in (*last.minutes, (last.begun_ns, running_Wh)) if each[0] >= since_ns)
        given_Wh = sum(Wh for _, Wh in minutes)
        state = HeatTotal(now_ns, now_ns, 0.0, minutes)
        if given_Wh <= max_Wh_per_h:
            return state, None
        text = f"{given_Wh:.0f} Wh of heat were given within an hour, above the limit of {max_Wh_per_h:g} Wh"
        return state, Fault(TOO_MUCH_HEAT, text)

    return make_stateful_rule(step)


@dataclass(frozen=True, slots=True)
class HeatSample:
    """One look at heat and probe."""

    time_ns: int
    percent: float
    probe_degC: float


@dataclass(frozen=True, slots=True)
class HeatStretch:
    """What was seen lately; while the regulator heats, since when, and the highest that the probe showed."""

    moments: tuple[HeatSample, ...]
    since_ns: int | None = None
    highest_degC: float = -math.inf


def require_heat_response(
    limits: HeatBalanceConfig, chamber: ChamberConfig, probe: str, regulator: str, permit: str
) -> Rule:
    """The regulator heats hard, and yet `probe` falls, or does not rise as that heat makes it: it hangs outside, or is
    stuck. Near the set-point, where the heat only keeps what is there, a rise is not asked for."""
    kept_ns = to_ns(max(_WINDOW_S, _BEFORE_S))

    def step(last: HeatStretch | None, readings: Readings, now_ns: int) -> tuple[HeatStretch | None, Fault | None]:
        reading = readings.known(probe)
        if reading is None or math.isnan(reading.value):
            return None, None
        moments = last.moments if last else ()
        if last and moments and reading.time_ns <= moments[-1].time_ns:
            return last, None
        now = HeatSample(reading.time_ns, compute_heat_percent(readings, regulator, permit), reading.value)
        moments = (*(each for each in moments if each.time_ns >= now.time_ns - kept_ns), now)
        stretch = _update_stretch(last, moments, limits)
        if stretch.since_ns is None:
            return stretch, None
        return stretch, _check_fall(stretch, limits, probe) or _check_rise(
            stretch, limits, chamber, probe, readings, regulator
        )

    return make_stateful_rule(step)


def _update_stretch(
    last: HeatStretch | None, moments: tuple[HeatSample, ...], limits: HeatBalanceConfig
) -> HeatStretch:
    now = moments[-1]
    if now.percent < HARD_PERCENT:
        return HeatStretch(moments)
    if last is None or last.since_ns is None:
        begun_ns = now.time_ns - to_ns(_BEFORE_S)
        return HeatStretch(moments, now.time_ns, max(each.probe_degC for each in moments if each.time_ns >= begun_ns))
    return HeatStretch(moments, last.since_ns, max(last.highest_degC, now.probe_degC))


def _check_fall(stretch: HeatStretch, limits: HeatBalanceConfig, probe: str) -> Fault | None:
    now = stretch.moments[-1]
    if stretch.highest_degC - now.probe_degC < _FALL_K:
        return None
    text = f"{probe} falls from {stretch.highest_degC:.1f} to {now.probe_degC:.1f} degC while the regulator heats"
    return Fault(NO_HEAT_RESPONSE, f"{text} by {now.percent:.0f} %")


def _check_rise(
    stretch: HeatStretch,
    limits: HeatBalanceConfig,
    chamber: ChamberConfig,
    probe: str,
    readings: Readings,
    regulator: str,
) -> Fault | None:
    first, now = stretch.moments[0], stretch.moments[-1]
    lasted_s = (now.time_ns - first.time_ns) / NS_PER_S
    settled_ns = (stretch.since_ns or 0) + to_ns(_SETTLE_S)
    # A poll may be late: nine tenths of the window count as all of it.
    if lasted_s < 0.9 * _WINDOW_S or first.time_ns < settled_ns:
        return None
    lacking_K = get_value(readings, f"{regulator}.sp") - get_value(readings, f"{regulator}.pv")
    if not lacking_K > 1.0:
        return None
    percent = sum(each.percent for each in stretch.moments) / len(stretch.moments)
    given_Wh = percent / 100 * chamber.heater_W * lasted_s / 3600
    needed_K = limits.rise_share * given_Wh / chamber.heat_capacity_Wh_K
    risen_K = now.probe_degC - first.probe_degC
    if risen_K >= needed_K:
        return None
    text = f"{probe} has risen by {risen_K:.2f} K in {lasted_s:.0f} s in which {given_Wh:.0f} Wh of heat were given"
    return Fault(NO_HEAT_RESPONSE, f"{text}; at least {needed_K:.2f} K are expected")
