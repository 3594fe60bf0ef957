"""Whether anything may move: what every verb of the stand asks first, and again after every wait."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Protocol

from foundation.errors import StandTripped
from stand.fault import Fault
from stand.gate import INTERLOCK, STOPPING, Gate


class Interlocked(StandTripped):
    """The guard has made the stand safe and an operator has not cleared it yet: nothing may move meanwhile."""


class Mover(Protocol):
    """A flap or an axis, which making safe bars from moving."""

    def allow(self) -> None:
        """New commands may move it again."""
        ...


class Interlock:
    """Closed by the first fault until the run that it ends is over, and by the gate's interlock until an operator
    clears it."""

    def __init__(self, gate: Gate, movers: Iterable[Mover]) -> None:
        self.fault: Fault | None = None
        self._gate = gate
        self._movers = tuple(movers)

    def latch(self, fault: Fault) -> None:
        """Closed until `unlatch`; the first fault stays. Nothing earns time while the stand is being made safe."""
        self.fault = self.fault or fault
        self._gate.hold(STOPPING)

    def unlatch(self) -> None:
        """The run that the latch has ended is over, and the stand was made safe."""
        self.fault = None
        self._gate.clear(STOPPING)

    def check(self) -> None:
        """StandTripped after a fault, Interlocked while the guard holds the stand; else everything may move."""
        if self.fault is not None:
            raise StandTripped(f"the stand is latched: {self.fault.text}")
        if INTERLOCK in self._gate.reasons:
            raise Interlocked("an interlock holds the stand until an operator clears it")
        for mover in self._movers:
            mover.allow()  # what making safe has barred, and bars again should it begin before the command is sent
