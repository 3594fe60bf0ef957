"""The first heat of a daemon: do the regulator's probe, its heater and the chamber's air belong together?"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from thermostand.foundation.clock import to_ns
from thermostand.foundation.events import guard_rule
from thermostand.stand.config.chamber_section import StartupResponseConfig
from thermostand.stand.guarding.heat_balance import compute_heat_percent
from thermostand.stand.guarding.plausibility import make_stateful_rule
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value

FIRST_HEAT = guard_rule("first_heat", "the temperature does not rise where the first heat is given")
_HEATS_PERCENT = 40.0  # that no chamber can take without getting warmer
_LACKING_K = 1.0  # below its set-point by more than this the regulator heats, nearer it only holds


@dataclass(frozen=True, slots=True)
class StartupState:
    """Heating since `since_ns`, from what `shown_degC` (PV, air) were; the most that each has risen. is_passed: both
    have risen, and nothing is looked at any more."""

    since_ns: int
    shown_degC: tuple[float, float]
    risen_K: tuple[float, float] = (0.0, 0.0)
    sum_percent: float = 0.0
    count: int = 0
    is_passed: bool = False


def require_startup_response(limits: StartupResponseConfig, air: str, regulator: str, permit: str) -> Rule:
    """The regulator heats for the first time, and its value or the chamber's air does not rise: two identical
    regulators with exchanged addresses pass every other probe."""
    pv = f"{regulator}.pv"

    def begins(readings: Readings) -> bool:
        lacking_K = get_value(readings, f"{regulator}.sp") - get_value(readings, pv)
        return lacking_K > _LACKING_K and compute_heat_percent(readings, regulator, permit) >= _HEATS_PERCENT

    def step(last: StartupState | None, readings: Readings, now_ns: int) -> tuple[StartupState | None, Fault | None]:
        if last is not None and last.is_passed:
            return last, None
        shown_degC = get_value(readings, pv), get_value(readings, air)
        if math.isnan(sum(shown_degC)):
            return None, None
        if last is None:
            return (StartupState(now_ns, shown_degC) if begins(readings) else None), None
        return _judged(
            _update_state(last, shown_degC, compute_heat_percent(readings, regulator, permit)), readings, now_ns
        )

    def _judged(state: StartupState, readings: Readings, now_ns: int) -> tuple[StartupState | None, Fault | None]:
        if min(state.risen_K) >= limits.rise_K:
            return replace(state, is_passed=True), None
        if now_ns - state.since_ns < to_ns(limits.within_s):
            return state, None
        if state.sum_percent / state.count < _HEATS_PERCENT:
            return None, None  # too little heat to judge
        rises = " and ".join(
            f"{name} rose by {risen_K:.1f} K" for name, risen_K in zip((pv, air), state.risen_K, strict=True)
        )
        text = f"in the first {limits.within_s:g} s of heat {rises}; both should rise by {limits.rise_K:g} K"
        return None, Fault(FIRST_HEAT, f"{text}: is this regulator the one of this chamber?")

    return make_stateful_rule(step)


def _update_state(state: StartupState, shown_degC: tuple[float, float], percent: float) -> StartupState:
    risen_K = tuple(
        max(most_K, shown - begun)
        for most_K, shown, begun in zip(state.risen_K, shown_degC, state.shown_degC, strict=True)
    )
    return replace(
        state, risen_K=(risen_K[0], risen_K[1]), sum_percent=state.sum_percent + percent, count=state.count + 1
    )
