"""A run as a table: for every state and everything that may happen in it, what is done next."""

import math
from dataclasses import replace
from typing import Any

import pytest

from thermostand.experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PowerCamera,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    StopChamber,
    number_steps,
)
from thermostand.foundation.clock import NS_PER_S
from thermostand.stand.running.executing.actions import (
    ArmCapture,
    Begin,
    Complete,
    ContinueSoak,
    Equilibrate,
    Perform,
    ReopenFlap,
    RestartCold,
    Restore,
    Retake,
    Sleep,
    Surroundings,
    TakeFrame,
    Wait,
    choose_next_action,
    compute_due_after_ns,
    compute_next_due_ns,
    credit_soaks,
)
from thermostand.stand.running.memory.entries import (
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
from thermostand.stand.running.memory.fold import apply_entry, fold
from thermostand.stand.running.memory.state import RunState, SetUp
from thermostand.stand.safety.gate import INTERLOCK, OPERATOR

S = NS_PER_S
FIT = Capture(2, 10.0, 0.1, Role.FIT, 30.0)
WARM_UP = Capture(3, 10.0, 0.1, Role.WARM_UP, 30.0)
PLAN = tuple(
    number_steps(
        [
            CloseFlap(),
            MoveTo("linear", 2.0),
            StartChamber(30.0),
            Soak(100.0),
            OpenFlap(),
            FIT,
            CloseFlap(),
            PowerCamera(False),
            CoolDown(2.0, 100.0, 500.0),
            Prompt("turn it"),
            PowerCamera(True),
            WARM_UP,
            CheckHome("linear"),
            StopChamber(),
        ]
    )
)
ID = [planned.step_id for planned in PLAN]
MOVE, START, SOAK, OPEN, CAPTURE, OFF, COOL, PROMPT, ON, WARM, HOME = (
    ID[i] for i in (1, 2, 3, 4, 5, 7, 8, 9, 10, 11, 12)
)


def done(index: int) -> list[StepChanged]:
    """All steps before that place."""
    return [
        entry
        for step_id in ID[:index]
        for entry in (StepChanged(0, step_id, "started"), StepChanged(0, step_id, "done"))
    ]


def begun(step_id: str) -> list[StepChanged]:
    return [*done(ID.index(step_id)), StepChanged(0, step_id, "started")]


# By name: the entries so far, all at 0 s. `now` is 20 s.
STATES = {
    "fresh": [],
    "begun": begun(START),
    "soak begun": begun(SOAK),
    "half soaked": [*begun(SOAK), Soaked(0, SOAK, 50.0)],
    "soaked": [*begun(SOAK), Soaked(0, SOAK, 100.0, "settled")],
    "before opening": done(4),
    "opened": done(5),
    "capture begun": begun(CAPTURE),
    "next is due": [*begun(CAPTURE), Due(0, 20 * S)],
    "next is ahead": [*begun(CAPTURE), Taken(0, CAPTURE), Due(0, 30 * S)],
    "one frame": [*begun(CAPTURE), Taken(0, CAPTURE), Due(0, 20 * S)],
    "one was lost": [*begun(CAPTURE), Taken(0, CAPTURE), Due(0, 20 * S, lost=True)],
    "all frames": [*begun(CAPTURE), Taken(0, CAPTURE), Taken(0, CAPTURE), Due(0, 30 * S)],
    "camera off": begun(COOL),
    "asked": begun(PROMPT),
    "camera on": done(11),
    "warming up": [*begun(WARM), Taken(0, WARM), Due(0, 20 * S)],
    "checking": begun(HOME),
    "complete": done(len(ID)),
}
FLAP_OPEN = {"opened", "capture begun", "next is due", "next is ahead", "one frame", "one was lost", "all frames"}


def held_for(begin_s: float, end_s: float, reason: str = OPERATOR) -> list[Held]:
    return [Held(int(begin_s * S), reason, True), Held(int(end_s * S), reason, False)]


# By name: what happens (its entries), and what of the surroundings is then another. `{}` of a step is the first to do;
# -1 of an edit is the first step that was not begun.
EVENTS = {
    "nothing": ([], {}),
    "held": ([Held(10 * S, OPERATOR, True)], {"held": True}),
    "tripped": ([Tripped(10 * S, "over_temperature", "too hot")], {"held": True}),
    "held 5 s": (held_for(10, 15), {}),
    "flap shut": (held_for(-60, 15), {"flap_open": False}),
    "ready": ([*held_for(0, 70), Preparing(70 * S, True)], {"now_ns": 80 * S}),
    "held 70 s": (held_for(0, 70), {"now_ns": 80 * S}),
    "interlock": ([Held(10 * S, INTERLOCK, True)], {"held": True}),
    "reset": (held_for(10, 15, INTERLOCK), {"flap_open": False}),
    "restored": ([*held_for(10, 15, INTERLOCK), Restored(16 * S, 1)], {"flap_open": False}),
    "camera off": ([Cooled(10 * S)], {"lost_equilibrium": True}),
    "camera back": ([Cooled(10 * S), Restored(15 * S, 1)], {"lost_equilibrium": True}),
    "killed": ([Gap(10 * S, 15 * S)], {"flap_open": False}),
    "left out": ([Skipped(10 * S, "{}")], {}),
    "longer": ([Extended(10 * S, "{}", 60.0)], {}),
    "the rest left out": ([Edited(10 * S, -1, [])], {}),
}

# What is done next: a row for each state, a column for each event, both in the order above.
NEXT = """
                 no  he  tr  h5  fs  re  h7  in  cl  rs  co  cb  ki  lo  lg  ed
fresh            Be  Wa  Wa  Be  Be  Be  Be  Wa  Re  Be  Re  Be  Re  Be  Be  --
begun            Pe  Wa  Wa  Pe  Pe  Pe  Pe  Wa  Re  Pe  Re  Pe  Re  Pe  Pe  Pe
soak begun       Ea  Wa  Wa  Ea  Ea  Ea  Ea  Wa  Re  Ea  Re  Ea  Re  Be  Ea  Ea
half soaked      Ea  Wa  Wa  Ea  Ea  Ea  Ea  Wa  Re  Ea  Re  Ea  Re  Be  Ea  Ea
soaked           Co  Wa  Wa  Co  Co  Co  Co  Wa  Co  Co  Co  Co  Re  Be  Ea  Co
before opening   Be  Wa  Wa  Be  Be  Be  Be  Wa  Re  Be  Re  Eq  Re  Be  Be  --
opened           Be  Wa  Wa  Be  OA  Be  Be  Wa  Re  OA  Re  Eq  Re  Be  Be  --
capture begun    Ai  Wa  Wa  Ai  OA  Ai  Ai  Wa  Re  OA  Re  Eq  Re  Be  Ai  Ai
next is due      TF  Wa  Wa  TF  OA  Ai  TF  Wa  Re  OA  Re  Eq  Re  Be  TF  TF
next is ahead    Sl  Sl  Sl  Sl  Sl  Ai  TA  Sl  Sl  Sl  Sl  Sl  Re  Be  Sl  Sl
one frame        TF  Wa  Wa  TF  OA  Ai  TA  Wa  Re  OA  Re  Eq  Re  Be  TF  TF
one was lost     Ai  Wa  Wa  Ai  OA  Ai  Ai  Wa  Re  OA  Re  Eq  Re  Be  Ai  Ai
all frames       Co  Co  Co  Co  Co  Co  Co  Co  Co  Co  Co  Co  Re  Be  Co  Co
camera off       Pe  Wa  Wa  Pe  Pe  Pe  Pe  Wa  Re  Pe  Re  Pe  Re  Be  Pe  Pe
asked            Pe  Wa  Wa  Pe  Pe  Pe  Pe  Wa  Re  Pe  Re  Pe  Re  Be  Pe  Pe
camera on        Be  Wa  Wa  Be  Be  Be  Be  Wa  SC  Be  SC  Eq  SC  Be  Be  --
warming up       TF  Wa  Wa  TF  SC  Ai  SC  Wa  SC  TF  SC  Eq  SC  Be  TF  TF
checking         Pe  Wa  Wa  Pe  Pe  Pe  Pe  Wa  Re  Pe  Re  Pe  Re  Pe  Pe  Pe
complete         --  --  --  --  --  --  --  --  --  --  --  --  --  --  --  --
"""
CODES = {
    "Ai": ArmCapture,
    "Be": Begin,
    "Co": Complete,
    "Ea": ContinueSoak,
    "Eq": Equilibrate,
    "OA": ReopenFlap,
    "Pe": Perform,
    "Re": Restore,
    "SC": RestartCold,
    "Sl": Sleep,
    "TA": Retake,
    "TF": TakeFrame,
    "Wa": Wait,
    "--": type(None),
}
ROWS = [line[:16].strip() for line in NEXT.splitlines()[2:]]
CELLS = [
    pytest.param(state, event, CODES[code], id=f"{state}, {event}")
    for state, line in zip(ROWS, NEXT.splitlines()[2:], strict=True)
    for event, code in zip(EVENTS, line[16:].split(), strict=True)
]


def met(state: str, event: str) -> tuple[RunState, Surroundings]:
    """The state after the event, and its surroundings."""
    entries, around = EVENTS[event]
    before = fold(PLAN, STATES[state])
    current = before.plan[before.index].step_id if before.index < len(PLAN) else ""
    used = [planned.index for planned in PLAN if planned.step_id in before.done | before.begun]

    def placed(entry: Entry) -> Entry:
        if isinstance(entry, Skipped | Extended):
            return replace(entry, step_id=current)
        return replace(entry, from_index=max(used, default=-1) + 1) if isinstance(entry, Edited) else entry

    now = [placed(entry) for entry in entries]
    found = {"now_ns": 20 * S, "flap_open": state in FLAP_OPEN, **around}
    return fold(PLAN, [*STATES[state], *now]), Surroundings(**found)


def test_the_table_has_a_row_for_each_state():
    assert list(STATES) == ROWS


@pytest.mark.parametrize(("state", "event", "expected"), CELLS)
def test_what_is_done_next(state: str, event: str, expected: type):
    assert type(choose_next_action(*met(state, event))) is expected


def test_nothing_moves_while_something_holds_the_run():
    still = Wait | Sleep | Complete | None
    for state in STATES:
        for event, (_, around) in EVENTS.items():
            if around.get("held"):
                assert isinstance(choose_next_action(*met(state, event)), still)


def test_what_is_restored_is_what_the_steps_before_have_set_up():
    restore = choose_next_action(*met("half soaked", "killed"))
    assert restore == Restore(SetUp(30.0, (PLAN[3],), True, False, {"linear": 2.0}))
    assert choose_next_action(*met("one frame", "killed")) == Restore(
        SetUp(30.0, (PLAN[3],), True, True, {"linear": 2.0})
    )
    assert choose_next_action(*met("camera off", "killed")).set_up.camera_on is False


def test_a_warm_up_begins_again_from_the_switch_that_made_it_cold_without_what_the_operator_did():
    again = choose_next_action(*met("warming up", "killed")).again
    assert [planned.step_id for planned in again] == [OFF, COOL, ON, WARM]
    state = apply_entry(met("warming up", "killed")[0], Restarted(0, [OFF, COOL, ON, WARM]))
    assert (state.index, state.frames, state.is_setup_invalid, state.under_way) == (7, {}, True, "")
    assert isinstance(choose_next_action(state, Surroundings(20 * S)), Restore)


def walk(state: RunState, around: dict[str, Any], *entries_and_actions) -> RunState:
    """After each entry, or change of the surroundings, the action named behind it comes next."""
    for given, expected in entries_and_actions:
        around |= given if isinstance(given, dict) else {}
        state = state if isinstance(given, dict) else apply_entry(state, given)
        assert type(choose_next_action(state, Surroundings(**around))) is expected, given
    return state


def test_a_capture_that_was_killed_and_stood_for_a_minute_is_taken_again():
    state = walk(
        fold(PLAN, STATES["one frame"]),
        {"now_ns": 90 * S},
        (Gap(20 * S, 81 * S), Restore),
        (Preparing(81 * S, True), Restore),
        (Restored(85 * S, 1), ReopenFlap),
        ({"flap_open": True}, Begin),
        (Preparing(86 * S, False), Begin),
        (StepChanged(87 * S, CAPTURE, "started"), ArmCapture),
        (Due(88 * S, 88 * S), Retake),
        (Restarted(90 * S, [CAPTURE]), TakeFrame),
        (StepChanged(90 * S, CAPTURE, "started"), TakeFrame),
        (Taken(91 * S, CAPTURE), TakeFrame),
        (Due(91 * S, 98 * S), Sleep),
        ({"now_ns": 98 * S}, TakeFrame),
        (Taken(98 * S, CAPTURE), Complete),
    )
    assert not state.is_setup_invalid


def test_a_capture_of_which_the_disk_lost_frames_is_taken_again_when_nothing_holds_the_run():
    state = walk(
        fold(PLAN, STATES["all frames"]),
        {"now_ns": 30 * S, "flap_open": True},
        ({"frames_lost": 1, "held": True}, Wait),
        ({"held": False}, Retake),
        (Restarted(30 * S, [CAPTURE]), TakeFrame),
        ({"frames_lost": 0}, TakeFrame),
        (StepChanged(30 * S, CAPTURE, "started"), TakeFrame),
        (Taken(31 * S, CAPTURE), TakeFrame),
        (Taken(41 * S, CAPTURE), Complete),
    )
    assert not state.is_setup_invalid


def test_a_capture_is_taken_again_three_times_for_lost_frames_also_when_it_is_resumed_meanwhile():
    """A disk that loses frames each time does not hold the session for good."""
    around = Surroundings(30 * S, flap_open=True, frames_lost=1)
    again = [Restarted(30 * S, [CAPTURE], 1), StepChanged(30 * S, CAPTURE, "started"), *[Taken(31 * S, CAPTURE)] * 2]
    entries = [*STATES["all frames"], *again, *again, Gap(32 * S, 33 * S), Restored(34 * S, 1)]
    twice = fold(PLAN, [*entries, StepChanged(35 * S, CAPTURE, "started")])
    assert choose_next_action(twice, around) == Retake(PLAN[5], "the disk has lost 1 of its frames", 1)
    thrice = apply_entry(twice, Restarted(36 * S, [CAPTURE], 1))
    assert isinstance(choose_next_action(fold(PLAN, []), around), Begin)
    for entry in again[1:]:
        thrice = apply_entry(thrice, entry)
    assert isinstance(choose_next_action(thrice, around), Complete)
    done = apply_entry(thrice, StepChanged(40 * S, CAPTURE, "done"))
    assert (thrice.retakes, done.retakes) == ({CAPTURE: 3}, {})


def test_a_warm_up_of_which_the_disk_lost_frames_is_not_taken_again():
    frames = [Taken(0, WARM)] * next(planned.step.frames for planned in PLAN if planned.step_id == WARM)
    state = fold(PLAN, [*begun(WARM), *frames])
    assert isinstance(choose_next_action(state, Surroundings(20 * S, frames_lost=1)), Complete)


def test_a_frame_is_settled_when_it_is_the_first_after_a_soak_and_no_warm_up():
    assert choose_next_action(*met("next is due", "nothing")).is_settled
    assert not choose_next_action(*met("one frame", "nothing")).is_settled
    assert not choose_next_action(*met("warming up", "nothing")).is_settled


def test_soaks_are_credited_only_in_the_band_and_when_the_camera_was_on():
    state, set_up = fold(PLAN, STATES["half soaked"]), SetUp(30.0, (PLAN[3],))
    for pv_degC, lost in ((29.1, ()), (31.0, ()), (28.9, (PLAN[3],))):
        credit = credit_soaks(state, set_up, Surroundings(0, pv_degC=pv_degC))
        assert (bool(credit.text), credit.lost) == (True, lost)
    assert credit_soaks(state, set_up, Surroundings(0, pv_degC=math.nan)).lost
    cold = apply_entry(state, Cooled(0))
    assert credit_soaks(cold, set_up, Surroundings(0, pv_degC=30.0)).lost
    assert not credit_soaks(cold, SetUp(30.0, (PLAN[3],), camera_on=False), Surroundings(0, pv_degC=30.0)).lost
    assert credit_soaks(fold(PLAN, begun(SOAK)), set_up, Surroundings(0, pv_degC=20.0)).text == ""
    assert not apply_entry(cold, Restored(0, 1)).is_cold
    assert apply_entry(apply_entry(cold, Cooled(0)), Restored(0, 1)).is_cold  # once more meanwhile


def test_deadlines_are_a_grid_of_which_those_missed_are_skipped():
    around = Surroundings(47 * S, lead_ns=S)
    assert compute_next_due_ns(None, FIT, around, is_lost=False) == 48 * S
    assert compute_next_due_ns(20 * S, FIT, around, is_lost=False) == 50 * S
    assert compute_next_due_ns(50 * S, FIT, around, is_lost=False) == 50 * S
    assert compute_next_due_ns(50 * S, FIT, around, is_lost=True) == 60 * S
    assert compute_due_after_ns(20 * S, FIT, 20 * S) == 30 * S
    assert compute_due_after_ns(20 * S, FIT, 47 * S) == 40 * S  # the latest that has passed


def test_a_frame_is_asked_for_its_lead_before_it_is_due():
    state = fold(PLAN, STATES["next is ahead"])
    for now_s, lead_s, expected in ((20, 0, Sleep(30 * S)), (20, 2, Sleep(28 * S)), (27, 2, Sleep(28 * S))):
        assert choose_next_action(state, Surroundings(now_s * S, lead_s * S, flap_open=True)) == expected
    for now_s, lead_s in ((28, 2), (30, 0)):
        assert isinstance(choose_next_action(state, Surroundings(now_s * S, lead_s * S, flap_open=True)), TakeFrame)


def test_a_step_that_is_left_out_ends_what_is_under_way_only_when_that_is_it():
    state = fold(PLAN, [*STATES["next is ahead"], Skipped(0, WARM)])
    assert (state.under_way, state.due_ns) == (CAPTURE, 30 * S)
    state = apply_entry(state, Skipped(0, CAPTURE))
    assert (state.under_way, state.due_ns, state.plan[state.index]) == ("", None, PLAN[6])


def test_the_end_of_a_step_ends_what_is_under_way_only_when_that_is_it():
    state = fold(PLAN, [*STATES["one was lost"], StepChanged(0, WARM, "done")])
    assert (state.under_way, state.due_ns, state.is_lost) == (CAPTURE, 20 * S, True)
    state = apply_entry(state, StepChanged(0, CAPTURE, "done"))
    assert (state.under_way, state.due_ns, state.is_lost) == ("", None, False)


def test_a_capture_of_which_a_step_before_is_done_again_is_neither_under_way_nor_has_lost_a_frame():
    before = fold(PLAN, STATES["one was lost"])
    state = apply_entry(before, Restarted(0, [OPEN, CAPTURE]))
    assert (state.under_way, state.due_ns, state.is_lost) == ("", None, False)
    assert state.setup_invalidations == before.setup_invalidations + 1
    assert state.plan[state.index].step_id == OPEN
    same = apply_entry(before, Restarted(0, [CAPTURE]))
    assert (same.under_way, same.due_ns, same.is_lost, same.frames) == (CAPTURE, 20 * S, True, {})
    assert same.setup_invalidations == before.setup_invalidations


def test_an_outage_is_what_was_held_or_made_ready_since_the_last_frame_and_counts_once():
    entries = [
        *begun(CAPTURE),
        Taken(0, CAPTURE),
        *held_for(5, 15),
        Held(20 * S, OPERATOR, True),
        Preparing(25 * S, True),
        Held(30 * S, OPERATOR, False),
        Preparing(32 * S, False),
    ]
    assert fold(PLAN, entries).outage_ns(50 * S) == 22 * S
    assert fold(PLAN, entries[:-1]).outage_ns(50 * S) == 40 * S
    assert fold(PLAN, [*entries[:-1], Gap(40 * S, 100 * S)]).outage_ns(120 * S) == 90 * S
    assert apply_entry(fold(PLAN, entries), Taken(60 * S, CAPTURE)).outage_ns(90 * S) == 0


def test_a_trip_stays_until_it_is_cleared_and_an_end_until_the_run_goes_on():
    state = fold(PLAN, [Tripped(0, "a", "first"), Tripped(0, "b", "second"), Ended(1, "tripped", "aborted")])
    assert (state.tripped, state.ended.status) == ("first", "tripped")
    assert apply_entry(state, Gap(1, 2)).ended is None
    assert apply_entry(state, Reset(2)).tripped == ""


def test_a_soak_longer_than_its_time_and_one_that_was_lost_owe_what_they_say():
    state = fold(PLAN, STATES["half soaked"])
    assert state.remaining_ns(PLAN[3]) == 150 * S  # it may take twice its time
    assert apply_entry(state, StepChanged(0, SOAK, "done")).remaining_ns(PLAN[3]) == 0
    assert (
        apply_entry(apply_entry(state, StepChanged(0, SOAK, "done")), Soaked(0, SOAK, 0.0)).remaining_ns(PLAN[3])
        == 200 * S
    )
    settled = next(number_steps([SoakUntilSettled(900.0, 60.0, 240.0, 60.0, 0.2, 0.003, 0.1, 24.0)]))
    assert fold([settled], []).remaining_ns(settled) == 900 * S


def test_a_new_set_point_is_another_set_up():
    set_up = SetUp(30.0, (PLAN[3],)).after(next(number_steps([SetTemperature(20.0)])))
    assert set_up == SetUp(20.0)
    assert SetUp(30.0, (PLAN[3],)).after(PLAN[13]).chamber_degC is None
