"""What a run does next: one action for each state and each surroundings. The table of a run, without any effect.

Rows are read from the top; the first that fits decides:

    the plan is done                                         None
    the capture under way has all its frames                 Complete, unless it is taken again for lost ones
    its next frame is not due yet                            Sleep
    something holds the run                                  Wait
    the soak under way has lasted its time                   Complete
    the set-up is disturbed; a warm-up was interrupted       RestartCold
    the set-up is disturbed                                  Restore
    a soak since the last set-point owes time                Earn
    the camera, which the step needs, is not in equilibrium  Equilibrate
    the flap should be open and is not                       ReopenFlap
    the step was not begun by this daemon                    Begin
    the step is a soak                                       Earn
    it is a capture: the disk lost some of its frames        Retake
    ... without a deadline, or after a hold                  Aim
    ... a warm-up, and it was interrupted for long           RestartCold
    ... with frames, and it was interrupted for long         Retake
    ... else                                                 TakeFrame
    any other step                                           Perform
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from thermostand.experiments.steps import AnySoak, Capture, CloseFlap, OpenFlap, PlannedStep, PowerCamera, Prompt, Role
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.stand.running.memory.state import Plan, RunState, SetUp

# A soak is credited after an interruption when the chamber is this near to its set-point: regulators hold 0.1 K, and a
# chamber left alone for a minute has gone further. The camera, which is slower than the air, has then hardly moved.
CREDITED_WITHIN_K = 1.0
# A capture that was interrupted for longer than this is taken again: its flap was shut meanwhile, and the air is not
# the same any more.
# Round number; nothing was measured.
RETAKE_AFTER_S = 60.0
# A disk that loses frames each time must not hold the run for good.
MOST_RETAKES_FOR_LOST_FRAMES = 3


@dataclass(frozen=True, slots=True)
class Surroundings:
    """What of the stand decides. lead_ns: how long before its instant a frame is asked for. held: whether the gate is
    closed, as after a latched fault. pv_degC: the chamber's last known temperature, NaN when it is not known.
    lost_equilibrium: the camera's. frames_lost: so many frames of the capture under way did not come onto the disk."""

    now_ns: int
    lead_ns: int = 0
    held: bool = False
    flap_open: bool = False
    lost_equilibrium: bool = False
    pv_degC: float = math.nan
    frames_lost: int = 0


@dataclass(frozen=True, slots=True)
class Complete:
    """The step is done when all that it has recorded is on the disk."""

    planned: PlannedStep


@dataclass(frozen=True, slots=True)
class Sleep:
    """Sleep: nothing is to be done before that instant."""

    until_ns: int


@dataclass(frozen=True, slots=True)
class Wait:
    """Wait until nothing holds the run."""


@dataclass(frozen=True, slots=True)
class RestartCold:
    """These steps of a warm-up, its capture last, are done again."""

    again: Plan


@dataclass(frozen=True, slots=True)
class Restore:
    """Bring the set-up about again."""

    set_up: SetUp


@dataclass(frozen=True, slots=True)
class ContinueSoak:
    """Soak for what the soak still owes."""

    soak: PlannedStep


@dataclass(frozen=True, slots=True)
class Equilibrate:
    """Wait until the camera is in equilibrium again."""


@dataclass(frozen=True, slots=True)
class ReopenFlap:
    """Open the flap, which was shut in a hold."""


@dataclass(frozen=True, slots=True)
class Begin:
    """Begin the step."""

    planned: PlannedStep


@dataclass(frozen=True, slots=True)
class ArmCapture:
    """Prepare for frames, and say when the next is due."""

    capture: Capture


@dataclass(frozen=True, slots=True)
class Retake:
    """The capture is restarted; why: as a clause. frames_lost: by the disk, when it is for them."""

    planned: PlannedStep
    why: str
    frames_lost: int = 0


@dataclass(frozen=True, slots=True)
class TakeFrame:
    """One frame; `is_settled`: the first after a soak."""

    planned: PlannedStep
    capture: Capture
    due_ns: int
    is_settled: bool


@dataclass(frozen=True, slots=True)
class Perform:
    """Do the step, all of it."""

    planned: PlannedStep


Action = (
    Complete
    | Sleep
    | Wait
    | RestartCold
    | Restore
    | ContinueSoak
    | Equilibrate
    | ReopenFlap
    | Begin
    | ArmCapture
    | Retake
    | TakeFrame
    | Perform
)
# Of these the outage of a capture is made. Soaks that come before the step count, too.
PreparingAction = Wait | Restore | Equilibrate | ReopenFlap


def choose_next_action(state: RunState, around: Surroundings) -> Action | None:
    """The action, None when the plan is done."""
    if state.index >= len(state.plan):
        return None
    planned = state.plan[state.index]
    is_under_way = state.under_way == planned.step_id
    step = planned.step
    if is_under_way and has_all_frames(state, planned) and not needs_retake(state, around, planned):
        return Complete(planned)
    if is_under_way and state.due_ns is not None and around.now_ns < state.due_ns - around.lead_ns:
        return Sleep(state.due_ns - around.lead_ns)
    if around.held:
        return Wait()
    if is_under_way and isinstance(step, AnySoak) and not state.remaining_ns(planned):
        return Complete(planned)
    if action := _find_preparation(state, around, planned):
        return action
    if not is_under_way:
        return Begin(planned)
    if isinstance(step, Capture):
        return _choose_capture_action(state, around, planned, step)
    return ContinueSoak(planned) if isinstance(step, AnySoak) else Perform(planned)


def has_all_frames(state: RunState, planned: PlannedStep) -> bool:
    """Return whether all frames of the capture were taken."""
    return isinstance(planned.step, Capture) and state.frames.get(planned.step_id, 0) >= planned.step.frames


def needs_retake(state: RunState, around: Surroundings, planned: PlannedStep) -> bool:
    """Return whether the capture, which has all its frames, is taken again because the disk has lost some; not one of a
    camera that has warmed up meanwhile."""
    if not around.frames_lost or not isinstance(planned.step, Capture) or planned.step.role is Role.WARM_UP:
        return False
    has_tries = state.retakes.get(planned.step_id, 0) < MOST_RETAKES_FOR_LOST_FRAMES
    return has_tries and has_all_frames(state, planned)


def _find_preparation(state: RunState, around: Surroundings, planned: PlannedStep) -> Action | None:
    """Return what is needed before the step; None when everything is as the steps before it have left it."""
    set_up = state.set_up
    if state.is_setup_invalid:
        if again := find_cold_start_steps(state):
            return RestartCold(again)
        # A soak depends on its own soak time so far as on the soaks before it.
        return Restore(set_up.after(planned) if isinstance(planned.step, AnySoak) else set_up)
    if owing := next((soak for soak in set_up.soaks if state.remaining_ns(soak)), None):
        return ContinueSoak(owing)
    if set_up.camera_on and around.lost_equilibrium and isinstance(planned.step, OpenFlap | Capture):
        return Equilibrate()
    if set_up.flap_open and not around.flap_open and not isinstance(planned.step, CloseFlap):
        return ReopenFlap()
    return None


def _choose_capture_action(state: RunState, around: Surroundings, planned: PlannedStep, capture: Capture) -> Action:
    if has_all_frames(state, planned):
        return Retake(planned, f"the disk has lost {around.frames_lost} of its frames", around.frames_lost)
    if state.due_ns is None or state.readying or state.is_lost:
        return ArmCapture(capture)
    outage_ns, has_frames = state.outage_ns(around.now_ns), state.frames.get(planned.step_id, 0) > 0
    is_warm_up = capture.role is Role.WARM_UP
    if outage_ns > to_ns(RETAKE_AFTER_S):
        if is_warm_up and (again := find_cold_start_steps(state)):
            return RestartCold(again)
        if has_frames:
            return Retake(planned, f"it was interrupted for {outage_ns / NS_PER_S:.0f} s")
    may_settle = bool(state.set_up.soaks) and capture.role not in (Role.WARM_UP, Role.OTHER)
    return TakeFrame(planned, capture, state.due_ns, may_settle and not has_frames)


def compute_next_due_ns(due_ns: int | None, capture: Capture, around: Surroundings, *, is_lost: bool) -> int:
    """Return when the next frame is due after the capture was made ready, on a grid of absolute deadlines: those missed
    while the run was held or a lost camera reopened are skipped, not caught up."""
    if due_ns is None:
        return around.now_ns + around.lead_ns
    interval_ns = to_ns(capture.interval_s)
    return due_ns + max(is_lost, math.ceil((around.now_ns - due_ns) / interval_ns)) * interval_ns


def compute_due_after_ns(due_ns: int, capture: Capture, now_ns: int) -> int:
    """Return when the next frame is due after one: at the latest deadline that has passed, for a free-running camera
    gives its frame up to a period late."""
    interval_ns = to_ns(capture.interval_s)
    return due_ns + max(1, (now_ns - due_ns) // interval_ns) * interval_ns


def find_cold_start_steps(state: RunState) -> Plan:
    """The steps of an interrupted warm-up that are done again, the capture last: from switching the camera off to its
    capture, but for what the operator was asked for. A warm-up that was killed, or held by an interlock, cannot be gone
    on with: its camera is warm.

    Empty when no warm-up was interrupted after its camera was, or may have been, switched on.
    """
    steps = state.plan
    last = next((step.index for step in steps if _is_warm_up(step) and step.step_id not in state.done), 0)
    on = _find_last_switch(steps[:last], on=True)
    off = _find_last_switch(steps[: on or 0], on=False)
    if on is None or off is None or steps[on].step_id not in state.done | state.begun:
        return ()
    return tuple(step for step in steps[off : last + 1] if not isinstance(step.step, Prompt))


def _is_warm_up(planned: PlannedStep) -> bool:
    return isinstance(planned.step, Capture) and planned.step.role is Role.WARM_UP


def _find_last_switch(steps: Plan, *, on: bool) -> int | None:
    return next((step.index for step in reversed(steps) if step.step == PowerCamera(on)), None)


@dataclass(frozen=True, slots=True)
class SoakCredit:
    """Which soaks that were begun still count after a disturbance; `lost` are soaked again. text: why, "" when
    there was nothing to lose."""

    text: str = ""
    lost: Plan = ()


def credit_soaks(state: RunState, set_up: SetUp, around: Surroundings) -> SoakCredit:
    """Soaks since the last set-point keep their soak time so far only if the chamber is in its band, and the camera was
    on."""
    begun = tuple(soak for soak in set_up.soaks if soak.step_id in state.done or state.soaked_ns.get(soak.step_id, 0))
    if not begun or set_up.chamber_degC is None:
        return SoakCredit()
    if state.is_cold and set_up.camera_on:
        return SoakCredit("the camera was or may have been off", begun)
    text = f"the chamber is at {around.pv_degC:.2f} degC, {{}}within {CREDITED_WITHIN_K:g} K of its set-point"
    if abs(around.pv_degC - set_up.chamber_degC) <= CREDITED_WITHIN_K:
        return SoakCredit(text.format(""))
    return SoakCredit(text.format("not "), begun)
