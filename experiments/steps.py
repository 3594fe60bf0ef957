"""The steps a plan is made of: data, not code. What performs them is the stand; what orders them, the scheduler.

Every step has a stable id (position and parameters), so that a plan can be listed, priced, checked and, after an
interruption, walked again.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, fields
from enum import StrEnum
from typing import Annotated, Literal, get_args

from pydantic import Field, TypeAdapter, ValidationError

from foundation.document_faults import path_text
from foundation.errors import ConfigError


class Role(StrEnum):
    """What a capture is for; the fitter never sees VALIDATION frames, the validation never scores FIT frames.

    CALIBRATION, POSE and REPEATABILITY frames show the target elsewhere than the drift's: no drift is fitted to them.
    POSE: the target at a validation position; REPEATABILITY: back at the first of them. SETTLING: a look during a soak,
    when the camera is not at rest yet. OTHER: for an evaluation of one's own; nothing here is fitted to them.
    """

    REFERENCE = "reference"
    FIT = "fit"
    VALIDATION = "validation"
    WARM_UP = "warm_up"
    CALIBRATION = "calibration"
    POSE = "pose"
    REPEATABILITY = "repeatability"
    SETTLING = "settling"
    OTHER = "other"


_BY_THE_PLAN = Field(json_schema_extra={"readOnly": True})  # nobody types what follows from the steps before
SetPoint_degC = Annotated[float, _BY_THE_PLAN]
"""Of frames: the set-point that the steps before have given the chamber."""


@dataclass(frozen=True, slots=True)
class StartChamber:
    """Give heat its permission and set the regulator running at `chamber_degC`."""

    chamber_degC: float


@dataclass(frozen=True, slots=True)
class SetTemperature:
    """A new chamber set-point; the next soak waits for what it does."""

    chamber_degC: float


@dataclass(frozen=True, slots=True)
class StopChamber:
    """Stop the regulator and withdraw the permission to heat and cool."""


OnUnsettled = Literal["mark", "hold"]
SOAK_BAND_K = 1.0
_LAST_PART, _LONGEST_LAST_S, _LIMIT = 1 / 3, 600.0, 2.0  # of a soak's time


@dataclass(frozen=True, slots=True)
class Soak:
    """Let the camera come to equilibrium: a guaranteed soak of `duration_s`.

    It ends when its time is over and the thermometer that the set-point controls was within `band_K` of it throughout
    the last `last_s` (by default a third of the time, at most 10 min). Until then it goes on, for `max_s` in all (by
    default twice its time). Then the run goes on and marks its frames, or with `unsettled: hold` is held.
    band_K 0: the chamber need not be anywhere; a wait for the table, or along a ramp.
    """

    duration_s: float
    band_K: float = SOAK_BAND_K
    last_s: float | None = None
    max_s: float | None = None
    unsettled: OnUnsettled = "mark"


@dataclass(frozen=True, slots=True)
class SoakUntilSettled:
    """Let the camera come to equilibrium at the set-point `chamber_degC`; done when it has settled, after `min_s` at
    the earliest and `max_s` at the latest.

    Settled: throughout `window_s` the chamber was in its band, the camera's temperature changed by less than
    `camera_K_per_min` and its image by less than `drift_px_per_min`, their uncertainties included. The image is looked
    at every `look_every_s` by a frame exposed for `exposure_s`, the flap being open for it only.
    """

    max_s: float
    min_s: float
    window_s: float
    look_every_s: float
    camera_K_per_min: float
    drift_px_per_min: float
    exposure_s: float
    chamber_degC: SetPoint_degC
    role: Annotated[Role, _BY_THE_PLAN] = Role.SETTLING


@dataclass(frozen=True, slots=True)
class OpenFlap:
    """Open the inspection flap and confirm it."""


@dataclass(frozen=True, slots=True)
class CloseFlap:
    """Close the inspection flap and confirm it."""


@dataclass(frozen=True, slots=True)
class Capture:
    """`frames` images, one every `interval_s`, each exposed for `exposure_s`. `chamber_degC`: the set-point
    of the steps before; of a chamber that is stopped, the temperature that the recipe states.
    `cameras`: the names of those that expose, none for all of the stand."""

    frames: int
    interval_s: float
    exposure_s: float
    role: Role
    chamber_degC: SetPoint_degC
    cameras: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class MoveTo:
    """Move the axis named `axis` to `position` (mm or deg), approached from below."""

    axis: str
    position: float


@dataclass(frozen=True, slots=True)
class PowerCamera:
    """Switch the camera's supply; switching on also waits until the camera answers."""

    on: bool


@dataclass(frozen=True, slots=True)
class CoolDown:
    """With the camera off, wait until it is within `band_K` of the chamber's air, at most `max_s`.

    Its excess is known from its last temperature before it was switched off and decays with `time_constant_s`, that of
    its slowest part.
    """

    band_K: float
    time_constant_s: float
    max_s: float


@dataclass(frozen=True, slots=True)
class CheckHome:
    """Home the axis named `axis` again, record how far its scale was off, and go back to where it stood."""

    axis: str


@dataclass(frozen=True, slots=True)
class Prompt:
    """Ask the operator to do what `text` says; skipped, with a note, when nobody attends."""

    text: str


WantedState = Literal["at_rest", "on_the_way"]
WANTED_STATES: tuple[WantedState, ...] = ("at_rest",)


@dataclass(frozen=True, slots=True)
class Decide:
    """Ask what to visit next, or whether enough is known: the answer replaces what is left of its cycle, which are
    visits of `set_points_degC` for `dwell_s` each (experiments/known.py).

    Wanted is a predicted residual of `residual_px` from `coldest_degC` to `warmest_degC`, over `states`: of a camera
    `at_rest`, 4 h after a change, or `on_the_way`, 45 min after it. No temperature outside is visited, none of
    `held_out_degC` is shown to the fitter; of these `unvalidated_degC` have not been visited yet.
    `dwells_s`: to choose from. `ramp_K_per_min`: of the chamber, at most. `left_s`: of the fixed cycle's time.
    `visits`: that were decided so far. `wait_s`: for an answer, in real time; without one the fixed visits go on.
    `frames`, `interval_s`, `exposure_s`: of a visit.
    """

    dwell_s: float
    residual_px: float
    coldest_degC: float
    warmest_degC: float
    dwells_s: tuple[float, ...]
    ramp_K_per_min: float
    left_s: Annotated[float, _BY_THE_PLAN]
    visits: Annotated[int, _BY_THE_PLAN]
    wait_s: float
    frames: int
    interval_s: float
    exposure_s: float
    set_points_degC: tuple[float, ...] = ()
    held_out_degC: tuple[float, ...] = ()
    unvalidated_degC: Annotated[tuple[float, ...], _BY_THE_PLAN] = ()
    states: tuple[WantedState, ...] = WANTED_STATES


Step = (
    StartChamber
    | SetTemperature
    | StopChamber
    | Soak
    | SoakUntilSettled
    | OpenFlap
    | CloseFlap
    | Capture
    | MoveTo
    | PowerCamera
    | CoolDown
    | CheckHome
    | Prompt
    | Decide
)


AnySoak = Soak | SoakUntilSettled


def find_fault(soak: Soak) -> str:
    """Why the soak cannot be guaranteed, as a clause; "" when it can."""
    if soak.max_s is not None and soak.max_s < soak.duration_s:
        return f"max_s {soak.max_s:g} is its longest time; it must be at least duration_s {soak.duration_s:g}"
    if last_part_s(soak) > soak.duration_s:
        return f"last_s {soak.last_s:g} is its last part; it must be at most duration_s {soak.duration_s:g}"
    return ""


def is_setup(step: Step) -> bool:
    """Whether the step brings about a state, to be restored after an interruption; the others are work, done once."""
    return not isinstance(step, AnySoak | CoolDown | Capture | CheckHome | Prompt | Decide)


def longest_s(soak: AnySoak) -> float:
    """What the soak takes at the most, s."""
    if isinstance(soak, SoakUntilSettled):
        return soak.max_s
    if soak.band_K == 0.0:
        return soak.duration_s
    return max(soak.duration_s, _LIMIT * soak.duration_s if soak.max_s is None else soak.max_s)


def band_K_of(soak: AnySoak) -> float:
    """How near to its set-point the chamber has to be in the soak's last part, K; 0: anywhere."""
    return soak.band_K if isinstance(soak, Soak) else SOAK_BAND_K


def last_part_s(soak: AnySoak) -> float:
    """For how long before its end the chamber has to be in the soak's band, s."""
    if isinstance(soak, Soak) and soak.last_s is not None:
        return soak.last_s
    stated_s = soak.duration_s if isinstance(soak, Soak) else soak.max_s
    return min(_LAST_PART * stated_s, _LONGEST_LAST_S)


# What a step takes beyond its stated durations, s: flap travel and its confirmation, stage moves, homing and back.
_FLAP_S = 3.0
_MOVE_S = 15.0
_CHECK_HOME_S = 120.0
_DECIDE_S = 10.0
_CAMERA_EXCESS_K = 20.0  # of a camera that has been on for an hour, over the air around it


def estimate_s(step: Step, camera_boot_s: float) -> float:
    """How long the step is expected to take on the stand's clock, s, with a camera that boots in `camera_boot_s`."""
    match step:
        case Soak():
            return step.duration_s
        case SoakUntilSettled():
            return step.max_s
        case Capture():
            return (step.frames - 1) * step.interval_s + step.exposure_s
        case OpenFlap() | CloseFlap():
            return _FLAP_S
        case MoveTo():
            return _MOVE_S
        case PowerCamera():
            return camera_boot_s if step.on else 0.0
        case CoolDown():
            return min(step.max_s, step.time_constant_s * max(0.0, math.log(_CAMERA_EXCESS_K / step.band_K)))
        case CheckHome():
            return _CHECK_HOME_S
        case Decide():
            return _DECIDE_S
        case StartChamber() | SetTemperature() | StopChamber() | Prompt():
            return 0.0


def frames_of(step: Step) -> int:
    """How many frames the step will record."""
    return step.frames if isinstance(step, Capture) else 0


def kind_of(step: Step) -> str:
    """The step's name as recordings and listings show it."""
    return type(step).__name__


def parameters_of(step: Step) -> dict[str, object]:
    """The step's fields as JSON-able values; without those that list nothing, such as a capture's cameras, or leave a
    default to the step."""
    values = {name: str(value) if isinstance(value, Role) else value for name, value in asdict(step).items()}
    return {name: value for name, value in values.items() if value != () and value is not None}


_KINDS: dict[str, type[Step]] = {kind.__name__: kind for kind in get_args(Step)}


def step_of(kind: str, parameters: Mapping[str, object]) -> Step:
    """The step that `kind_of` and `parameters_of` have given; ConfigError when there is none such."""
    if kind not in _KINDS:
        raise ConfigError(f"no step is called {kind!r}; there are {', '.join(_KINDS)}")
    if unknown := sorted(set(parameters) - {each.name for each in fields(_KINDS[kind])}):
        raise ConfigError(f"{kind} has no {', '.join(unknown)}")
    try:
        step = TypeAdapter(_KINDS[kind]).validate_python(dict(parameters))
    except ValidationError as error:
        wrong = "; ".join(f"{path_text(each['loc'])}: {each['msg']}" for each in error.errors())
        raise ConfigError(f"{kind}: {wrong}") from error
    for name, value in asdict(step).items():
        least = 1 if name == "frames" else 0 if name.endswith("_s") or name == "band_K" else -math.inf
        if isinstance(value, int | float) and not least <= value < math.inf:
            raise ConfigError(f"{kind}: {name} is {value}")
    if isinstance(step, Soak) and (reason := find_fault(step)):
        raise ConfigError(f"{kind}: {reason}")
    return step


def schema_of_steps() -> dict[str, object]:
    """The JSON Schema of any step's parameters, with a definition for each kind, by its name. readOnly: what follows
    from the plan; `chamber_degC` of frames need not be given."""
    schema = TypeAdapter(Step).json_schema()
    for kind in (Capture, SoakUntilSettled):
        schema["$defs"][kind.__name__]["required"].remove("chamber_degC")
    return schema


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """A step at its place in the plan. `step_id` stays the same as long as place and parameters do."""

    index: int
    step_id: str
    step: Step


def number_steps(steps: Iterable[Step], first: int = 0) -> Iterator[PlannedStep]:
    """Give each step its place (from `first`) and its id."""
    for index, step in enumerate(steps, first):
        text = json.dumps([index, kind_of(step), parameters_of(step)], sort_keys=True)
        yield PlannedStep(index, hashlib.sha256(text.encode()).hexdigest()[:12], step)
