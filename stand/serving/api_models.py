"""The values in which a stand answers: where daemon, HTTP interface, page and command line meet.

They are immutable, they are what the published OpenAPI document describes, and an instant in them is ns since the epoch
on the stand's clock, to which `utc_offset_ns` is added for UTC. One more field of the state is one of StandState, and
its value: in `snapshot_state`, or in `state` of the service when it is of a run or a daemon.
"""

from __future__ import annotations

import importlib.metadata
from functools import cache
from typing import TYPE_CHECKING, Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, JsonValue

from thermostand.foundation.clock import Clock, utc_offset_ns
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import StandError
from thermostand.foundation.readings import Cause, Quality, Reading
from thermostand.recording.reading.notes import LONGEST_NOTE, TAG
from thermostand.stand.config.interface_section import Role, may
from thermostand.stand.estimating.course import Course

if TYPE_CHECKING:
    from thermostand.foundation.hub import Hub
    from thermostand.stand.assembly.stand import Stand
    from thermostand.stand.config.stand_config import StandConfig

# socket: this machine's Unix socket. loopback: TCP on this machine. token: TCP with a token. network: TCP without one,
# which STOP needs not. proxy: whom a reverse proxy names. secop: SECoP on this machine. terminal: a signal, a key.
How = Literal["socket", "loopback", "token", "proxy", "network", "secop", "terminal", "queue"]
When = Literal["now", "step"]
StepStanding = Literal["waiting", "under_way", "done", "skipped"]


class Conflict(StandError):
    """The state of the stand or of its run forbids what was asked for; the text says why, and what would help."""


class Missing(StandError):
    """What was asked for does not exist: a step, a queued run, a session, a device."""


class Forbidden(StandError):
    """Who asks has a role that is not enough."""


class Value(BaseModel):
    """What all values here are: immutable, without infinities or NaN, which JSON does not have."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)


class Requester(Value):
    """Who asks. name: the user of the socket or of a proxy, else the name of the token; "" when it is not known."""

    name: str
    how: How
    role: Role = "commission"

    @property
    def described(self) -> str:
        """In a sentence."""
        named = {"token": f"the token of {self.name}", "proxy": self.name}
        return named.get(self.how, "this machine, without a token,")

    def require(self, needed: Role, what: str) -> None:
        """Forbidden unless the role is enough for it."""
        if not may(self.role, needed):
            raise Forbidden(f"{what} needs the role {needed}, and {self.described} has the role {self.role}")


class RunStatus(Value):
    """The status of a run. Instants are ns since the epoch on the stand's clock, which may be virtual;
    utc_offset_ns makes now and later UTC as the host has it, since_utc_offset_ns and warning_utc_offset_ns the others.

    session: its folder as it was when the run began. run_id: the session's name, which no other run of the stand has.
    step: number of the step under way, 1 is the first; doing: that step in words. since_ns: when the present state
    began. end_ns: when the run is expected to end, the way back to the laboratory's temperature included, None when
    unknown; end_within_s: by how much it may be earlier or later, from how far this run's steps were from what was
    expected of them, None before that says enough. frames_planned: how many the plan is expected to give.
    temperatures_degC: by channel, None for a BAD reading. warning: the text of the last warning or error, published at
    warning_ns. fault_rule, fault: the rule that has tripped and holds or ends the run, and what was found, "" when all
    is well.
    """

    recipe: str
    step: int
    steps: int
    doing: str
    state: Literal["running", "held", "stopping"]
    reasons: tuple[str, ...]
    now_ns: int
    since_ns: int
    end_ns: int | None
    temperatures_degC: dict[str, float | None]
    frames_saved: int
    frames_lost: int
    disk_free_bytes: int
    warning: str = ""
    warning_level: Literal["", "warning", "error"] = ""
    warning_ns: int | None = None
    end_within_s: float | None = None
    frames_planned: int | None = None
    utc_offset_ns: int = 0
    since_utc_offset_ns: int = 0
    warning_utc_offset_ns: int = 0
    fault_rule: str = ""
    fault: str = ""
    session: str = ""
    run_id: str = ""


class ReadingState(Value):
    """The last reading of a channel. value: None exactly when it is BAD; reason, cause: why it is not GOOD."""

    value: float | None
    unit: str
    quality: Quality
    time_ns: int
    reason: str = ""
    cause: Cause = ""


class FaultState(Value):
    """What has tripped. rule: its name; data: what a program needs of it; since_ns: when it was found."""

    rule: str
    text: str
    since_ns: int
    data: dict[str, JsonValue] = Field(default_factory=dict)


class PromptState(Value):
    """What an operator is asked to do; the pause that goes with it is ended by `continue`."""

    step_id: str
    text: str


class PlanStep(Value):
    """A step of the plan in force. kind, parameters: as in a recipe's `steps`; text: the same in words.

    duration_s: expected in all. soaked_s: of a soak so far. frames, frames_saved: of a capture. began_ns, ended_ns:
    when it was begun and done by this daemon, None for what is not known. expected_ns: when a step to come, or under
    way, is expected to end, None when that is not known.
    """

    step_id: str
    index: int
    kind: str
    parameters: dict[str, JsonValue]
    text: str
    standing: StepStanding
    duration_s: float
    soaked_s: float = 0.0
    frames: int = 0
    frames_saved: int = 0
    began_ns: int | None = None
    ended_ns: int | None = None
    expected_ns: int | None = None


class QueuedRun(Value):
    """A run of the queue. waiting and interrupted ones are still to be done. expected_s: how long it will take, None
    when unknown. session: the name of its folder, "" before it has one. reason: why it did not come to its
    end."""

    id: int
    recipe: str
    state: Literal["waiting", "running", "done", "failed", "stopped", "interrupted"]
    added_ns: int
    began_ns: int | None = None
    ended_ns: int | None = None
    session: str = ""
    reason: str = ""
    expected_s: float | None = None
    key: str = ""
    added_by: str = ""


class NotConfirmed(Value):
    """It is tried again until it confirms. name: of the device, or of its relay. since_ns: when its safe state was
    demanded. reason: why the last try did not confirm it, "" while the first one is under way. timer_s: of the relays
    of heat and cold, how long after since_ns the board's own timer has switched them off all the same; None where there
    is none.
    """

    name: str
    since_ns: int
    reason: str = ""
    timer_s: float | None = None


class HeatByHand(Value):
    """Heat and cold that somebody ordered between runs. setpoint_degC: as it was ordered, also while the regulator does
    not answer; since_ns: when they were permitted; cut_ns: when the relay board's own timer ended them, because it
    could not be reached, null while they last."""

    setpoint_degC: float
    since_ns: int
    cut_ns: int | None = None


class StandState(Value):
    """The whole stand at one instant, as the control loop published it.

    seq: the sequence number of the stream that this state is after. version: of the program. phase: idle between runs.
    by_hand: heat that somebody ordered then. not_confirmed: what has not confirmed its safe state since a stop, a trip
    or the end of a run. reasons: what holds the run. readings: the last of every channel. setpoint_degC: of the
    chamber, None when it is stopped or unknown. cameras: their names. output_percent: of the regulator. flap: "open",
    "closed", "moving", or "" when it is not known. axes: positions, mm or deg. counters: what wears, by name
    (compressor_hours, relay_cycles, ...). moving: what is under way, as in `linear to 250 mm`. busy: the devices that
    carry out an order. drops: items that the interface was too slow for. pausing: a pause comes when the step under way
    is done.
    """

    seq: int = 0
    stand: str
    version: str
    simulated: bool
    now_ns: int
    utc_offset_ns: int
    phase: Literal["idle", "running", "held", "stopping"]
    run: RunStatus | None = None
    reasons: tuple[str, ...] = ()
    fault: FaultState | None = None
    prompt: PromptState | None = None
    # Data of its own, and no phase: programs wait for the phase `idle`, which heat by hand must not change.
    by_hand: HeatByHand | None = None
    # Also what is merely under way, such as a flap that closes, so that "no failure yet" is not read as "safe".
    not_confirmed: tuple[NotConfirmed, ...] = ()
    readings: dict[str, ReadingState] = Field(default_factory=dict)
    cameras: tuple[str, ...] = ()
    setpoint_degC: float | None = None
    output_percent: float | None = None
    heater_permitted: bool = False
    compressor_on: bool = False
    camera_on: bool = False
    flap: str = ""
    axes: dict[str, float | None] = Field(default_factory=dict)
    queue: tuple[QueuedRun, ...] = ()
    queue_halted: str = ""
    counters: dict[str, float] = Field(default_factory=dict)
    disk_free_bytes: int = 0
    moving: tuple[str, ...] = ()
    busy: tuple[str, ...] = ()
    drops: int = 0
    pausing: bool = False


class CommandAnswer(Value):
    """The answer to a command. reasons: what holds the run now; moving: what is still under way, as in
    `linear to 250 mm`; text: what came of it, in a sentence; seq: of the command's event in the stream."""

    verb: str
    text: str = ""
    reasons: tuple[str, ...] = ()
    moving: tuple[str, ...] = ()
    seq: int = 0


class WrittenStep(Value):
    """A step as it is written in a recipe's `steps`: its kind and parameters."""

    kind: str = Field(max_length=100)
    parameters: dict[str, JsonValue] = Field(default_factory=dict)


class PlanRequest(Document):
    """The steps from a place on are replaced by these."""

    from_index: int = Field(ge=0, le=1_000_000)
    steps: tuple[WrittenStep, ...] = Field(max_length=10_000)


class StepFault(Value):
    """Why the plan cannot be so. index: of the step in the plan, None when it is the plan as a whole."""

    index: int | None
    text: str


class PlanCheck(Value):
    """faults: what is wrong, none when the steps would be taken; duration_s: how long they take then, else None.
    texts: each of them in words, "" of one that is no step. set_points_degC: of the chamber at each of them, None while
    it is stopped."""

    faults: tuple[StepFault, ...] = ()
    duration_s: float | None = None
    texts: tuple[str, ...] = ()
    set_points_degC: tuple[float | None, ...] = ()


# Checked, with a sentence, where it is kept.
Tag = Annotated[str, Field(max_length=100, json_schema_extra={"pattern": f"^{TAG.pattern}$"})]
LONGEST_RECIPE = 1 << 18  # characters
_NAMED: dict[str, Any] = {"properties": {"recipe": {"minLength": 1}}, "required": ["recipe"]}
_WRITTEN: dict[str, Any] = {"properties": {"recipe_text": {"minLength": 1}}, "required": ["recipe_text"]}


class RunRequest(Document):
    """A run that is asked for: the name of an installed recipe, or the text of one, as GET /api/v1/recipes/schema has
    it. Names of files are not taken: the interface must not be a way to read any.

    attended: somebody is there to do what the plan prompts for. tags, note: for the catalogue of sessions.
    """

    model_config = ConfigDict(json_schema_extra={"oneOf": [_NAMED, _WRITTEN]})

    recipe: str = Field(default="", max_length=200)
    recipe_text: str = Field(default="", max_length=LONGEST_RECIPE)
    attended: bool = Field(default=False, strict=True)
    tags: tuple[Tag, ...] = Field(default=(), max_length=32)
    note: str = Field(default="", max_length=LONGEST_NOTE)


class PlanWarning(Value):
    """What will not be as it is meant in a plan. step: index in the plan; at_s: when it begins, from the plan's
    beginning."""

    step: int
    at_s: float
    text: str


class RunPreview(Value):
    """What a recipe would do on this stand now; nothing is queued.

    recipe: as a document, to fill a form with; recipe_text: the same as YAML. duration_s: of the plan; after_s: of the
    way back to the laboratory's temperature behind it. begins: "now" when it would begin at once, "queued" behind
    `ahead` others (begin_ns: when that is expected, None when unknown), "halted" when the queue waits for somebody.
    size_bytes: what it records; free_bytes: on the disk. lacks: why it would be refused as the stand is now. looks:
    what steps of the image the plan can show, in words, "" without looks at drift. learned: where the durations come
    from, in words. chamber_degC: the stand's limits; dew_degC: below it nothing may be while the flap is open, None
    when that is not known.
    """

    recipe: dict[str, JsonValue]
    recipe_text: str
    steps: int
    duration_s: float
    after_s: float
    begins: Literal["now", "queued", "halted"]
    ahead: int
    begin_ns: int | None
    end_ns: int | None
    frames: int
    size_bytes: int
    free_bytes: int
    lacks: tuple[str, ...]
    warnings: tuple[PlanWarning, ...]
    looks: str
    learned: str
    chamber_degC: tuple[float, float]
    dew_degC: float | None
    course: Course


class Argument(Value):
    """What a verb of a device is given: its name, unit, and the range in which the stand takes it, or its choices."""

    name: str
    unit: str = ""
    minimum: float | None = None
    maximum: float | None = None
    choices: tuple[str, ...] = ()


class DeviceVerb(Value):
    """A command that a device takes by hand between runs. role: that it needs."""

    verb: str
    text: str
    role: Role = "operate"
    arguments: tuple[Argument, ...] = ()


class DeviceState(Value):
    """A device. channels: of its readings. refused: why it takes no order now, "" when it does."""

    name: str
    kind: str
    channels: tuple[str, ...] = ()
    verbs: tuple[DeviceVerb, ...] = ()
    refused: str = ""


class KnownFault(Value):
    """Something that can be broken in the simulated laboratory: with `worst`, unless another value is given."""

    name: str
    worst: JsonValue
    mended: JsonValue
    text: str


class SimulatedFaults(Value):
    """What can be broken, and what is broken now, with its value."""

    faults: tuple[KnownFault, ...]
    standing: dict[str, JsonValue]


class FaultRequest(Document):
    """What is to be broken in the simulated laboratory: value, of the kind that GET shows, null for the worst; for_s:
    for so long, null until it is mended. mend: it is mended instead."""

    name: str = Field(max_length=100)
    value: JsonValue = None
    for_s: float | None = Field(default=None, gt=0, le=31_622_400)
    mend: bool = Field(default=False, strict=True)


def snapshot_state(config: StandConfig, stand: Stand, hub: Hub, clock: Clock) -> StandState:
    """A stand on which nothing is run, as its devices were last read."""
    readings = hub.readings
    heat_percent, cool_percent = (
        _get_value(readings.get("regulator.mv_heat")),
        _get_value(readings.get("regulator.mv_cool")),
    )
    output_percent = None if heat_percent is None else heat_percent - (cool_percent or 0.0)
    return StandState(
        stand=config.name,
        version=_get_version(),
        simulated=config.simulation is not None,
        now_ns=clock.now_ns(),
        utc_offset_ns=utc_offset_ns(clock),
        phase="idle",
        reasons=tuple(sorted(stand.gate.reasons)),
        not_confirmed=_list_not_confirmed(stand),
        readings={channel: _make_reading(reading) for channel, reading in readings.items()},
        cameras=tuple(config.cameras),
        setpoint_degC=_get_value(readings.get("regulator.sp"))
        if _get_value(readings.get("regulator.running"))
        else None,
        output_percent=output_percent,
        heater_permitted=stand.chamber.permits.is_granted,
        compressor_on=bool(_get_value(readings.get("relays.compressor"))),
        camera_on=stand.imaging.supply.is_on,
        flap=_describe_flap(config, stand),
        axes={name: _get_value(readings.get(f"{name}.position")) for name in stand.devices.axes},
        moving=tuple(stand.motions.texts),
        busy=stand.motions.names,
    )


def _list_not_confirmed(stand: Stand) -> tuple[NotConfirmed, ...]:
    permits = stand.chamber.permits
    return tuple(
        NotConfirmed(
            name=each.name,
            since_ns=each.since_ns,
            reason=each.failure,
            timer_s=permits.timer_s if each.name == permits.name else None,
        )
        for each in stand.safety.pending
    )


def _describe_flap(config: StandConfig, stand: Stand) -> str:
    if config.flap is None:
        return "none"
    return "moving" if stand.motions.moves("flap") else "open" if stand.imaging.flap_open else "closed"


def _get_value(reading: Reading | None) -> float | None:
    return None if reading is None or reading.quality is Quality.BAD else reading.value


def _make_reading(reading: Reading) -> ReadingState:
    return ReadingState.model_construct(
        value=_get_value(reading),
        unit=reading.unit,
        quality=reading.quality,
        time_ns=reading.time_ns,
        reason=reading.reason,
        cause=reading.cause,
    )


@cache
def _get_version() -> str:
    return importlib.metadata.version("thermostand")
