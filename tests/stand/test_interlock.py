"""Whether anything may move, and what moves."""

from __future__ import annotations

import pytest

from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.errors import StandTripped
from thermostand.foundation.hub import Hub
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import INTERLOCK, OPERATOR, STOPPING, Gate
from thermostand.stand.safety.interlock import Interlock, Interlocked, Motions
from thermostand.stand.safety.latch import Latch


class Counted:
    """A mover that counts how often it was allowed to move."""

    times = 0

    def allow(self) -> None:
        self.times += 1


def test_nothing_may_move_while_a_run_is_ended_or_something_is_latched_and_a_pause_bars_nothing():
    gate, mover = Gate(), Counted()
    latch = Latch(gate, Hub(), VirtualClock(0))
    interlock = Interlock(latch, gate, (mover,))
    gate.hold(OPERATOR)
    interlock.check()
    latch.trip(Fault("air_hot", "the air is too hot"))
    with pytest.raises(Interlocked, match="too hot"):
        interlock.check()
    gate.hold(STOPPING)
    with pytest.raises(StandTripped, match="too hot") as ended:
        interlock.check()
    assert not isinstance(ended.value, Interlocked)  # which a step would wait for
    gate.clear(STOPPING)
    latch.hold_gate()
    assert gate.reasons == {OPERATOR, INTERLOCK}
    latch.reset()
    assert gate.reasons == {OPERATOR}
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
