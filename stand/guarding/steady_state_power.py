"""The output that a chamber at rest needs at its set-point, learned during the run: far from it, something is wrong."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from thermostand.foundation.clock import to_ns
from thermostand.foundation.events import guard_rule
from thermostand.stand.config.chamber_section import SteadyStatePowerConfig
from thermostand.stand.guarding.heat_balance import compute_heat_percent
from thermostand.stand.guarding.plausibility import make_stateful_rule
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value

OUTPUT_NOT_AS_NEEDED = guard_rule(
    "output_not_as_needed", "the regulator needs another output than before for the same set-point"
)
_FLAP_OPEN_ABOVE = 0.05  # as in interlocks.py
_BAND_K, _MEAN_S = 2.0, 300.0  # at its set-point; the cycles of a relay's output are a minute
# In proportion, set-points twice as far apart differ by 20 %, close to the limit of 25.
_NEAR_K = 3.0  # a set-point so near needs the same within 10 % in good sessions
_LEARNING = 0.25  # share of a new mean; the first is taken whole


@dataclass(frozen=True, slots=True)
class RestState:
    """What the chamber rests at."""

    set_point_degC: float
    compressor: float


@dataclass(frozen=True, slots=True)
class PowerState:
    """A state at rest since `since_ns`, the output summed over `count` looks since `begun_ns`; what was learned, %."""

    rest: RestState | None = None
    since_ns: int = 0
    begun_ns: int = 0
    sum_percent: float = 0.0
    count: int = 0
    learned: Mapping[RestState, float] = field(default_factory=dict[RestState, float])


def find_nearest(learned: Mapping[RestState, float], rest: RestState) -> float | None:
    """Return what was needed at the nearest set-point with the compressor alike; None where nothing near was
    learned."""
    found = [
        (abs(other.set_point_degC - rest.set_point_degC), percent)
        for other, percent in learned.items()
        if other.compressor == rest.compressor and abs(other.set_point_degC - rest.set_point_degC) <= _NEAR_K
    ]
    return min(found)[1] if found else None


def limit_output_deviation(
    limits: SteadyStatePowerConfig, regulator: str, permit: str, compressor: str, flap: str
) -> Rule:
    """The chamber needs far more, or far less, than it did at about this set-point: a probe that shows too little, or
    holds still, makes the regulator heat on."""

    def rest_of(readings: Readings) -> RestState | None:
        set_point_degC = get_value(readings, f"{regulator}.sp")
        off_K = abs(get_value(readings, f"{regulator}.pv") - set_point_degC)
        is_controlled = get_value(readings, f"{regulator}.running") == 1 and get_value(readings, permit) == 1
        is_open = get_value(readings, flap) > _FLAP_OPEN_ABOVE
        if not (is_controlled and off_K <= _BAND_K) or is_open:
            return None
        on = get_value(readings, compressor)
        return None if math.isnan(on) else RestState(set_point_degC, on)

    def step(last: PowerState | None, readings: Readings, now_ns: int) -> tuple[PowerState | None, Fault | None]:
        last = last or PowerState()
        rest = rest_of(readings)
        if rest is None or rest != last.rest:
            return PowerState(rest, since_ns=now_ns, learned=last.learned), None
        if now_ns - last.since_ns < to_ns(limits.settle_s):
            return last, None
        if last.count == 0:
            last = replace(last, begun_ns=now_ns)
        summed = replace(
            last, sum_percent=last.sum_percent + compute_heat_percent(readings, regulator, permit), count=last.count + 1
        )
        if now_ns - summed.begun_ns < to_ns(_MEAN_S):
            return summed, None
        return _judge_mean(summed, rest, limits, regulator)

    return make_stateful_rule(step)


def _judge_mean(
    needs: PowerState, rest: RestState, limits: SteadyStatePowerConfig, regulator: str
) -> tuple[PowerState, Fault | None]:
    mean_percent = needs.sum_percent / needs.count
    needed_percent = find_nearest(needs.learned, rest)
    state = replace(needs, sum_percent=0.0, count=0)
    if needed_percent is not None and abs(mean_percent - needed_percent) > limits.limit_percent:
        text = f"{regulator} heats by {mean_percent:.0f} % at {rest.set_point_degC:.1f} degC, where the chamber needed"
        return state, Fault(OUTPUT_NOT_AS_NEEDED, f"{text} {needed_percent:.0f} % before")
    was_percent = needs.learned.get(rest)
    now_percent = mean_percent if was_percent is None else was_percent + _LEARNING * (mean_percent - was_percent)
    return replace(state, learned={**needs.learned, rest: now_percent}), None
