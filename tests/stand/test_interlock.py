"""Whether anything may move, and what moves."""

from __future__ import annotations

import pytest

from thermostand.foundation.errors import StandTripped
from thermostand.stand.fault import Fault
from thermostand.stand.gate import INTERLOCK, OPERATOR, STOPPING, Gate
from thermostand.stand.interlock import Interlock, Interlocked, Motions


class Counted:
    """A mover that counts how often it was allowed to move."""

    times = 0

    def allow(self) -> None:
        self.times += 1


def test_nothing_may_move_from_the_first_fault_on_until_the_run_that_it_ends_is_over():
    gate, mover = Gate(), Counted()
    interlock = Interlock(gate, (mover,))
    interlock.check()
    assert mover.times == 1
    interlock.latch(Fault("air_hot", "the air is too hot"))
    interlock.latch(Fault("late", "nobody looks"))
    assert interlock.fault == Fault("air_hot", "the air is too hot")
    assert gate.reasons == {STOPPING}  # nothing earns time meanwhile
    with pytest.raises(StandTripped, match="the air is too hot"):
        interlock.check()
    assert mover.times == 1
    interlock.unlatch()
    assert gate.reasons == set()
    interlock.check()
    assert mover.times == 2


def test_a_hold_of_the_guard_bars_movement_and_a_pause_does_not():
    gate, mover = Gate(), Counted()
    interlock = Interlock(gate, (mover,))
    gate.hold(OPERATOR)
    interlock.check()
    gate.hold(INTERLOCK)
    with pytest.raises(Interlocked):
        interlock.check()
    gate.clear(INTERLOCK)
    interlock.check()
    assert mover.times == 2


def test_what_moves_is_what_has_begun_last_of_each_and_has_not_ended():
    motions = Motions()
    with motions.under_way("linear", "to 250 mm"):
        with motions.under_way("flap", "closing"), motions.under_way("linear", "to 20 mm"):
            assert motions.texts == ["linear to 20 mm", "flap closing"]
            assert motions.names == ("linear", "flap")
            assert motions.moves("flap")
        assert motions.texts == ["linear to 250 mm"]
        assert (motions.moves("flap"), motions.moves("linear")) == (False, True)
    assert (motions.texts, motions.names, motions.moves("linear")) == ([], (), False)
