"""Two thermometers in the same air, compared with themselves: a slow drift of one shows when a set-point is held again,
or for long, long before it is large enough to be a disagreement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import SENSOR, guard_rule
from thermostand.stand.guarding.plausibility import make_stateful_rule
from thermostand.stand.guarding.sensor_diagnosis import Suspicion
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value

SENSOR_DRIFTS = guard_rule("sensor_drifts", "two sensors of the same air drift apart while it is at rest", SENSOR)
_NEAR_K = 1.0  # of the set-point, or it is not held
_STILL_AFTER_S, _MEAN_S = 3600.0, 600.0  # walls have followed by then; over which a mean is taken

Key = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _HeldSetPoint:
    """The set-point and what else is as it was, since when; the sums over the readings of the means under way, of
    channel minus other and minus each third; what each such state had at first (K, ns), and what is to be reported."""

    key: Key
    since_ns: int
    sums_K: tuple[float, ...] = ()
    count: int = 0
    first: Mapping[Key, tuple[tuple[float, ...], int]] = field(default_factory=dict[Key, tuple[tuple[float, ...], int]])
    fault: Fault | None = None


def limit_sensor_drift(
    pair: tuple[str, str], set_point: str, same: Sequence[str], limit_K: float, thirds: Sequence[str] = ()
) -> Rule:
    """The difference of both, held at a set-point, has changed by more than `limit_K` since that was first held, with
    the channels `same` (0 or 1: flap, supplies) as they were. thirds: others in that air, which show who of both it
    is."""
    channel, other = pair

    def step(last: _HeldSetPoint | None, readings: Readings, now_ns: int) -> tuple[_HeldSetPoint | None, Fault | None]:
        sp_degC, value_degC = get_value(readings, set_point), get_value(readings, channel)
        difference_K = value_degC - get_value(readings, other)
        key = (round(sp_degC, 1), *(float(get_value(readings, each) > 0.5) for each in same))
        if math.isnan(difference_K) or not abs(value_degC - sp_degC) < _NEAR_K or last is None or key != last.key:
            known = {} if last is None else last.first
            return _HeldSetPoint(key, now_ns, first=known, fault=last and last.fault), last and last.fault
        held_s = (now_ns - last.since_ns) / NS_PER_S
        if held_s < _STILL_AFTER_S:
            return last, last.fault
        apart_K = (difference_K, *(value_degC - get_value(readings, third) for third in thirds))
        sums_K = last.sums_K or (0.0,) * len(apart_K)
        held = replace(last, sums_K=tuple(a + b for a, b in zip(sums_K, apart_K, strict=True)), count=last.count + 1)
        if held_s >= _STILL_AFTER_S + _MEAN_S:
            held = _compared(held, now_ns)
        return held, held.fault

    def _compared(held: _HeldSetPoint, now_ns: int) -> _HeldSetPoint:
        means_K = tuple(sum_K / held.count for sum_K in held.sums_K)
        first_K, first_ns = held.first.get(held.key, (means_K, now_ns))
        known = {**held.first, held.key: (first_K, first_ns)}
        hours, changes_K = (now_ns - first_ns) / NS_PER_S / 3600, [b - a for a, b in zip(first_K, means_K, strict=True)]
        fault = None
        if abs(changes_K[0]) > limit_K:
            text = (
                f"{channel} minus {other} at {held.key[0]:g} degC has changed by {1e3 * changes_K[0]:+.0f} mK in "
                f"{hours:.1f} h ({1e3 * changes_K[0] / hours:+.1f} mK/h)"
            )
            found = _suspicion(changes_K)
            fault = Fault(SENSOR_DRIFTS, text + found.words(pair), channels=pair, suspect=found.suspect)
        return _HeldSetPoint(held.key, now_ns - to_ns(_STILL_AFTER_S), first=known, fault=fault)

    def _suspicion(changes_K: Sequence[float]) -> Suspicion:
        """Judge by the thirds, each of which has to be nearer to one of both by twice."""
        of_channel, of_other = list[str](), list[str]()
        for third, from_channel_K in zip(thirds, changes_K[1:], strict=True):
            from_other_K = from_channel_K - changes_K[0]
            if abs(from_channel_K) > 2 * abs(from_other_K):
                of_channel.append(third)
            elif abs(from_other_K) > 2 * abs(from_channel_K):
                of_other.append(third)
        if len(of_channel) == len(of_other):
            return Suspicion()
        is_channel = len(of_channel) > len(of_other)
        return Suspicion(channel if is_channel else other, tuple(of_channel if is_channel else of_other))

    return make_stateful_rule(step)
