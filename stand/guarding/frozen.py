"""Temperatures that do not move at all: a converter that works has noise of its last digit."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from thermostand.foundation.clock import seconds_ns
from thermostand.foundation.events import guard_rule
from thermostand.stand.fault import Fault, Readings, value_of
from thermostand.stand.guarding.interlocks import Rule
from thermostand.stand.guarding.plausibility import remembering

SENSOR_FROZEN = guard_rule("sensor_frozen", "a temperature has not moved at all while the regulator's output works")


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
        return state, Fault(SENSOR_FROZEN, text)

    return remembering(step)


def _finer(state: Still, shown: dict[str, float], step_K: float) -> Still:
    if state.step_K <= step_K:  # fine enough is known
        return state
    steps_K = [abs(value - state.shown.get(name, math.nan)) for name, value in shown.items()]
    smallest_K = min((each for each in steps_K if each > 0), default=math.inf)
    return replace(state, step_K=min(state.step_K, smallest_K), shown=shown)
