"""Steps as a recipe writes them: any step by its name, `repeat:` of steps, and `ramp:` of the set-point.

An entry has exactly one key. A capture takes the set-point it is made at from the steps before it.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Self, cast

from pydantic import BeforeValidator, Field, StringConstraints, model_validator

from experiments.parameters import (
    CaptureParameters,
    Chamber_degC,
    FrameCount,
    Guaranteed,
    Settled,
    Wait_s,
    check_until,
)
from experiments.pieces import placed, soak_until_settled
from experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    OpenFlap,
    PowerCamera,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    StartChamber,
    Step,
    StopChamber,
    find_fault,
)
from foundation.documents import Document

Place = tuple[str | int, ...]  # of an entry within the recipe, as in ("experiments", 0, "steps", 3)


class PlanError(ValueError):
    """A step cannot be where it is in the plan; `place` is that of its entry, the text says what to do."""

    def __init__(self, place: Place, text: str) -> None:
        super().__init__(text)
        self.place = place


@dataclass(frozen=True, slots=True)
class Written:
    """A step, and the place of the entry that it comes from."""

    place: Place
    step: Step


class Nothing(Document):
    """A step without parameters."""


class CaptureEntry(CaptureParameters):
    """`frames` images. role: what they are for; `other` frames are recorded and shown, and nothing is fitted to them.
    chamber_degC: only while the chamber is stopped, the temperature they are made at; else it is the set-point of the
    steps before. cameras: the names of those that expose, by default all of the stand."""

    frames: FrameCount = 1
    role: Role = Role.OTHER
    chamber_degC: Chamber_degC | None = None
    cameras: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _has_a_purpose(self) -> Self:
        if self.role is Role.SETTLING:
            raise ValueError("role settling is kept for the looks of soak_until_settled; give another one, or none")
        return self


class _Timed(Document):
    duration_s: Wait_s


class SoakEntry(Guaranteed, _Timed):
    """A guaranteed soak, as the step Soak."""

    last_s: Wait_s | None = None
    max_s: Wait_s | None = None

    @model_validator(mode="after")
    def _possible(self) -> Self:
        if reason := find_fault(self.step):
            raise ValueError(reason)
        return self

    @property
    def step(self) -> Soak:
        """The step."""
        return Soak(self.duration_s, self.band_K, self.last_s, self.max_s, self.unsettled)


def _soak(value: object) -> object:
    """A number alone is its time, s."""
    return {"duration_s": value} if isinstance(value, int | float) else value


class SoakUntilSettledEntry(Settled):
    """A soak until the camera has settled, at most `max_s`."""

    max_s: Wait_s = 2700.0
    exposure_s: float = Field(default=0.1, gt=0, le=10)

    @model_validator(mode="after")
    def _possible(self) -> Self:
        check_until(self, self.max_s, "max_s")
        return self


class CoolDownEntry(Document):
    """As the step CoolDown."""

    band_K: float = Field(default=0.5, gt=0, le=20)
    time_constant_s: float = Field(default=1200.0, gt=0, le=86400)
    max_s: Wait_s = 7200.0


class Repeat(Document):
    """The same steps `times` times."""

    times: int = Field(ge=1, le=10_000)
    steps: StepEntries = Field(min_length=1)


class Ramp(Document):
    """The set-point goes from where it is to `to_degC`, by `rate_K_per_min`: a new set-point every `every_K`, a soak
    that keeps the rate, then `steps`."""

    to_degC: Chamber_degC
    rate_K_per_min: float = Field(gt=0, le=20)
    every_K: float = Field(default=1.0, ge=0.1, le=80)
    steps: StepEntries = ()

    def set_points(self, from_degC: float) -> Iterator[tuple[float, float]]:
        """Each set-point, degC, and the soak after it, s."""
        way_K, before_degC = self.to_degC - from_degC, from_degC
        count = math.ceil(abs(way_K) / self.every_K - 1e-9)
        for number in range(1, count + 1):
            part = math.copysign(self.every_K * number, way_K)
            degC = self.to_degC if number == count else round(from_degC + part, 6)
            yield degC, round(abs(degC - before_degC) / self.rate_K_per_min * 60.0, 6)
            before_degC = degC


def _as_entry(value: object) -> object:
    """A name alone is a step without parameters, and so is a name without a value."""
    if isinstance(value, str):
        value = {value: None}
    if not isinstance(value, Mapping):
        raise ValueError("give the step's name, with its parameters behind a colon if it has any")
    entry = dict(cast("Mapping[object, object]", value))
    names = [str(name) for name in entry]
    if len(names) != 1:
        raise ValueError(f"an entry is one step, this one has {' and '.join(names) or 'none'}; begin each with a dash")
    if names[0] not in StepEntry.model_fields:
        raise ValueError(unknown("step", names[0], StepEntry.model_fields))
    return {names[0]: {} if entry[names[0]] is None and names[0] not in _WITH_A_VALUE else entry[names[0]]}


def unknown(what: str, name: str, known: Iterable[str]) -> str:
    """The sentence about a name that is none of these."""
    near = difflib.get_close_matches(name, known, 1, 0.5)
    advice = f"did you mean {near[0]}? There are" if near else "there are"
    return f"there is no {what} {name[:100]!r}; {advice} {', '.join(known)}"


def _as_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


_AxisNames = Annotated[
    tuple[str, ...], Field(min_length=1), BeforeValidator(_as_list, json_schema_input_type=str | tuple[str, ...])
]


class StepEntry(Document):
    """One step, repeat or ramp."""

    start_chamber: Chamber_degC | None = None
    set_temperature: Chamber_degC | None = None
    ramp: Ramp | None = None
    stop_chamber: Nothing | None = None
    soak: Annotated[SoakEntry, BeforeValidator(_soak, json_schema_input_type=Wait_s | SoakEntry)] | None = None
    soak_until_settled: SoakUntilSettledEntry | None = None
    open_flap: Nothing | None = None
    close_flap: Nothing | None = None
    capture: CaptureEntry | None = None
    move_to: Annotated[dict[str, float], Field(min_length=1)] | None = None
    check_home: _AxisNames | None = None
    power_camera: bool | None = None
    cool_down: CoolDownEntry | None = None
    prompt: Annotated[str, StringConstraints(min_length=1, max_length=500)] | None = None
    repeat: Repeat | None = None

    @model_validator(mode="after")
    def _has_a_value(self) -> Self:
        if getattr(self, self.name) is None:
            raise ValueError(f"{self.name} needs a value behind its colon")
        return self

    @property
    def name(self) -> str:
        """Its one key."""
        (name,) = self.model_fields_set
        return name


_WITH_A_VALUE = frozenset(
    {"start_chamber", "set_temperature", "soak", "move_to", "check_home", "power_camera", "prompt"}
)
StepEntries = tuple[Annotated[StepEntry, BeforeValidator(_as_entry, json_schema_input_type=str | StepEntry)], ...]
Repeat.model_rebuild()
Ramp.model_rebuild()
StepEntry.model_rebuild()


def written_steps(
    entries: Sequence[StepEntry], place: Place, at_degC: float | None
) -> Generator[Written, None, float | None]:
    """The steps of `entries`, which stand at `place`. at_degC: the set-point before them, None when the chamber is
    stopped; that after them is returned. Raises PlanError."""
    for number, entry in enumerate(entries):
        here = (*place, number, entry.name)
        match getattr(entry, entry.name):
            case Repeat() as repeat:
                for _ in range(repeat.times):
                    at_degC = yield from written_steps(repeat.steps, (*here, "steps"), at_degC)
            case Ramp() as ramp:
                if at_degC is None:
                    raise PlanError(here, "a ramp begins at a set-point; give start_chamber before it")
                for degC, soak_s in ramp.set_points(at_degC):
                    yield Written(here, SetTemperature(degC))
                    yield Written(here, Soak(soak_s, band_K=0.0))
                    at_degC = yield from written_steps(ramp.steps, (*here, "steps"), degC)
            case value:
                for step in _steps(entry.name, value, here, at_degC):
                    yield Written(here, step)
                    at_degC = set_point_after(step, at_degC)
    return at_degC


def set_point_after(step: Step, at_degC: float | None) -> float | None:
    """The chamber's set-point, degC, when the step is done; None when the chamber is stopped."""
    if isinstance(step, StartChamber | SetTemperature):
        return step.chamber_degC
    return None if isinstance(step, StopChamber) else at_degC


def _steps(name: str, value: object, place: Place, at_degC: float | None) -> Iterable[Step]:
    match name, value:
        case "start_chamber", float(degC):
            return (StartChamber(degC),)
        case "set_temperature", float(degC):
            return (SetTemperature(degC),)
        case _, SoakEntry() as soak:
            return (soak.step,)
        case _, SoakUntilSettledEntry(max_s=max_s, exposure_s=exposure_s) as until:
            return (soak_until_settled(max_s, until, exposure_s, _known(at_degC, place, "start_chamber before it")),)
        case _, CaptureEntry() as capture:
            degC = at_degC if capture.chamber_degC is None else capture.chamber_degC
            degC = _known(degC, place, "start_chamber before it, or chamber_degC")
            return (
                Capture(capture.frames, capture.interval_s, capture.exposure_s, capture.role, degC, capture.cameras),
            )
        case "move_to", dict() as positions:
            return placed(cast("dict[str, float]", positions))
        case "check_home", tuple() as axes:
            return (CheckHome(axis) for axis in cast("tuple[str, ...]", axes))
        case "power_camera", bool(on):
            return (PowerCamera(on),)
        case _, CoolDownEntry() as wait:
            return (CoolDown(wait.band_K, wait.time_constant_s, wait.max_s),)
        case "prompt", str(text):
            return (Prompt(text),)
        case _:
            return ({"stop_chamber": StopChamber, "open_flap": OpenFlap, "close_flap": CloseFlap}[name](),)


def _known(degC: float | None, place: Place, remedy: str) -> float:
    if degC is None:
        raise PlanError(place, f"the chamber has no set-point here; give {remedy}")
    return degC
