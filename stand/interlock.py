"""Whether anything may move, which every verb asks first and again after every wait, and what moves now."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from contextlib import contextmanager
from typing import Protocol

from thermostand.foundation.errors import StandTripped
from thermostand.stand.fault import Fault
from thermostand.stand.gate import INTERLOCK, STOPPING, Gate


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


class Motions:
    """What moves at this moment (an axis, the flap), and where to: whether an operator may put a hand in."""

    def __init__(self) -> None:
        self._under_way: dict[object, tuple[str, str]] = {}  # by motion, in the order they began: what moves, where to

    @property
    def texts(self) -> list[str]:
        """As in `["linear to 250 mm", "flap closing"]`: of each the motion that began last."""
        return [f"{name} {text}" for name, text in dict(self._under_way.values()).items()]

    @property
    def names(self) -> tuple[str, ...]:
        """What moves: axes, the flap."""
        return tuple(dict(self._under_way.values()))

    def moves(self, name: str) -> bool:
        """Whether this one is under way."""
        return name in self.names

    @contextmanager
    def under_way(self, name: str, text: str) -> Generator[None]:
        """It moves while inside. A motion may be part of another, or end after one that has taken its place."""
        motion = object()
        self._under_way[motion] = name, text
        try:
            yield
        finally:
            del self._under_way[motion]
