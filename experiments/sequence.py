"""Whether a sequence of steps makes sense: what each step needs of those before it."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace

from experiments.parameters import COLDEST_degC, WARMEST_degC
from experiments.steps import (
    AnySoak,
    Capture,
    CloseFlap,
    CoolDown,
    OpenFlap,
    PowerCamera,
    Role,
    SetTemperature,
    SoakUntilSettled,
    StartChamber,
    Step,
    longest_s,
)
from experiments.written import PlanError, Written, set_point_after

MOST_STEPS = 100_000  # of a plan: weeks; it is still listed within seconds
MOST_CAPTURES = 20_000  # more than any camera lives through
_OPEN_S = 60.0  # of a soak through an open flap: the laboratory's air comes in


@dataclass(frozen=True, slots=True)
class _Before:
    """What the steps so far have left: set-point (None: stopped), camera's supply, flap."""

    degC: float | None = None
    camera_on: bool = True
    flap_open: bool = False

    def after(self, step: Step) -> _Before:
        match step:
            case PowerCamera(on):
                return replace(self, camera_on=on)
            case OpenFlap():
                return replace(self, flap_open=True)
            case CloseFlap():
                return replace(self, flap_open=False)
            case _:
                return replace(self, degC=set_point_after(step, self.degC))


def checked(steps: Iterable[Written]) -> Iterator[Written]:
    """The steps as they are; PlanError at the first that cannot be where it is, or is one too many."""
    for written, fault in faults(steps):
        if fault:
            raise PlanError(written.place, fault)
        yield written


def faults(steps: Iterable[Written]) -> Iterator[tuple[Written, str]]:
    """Each step, and why it cannot be where it is or that it is one too many; "" when it can."""
    before, captures = _Before(), 0
    for count, written in enumerate(steps):
        step = written.step
        captures += isinstance(step, Capture)
        fault = _out_of_place(step, before)
        if count >= MOST_STEPS or captures > MOST_CAPTURES:
            fault = f"the plan has more than {MOST_STEPS} steps or {MOST_CAPTURES} captures here; repeat less often"
        before = before.after(step)
        yield written, fault


def _out_of_place(step: Step, before: _Before) -> str:
    """Why the step cannot be here, and what to do; "" when it can."""
    match step:
        case StartChamber(degC) | SetTemperature(degC) if not COLDEST_degC <= degC <= WARMEST_degC:
            return f"a set-point of {degC:g} degC; give {COLDEST_degC:g} to {WARMEST_degC:g} degC"
        case SetTemperature() if before.degC is None:
            return "the chamber is stopped here; start_chamber sets its set-point and lets it heat and cool"
        case CoolDown() if before.camera_on:
            return "the camera is on here; give power_camera: off before it"
        case Capture() | SoakUntilSettled() if not before.camera_on:
            return "the camera is off here; give power_camera: on before it"
        case SoakUntilSettled() if before.degC is None:
            return "the chamber has no set-point here; give start_chamber before it"
        case Capture(role=Role.SETTLING):
            return "role settling is kept for the looks of a soak until settled; give another one"
        case SoakUntilSettled(role=role) if role is not Role.SETTLING:
            return f"the looks of a soak until settled have the role settling, not {role}"
        case Capture(role=role) if not before.flap_open and role is not Role.OTHER:
            return f"the flap is closed here, and {role} frames show the target; give open_flap before it"
        case _ if isinstance(step, AnySoak) and before.flap_open and longest_s(step) > _OPEN_S:
            return (
                f"the flap is open here, and the laboratory's air comes in for {longest_s(step):g} s; give close_flap"
            )
        case Capture() | SoakUntilSettled() if before.degC is not None and step.chamber_degC != before.degC:
            return (
                f"chamber_degC is {step.chamber_degC:g}, and the set-point of the steps before {before.degC:g} degC; "
                "leave chamber_degC out, or set that temperature before"
            )
        case _:
            return ""
