"""Temperatures that do not move at all: a converter that works has noise of its last digit."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace

from foundation.clock import seconds_ns
from foundation.readings import Quality, Reading
from stand.fault import Fault, Readings, value_of
from stand.guarding.interlocks import Rule
from stand.guarding.plausibility import remembering

_STEPS_BEHIND = 3.0

Poll = tuple[Reading, ...]


@dataclass(frozen=True, slots=True)
class Still:
    """A value that has not changed since `since_ns`; the smallest step that any thermometer of the module has made, and
    what each showed last."""

    value: float = math.nan
    since_ns: int = 0
    step_K: float = math.inf
    shown: Mapping[str, float] = field(default_factory=dict[str, float])


def frozen(channel: str, module: tuple[str, ...], step_K: float, after_s: float, regulator: str) -> Rule:
    """`channel` has been exactly constant for `after_s` while the regulator's output works.

    That is evidence for fine converters only; how fine it is shows in the steps of all thermometers of its `module`,
    so that one that was frozen from the begin is found too.
    """

    def works(readings: Readings) -> bool:
        outputs = (value_of(readings, f"{regulator}.{side}") for side in ("mv_heat", "mv_cool"))
        return value_of(readings, f"{regulator}.running") == 1 and any(output > 0 for output in outputs)

    def step(last: Still | None, readings: Readings, now_ns: int) -> tuple[Still | None, Fault | None]:
        value = value_of(readings, channel)
        state = _finer(last or Still(), {name: value_of(readings, name) for name in module}, step_K)
        if value != state.value or not works(readings):
            return replace(state, value=value, since_ns=now_ns), None
        if state.step_K > step_K or now_ns - state.since_ns < seconds_ns(after_s):
            return state, None
        text = f"{channel} has been exactly {value:.3f} degC for {after_s:g} s while the regulator's output works"
        return state, Fault("sensor_frozen", text)

    return remembering(step)


def _finer(state: Still, shown: dict[str, float], step_K: float) -> Still:
    if state.step_K <= step_K:  # fine enough is known
        return state
    steps_K = [abs(value - state.shown.get(name, math.nan)) for name, value in shown.items()]
    smallest_K = min((each for each in steps_K if each > 0), default=math.inf)
    return replace(state, step_K=min(state.step_K, smallest_K), shown=shown)


@dataclass(frozen=True, slots=True)
class Constant:
    """A value that has not changed; the lowest and highest air meanwhile, since when these are far apart, and the
    smallest step that it has made before."""

    value: float
    lowest_degC: float
    highest_degC: float
    moved_ns: int | None = None
    step_K: float = math.inf


def stale_by_air(channel: str, air: str, moved_K: float, after_s: float) -> Rule:
    """`channel` is still exactly the same `after_s` after `air` has gone by `moved_K`: it is no measurement of now. One
    in steps of 0.5 K stands still for hours while nothing happens; one in coarser steps than moved_K / 3 has to be left
    behind by three of them."""

    def step(last: Constant | None, readings: Readings, now_ns: int) -> tuple[Constant | None, Fault | None]:
        value, air_degC = value_of(readings, channel), value_of(readings, air)
        if math.isnan(value) or math.isnan(air_degC):
            return None, None
        if last is None:
            return Constant(value, air_degC, air_degC), None
        if value != last.value:
            step_K = min(last.step_K, abs(value - last.value))
            return Constant(value, air_degC, air_degC, step_K=step_K), None
        lowest_degC, highest_degC = min(last.lowest_degC, air_degC), max(last.highest_degC, air_degC)
        went_K = highest_degC - lowest_degC
        needed_K = moved_K if math.isinf(last.step_K) else max(moved_K, _STEPS_BEHIND * last.step_K)
        moved_ns = now_ns if last.moved_ns is None and went_K >= needed_K else last.moved_ns
        state = Constant(value, lowest_degC, highest_degC, moved_ns, last.step_K)
        if moved_ns is None or now_ns - moved_ns < seconds_ns(after_s):
            return state, None
        text = f"{channel} stays at {value} while {air} went by {went_K:.1f} K; it is stale"
        return state, Fault("sensor_stale", text)

    return remembering(step)


class _Now:
    """The readings of a poll that is not published yet, before those that are."""

    def __init__(self, readings: Poll, published: Readings) -> None:
        self._readings = {reading.channel: reading for reading in readings if reading.cause != "wire"}
        self._published = published

    def latest(self, channel: str) -> Reading | None:
        return self._readings.get(channel) or self._published.latest(channel)

    def known(self, channel: str) -> Reading | None:
        return self._readings.get(channel) or self._published.known(channel)

    def last_good_ns(self, channel: str) -> int | None:
        return self._published.last_good_ns(channel)


def marking_stale(channel: str, is_stale: Rule, published: Readings) -> Callable[[Poll, int], Poll]:
    """What is to be published of a poll: GOOD readings of `channel` to which the rule objects are STALE, with its
    reason."""

    def mark(readings: Poll, now_ns: int) -> Poll:
        fault = is_stale(_Now(readings, published), now_ns)
        if fault is None:
            return readings
        return tuple(
            replace(each, quality=Quality.STALE, reason=fault.text)
            if each.channel == channel and each.quality is Quality.GOOD
            else each
            for each in readings
        )

    return mark
