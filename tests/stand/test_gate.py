"""The gate's reasons, and the phases of a run."""

import asyncio
import itertools

import pytest
from hypothesis import given
from hypothesis import strategies as st

from thermostand.stand.safety.gate import Gate, Phase, PhaseTurn, get_next_phase

REASONS = st.sampled_from(["operator", "interlock", "camera_lost", "disk_low"])


@given(st.lists(st.tuples(REASONS, st.booleans()), max_size=20))
def test_the_gate_is_open_exactly_when_no_reason_is_left_and_no_reason_clears_another(changes):
    gate, standing, reported = Gate(), set(), []
    gate.subscribe(lambda reason, held: reported.append((reason, held)))
    expected = []
    for reason, held in changes:
        if held != (reason in standing):
            expected.append((reason, held))
        (standing.add if held else standing.discard)(reason)
        (gate.hold if held else gate.clear)(reason)
        assert gate.reasons == standing
        assert reported == expected


async def test_a_waiting_step_passes_when_the_last_reason_goes():
    gate = Gate()
    await gate.wait_until_open()
    gate.hold("operator")
    gate.hold("disk_low")
    waiting = asyncio.create_task(gate.wait_until_open())
    gate.clear("operator")
    await asyncio.sleep(0)
    assert not waiting.done()
    gate.clear("disk_low")
    await waiting


async def test_a_gate_that_closes_again_before_the_waiter_runs_keeps_it_waiting():
    gate = Gate()
    gate.hold("operator")
    waiting = asyncio.create_task(gate.wait_until_open())
    await asyncio.sleep(0)
    gate.clear("operator")
    gate.hold("disk_low")
    await asyncio.sleep(0)
    assert not waiting.done()
    gate.clear("disk_low")
    await waiting


async def test_a_hold_for_a_moment_is_not_missed():
    gate = Gate()
    waiting = asyncio.create_task(gate.wait_until_closed())
    await asyncio.sleep(0)
    gate.hold("operator")
    gate.clear("operator")
    await waiting


@pytest.mark.parametrize("phase", Phase)
def test_stop_ends_a_run_from_every_phase_and_nothing_brings_it_back(phase: Phase):
    stopped = get_next_phase(phase, PhaseTurn.STOP)
    assert stopped in (Phase.ABORTING, Phase.ENDING, Phase.ENDED)
    for turns in itertools.product((PhaseTurn.START, PhaseTurn.HOLD, PhaseTurn.RELEASE, PhaseTurn.STOP), repeat=2):
        after = stopped
        for turn in turns:
            after = get_next_phase(after, turn)
        assert after is stopped
    assert get_next_phase(stopped, PhaseTurn.END) is Phase.ENDED


@pytest.mark.parametrize("phase", Phase)
def test_a_run_that_takes_itself_down_is_not_aborted_any_more(phase: Phase):
    ending = get_next_phase(phase, PhaseTurn.TAKE_DOWN)
    assert ending is (Phase.ENDED if phase is Phase.ENDED else Phase.ENDING)
    assert {get_next_phase(ending, turn) for turn in PhaseTurn} <= {ending, Phase.ENDED}


def test_a_run_is_held_and_released_only_between_its_start_and_its_stop():
    assert get_next_phase(Phase.IDLE, PhaseTurn.HOLD) is Phase.IDLE
    assert get_next_phase(Phase.IDLE, PhaseTurn.START) is Phase.RUNNING
    assert get_next_phase(Phase.RUNNING, PhaseTurn.HOLD) is Phase.HELD
    assert get_next_phase(Phase.HELD, PhaseTurn.RELEASE) is Phase.RUNNING
