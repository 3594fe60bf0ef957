"""For how long a capture was not going on: the gate closed, or the stand being made ready again."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager

from foundation.clock import Clock
from stand.gate import Gate


class Outage:
    """Adds up, since the last `reset`, the time during which the gate was closed or somebody was inside `counted`; when
    both were, it counts once."""

    def __init__(self, gate: Gate, clock: Clock) -> None:
        self._gate = gate
        self._clock = clock
        self._ended_ns = 0
        self._since_ns = clock.now_ns()
        self._inside = 0
        self._is_closed = bool(gate.reasons)
        gate.subscribe(self._on_gate)

    @property
    def length_ns(self) -> int:
        """Until now."""
        return self._ended_ns + (self._clock.now_ns() - self._since_ns if self._is_out else 0)

    @property
    def _is_out(self) -> bool:
        return self._is_closed or self._inside > 0

    def reset(self, length_ns: int = 0) -> None:
        """Count from `length_ns` on."""
        self._ended_ns, self._since_ns = length_ns, self._clock.now_ns()

    @contextmanager
    def counted(self) -> Generator[None]:
        """The time inside counts."""
        self._change(self._is_closed, self._inside + 1)
        try:
            yield
        finally:
            self._change(self._is_closed, self._inside - 1)

    def _on_gate(self, reason: str, held: bool) -> None:
        self._change(bool(self._gate.reasons), self._inside)

    def _change(self, is_closed: bool, inside: int) -> None:
        self.reset(self.length_ns)
        self._is_closed, self._inside = is_closed, inside
