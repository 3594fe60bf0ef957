"""The steps a plan is made of: data, not code. Each kind is described once, by its class: its name in recipes, in the
API and in the journal, its fields, its words, how long it takes, what it needs of the steps before it and of the stand,
what it leaves behind, and what it asks of the stand that performs it.

Another package adds a kind by a subclass of Step, which an entry point of the group `thermostand.steps` names.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from enum import StrEnum
from functools import cache
from importlib.metadata import entry_points
from types import MappingProxyType
from typing import Annotated, Any, ClassVar, Protocol, Self, cast

from pydantic import BeforeValidator, Field, StringConstraints, TypeAdapter, ValidationError, model_validator

from thermostand.experiments.parameters import (
    SOAK_BAND_K,
    WANTED_STATES,
    CaptureParameters,
    Chamber_degC,
    COLDEST_degC,
    FrameCount,
    Guaranteed,
    OnUnsettled,
    Settled,
    Wait_s,
    WantedState,
    WARMEST_degC,
    check_until,
)
from thermostand.foundation.document_faults import format_path
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.plugins import load_point

GROUP = "thermostand.steps"
LABORATORY_degC = 24.0  # where the chamber begins a run; the room temperature of the paper (section 3.1)


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


class _Chamber(Protocol):
    async def start(self, setpoint_degC: float) -> None: ...
    async def set_temperature(self, setpoint_degC: float) -> None: ...
    async def stop(self) -> None: ...


class _Imaging(Protocol):
    async def open_flap(self) -> None: ...
    async def close_flap(self) -> None: ...
    async def power_camera(self, *, on: bool) -> None: ...
    async def cool_down(self, band_K: float, time_constant_s: float, max_s: float) -> None: ...


class _Table(Protocol):
    async def move_to(self, axis: str, position: float) -> None: ...
    async def check_home(self, axis: str) -> None: ...


class PerformingStand(Protocol):
    """What steps ask of the stand that performs them."""

    @property
    def chamber(self) -> _Chamber: ...
    @property
    def imaging(self) -> _Imaging: ...
    @property
    def table(self) -> _Table: ...
    async def prompt(self, text: str) -> None: ...


class KnownStand:
    """What is known of a stand before anything moves; this is one of which nothing is known. The faults are clauses, ""
    when there is none; times are in s."""

    boot_s: float = 0.0
    """Of the camera that takes longest to answer after it was switched on."""

    def set_point_way_s(self, from_degC: float, to_degC: float) -> float:
        """Return how long the set-point itself is on its way, where it goes by a ramp."""
        del from_degC, to_degC
        return 0.0

    def arrival_s(self, from_degC: float, to_degC: float, band_K: float) -> float | None:
        """Return when the chamber is in its band after a new set-point; None when no recorded run has shown how fast it
        is."""
        del from_degC, to_degC, band_K
        return None

    def settling_s(self, from_degC: float, to_degC: float, camera_K_per_min: float) -> float | None:
        """Return when the camera changes by less than that after a new set-point of the chamber; None when that is
        unknown."""
        del from_degC, to_degC, camera_K_per_min
        return None

    def move_s(self, axis: str, begin: float, end: float) -> float:
        """Compute the time of a move, mm or deg; ConfigError when the stand has no such axis."""
        del axis, begin, end
        return 0.0

    def to_home_s(self, axis: str, position: float) -> float:
        """Compute the time of the way from `position` to the home switch; ConfigError as above."""
        del axis, position
        return 0.0

    def set_point_fault(self, chamber_degC: float) -> str:
        """Return why the stand may not have that set-point."""
        del chamber_degC
        return ""

    def camera_fault(self) -> str:
        """Return why no camera can be used."""
        return ""

    def supply_fault(self) -> str:
        """Return why the camera cannot be switched off."""
        return ""

    def exposure_fault(self, chamber_degC: float) -> str:
        """Return why the flap must not be open at that set-point."""
        del chamber_degC
        return ""

    def rate_fault(self, cameras: tuple[str, ...], interval_s: float | None) -> str:
        """Return why these cameras (none: all) cannot expose, one frame each `interval_s` when there are several."""
        del cameras, interval_s
        return ""

    def axis_fault(self, axis: str, position: float | None) -> str:
        """Return why the axis cannot go to `position`, mm or deg, or, with None, be homed from anywhere."""
        del axis, position
        return ""


@dataclass(frozen=True, slots=True)
class Situation:
    """What a step finds, as the steps before have left it: set-point (None: the chamber is stopped), the camera's
    supply, whether the plan has had it on (before that its temperature is unknown), the flap, where each axis stands
    (mm or deg; one that is missing is not homed), the last two set-points, and what was soaked since, s: the first soak
    is taken to begin when the chamber sets off from the one to the other."""

    set_point_degC: float | None = None
    camera_on: bool = True
    camera_was_on: bool = False
    flap_open: bool = False
    positions: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    from_degC: float = LABORATORY_degC
    to_degC: float = LABORATORY_degC
    soaked_s: float = 0.0


@dataclass(frozen=True, slots=True)
class Price:
    """How long a step takes, s: `stated_s` follows from it and what it finds, `overhead_s` is what `work` of this kind
    usually takes beyond that, until recorded runs have shown better."""

    work: str
    stated_s: float
    overhead_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """Together, s."""
        return max(0.0, self.stated_s + self.overhead_s)


def estimate_duration_s(steps: Iterable[Step]) -> float:
    """Return what these steps take one after the other on a stand of which nothing is known, s."""
    found, total_s = Situation(), 0.0
    for step in steps:
        total_s += step.price(found, KnownStand()).duration_s
        found = step.situation_after(found)
    return total_s


STEPS: dict[str, type[Step]] = {}
"""Every kind of step that is known, by its name."""


class Step:
    """A step, and everything that describes its kind; a subclass is a frozen dataclass.

    kind: its name. is_setup: whether it brings about a state, which is restored after an interruption; the others are
    work, done once. ends_when_skipped: whether work under way can be broken off. at_set_point: it takes frames, and has
    a field `chamber_degC` that follows from the steps before. says: its words, with fields in braces. in_recipes:
    whether a recipe can name it. form: what a recipe writes behind the name, by default nothing.
    """

    __slots__ = ()
    kind: ClassVar[str]
    is_setup: ClassVar[bool]
    ends_when_skipped: ClassVar[bool] = False
    at_set_point: ClassVar[bool] = False
    says: ClassVar[str] = ""
    in_recipes: ClassVar[bool] = True
    form: ClassVar[Any] = None

    def __init_subclass__(cls) -> None:
        missing = [name for name in ("kind", "is_setup") if name not in vars(cls)]
        if missing:
            raise TypeError(f"{cls.__name__} is a step and has to state {' and '.join(missing)}")
        if not (cls.kind.isidentifier() and cls.kind.islower()):
            raise TypeError(f"{cls.__name__} is a step; its kind {cls.kind!r} has to be one word, as in move_to")
        STEPS[cls.kind] = cls

    @classmethod
    def of_form(cls, value: Any, at_degC: float | None) -> Iterable[Step]:
        """The steps that a recipe's entry stands for, at that set-point; ValueError when they cannot be there."""
        del at_degC
        make = cast("Any", cls)  # each subclass is a dataclass
        return (make(),) if cls.form is None else (make(value),)

    @property
    def words(self) -> str:
        """Describe the step as in `soak for 45 min`, for people who watch a run."""
        return self.says.format(**asdict(cast("Any", self))) or self.kind.replace("_", " ")

    @property
    def parameters(self) -> dict[str, object]:
        """The fields as JSON-able values; without those that list nothing, such as a capture's cameras, or leave a
        default to the step."""
        values = asdict(cast("Any", self))  # each subclass is a dataclass
        return {name: _make_json(value) for name, value in values.items() if value != () and value is not None}

    @property
    def frame_count(self) -> int:
        """How many frames it records."""
        return 0

    def fault(self) -> str:
        """Return why its fields do not go together, as a clause; "" when they do."""
        return ""

    def placement_fault(self, found: Situation) -> str:
        """Return why it cannot follow the steps before it, and what to do; "" when it can."""
        del found
        return ""

    def stand_fault(self, stand: KnownStand) -> str:
        """Return why it is nothing for this stand, or outside its limits; "" when the stand can do it. Raises
        ConfigError where a name is unknown."""
        del stand
        return ""

    def price(self, found: Situation, stand: KnownStand) -> Price:
        """Return how long it takes in the situation it finds."""
        del found, stand
        return Price(self.kind, 0.0)

    def situation_after(self, found: Situation) -> Situation:
        """Return what is different when it is done."""
        return found

    async def perform(self, stand: PerformingStand) -> None:
        """Do it. The run itself soaks, captures and decides."""
        del stand


class _SetPoint:
    """What a step with a new set-point is, however it is given."""

    __slots__ = ()
    kind: ClassVar[str]
    chamber_degC: float

    def placement_fault(self, found: Situation) -> str:
        del found
        if COLDEST_degC <= self.chamber_degC <= WARMEST_degC:
            return ""
        return f"a set-point of {self.chamber_degC:g} degC; give {COLDEST_degC:g} to {WARMEST_degC:g} degC"

    def stand_fault(self, stand: KnownStand) -> str:
        return stand.set_point_fault(self.chamber_degC)

    def price(self, found: Situation, stand: KnownStand) -> Price:
        return Price(self.kind, stand.set_point_way_s(found.to_degC, self.chamber_degC))

    def situation_after(self, found: Situation) -> Situation:
        degC = self.chamber_degC
        return replace(found, set_point_degC=degC, from_degC=found.to_degC, to_degC=degC, soaked_s=0.0)


@dataclass(frozen=True, slots=True)
class StartChamber(_SetPoint, Step):
    """Give heat its permission and set the regulator running at `chamber_degC`."""

    kind = "start_chamber"
    is_setup = True
    says = "start the chamber at {chamber_degC:g} °C"
    form = Chamber_degC
    chamber_degC: float

    async def perform(self, stand: PerformingStand) -> None:
        await stand.chamber.start(self.chamber_degC)


@dataclass(frozen=True, slots=True)
class SetTemperature(_SetPoint, Step):
    """A new chamber set-point; the next soak waits for what it does."""

    kind = "set_temperature"
    is_setup = True
    says = "chamber at {chamber_degC:g} °C"
    form = Chamber_degC
    chamber_degC: float

    def placement_fault(self, found: Situation) -> str:
        if fault := _SetPoint.placement_fault(self, found):
            return fault
        stopped = "the chamber is stopped here; start_chamber sets its set-point and lets it heat and cool"
        return stopped if found.set_point_degC is None else ""

    async def perform(self, stand: PerformingStand) -> None:
        await stand.chamber.set_temperature(self.chamber_degC)


@dataclass(frozen=True, slots=True)
class StopChamber(Step):
    """Stop the regulator and withdraw the permission to heat and cool."""

    kind = "stop_chamber"
    is_setup = True
    says = "stop the chamber"

    def situation_after(self, found: Situation) -> Situation:
        return replace(found, set_point_degC=None)

    async def perform(self, stand: PerformingStand) -> None:
        await stand.chamber.stop()


# A soak is judged by its last third, at most 10 min of it, and lasts at most twice its time: a chamber that is too weak
# for a set-point still gives a session, whose frames say so.
_LAST_PART, _LONGEST_LAST_S, _LIMIT = 1 / 3, 600.0, 2.0  # of a soak's time
_OPEN_S = 60.0  # of a soak through an open flap: the laboratory's air comes in


class _Timed(Document):
    duration_s: Wait_s = Field(description="The time of the soak.")


class SoakEntry(Guaranteed, _Timed):
    """A guaranteed soak, as the step Soak."""

    last_s: Wait_s | None = Field(
        default=None, description="The last part, in which the chamber has to stay in its band; empty for a third."
    )
    max_s: Wait_s | None = Field(default=None, description="The longest soak; empty for twice its time.")

    @model_validator(mode="after")
    def _check_possible(self) -> Self:
        if reason := self.step.fault():
            raise ValueError(reason)
        return self

    @property
    def step(self) -> Soak:
        """The step."""
        return Soak(self.duration_s, self.band_K, self.last_s, self.max_s, self.unsettled)


def _expand_time(value: object) -> object:
    """A number alone is its time, s."""
    return {"duration_s": value} if isinstance(value, int | float) else value


@dataclass(frozen=True, slots=True)
class Soak(Step):
    """Let the camera come to equilibrium: a guaranteed soak of `duration_s`.

    It ends when its time is over and the thermometer that the set-point controls was within `band_K` of it throughout
    the last `last_s` (by default a third of the time, at most 10 min). Until then it goes on, for `max_s` in all (by
    default twice its time). Then the run goes on and marks its frames, or with `unsettled: hold` is held.
    band_K 0: the chamber need not be anywhere; a wait for the table, or along a ramp.
    """

    kind = "soak"
    is_setup = False
    ends_when_skipped = True
    form = Annotated[SoakEntry, BeforeValidator(_expand_time, json_schema_input_type=Wait_s | SoakEntry)]
    duration_s: float
    band_K: float = SOAK_BAND_K
    last_s: float | None = None
    max_s: float | None = None
    unsettled: OnUnsettled = "mark"

    @classmethod
    def of_form(cls, value: SoakEntry, at_degC: float | None) -> Iterable[Step]:
        return (value.step,)

    @property
    def words(self) -> str:
        return f"soak for {_format_span(self.duration_s)}"

    @property
    def longest_s(self) -> float:
        """What it takes at the most, s."""
        if self.band_K == 0.0:
            return self.duration_s
        return max(self.duration_s, _LIMIT * self.duration_s if self.max_s is None else self.max_s)

    @property
    def guaranteed_K(self) -> float:
        """How near to its set-point the chamber has to be in the last part, K; 0: anywhere."""
        return self.band_K

    @property
    def last_part_s(self) -> float:
        """How long before its end the chamber has to be in its band, s."""
        return min(_LAST_PART * self.duration_s, _LONGEST_LAST_S) if self.last_s is None else self.last_s

    def extend(self, by_s: float) -> Soak:
        """One that takes so much longer."""
        return replace(self, duration_s=self.duration_s + by_s, max_s=None if self.max_s is None else self.max_s + by_s)

    def fault(self) -> str:
        if self.max_s is not None and self.max_s < self.duration_s:
            return f"max_s {self.max_s:g} is its longest time; it must be at least duration_s {self.duration_s:g}"
        if self.last_part_s > self.duration_s:
            return f"last_s {self.last_s:g} is its last part; it must be at most duration_s {self.duration_s:g}"
        return ""

    def placement_fault(self, found: Situation) -> str:
        return _explain_open_flap(found, self.longest_s)

    def price(self, found: Situation, stand: KnownStand) -> Price:
        """Return the time until the chamber has been in its band for the last part, too, where that is known."""
        arrival_s = stand.arrival_s(found.from_degC, found.to_degC, self.band_K) if self.band_K else None
        if arrival_s is None:
            return Price(self.kind, self.duration_s)
        settled_s = arrival_s - found.soaked_s + self.last_part_s
        return Price(self.kind, min(self.longest_s, max(self.duration_s, settled_s)))

    def situation_after(self, found: Situation) -> Situation:
        return replace(found, soaked_s=found.soaked_s + self.duration_s)


class SoakUntilSettledEntry(Settled):
    """A soak until the camera has settled, at most `max_s`."""

    max_s: Wait_s = 2700.0
    exposure_s: float = Field(default=0.1, gt=0, le=10)

    @model_validator(mode="after")
    def _check_possible(self) -> Self:
        check_until(self, self.max_s, "max_s")
        return self


_BY_THE_PLAN = Field(json_schema_extra={"readOnly": True})  # nobody types what follows from the steps before
SetPoint_degC = Annotated[float, _BY_THE_PLAN]
"""Of frames: the set-point that the steps before have given the chamber."""


@dataclass(frozen=True, slots=True)
class SoakUntilSettled(Step):
    """Let the camera come to equilibrium at the set-point `chamber_degC`; done when it has settled, after `min_s` at
    the earliest and `max_s` at the latest.

    Settled: throughout `window_s` the chamber was in its band, the camera's temperature changed by less than
    `camera_K_per_min` and its image by less than `drift_px_per_min`, their uncertainties included. The image is looked
    at every `look_every_s` by a frame exposed for `exposure_s`, the flap being open for it only.
    """

    kind = "soak_until_settled"
    is_setup = False
    ends_when_skipped = True
    at_set_point = True
    form = SoakUntilSettledEntry
    max_s: float
    min_s: float
    window_s: float
    look_every_s: float
    camera_K_per_min: float
    drift_px_per_min: float
    exposure_s: float
    chamber_degC: SetPoint_degC
    role: Annotated[Role, _BY_THE_PLAN] = Role.SETTLING

    @classmethod
    def until(cls, max_s: float, until: Settled, exposure_s: float, chamber_degC: float) -> SoakUntilSettled:
        """Return the step with the thresholds of `until`."""
        return cls(
            max_s=max_s,
            min_s=until.min_s,
            window_s=until.window_s,
            look_every_s=until.look_every_s,
            camera_K_per_min=until.camera_K_per_min,
            drift_px_per_min=until.drift_px_per_min,
            exposure_s=exposure_s,
            chamber_degC=chamber_degC,
        )

    @classmethod
    def of_form(cls, value: SoakUntilSettledEntry, at_degC: float | None) -> Iterable[Step]:
        return (
            cls.until(value.max_s, value, value.exposure_s, _require_set_point(at_degC, "start_chamber before it")),
        )

    @property
    def words(self) -> str:
        return f"soak at {self.chamber_degC:g} °C until settled, at most {_format_span(self.max_s)}"

    @property
    def longest_s(self) -> float:
        """What it takes at the most, s."""
        return self.max_s

    @property
    def guaranteed_K(self) -> float:
        """How near to its set-point the chamber has to be in the last part, K."""
        return SOAK_BAND_K

    @property
    def last_part_s(self) -> float:
        """How long before its end the chamber has to be in its band, s."""
        return min(_LAST_PART * self.max_s, _LONGEST_LAST_S)

    def extend(self, by_s: float) -> SoakUntilSettled:
        """One that waits longer at the least and at the most."""
        return replace(self, min_s=self.min_s + by_s, max_s=self.max_s + by_s)

    def placement_fault(self, found: Situation) -> str:
        if not found.camera_on:
            return _CAMERA_OFF
        if found.set_point_degC is None:
            return "the chamber has no set-point here; give start_chamber before it"
        if self.role is not Role.SETTLING:
            return f"the looks of a soak until settled have the role settling, not {self.role}"
        return _explain_open_flap(found, self.longest_s) or _explain_set_point_mismatch(self.chamber_degC, found)

    def stand_fault(self, stand: KnownStand) -> str:
        return stand.exposure_fault(self.chamber_degC) or stand.camera_fault()

    def price(self, found: Situation, stand: KnownStand) -> Price:
        """The chamber arrives, the camera follows until it is slow enough, and then it has to stay so. How the image
        drifts is unknown until it was seen once."""
        settling_s = stand.settling_s(found.from_degC, found.to_degC, self.camera_K_per_min)
        expected_s = self.max_s if settling_s is None else settling_s + self.window_s
        return Price(self.kind, min(self.max_s, max(self.min_s, expected_s)))


AnySoak = Soak | SoakUntilSettled
_CAMERA_OFF = "the camera is off here; give power_camera: on before it"


def _explain_open_flap(found: Situation, longest_s: float) -> str:
    if not found.flap_open or longest_s <= _OPEN_S:
        return ""
    return f"the flap is open here, and the laboratory's air comes in for {longest_s:g} s; give close_flap"


def _explain_set_point_mismatch(chamber_degC: float, found: Situation) -> str:
    if found.set_point_degC is None or chamber_degC == found.set_point_degC:
        return ""
    return (
        f"chamber_degC is {chamber_degC:g}, and the set-point of the steps before {found.set_point_degC:g} degC; "
        "leave chamber_degC out, or set that temperature before"
    )


def _require_set_point(degC: float | None, remedy: str) -> float:
    if degC is None:
        raise ValueError(f"the chamber has no set-point here; give {remedy}")
    return degC


# A flap's travel with its confirmation, until recorded sessions have shown better, s.
_FLAP_TRAVEL_S = 3.0
_FLAP_AT_REST_S = 0.2  # as _FLAP_TRAVEL_S, with nothing to wait for


def _price_flap(travels: bool) -> Price:
    return Price("flap travel", 0.0, _FLAP_TRAVEL_S) if travels else Price("flap at rest", 0.0, _FLAP_AT_REST_S)


@dataclass(frozen=True, slots=True)
class OpenFlap(Step):
    """Open the inspection flap and confirm it."""

    kind = "open_flap"
    is_setup = True
    says = "open the flap"

    def price(self, found: Situation, stand: KnownStand) -> Price:
        return _price_flap(not found.flap_open)

    def situation_after(self, found: Situation) -> Situation:
        return replace(found, flap_open=True)

    async def perform(self, stand: PerformingStand) -> None:
        await stand.imaging.open_flap()


@dataclass(frozen=True, slots=True)
class CloseFlap(Step):
    """Close the inspection flap and confirm it."""

    kind = "close_flap"
    is_setup = True
    says = "close the flap"

    def price(self, found: Situation, stand: KnownStand) -> Price:
        return _price_flap(found.flap_open)

    def situation_after(self, found: Situation) -> Situation:
        return replace(found, flap_open=False)

    async def perform(self, stand: PerformingStand) -> None:
        await stand.imaging.close_flap()


class CaptureEntry(CaptureParameters):
    """`frames` images. role: what they are for; `other` frames are recorded and shown, and nothing is fitted to them.
    chamber_degC: only while the chamber is stopped, the temperature they are made at; else it is the set-point of the
    steps before. cameras: the names of those that expose, by default all of the stand."""

    frames: FrameCount = Field(default=1, description="How many.")
    role: Role = Field(default=Role.OTHER, description="What they are for; nothing is fitted to `other` ones.")
    chamber_degC: Chamber_degC | None = Field(
        default=None, description="At which temperature they are made, only while the chamber is stopped."
    )
    cameras: tuple[str, ...] = Field(default=(), description="Those that expose, by name; empty for all.")

    @model_validator(mode="after")
    def _check_purpose(self) -> Self:
        if self.role is Role.SETTLING:
            raise ValueError("role settling is kept for the looks of soak_until_settled; give another one, or none")
        return self


@dataclass(frozen=True, slots=True)
class Capture(Step):
    """`frames` images, one every `interval_s`, each exposed for `exposure_s`. `chamber_degC`: the set-point
    of the steps before; of a chamber that is stopped, the temperature that the recipe states.
    `cameras`: the names of those that expose, none for all of the stand."""

    kind = "capture"
    is_setup = False
    ends_when_skipped = True
    at_set_point = True
    form = CaptureEntry
    frames: int
    interval_s: float
    exposure_s: float
    role: Role
    chamber_degC: SetPoint_degC
    cameras: tuple[str, ...] = ()

    @classmethod
    def of_form(cls, value: CaptureEntry, at_degC: float | None) -> Iterable[Step]:
        degC = _require_set_point(
            at_degC if value.chamber_degC is None else value.chamber_degC, "start_chamber before it, or chamber_degC"
        )
        return (cls(value.frames, value.interval_s, value.exposure_s, value.role, degC, value.cameras),)

    @property
    def words(self) -> str:
        frames = "frame" if self.frames == 1 else "frames"
        of = f" of {', '.join(self.cameras)}" if self.cameras else ""
        return f"{self.frames} {frames}{of} at {self.chamber_degC:g} °C ({self.role.replace('_', ' ')})"

    @property
    def frame_count(self) -> int:
        return self.frames

    def placement_fault(self, found: Situation) -> str:
        if not found.camera_on:
            return _CAMERA_OFF
        if self.role is Role.SETTLING:
            return "role settling is kept for the looks of a soak until settled; give another one"
        if not found.flap_open and self.role is not Role.OTHER:
            return f"the flap is closed here, and {self.role} frames show the target; give open_flap before it"
        return _explain_set_point_mismatch(self.chamber_degC, found)

    def stand_fault(self, stand: KnownStand) -> str:
        interval_s = self.interval_s if self.frames > 1 else None
        return (
            stand.exposure_fault(self.chamber_degC)
            or stand.camera_fault()
            or stand.rate_fault(self.cameras, interval_s)
        )

    def price(self, found: Situation, stand: KnownStand) -> Price:
        return Price(self.kind, (self.frames - 1) * self.interval_s + self.exposure_s)

    def situation_after(self, found: Situation) -> Situation:
        return replace(found, camera_was_on=True)


# Homing from near the switch, and the confirmation of a move, until recorded sessions have shown better, s.
_HOMING_S = 15.0
_MOVE_CONFIRMED_S = 0.1  # as _HOMING_S: until recorded sessions have shown better


@dataclass(frozen=True, slots=True)
class MoveTo(Step):
    """Move the axis named `axis` to `position` (mm or deg), approached from below."""

    kind = "move_to"
    is_setup = True
    says = "move {axis} to {position:g}"
    form = Annotated[dict[str, float], Field(min_length=1)]
    axis: str
    position: float

    @classmethod
    def of_form(cls, value: Mapping[str, float], at_degC: float | None) -> Iterable[Step]:
        return (cls(axis, position) for axis, position in value.items())

    def stand_fault(self, stand: KnownStand) -> str:
        return stand.axis_fault(self.axis, self.position)

    def price(self, found: Situation, stand: KnownStand) -> Price:
        begin = found.positions.get(self.axis)
        if begin is None:
            return Price(f"home and move {self.axis}", stand.move_s(self.axis, 0.0, self.position), _HOMING_S)
        return Price(f"move {self.axis}", stand.move_s(self.axis, begin, self.position), _MOVE_CONFIRMED_S)

    def situation_after(self, found: Situation) -> Situation:
        return replace(found, positions=MappingProxyType({**found.positions, self.axis: self.position}))

    async def perform(self, stand: PerformingStand) -> None:
        await stand.table.move_to(self.axis, self.position)


@dataclass(frozen=True, slots=True)
class PowerCamera(Step):
    """Switch the camera's supply; switching on also waits until the camera answers."""

    kind = "power_camera"
    is_setup = True
    form = bool
    on: bool

    @property
    def words(self) -> str:
        return f"camera {'on' if self.on else 'off'}"

    def stand_fault(self, stand: KnownStand) -> str:
        return stand.camera_fault() or ("" if self.on else stand.supply_fault())

    def price(self, found: Situation, stand: KnownStand) -> Price:
        return Price(self.kind, stand.boot_s if self.on else 0.0)

    def situation_after(self, found: Situation) -> Situation:
        return replace(found, camera_on=self.on, camera_was_on=found.camera_was_on or self.on)

    async def perform(self, stand: PerformingStand) -> None:
        await stand.imaging.power_camera(on=self.on)


# The warmest camera of the published ones is 25 K above the air; an error of two changes a cool-down's estimate by 0.7
# of a time constant.
_CAMERA_EXCESS_K = 20.0  # of a camera that has been on for an hour, over the air around it
COOL_DOWN_AS_FOUND = "cool down as found"  # of a camera that the run finds as warm as it happens to be


class CoolDownEntry(Document):
    """The entry of a recipe for the step CoolDown."""

    band_K: float = Field(default=0.5, gt=0, le=20, description="How near to the air the camera has to be.")
    time_constant_s: float = Field(
        default=1200.0, gt=0, le=86400, description="With which the camera's slowest part cools down."
    )
    max_s: Wait_s = Field(default=7200.0, description="The longest wait.")


@dataclass(frozen=True, slots=True)
class CoolDown(Step):
    """With the camera off, wait until it is within `band_K` of the chamber's air, at most `max_s`.

    Its excess is known from its last temperature before it was switched off and decays with `time_constant_s`, that of
    its slowest part.
    """

    kind = "cool_down"
    is_setup = False
    ends_when_skipped = True
    form = CoolDownEntry
    band_K: float
    time_constant_s: float
    max_s: float

    @classmethod
    def of_form(cls, value: CoolDownEntry, at_degC: float | None) -> Iterable[Step]:
        return (cls(value.band_K, value.time_constant_s, value.max_s),)

    @property
    def words(self) -> str:
        return f"camera cools down to within {self.band_K:g} K, at most {_format_span(self.max_s)}"

    @property
    def needed_s(self) -> float:
        """What a camera takes that has been on for an hour, s."""
        return self.time_constant_s * max(0.0, math.log(_CAMERA_EXCESS_K / self.band_K))

    def placement_fault(self, found: Situation) -> str:
        return "the camera is on here; give power_camera: off before it" if found.camera_on else ""

    def stand_fault(self, stand: KnownStand) -> str:
        return stand.camera_fault()

    def price(self, found: Situation, stand: KnownStand) -> Price:
        return Price(self.kind if found.camera_was_on else COOL_DOWN_AS_FOUND, min(self.max_s, self.needed_s))

    async def perform(self, stand: PerformingStand) -> None:
        await stand.imaging.cool_down(self.band_K, self.time_constant_s, self.max_s)


def _make_list(value: object) -> object:
    return [value] if isinstance(value, str) else value


@dataclass(frozen=True, slots=True)
class CheckHome(Step):
    """Home the axis named `axis` again, record how far its scale was off, and go back to where it stood."""

    kind = "check_home"
    is_setup = False
    says = "check the home of {axis}"
    form = Annotated[
        tuple[str, ...], Field(min_length=1), BeforeValidator(_make_list, json_schema_input_type=str | tuple[str, ...])
    ]
    axis: str

    @classmethod
    def of_form(cls, value: Iterable[str], at_degC: float | None) -> Iterable[Step]:
        return (cls(axis) for axis in value)

    def stand_fault(self, stand: KnownStand) -> str:
        return stand.axis_fault(self.axis, None)

    def price(self, found: Situation, stand: KnownStand) -> Price:
        position = found.positions.get(self.axis, 0.0)
        stated_s = stand.to_home_s(self.axis, position) + stand.move_s(self.axis, 0.0, position)
        return Price(f"check home {self.axis}", stated_s, _HOMING_S)

    async def perform(self, stand: PerformingStand) -> None:
        await stand.table.check_home(self.axis)


@dataclass(frozen=True, slots=True)
class Prompt(Step):
    """Ask the operator to do what `text` says; skipped, with a note, when nobody attends."""

    kind = "prompt"
    is_setup = False
    says = "ask the operator: {text}"
    ends_when_skipped = True
    form = Annotated[str, StringConstraints(min_length=1, max_length=500)]
    text: str

    async def perform(self, stand: PerformingStand) -> None:
        await stand.prompt(self.text)


# An estimate only, for the time that is left; what a decision takes is measured as the run goes on.
_DECIDE_S = 10.0


@dataclass(frozen=True, slots=True)
class Decide(Step):
    """Ask what to visit next, or whether enough is known: the answer replaces what is left of its cycle, which are
    visits of `set_points_degC` for `soak_s` each (experiments/adaptive.py).

    Wanted is a predicted residual of `residual_px` from `coldest_degC` to `warmest_degC`, over `states`: of a camera
    `at_rest`, 4 h after a change, or `on_the_way`, 45 min after it. No temperature outside is visited, none of
    `held_out_degC` is shown to the fitter; of these `unvalidated_degC` have not been visited yet.
    `soaks_s`: to choose from. `ramp_K_per_min`: of the chamber, at most. `left_s`: of the fixed cycle's time.
    `visits`: that were decided so far. `wait_s`: for an answer, in real time; without one the fixed visits go on.
    `frames`, `interval_s`, `exposure_s`: of a visit.
    """

    kind = "decide"
    is_setup = False
    in_recipes = False
    ends_when_skipped = True
    soak_s: float
    residual_px: float
    coldest_degC: float
    warmest_degC: float
    soaks_s: tuple[float, ...]
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

    @property
    def words(self) -> str:
        return f"decide the next visit, until {1e3 * self.residual_px:g} mpx are predicted"

    def price(self, found: Situation, stand: KnownStand) -> Price:
        return Price(self.kind, _DECIDE_S)


def find_step_kind(kind: str) -> type[Step] | None:
    """The class of that name, which another package may add; None when there is none. ConfigError when the package
    that adds it cannot be loaded."""
    if kind not in STEPS and kind.islower():  # what other versions called `Soak` is not looked for, mark by mark
        for point in entry_points(group=GROUP, name=kind):
            load_point(point)
    return STEPS.get(kind)


@cache
def _adapter(step: type[Step]) -> TypeAdapter[Step]:
    return TypeAdapter(step)


def make_step(kind: str, parameters: Mapping[str, object]) -> Step:
    """The step of that kind and these `parameters`; ConfigError when there is none such."""
    if (known := find_step_kind(kind)) is None:
        raise ConfigError(f"no step is called {kind!r}; there are {', '.join(STEPS)}")
    if unknown := sorted(set(parameters) - {each.name for each in fields(cast("Any", known))}):
        raise ConfigError(f"{kind} has no {', '.join(unknown)}")
    try:
        step = _adapter(known).validate_python(dict(parameters))
    except ValidationError as error:
        wrong = "; ".join(f"{format_path(each['loc'])}: {each['msg']}" for each in error.errors())
        raise ConfigError(f"{kind}: {wrong}") from error
    for name, value in step.parameters.items():
        least = 1 if name == "frames" else 0 if name.endswith("_s") or name == "band_K" else -math.inf
        if isinstance(value, int | float) and not least <= value < math.inf:
            raise ConfigError(f"{kind}: {name} is {value}")
    if reason := step.fault():
        raise ConfigError(f"{kind}: {reason}")
    return step


def describe_step(kind: str, parameters: Mapping[str, object]) -> str:
    """A recorded step in words; kind and parameters as they are for one that is not known."""
    try:
        return make_step(kind, parameters).words
    except ConfigError:
        return " ".join([kind, *(f"{name}={value}" for name, value in parameters.items())])


def make_step_schema() -> dict[str, object]:
    """The JSON Schema of any step's parameters, with a definition for each kind, by its name. readOnly: what follows
    from the plan; `chamber_degC` of frames need not be given."""
    definitions: dict[str, Any] = {}
    for kind, step in STEPS.items():
        schema = _adapter(step).json_schema()
        if step.at_set_point:
            schema["required"].remove("chamber_degC")
        definitions |= schema.pop("$defs", {})
        definitions[kind] = schema
    return {"anyOf": [{"$ref": f"#/$defs/{kind}"} for kind in STEPS], "$defs": definitions}


@dataclass(frozen=True, slots=True)
class PlannedStep:
    """A step at its place in the plan. `step_id` stays the same as long as place and parameters do."""

    index: int
    step_id: str
    step: Step


def number_steps(steps: Iterable[Step], first: int = 0) -> Iterator[PlannedStep]:
    """Give each step its place (from `first`) and its id."""
    for index, step in enumerate(steps, first):
        text = json.dumps([index, step.kind, step.parameters], sort_keys=True)
        yield PlannedStep(index, hashlib.sha256(text.encode()).hexdigest()[:12], step)


def _make_json(value: object) -> object:
    return str(value) if isinstance(value, StrEnum) else value


def _format_span(duration_s: float) -> str:
    """`45 s`, `3 min 30 s`, `45 min`, `2 h 30 min`."""
    if duration_s < 120.0:
        return f"{duration_s:g} s"
    if duration_s < 600.0 and round(duration_s) % 60:
        return f"{round(duration_s) // 60} min {round(duration_s) % 60} s"
    minutes = round(duration_s / 60.0)
    if minutes < 120:
        return f"{minutes} min"
    return f"{minutes // 60} h" + (f" {minutes % 60} min" if minutes % 60 else "")
