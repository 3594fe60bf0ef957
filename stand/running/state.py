"""The whole memory of a run, folded from its entries: what is done, earned and recorded, and what has been undone.

    state = fold(plan, entries)         the same for a run that goes on and for one that is resumed
    state = after(state, entry)

Pure: no clock, no disk, no device. What to do next is read from it (stand/running/actions.py).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from experiments.steps import (
    AnySoak,
    CheckHome,
    CloseFlap,
    MoveTo,
    OpenFlap,
    PlannedStep,
    PowerCamera,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    StopChamber,
    is_setup,
    kind_of,
    longest_s,
    number_steps,
    step_of,
)
from foundation.clock import seconds_ns
from stand.gate import INTERLOCK
from stand.running.entries import (
    Again,
    Change,
    Cleared,
    Cooled,
    Due,
    Dwell,
    Edited,
    Ended,
    Entry,
    Extended,
    Gap,
    Held,
    Readying,
    Restored,
    Skipped,
    Step,
    Taken,
    Tripped,
)

Plan = tuple[PlannedStep, ...]
_NOTHING: Mapping[str, int] = MappingProxyType({})


@dataclass(frozen=True, slots=True)
class SetUp:
    """What steps have set up, so that it can be brought about again: of each kind only the last counts.

    chamber_degC: the set-point, None when the chamber is stopped. positions: axis -> mm or deg. soaks: the soaks since
    the last set-point, worth something only as long as the chamber stays at it. Before any step the camera is on and
    the flap closed."""

    chamber_degC: float | None = None
    soaks: Plan = ()
    camera_on: bool = True
    flap_open: bool = False
    positions: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))

    def after(self, planned: PlannedStep) -> SetUp:
        """What it is when that step, too, is done."""
        match planned.step:
            case StartChamber(chamber_degC) | SetTemperature(chamber_degC):
                return replace(self, chamber_degC=chamber_degC, soaks=())
            case StopChamber():
                return replace(self, chamber_degC=None, soaks=())
            case Soak() | SoakUntilSettled():
                return replace(self, soaks=(*self.soaks, planned))
            case PowerCamera(on):
                return replace(self, camera_on=on)
            case OpenFlap():
                return replace(self, flap_open=True)
            case CloseFlap():
                return replace(self, flap_open=False)
            case MoveTo(axis, position):
                return replace(self, positions=MappingProxyType({**self.positions, axis: position}))
            case _:
                return self

    @property
    def text(self) -> str:
        """As in `chamber at 30 degC, camera on, flap open, linear at 2`."""
        parts = [f"camera {'on' if self.camera_on else 'off'}", f"flap {'open' if self.flap_open else 'closed'}"]
        parts += [f"{axis} at {position:g}" for axis, position in self.positions.items()]
        chamber = "stopped" if self.chamber_degC is None else f"at {self.chamber_degC:g} degC"
        return f"chamber {chamber}, {', '.join(parts)}"


@dataclass(frozen=True, slots=True)
class RunState:
    """plan: in force, that is with all changes. index: the place of the first step that is not done, len(plan) when all
    are; set_up: by the steps before it.

    done, begun, skipped: ids of steps; what is skipped counts as done. under_way: the id of the step that was begun by
    this daemon and is not done, "" when there is none. earned_ns: of soaks, by id; one that is done and not listed has
    earned all of it. frames: by the id of a capture that is not done. changes: of the plan, as they came.

    disturbances: how often something may have undone the set-up (an interlock, a camera that was off, a daemon's death,
    a warm-up that begins anew), of which so many are `restored`. is_cold: the camera was or may have been off, and the
    soaks have not been taken back yet.

    reasons: what holds the run. readying: the stand is being made ready. out_ns: for how long either was so since the
    camera was last seen (its last frame, or when the plan switched it), with out_since_ns the present time of it.
    seen_ns: that instant. was_held: since then. due_ns: of the next frame; is_lost: the camera did not give the last.

    tripped: why an operator has to look first, "" when nothing tripped. ended: how the run last ended, None while it
    goes on.
    """

    plan: Plan
    index: int = 0
    set_up: SetUp = field(default_factory=SetUp)
    done: frozenset[str] = frozenset()
    begun: frozenset[str] = frozenset()
    skipped: frozenset[str] = frozenset()
    under_way: str = ""
    earned_ns: Mapping[str, int] = _NOTHING
    frames: Mapping[str, int] = _NOTHING
    changes: tuple[Change, ...] = ()
    disturbances: int = 0
    restored: int = 0
    is_cold: bool = False
    reasons: frozenset[str] = frozenset()
    readying: bool = False
    out_ns: int = 0
    out_since_ns: int | None = None
    seen_ns: int = 0
    was_held: bool = False
    due_ns: int | None = None
    is_lost: bool = False
    tripped: str = ""
    ended: Ended | None = None

    @property
    def is_disturbed(self) -> bool:
        """Whether the set-up has to be brought about again."""
        return self.disturbances > self.restored

    def step(self, step_id: str) -> PlannedStep | None:
        """The step of that id in the plan in force."""
        return next((planned for planned in self.plan if planned.step_id == step_id), None)

    def owed_ns(self, soak: PlannedStep) -> int:
        """What the soak has not earned yet."""
        duration_ns = duration_of(soak)
        earned_ns = self.earned_ns.get(soak.step_id, duration_ns if soak.step_id in self.done else 0)
        return max(0, duration_ns - earned_ns)

    def outage_ns(self, now_ns: int) -> int:
        """For how long the run did not go on since the camera was last seen."""
        return self.out_ns + (0 if self.out_since_ns is None else now_ns - self.out_since_ns)


def duration_of(soak: PlannedStep) -> int:
    """What the soak takes when it is not cut short, ns; 0 when it is no soak."""
    return seconds_ns(longest_s(soak.step)) if isinstance(soak.step, AnySoak) else 0


def fold(plan: Iterable[PlannedStep], entries: Iterable[Entry]) -> RunState:
    """The state of a run of that plan after these entries. ConfigError when the plan was edited to steps that are not
    known here."""
    state = RunState(tuple(plan))
    for entry in entries:
        state = after(state, entry)
    return state


def after(state: RunState, entry: Entry) -> RunState:
    """What the state is after one more entry. What does not fit, such as a change of a step that is done, changes
    nothing."""
    match entry:
        case Step():
            return _begun(state, entry) if entry.state == "started" else _done(state, entry)
        case Dwell(_, step_id, earned_s):
            if step_id in state.skipped:
                return state
            return replace(state, earned_ns=_with(state.earned_ns, step_id, seconds_ns(earned_s)))
        case Taken():
            return _taken(state, entry)
        case Due(_, due_ns, lost):
            return replace(state, due_ns=due_ns, is_lost=lost)
        case Held():
            return _held(state, entry)
        case Readying(time_ns, begins):
            return _counted(state, time_ns, state.reasons, readying=begins)
        case Gap():
            return _gap(state, entry)
        case Again():
            return _again(state, entry)
        case Cooled():
            return replace(state, disturbances=state.disturbances + 1, is_cold=True)
        case Restored(_, disturbances):
            is_cold = state.is_cold and disturbances < state.disturbances
            return replace(state, restored=max(state.restored, disturbances), is_cold=is_cold)
        case Skipped() | Extended() | Edited():
            return state if refusal(state, entry) else _changed(state, entry)
        case Tripped(_, _, text):
            return replace(state, tripped=state.tripped or text)
        case Cleared():
            return replace(state, tripped="")
        case Ended():
            return replace(state, ended=entry)
        case _:
            return state


def refusal(state: RunState, change: Change) -> str:
    """Why the plan cannot be changed so, "" when it can."""
    if isinstance(change, Edited):
        first = _first_free(state)
        if not first <= change.from_index <= len(state.plan):
            return f"the steps from {first} to {len(state.plan)} can be replaced, not those from {change.from_index}"
        return ""
    planned = state.step(change.step_id)
    if planned is None:
        return f"the plan has no step {change.step_id}"
    name = f"step {planned.index} ({kind_of(planned.step)})"
    if change.step_id in state.done:
        return f"{name} is done"
    if isinstance(change, Extended):
        if not isinstance(planned.step, AnySoak):
            return f"{name} is no soak"
        return "" if 0.0 < change.by_s < float("inf") else f"{name} cannot be extended by {change.by_s:g} s"
    if is_setup(planned.step):
        return f"{name} sets up what later steps rely on; replace those from it on"
    is_moving = isinstance(planned.step, CheckHome) and state.under_way == change.step_id
    return f"{name} is under way and ends by itself" if is_moving else ""


def _first_free(state: RunState) -> int:
    """The place of the first step that is neither done nor begun, nor before one that is."""
    used = state.done | state.begun
    return max((planned.index + 1 for planned in state.plan if planned.step_id in used), default=0)


def _changed(state: RunState, change: Change) -> RunState:
    state = replace(state, changes=(*state.changes, change))
    match change:
        case Skipped(_, step_id):
            state = replace(state, skipped=state.skipped | {step_id}, done=state.done | {step_id})
            if state.under_way == step_id:
                state = replace(state, under_way="", due_ns=None, is_lost=False)
            return _placed(state)
        case Extended(_, step_id, by_s):
            return replace(state, plan=tuple(_longer(each, step_id, by_s) for each in state.plan))
        case Edited(_, first, steps):
            made = (step_of(str(each.get("kind")), _mapping(each.get("parameters"))) for each in steps)
            return _placed(replace(state, plan=(*state.plan[:first], *number_steps(made, first))))


def _mapping(value: object) -> Mapping[str, object]:
    return {str(name): each for name, each in value.items()} if isinstance(value, dict) else {}


def _longer(planned: PlannedStep, step_id: str, by_s: float) -> PlannedStep:
    """One that waits for the camera waits longer at the least and at the most."""
    step = planned.step
    if planned.step_id != step_id or not isinstance(step, AnySoak):
        return planned
    if isinstance(step, Soak):
        return replace(planned, step=replace(step, duration_s=step.duration_s + by_s))
    return replace(planned, step=replace(step, min_s=step.min_s + by_s, max_s=step.max_s + by_s))


def _placed(state: RunState) -> RunState:
    """The first step to do, and what those before it have set up."""
    set_up = SetUp()
    for index, planned in enumerate(state.plan):
        if planned.step_id not in state.done:
            return replace(state, index=index, set_up=set_up)
        set_up = set_up if planned.step_id in state.skipped else set_up.after(planned)
    return replace(state, index=len(state.plan), set_up=set_up)


def _begun(state: RunState, entry: Step) -> RunState:
    """A camera that the plan switches is seen from then on: what follows in the plan is made for that."""
    is_anew = state.under_way != entry.step_id
    state = replace(
        state,
        begun=state.begun | {entry.step_id},
        under_way=entry.step_id,
        due_ns=None if is_anew else state.due_ns,
        is_lost=state.is_lost and not is_anew,
    )
    planned = state.step(entry.step_id)
    if planned is None or not isinstance(planned.step, PowerCamera):
        return state
    return replace(_seen(state, entry.time_ns), was_held=False, is_cold=False)


def _done(state: RunState, entry: Step) -> RunState:
    is_under_way = state.under_way == entry.step_id
    return _placed(
        replace(
            state,
            done=state.done | {entry.step_id},
            under_way="" if is_under_way else state.under_way,
            earned_ns=_without(state.earned_ns, entry.step_id),
            frames=_without(state.frames, entry.step_id),
            due_ns=None if is_under_way else state.due_ns,
            is_lost=state.is_lost and not is_under_way,
        )
    )


def _taken(state: RunState, entry: Taken) -> RunState:
    if entry.step_id in state.done:
        return state
    frames = _with(state.frames, entry.step_id, state.frames.get(entry.step_id, 0) + 1)
    return replace(_seen(state, entry.time_ns), frames=frames, was_held=bool(state.reasons))


def _seen(state: RunState, time_ns: int) -> RunState:
    return replace(state, seen_ns=time_ns, out_ns=0, out_since_ns=None if state.out_since_ns is None else time_ns)


def _held(state: RunState, entry: Held) -> RunState:
    reasons = state.reasons | {entry.reason} if entry.held else state.reasons - {entry.reason}
    undone = entry.held and entry.reason == INTERLOCK  # an interlock makes the stand safe: nothing is as it was
    state = replace(state, was_held=state.was_held or entry.held, disturbances=state.disturbances + undone)
    return _counted(state, entry.time_ns, reasons, readying=state.readying)


def _counted(state: RunState, time_ns: int, reasons: frozenset[str], *, readying: bool) -> RunState:
    """The time during which the run is held or made ready counts; when it is both, once."""
    return replace(
        state,
        reasons=reasons,
        readying=readying,
        out_ns=state.outage_ns(time_ns),
        out_since_ns=time_ns if reasons or readying else None,
    )


def _gap(state: RunState, entry: Gap) -> RunState:
    """Another daemon goes on: nothing holds it yet, nothing is under way, and nobody knows how the stand is."""
    return replace(
        state,
        under_way="",
        disturbances=state.disturbances + 1,
        reasons=frozenset[str](),
        readying=False,
        out_ns=state.outage_ns(entry.from_ns) + entry.time_ns - entry.from_ns,
        out_since_ns=None,
        due_ns=None,
        is_lost=False,
        ended=None,
    )


def _again(state: RunState, entry: Again) -> RunState:
    """A capture under way begins anew where it is; for other steps what those before them set up is needed again."""
    ids = frozenset(entry.step_ids)
    frames = MappingProxyType({each: count for each, count in state.frames.items() if each not in ids})
    kept = replace(state, done=state.done - ids, begun=state.begun - ids, skipped=state.skipped - ids, frames=frames)
    if ids != {state.under_way}:
        kept = replace(kept, under_way="", due_ns=None, is_lost=False, disturbances=state.disturbances + 1)
    return _placed(kept)


def _with(values: Mapping[str, int], name: str, value: int) -> Mapping[str, int]:
    return MappingProxyType({**values, name: value})


def _without(values: Mapping[str, int], name: str) -> Mapping[str, int]:
    return (
        MappingProxyType({each: value for each, value in values.items() if each != name}) if name in values else values
    )
