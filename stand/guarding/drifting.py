"""Two thermometers in the same air, compared with themselves: a slow drift of one shows when a set-point is held again,
or for long, long before it is large enough to be a disagreement.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from foundation.clock import NS_PER_S, seconds_ns
from stand.fault import Fault, Readings, value_of
from stand.guarding.interlocks import Rule
from stand.guarding.plausibility import remembering

_NEAR_K = 1.0  # of the set-point, or it is not held
_STILL_AFTER_S, _MEAN_S = 3600.0, 600.0  # walls have followed by then; over which a mean is taken

Key = tuple[float, ...]


@dataclass(frozen=True, slots=True)
class _Held:
    """The set-point and what else is as it was, since when; the sum over the readings of the mean under way; what each
    such state had at first (K, ns), and what is to be said."""

    key: Key
    since_ns: int
    sum_K: float = 0.0
    count: int = 0
    first: Mapping[Key, tuple[float, int]] = field(default_factory=dict[Key, tuple[float, int]])
    fault: Fault | None = None


def drifting(channel: str, other: str, set_point: str, same: Sequence[str], limit_K: float) -> Rule:
    """The difference of both, held at a set-point, has changed by more than `limit_K` since that was first held, with
    the channels `same` (0 or 1: flap, supplies) as they were."""

    def step(last: _Held | None, readings: Readings, now_ns: int) -> tuple[_Held | None, Fault | None]:
        sp_degC, value_degC = value_of(readings, set_point), value_of(readings, channel)
        difference_K = value_degC - value_of(readings, other)
        key = (round(sp_degC, 1), *(float(value_of(readings, each) > 0.5) for each in same))
        if math.isnan(difference_K) or not abs(value_degC - sp_degC) < _NEAR_K or last is None or key != last.key:
            known = {} if last is None else last.first
            return _Held(key, now_ns, first=known, fault=last and last.fault), last and last.fault
        held_s = (now_ns - last.since_ns) / NS_PER_S
        if held_s < _STILL_AFTER_S:
            return last, last.fault
        held = replace(last, sum_K=last.sum_K + difference_K, count=last.count + 1)
        if held_s >= _STILL_AFTER_S + _MEAN_S:
            held = _compared(held, now_ns)
        return held, held.fault

    def _compared(held: _Held, now_ns: int) -> _Held:
        mean_K = held.sum_K / held.count
        first_K, first_ns = held.first.get(held.key, (mean_K, now_ns))
        known = {**held.first, held.key: (first_K, first_ns)}
        hours, change_K = (now_ns - first_ns) / NS_PER_S / 3600, mean_K - first_K
        fault = None
        if abs(change_K) > limit_K:
            text = (
                f"{channel} minus {other} at {held.key[0]:g} degC has changed by {1e3 * change_K:+.0f} mK in "
                f"{hours:.1f} h ({1e3 * change_K / hours:+.1f} mK/h): one of them drifts; compare both with a third"
            )
            fault = Fault("sensor_drifts", text)
        return _Held(held.key, now_ns - seconds_ns(_STILL_AFTER_S), first=known, fault=fault)

    return remembering(step)
