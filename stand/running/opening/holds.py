"""What is done while something holds a run, wherever it waits.

The flap is shut in every hold that lasts: through an open one the chamber breathes the laboratory's air (frost in the
cold, and no equilibrium). And in virtual time, where no operator is there, a hold that lasts for ever ends the run.
"""

from __future__ import annotations

from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import DeviceError, NotReset, StandError
from thermostand.foundation.events import COMMAND, FLAP_NOT_SHUT, FLAP_SHUT_IN_HOLD
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.tasks import wait_for_first
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.safety.gate import STOPPING, Gate
from thermostand.stand.safety.latch import Latch

# Within 60 s of the hold it is shut, its travel included; a shorter pause leaves a capture as it is.
SHUT_AFTER_S = 48.0
_LOOK_S = 5.0  # who was on the way when the gate closed may open it later
_CLEARED_WITHIN_S = 1800.0  # by the person who works with a virtual run: some 30 s of real time
_ENDLESS_LOOK_S = 30.0  # of hours; not measured
_AGAIN_S = 60.0  # after a try that failed: a jammed flap's motor must not be worn


async def keep_flap_closed_in_holds(stand: Stand, hub: Hub, clock: Clock) -> None:
    """Keep the flap shut in each hold, until cancelled. Events: `flap_shut_in_hold` and, when it does not close,
    `flap_not_shut` (an error)."""
    while True:
        await stand.gate.wait_until_closed()
        if await _opens_within(stand.gate, clock, SHUT_AFTER_S):
            continue
        while stand.gate.reasons:
            wait_s = _LOOK_S
            if (
                stand.imaging.flap_open
                and STOPPING not in stand.gate.reasons
                and not await _shut_flap(stand, hub, clock)
            ):
                wait_s = _AGAIN_S
            await _opens_within(stand.gate, clock, wait_s)


async def _shut_flap(stand: Stand, hub: Hub, clock: Clock) -> bool:
    """Return whether it is shut now."""
    reasons = sorted(stand.gate.reasons)
    try:
        await stand.imaging.close_flap()
    except DeviceError as error:
        hub.publish(FLAP_NOT_SHUT.at(clock.now_ns(), str(error), reasons=reasons))
        return False
    hub.publish(FLAP_SHUT_IN_HOLD.at(clock.now_ns(), reasons=reasons))
    return True


async def _opens_within(gate: Gate, clock: Clock, duration_s: float) -> bool:
    """Return whether the gate opens before so long is over."""
    return await wait_for_first(gate.wait_until_open(), clock.sleep_until(clock.now_ns() + to_ns(duration_s))) == 0


async def end_endless_holds(gate: Gate, hub: Hub, clock: Clock, latch: Latch, limit_h: float) -> None:
    """End holds for virtual time, until cancelled. NotReset when what is latched needs an operator and no command came
    for 30 min, StandError when the gate has been closed for `limit_h` without interruption."""
    since_ns: int | None = None  # the gate has been closed
    waits_ns: int | None = None  # the hold has waited for an operator

    def follow(_reason: str, held: bool) -> None:
        nonlocal since_ns
        since_ns = None if not gate.reasons else clock.now_ns() if since_ns is None and held else since_ns

    def receive(item: Item) -> None:
        nonlocal waits_ns
        if isinstance(item, Event) and item.kind == COMMAND:
            waits_ns = None

    gate.subscribe(follow)
    hub.subscribe(receive)
    try:
        while True:
            await gate.wait_until_closed()
            now_ns, fault = clock.now_ns(), latch.fault
            since_ns = now_ns if since_ns is None else since_ns
            if fault is None or fault.ends_itself:
                waits_ns = None
            elif waits_ns is None:
                waits_ns = now_ns
            elif now_ns - waits_ns >= to_ns(_CLEARED_WITHIN_S):
                minutes = _CLEARED_WITHIN_S / 60
                raise NotReset(f"held for {minutes:g} min of virtual time, and nobody reset it: {fault.text}")
            if now_ns - since_ns >= to_ns(3600.0 * limit_h):
                reasons = fault.text if fault else ", ".join(sorted(gate.reasons))
                raise StandError(f"held for {limit_h:g} h of virtual time ({reasons}), and nobody continued it")
            await _opens_within(gate, clock, _ENDLESS_LOOK_S)
    finally:
        hub.unsubscribe(receive)
