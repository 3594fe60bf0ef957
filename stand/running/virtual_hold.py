"""In virtual time nobody sits beside the stand: a run that is held for too long ends instead of waiting for ever."""

from __future__ import annotations

from foundation.clock import Clock, seconds_ns
from foundation.errors import StandError
from stand.gate import Gate


async def end_endless_holds(gate: Gate, clock: Clock, limit_h: float) -> None:
    """Raises StandError when the gate has been closed for `limit_h` without interruption; else runs until cancelled."""
    since_ns: int | None = None

    def follow(_reason: str, held: bool) -> None:
        nonlocal since_ns
        since_ns = None if not gate.reasons else clock.now_ns() if since_ns is None and held else since_ns

    gate.subscribe(follow)
    while True:
        await gate.closed()
        if since_ns is None:  # it was closed before anybody listened
            since_ns = clock.now_ns()
        ends_ns = since_ns + seconds_ns(3600.0 * limit_h)
        if clock.now_ns() >= ends_ns:
            reasons = ", ".join(sorted(gate.reasons))
            raise StandError(f"held for {limit_h:g} h of virtual time ({reasons}), and nobody let it go on")
        await clock.sleep_until(ends_ns)
