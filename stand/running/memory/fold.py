"""The state of a run, folded from its entries.

    state = fold(plan, entries)         the same for a run under way and for one that is resumed
    state = after(state, entry)

Pure: no clock, no disk, no device.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from dataclasses import replace
from functools import reduce
from types import MappingProxyType

from thermostand.experiments.steps import (
    AnySoak,
    PlannedStep,
    PowerCamera,
    make_step,
    number_steps,
)
from thermostand.foundation.clock import to_ns
from thermostand.stand.running.memory.entries import (
    Change,
    Cooled,
    Due,
    Edited,
    Ended,
    Entry,
    Extended,
    Gap,
    Held,
    Preparing,
    Reset,
    Restarted,
    Restored,
    Skipped,
    Soaked,
    StepChanged,
    Taken,
    Tripped,
)
from thermostand.stand.running.memory.state import RunState, SetUp
from thermostand.stand.safety.gate import INTERLOCK


def fold(plan: Iterable[PlannedStep], entries: Iterable[Entry]) -> RunState:
    """The state of a run of that plan after these entries. ConfigError when the plan was edited to steps that are not
    known here."""
    return reduce(apply_entry, entries, RunState(tuple(plan)))


def apply_entry(state: RunState, entry: Entry) -> RunState:
    """Return what the state is after one more entry. What does not fit, such as a change of a step that is done,
    changes nothing."""
    match entry:
        case StepChanged():
            return _apply_begin(state, entry) if entry.state == "started" else _apply_end(state, entry)
        case Soaked(_, step_id, soaked_s, ended):
            if step_id in state.skipped:
                return state
            soaked = {**_forget_ends(state, {step_id}), **({step_id: ended} if ended else {})}
            soaked_ns = _set_value(state.soaked_ns, step_id, to_ns(soaked_s))
            return replace(state, soaked_ns=soaked_ns, soaked=MappingProxyType(soaked))
        case Taken():
            return _apply_frame(state, entry)
        case Due(_, due_ns, lost):
            return replace(state, due_ns=due_ns, is_lost=lost)
        case Held():
            return _apply_hold(state, entry)
        case Preparing(time_ns, begins):
            return _count_outage(state, time_ns, state.reasons, readying=begins)
        case Gap():
            return _apply_gap(state, entry)
        case Restarted():
            return _apply_restart(state, entry)
        case Cooled():
            return replace(state, setup_invalidations=state.setup_invalidations + 1, is_cold=True)
        case Restored(_, disturbances):
            is_cold = state.is_cold and disturbances < state.setup_invalidations
            restored = min(max(state.restored, disturbances), state.setup_invalidations)
            return replace(state, restored=restored, is_cold=is_cold)
        case Skipped() | Extended() | Edited():
            return state if find_refusal(state, entry) else _apply_change(state, entry)
        case Tripped(_, _, text):
            return replace(state, tripped=state.tripped or text)
        case Reset():
            return replace(state, tripped="")
        case Ended():
            return replace(state, ended=entry)
        case _:
            return state


def find_refusal(state: RunState, change: Change) -> str:
    """Return why the plan cannot be changed so, "" when it can."""
    if state.index >= len(state.plan):
        return "the plan is done"
    if isinstance(change, Edited):
        first = _find_first_free(state)
        if not first <= change.from_index <= len(state.plan):
            wanted = change.from_index + 1
            return f"the steps from number {first + 1} on can be replaced, not those from number {wanted} on"
        return ""
    planned = state.step(change.step_id)
    if planned is None:
        return f"the plan has no step {change.step_id}"
    name = f"step {planned.index + 1} ({planned.step.kind})"
    if change.step_id in state.done:
        return f"{name} is done"
    if isinstance(change, Extended):
        if not isinstance(planned.step, AnySoak):
            return f"{name} is no soak"
        return "" if 0.0 < change.by_s < float("inf") else f"{name} cannot be extended by {change.by_s:g} s"
    if planned.step.is_setup:
        return f"{name} sets up what later steps rely on; replace those from it on"
    if not planned.step.ends_when_skipped and state.under_way == change.step_id:
        return f"{name} is under way and ends by itself"
    return ""


def describe_change(state: RunState, change: Change) -> str:
    """The change of a plan, in words."""
    if isinstance(change, Edited):
        if change.decided:
            return f"{len(change.by)} steps are to come, decided: {change.reason}"
        return (
            f"the steps from number {change.from_index + 1} on are replaced by {len(change.by)} others by an operator"
        )
    planned = state.step(change.step_id)
    name = change.step_id if planned is None else f"step {planned.index + 1} ({planned.step.kind})"
    if isinstance(change, Extended):
        return f"{name} takes {change.by_s:g} s longer, by an operator"
    return f"{name} is left out, by an operator"


def _find_first_free(state: RunState) -> int:
    """The place of the first step that is neither done nor begun, nor before one that is."""
    used = state.done | state.begun
    return max((planned.index + 1 for planned in state.plan if planned.step_id in used), default=0)


def _apply_change(state: RunState, change: Change) -> RunState:
    state = replace(state, changes=(*state.changes, change))
    match change:
        case Skipped(_, step_id):
            state = replace(state, skipped=state.skipped.plus(step_id), done=state.done.plus(step_id))
            if state.under_way == step_id:
                state = replace(state, under_way="", due_ns=None, is_lost=False)
            return _advance_index(state)
        case Extended(_, step_id, by_s):
            plan = tuple(_extend(each, step_id, by_s) for each in state.plan)
            return replace(state, plan=plan, soaked=_forget_ends(state, {step_id}))
        case Edited(_, first, by):
            made = (make_step(str(each.get("kind")), _make_mapping(each.get("parameters"))) for each in by)
            return _advance_index(replace(state, plan=(*state.plan[:first], *number_steps(made, first))))


def _make_mapping(value: object) -> Mapping[str, object]:
    return {str(name): each for name, each in value.items()} if isinstance(value, dict) else {}


def _extend(planned: PlannedStep, step_id: str, by_s: float) -> PlannedStep:
    step = planned.step
    if planned.step_id != step_id or not isinstance(step, AnySoak):
        return planned
    return replace(planned, step=step.extend(by_s))


def _advance_index(state: RunState) -> RunState:
    """Advance the index from its place on: to the first step to do, with what those before it have set up."""
    index, set_up = state.index, state.set_up
    while index < len(state.plan) and (planned := state.plan[index]).step_id in state.done:
        set_up = set_up if planned.step_id in state.skipped else set_up.after(planned)
        index += 1
    return replace(state, index=index, set_up=set_up)


def _apply_begin(state: RunState, entry: StepChanged) -> RunState:
    """A camera that the plan switches is seen from then on: what follows in the plan is made for that."""
    is_first = state.under_way != entry.step_id
    state = replace(
        state,
        begun=state.begun.plus(entry.step_id),
        under_way=entry.step_id,
        due_ns=None if is_first else state.due_ns,
        is_lost=state.is_lost and not is_first,
    )
    planned = state.step(entry.step_id)
    if planned is None or not isinstance(planned.step, PowerCamera):
        return state
    return replace(_mark_camera_seen(state, entry.time_ns), was_held=False, is_cold=False)


def _apply_end(state: RunState, entry: StepChanged) -> RunState:
    is_under_way = state.under_way == entry.step_id
    return _advance_index(
        replace(
            state,
            done=state.done.plus(entry.step_id),
            under_way="" if is_under_way else state.under_way,
            soaked_ns=_remove_value(state.soaked_ns, entry.step_id),
            frames=_remove_value(state.frames, entry.step_id),
            retakes=_remove_value(state.retakes, entry.step_id),
            due_ns=None if is_under_way else state.due_ns,
            is_lost=state.is_lost and not is_under_way,
        )
    )


def _apply_frame(state: RunState, entry: Taken) -> RunState:
    if entry.step_id in state.done:
        return state
    frames = _set_value(state.frames, entry.step_id, state.frames.get(entry.step_id, 0) + 1)
    return replace(_mark_camera_seen(state, entry.time_ns), frames=frames, was_held=bool(state.reasons))


def _mark_camera_seen(state: RunState, time_ns: int) -> RunState:
    return replace(state, seen_ns=time_ns, out_ns=0, out_since_ns=None if state.out_since_ns is None else time_ns)


def _apply_hold(state: RunState, entry: Held) -> RunState:
    reasons = state.reasons | {entry.reason} if entry.held else state.reasons - {entry.reason}
    undone = entry.held and entry.reason == INTERLOCK  # an interlock makes the stand safe: nothing is as it was
    state = replace(
        state, was_held=state.was_held or entry.held, setup_invalidations=state.setup_invalidations + undone
    )
    return _count_outage(state, entry.time_ns, reasons, readying=state.readying)


def _count_outage(state: RunState, time_ns: int, reasons: frozenset[str], *, readying: bool) -> RunState:
    """The time during which the run is held or made ready counts; when it is both, once."""
    return replace(
        state,
        reasons=reasons,
        readying=readying,
        out_ns=state.outage_ns(time_ns),
        out_since_ns=time_ns if reasons or readying else None,
    )


def _apply_gap(state: RunState, entry: Gap) -> RunState:
    """Apply that another daemon resumes the run: nothing holds it yet, nothing is under way, and the stand's state is
    unknown."""
    return replace(
        state,
        under_way="",
        setup_invalidations=state.setup_invalidations + 1,
        reasons=frozenset[str](),
        readying=False,
        out_ns=state.outage_ns(entry.from_ns) + entry.time_ns - entry.from_ns,
        out_since_ns=None,
        due_ns=None,
        is_lost=False,
        ended=None,
    )


def _apply_restart(state: RunState, entry: Restarted) -> RunState:
    """A capture under way is restarted where it is; for other steps what those before them set up is needed again."""
    ids, counts = frozenset(entry.step_ids), state.retakes
    lossy = {each: counts.get(each, 0) + 1 for each in entry.step_ids} if entry.frames_lost else {}
    frames = MappingProxyType({each: count for each, count in state.frames.items() if each not in ids})
    kept = replace(
        state,
        index=0,
        set_up=SetUp(),
        done=state.done.minus(ids),
        begun=state.begun.minus(ids),
        skipped=state.skipped.minus(ids),
        frames=frames,
        soaked=_forget_ends(state, ids),
        retakes=MappingProxyType({**counts, **lossy}) if lossy else counts,
    )
    if ids != frozenset((state.under_way,)):
        kept = replace(
            kept, under_way="", due_ns=None, is_lost=False, setup_invalidations=state.setup_invalidations + 1
        )
    return _advance_index(kept)


def _forget_ends(state: RunState, step_ids: Collection[str]) -> Mapping[str, str]:
    """Return how soaks have ended, but for these: they go on, or are soaked again."""
    return MappingProxyType({each: ended for each, ended in state.soaked.items() if each not in step_ids})


def _set_value(values: Mapping[str, int], name: str, value: int) -> Mapping[str, int]:
    return MappingProxyType({**values, name: value})


def _remove_value(values: Mapping[str, int], name: str) -> Mapping[str, int]:
    return (
        MappingProxyType({each: value for each, value in values.items() if each != name}) if name in values else values
    )
