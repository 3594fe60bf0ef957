"""A thermal cycle that decides (`until: known`): its decisions as steps.

The plan always holds a whole run: behind the step `Decide` stand the fixed visits that are left. A decision puts a
visit, and the next `Decide`, before them, and takes as many of the fixed ones away as its time would have paid for: a
run that gets no more decisions continues with the fixed plan, and none takes much longer than that.

Every third visit is followed by one of a held-out temperature, and those that are left are visited at the end: what
compensation leaves there is measured in the same run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from thermostand.experiments.parameters import CaptureParameters, Known
from thermostand.experiments.steps import (
    Capture,
    CloseFlap,
    Decide,
    OpenFlap,
    Role,
    SetTemperature,
    Soak,
    Step,
    estimate_duration_s,
)

MOST_VISITS = 200  # round number; nothing was measured
# A held-out visit after each third one. Round number; nothing was measured.
_VALIDATED_AFTER = 3


@dataclass(frozen=True, slots=True)
class Visit:
    """A decision: a set-point that is new, and for how long it is held."""

    chamber_degC: float
    soak_s: float


class CycleComplete:
    """A decision: enough is known."""


class DecisionPending:
    """There was no decision; the fixed plan goes on."""


Answer = Visit | CycleComplete | DecisionPending


def begin_cycle(
    known: Known,
    set_points_degC: Sequence[float],
    held_out_degC: Sequence[float],
    soak_s: float,
    frames: int,
    taken: CaptureParameters,
) -> Decide:
    """The step that begins a cycle of these fixed visits, of so many frames each; `plan_fixed_visits` follows it."""
    decide = Decide(
        set_points_degC=tuple(set_points_degC),
        held_out_degC=tuple(held_out_degC),
        unvalidated_degC=tuple(dict.fromkeys(held_out_degC)),
        soak_s=soak_s,
        residual_px=known.residual_px,
        coldest_degC=min(set_points_degC),
        warmest_degC=max(set_points_degC),
        soaks_s=tuple(sorted(known.soaks_s)),
        ramp_K_per_min=known.ramp_K_per_min,
        states=known.states,
        left_s=0.0,
        visits=0,
        wait_s=known.wait_s,
        frames=frames,
        interval_s=taken.interval_s,
        exposure_s=taken.exposure_s,
    )
    return replace(decide, left_s=estimate_duration_s(plan_fixed_visits(decide)))


def plan_fixed_visits(decide: Decide) -> tuple[Step, ...]:
    """Return what follows a `Decide` in the plan: the visits that are made when nothing is decided."""
    return tuple(step for degC in decide.set_points_degC for step in _plan_visit(decide, degC, decide.soak_s))


def apply_decision(decide: Decide, answer: Answer) -> tuple[Step, ...]:
    """Return what follows that `Decide` instead of `plan_fixed_visits`."""
    match answer:
        case CycleComplete():
            return _plan_validations(decide, decide.unvalidated_degC)
        case DecisionPending():
            first, rest = decide.set_points_degC[:1], decide.set_points_degC[1:]
            steps = tuple(step for degC in first for step in _plan_visit(decide, degC, decide.soak_s))
            unvalidated = tuple(degC for degC in decide.unvalidated_degC if degC not in first)
            left = replace(decide, set_points_degC=rest, unvalidated_degC=unvalidated)
            return _append_next_decision(left, steps) if first else ()
        case Visit(chamber_degC, soak_s):
            visits = decide.visits + 1
            count = 1 if visits % _VALIDATED_AFTER == 0 else 0
            now, later = decide.unvalidated_degC[:count], decide.unvalidated_degC[count:]
            steps = (*_plan_visit(decide, chamber_degC, soak_s), *_plan_validations(decide, now))
            return _append_next_decision(replace(decide, visits=visits, unvalidated_degC=later), steps)


def _append_next_decision(decide: Decide, steps: tuple[Step, ...]) -> tuple[Step, ...]:
    """Return these steps, then the next decision and the fixed visits for which time is left behind them."""
    left_s = max(0.0, decide.left_s - estimate_duration_s(steps))
    validations = _plan_validations(decide, decide.unvalidated_degC)
    longest_s = estimate_duration_s(_plan_visit(decide, decide.warmest_degC, max(decide.soaks_s)))
    if left_s < estimate_duration_s(validations) + longest_s:
        return (*steps, *validations)
    fixed = round(left_s / estimate_duration_s(_plan_visit(decide, decide.warmest_degC, decide.soak_s)))
    kept = decide.set_points_degC[max(0, len(decide.set_points_degC) - fixed) :]
    following = replace(decide, set_points_degC=kept, left_s=left_s)
    return (*steps, following, *plan_fixed_visits(following))


def _plan_validations(decide: Decide, degC: Sequence[float]) -> tuple[Step, ...]:
    soak_s = decide.soaks_s[len(decide.soaks_s) // 2]
    return tuple(step for each in degC for step in _plan_visit(decide, each, soak_s))


def _plan_visit(decide: Decide, chamber_degC: float, soak_s: float) -> tuple[Step, ...]:
    role = Role.VALIDATION if chamber_degC in decide.held_out_degC else Role.FIT
    return (
        SetTemperature(chamber_degC),
        Soak(soak_s),
        OpenFlap(),
        Capture(decide.frames, decide.interval_s, decide.exposure_s, role, chamber_degC),
        CloseFlap(),
    )
