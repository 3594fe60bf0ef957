"""The state of a run is folded from its entries: any of them, in any order, and the same from the journal's lines."""

import dataclasses

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.journals import lines_with, read_lines
from tests.stand.test_run_table import ID, PLAN, SOAK, S
from thermostand.experiments.steps import Soak
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.stand.running.executing.actions import (
    ArmCapture,
    ContinueSoak,
    Perform,
    Surroundings,
    TakeFrame,
    choose_next_action,
)
from thermostand.stand.running.memory.entries import (
    Begun,
    Cooled,
    Due,
    Edited,
    Ended,
    Extended,
    Gap,
    Held,
    JournalEntry,
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
from thermostand.stand.running.memory.fold import apply_entry, fold
from thermostand.stand.running.memory.state import RunState
from thermostand.stand.running.resume import fold_entries

ids = st.sampled_from([*ID, "unknown"])
soak = {"kind": "soak", "parameters": {"duration_s": 5.0}}
open_flap = {"kind": "open_flap", "parameters": {}}
KINDS = {
    StepChanged: st.tuples(ids, st.sampled_from(["started", "done"])),
    Soaked: st.tuples(ids, st.floats(0, 200)),
    Held: st.tuples(st.sampled_from(["operator", "interlock", "disk_low"]), st.booleans()),
    Restarted: st.tuples(st.lists(ids, max_size=3), st.integers(0, 2)),
    Skipped: st.tuples(ids),
    Extended: st.tuples(ids, st.floats(-5, 50)),
    Edited: st.tuples(st.integers(-1, 15), st.lists(st.sampled_from([soak, open_flap]), max_size=3)),
    Tripped: st.tuples(st.just("rule"), st.just("text")),
    Reset: st.tuples(),
    Ended: st.tuples(st.sampled_from(["stopped", "complete"]), st.just("text")),
    Taken: st.tuples(ids),
    Due: st.tuples(st.none() | st.integers(0, 100 * S), st.booleans()),
    Preparing: st.tuples(st.booleans()),
    Restored: st.tuples(st.integers(0, 5)),
    Cooled: st.tuples(),
}
VOID = (Due, Preparing, Restored, Cooled)  # not written, and void after a gap


@st.composite
def runs(draw):
    """Entries at instants that only grow."""
    entries, now_ns = [], 0
    for kind in draw(st.lists(st.sampled_from([*KINDS, Gap]), max_size=30)):
        from_ns, now_ns = now_ns, now_ns + draw(st.integers(0, 40 * S))
        entries.append(Gap(from_ns, now_ns) if kind is Gap else kind(now_ns, *draw(KINDS[kind])))
    return entries


def lasting(state: RunState) -> dict[str, object]:
    """What a gap leaves; for how long it was out, and how often disturbed, is not known to the last digit."""
    fields = {field.name: getattr(state, field.name) for field in dataclasses.fields(state)}
    for name in ("out_ns", "out_since_ns", "seen_ns", "was_held", "setup_invalidations", "restored", "is_cold"):
        del fields[name]
    return fields


@given(runs())
def test_any_entries_make_a_state_that_holds_together(entries):
    state = fold(PLAN, entries)
    ids = [planned.step_id for planned in state.plan]
    assert [planned.index for planned in state.plan] == list(range(len(ids)))
    assert all(step_id in state.done for step_id in ids[: state.index])
    assert state.index == len(ids) or ids[state.index] not in state.done
    assert state.skipped <= state.done
    assert 0 <= state.restored <= state.setup_invalidations
    assert all(state.remaining_ns(planned) >= 0 for planned in state.plan)
    assert state.outage_ns(2000 * S) >= 0
    choose_next_action(state, Surroundings(2000 * S))


@given(runs(), st.integers(0, 30))
def test_entry_by_entry_is_the_same_as_all_at_once(entries, cut):
    state = fold(PLAN, entries[:cut])
    for entry in entries[cut:]:
        state = apply_entry(state, entry)
    assert state == fold(PLAN, entries)


@given(runs())
def test_after_a_gap_nothing_is_done_before_the_stand_is_as_it_was(entries):
    state = apply_entry(fold(PLAN, entries), Gap(1900 * S, 2000 * S))
    assert (state.is_setup_invalid, state.under_way, state.reasons, state.due_ns) == (True, "", frozenset(), None)
    assert not isinstance(
        choose_next_action(state, Surroundings(2000 * S)), ArmCapture | ContinueSoak | Perform | TakeFrame
    )


@given(runs())
def test_what_is_not_written_is_proved_by_the_recording_or_void_after_a_gap(entries):
    gap = Gap(1900 * S, 2000 * S)
    kept = [entry for entry in entries if not isinstance(entry, VOID)]
    assert lasting(fold(PLAN, [*entries, gap])) == lasting(fold(PLAN, [*kept, gap]))


@given(runs())
def test_the_lines_of_a_journal_make_the_same_state(entries):
    written = [Begun(0, "cycle-1", "0f", {}), *(entry for entry in entries if isinstance(entry, JournalEntry))]
    assert fold(PLAN, read_lines(lines_with(written))[0]) == fold(PLAN, written)


@pytest.mark.parametrize(
    "entry",  # of wrong types, as a damaged or foreign line may hold
    [
        Soaked(0, SOAK, "long"),  # pyright: ignore[reportArgumentType]
        Soaked(0, [], 1.0),  # pyright: ignore[reportArgumentType]
        StepChanged(0, {}, "done"),  # pyright: ignore[reportArgumentType]
        Restarted(0, 7),  # pyright: ignore[reportArgumentType]
        Extended(0, SOAK, "long"),  # pyright: ignore[reportArgumentType]
        Edited(0, "first", []),  # pyright: ignore[reportArgumentType]
        Edited(0, 13, [7]),  # pyright: ignore[reportArgumentType]
        Edited(0, 13, 7),  # pyright: ignore[reportArgumentType]
        Gap("then", 5),  # pyright: ignore[reportArgumentType]
    ],
)
def test_entries_that_no_run_has_written_are_refused(entry):
    with pytest.raises(SessionError, match="no run has written"):
        fold_entries(PLAN, read_lines(lines_with([entry]))[0])


@pytest.mark.parametrize("by", [[{}], [{"kind": "soak", "parameters": 5}], [{"kind": ["soak"], "parameters": {}}]])
def test_steps_that_are_none_are_refused(by):
    with pytest.raises(ConfigError):
        fold_entries(PLAN, [Edited(0, 13, by)])


@pytest.mark.parametrize(
    ("entries", "is_unsettled"),
    [
        ([Soaked(0, ID[3], 100.0, "settled"), StepChanged(0, ID[3], "done")], False),
        ([Soaked(0, ID[3], 100.0, "unsettled"), StepChanged(0, ID[3], "done")], True),
        ([Skipped(0, ID[3])], True),
    ],
)
def test_a_chamber_counts_as_unsettled_after_a_soak_that_ended_so_or_was_left_out(entries, is_unsettled):
    guaranteed = tuple(dataclasses.replace(each, step=Soak(100.0)) if each.index == 3 else each for each in PLAN)
    before = [StepChanged(0, each, "done") for each in ID[:3]]
    assert fold(guaranteed, [*before, *entries]).is_unsettled is is_unsettled
