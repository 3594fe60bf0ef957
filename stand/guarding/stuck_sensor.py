"""Temperatures that do not move at all: a converter that works has noise of its last digit, and what another sensor of
the same air shows moves a probe, too."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from thermostand.foundation.clock import to_ns
from thermostand.foundation.events import SENSOR, guard_rule
from thermostand.stand.guarding.plausibility import Scatter, make_stateful_rule
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value, is_suspect

SENSOR_STUCK = guard_rule("sensor_stuck", "a temperature stays exactly where it is while it must move", SENSOR)
FINE_STEP_K = 0.02
"""A converter in steps as fine moves by its own noise at every poll or two; one of 0.1 K may stand still for hours."""
# At a poll a second 300 equal readings, of a converter that rests for a poll or two.
_FROZEN_S = 300.0
_STUCK_S, _MOVED_K = 60.0, 1.0  # a probe in steps of 0.1 K follows within seconds what moves the air by so much


@dataclass(frozen=True, slots=True)
class StillReading:
    """A value that has not changed since `since_ns`; the smallest step that any thermometer of the module has made, and
    what each showed last."""

    value: float = math.nan
    since_ns: int = 0
    step_K: float = math.inf
    shown: Mapping[str, float] = field(default_factory=dict[str, float])


def forbid_stuck_sensor(channel: str, module: tuple[str, ...], regulator: str) -> Rule:
    """`channel` has been exactly constant for 5 min while the regulator's output works.

    That is evidence for fine converters only; how fine it is shows in the steps of all thermometers of its `module`,
    so that one that was frozen from the begin is found too.
    """

    def works(readings: Readings) -> bool:
        outputs = (get_value(readings, f"{regulator}.{side}") for side in ("mv_heat", "mv_cool"))
        return get_value(readings, f"{regulator}.running") == 1 and any(output > 0 for output in outputs)

    def step(last: StillReading | None, readings: Readings, now_ns: int) -> tuple[StillReading | None, Fault | None]:
        value = get_value(readings, channel)
        state = _update_step(last or StillReading(), {name: get_value(readings, name) for name in module})
        if value != state.value or not works(readings):
            return replace(state, value=value, since_ns=now_ns), None
        if state.step_K > FINE_STEP_K or now_ns - state.since_ns < to_ns(_FROZEN_S):
            return state, None
        text = f"{channel} has been exactly {value:.3f} degC for {_FROZEN_S:g} s while the regulator's output works"
        return state, Fault(SENSOR_STUCK, text)

    return make_stateful_rule(step)


def _update_step(state: StillReading, shown: dict[str, float]) -> StillReading:
    if state.step_K <= FINE_STEP_K:  # fine enough is known
        return state
    steps_K = [abs(value - state.shown.get(name, math.nan)) for name, value in shown.items()]
    smallest_K = min((each for each in steps_K if each > 0), default=math.inf)
    return replace(state, step_K=min(state.step_K, smallest_K), shown=shown)


@dataclass(frozen=True, slots=True)
class Constant:
    """A value that has not changed since `since_ns`, and what another sensor read then."""

    value: float
    since_ns: int
    other: float


def forbid_stuck_while_other_moves(channel: str, other: str) -> Rule:
    """`channel` has been exactly constant for at least a minute, in which `other`, in the same air, went 1 K
    beyond its scatter; one that is suspect counts as not moving.

    The regulator shows 0.1 K and holds that for an hour, while its output goes from one end to the other to do so:
    neither a constant value nor an output that moves proves a stuck probe, a second sensor does.
    """
    scatter = Scatter(other)

    def step(last: Constant | None, readings: Readings, now_ns: int) -> tuple[Constant | None, Fault | None]:
        value, other_value, scatter_K = (
            get_value(readings, channel),
            get_value(readings, other),
            scatter.most_K(readings),
        )
        if last is None or value != last.value or is_suspect(readings, other):
            return Constant(value, now_ns, other_value), None
        went_K = abs(other_value - last.other)
        if now_ns - last.since_ns < to_ns(_STUCK_S) or not went_K >= _MOVED_K + scatter_K:
            return last, None
        return last, Fault(SENSOR_STUCK, f"{channel} stays at {value} while {other} went by {went_K:.2f} K")

    return make_stateful_rule(step)
