"""Whether anything may move, which every verb asks first and again after every wait, and what moves now."""

from __future__ import annotations

from collections.abc import Generator, Iterable
from contextlib import contextmanager
from typing import Protocol

from thermostand.foundation.errors import StandTripped
from thermostand.stand.safety.gate import STOPPING, Gate
from thermostand.stand.safety.latch import Latch


class Interlocked(StandTripped):
    """The guard has made the stand safe and an operator has not reset it yet: nothing may move meanwhile."""


class Mover(Protocol):
    """A flap or an axis, which making safe bars from moving."""

    def allow(self) -> None:
        """Allow new commands to move it again."""
        ...


class Interlock:
    """Closed while a run is being ended, and while the latch holds what has tripped."""

    def __init__(self, latch: Latch, gate: Gate, movers: Iterable[Mover]) -> None:
        self._latch = latch
        self._gate = gate
        self._movers = tuple(movers)

    def check(self) -> None:
        """StandTripped while a run is being ended, Interlocked while the guard holds the stand; else everything may
        move."""
        fault = self._latch.fault
        if STOPPING in self._gate.reasons:
            raise StandTripped(f"the run is being ended: {'stopped' if fault is None else fault.text}")
        if fault is not None:
            raise Interlocked(f"an interlock holds the stand until it is reset: {fault.text}")
        for mover in self._movers:
            mover.allow()  # what making safe has barred, and bars again should it begin before the command is sent


class Motions:
    """What moves at this moment (an axis, the flap), and where to: whether an operator may put a hand in."""

    def __init__(self) -> None:
        self._under_way: dict[object, tuple[str, str]] = {}  # by motion, in the order they began: what moves, where to

    @property
    def texts(self) -> list[str]:
        """The motions in words, as in `["linear to 250 mm", "flap closing"]`: of each the motion that began last."""
        return [f"{name} {text}" for name, text in dict(self._under_way.values()).items()]

    @property
    def names(self) -> tuple[str, ...]:
        """What moves: axes, the flap."""
        return tuple(dict(self._under_way.values()))

    def moves(self, name: str) -> bool:
        """Return whether this one is under way."""
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
