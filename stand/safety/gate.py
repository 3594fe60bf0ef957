"""The one gate before everything a run does: a set of reasons to wait. It is open when there is none."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from enum import StrEnum

from thermostand.foundation.events import CAMERA_ENDS, DISK, DISK_SPACE_ADVICE, RESET_ADVICE, Alert, event

Listener = Callable[[str, bool], None]

# What may hold a run; each reason is cleared by what has set it.
OPERATOR = "operator"  # a pause; the chamber keeps its set-point
INTERLOCK = "interlock"  # the guard has made the chamber safe (set and cleared by the latch alone)
CAMERA_LOST = "camera_lost"  # until it answers again
DISK_LOW = "disk_low"  # until frames can be recorded again
NOT_RECORDED = "not_recorded"  # until the disk takes telemetry again
STOPPING = "stopping"  # the run is being ended; cleared when it is over

# The same in words, for people.
REASON_TEXTS = {
    OPERATOR: "an operator's pause",
    INTERLOCK: "a rule of the guard",
    CAMERA_LOST: "a camera that does not answer",
    DISK_LOW: "a disk that takes no frames",
    NOT_RECORDED: "a disk that takes no telemetry",
    STOPPING: "the end of the run",
}
_STATUS = "`stand status` says what holds it, and what ends that"
ENDINGS = {
    OPERATOR: "`stand continue` ends the pause",
    INTERLOCK: RESET_ADVICE,
    CAMERA_LOST: CAMERA_ENDS,
    DISK_LOW: DISK_SPACE_ADVICE,
    NOT_RECORDED: DISK,
}
HELD = event(
    "held",
    "warning",
    "held by {text}",
    # What the guard says of its rule reports how that ends.
    lambda data: (ENDINGS | {INTERLOCK: ""}).get(str(data.get("reason"))) or _STATUS,
    counts=True,
    cases=tuple({"reason": reason} for reason in ENDINGS),
)
RELEASED = event(
    "released",
    "info",
    "no longer held by {text}",
    alert=lambda data: Alert("hold", "guard", "over") if data.get("reason") == INTERLOCK else None,
    counts=True,
    cases=({"reason": INTERLOCK}, {"reason": OPERATOR}),
)


class Gate:
    """Awaited before each action, and within dwells and captures. Reasons are independent: none clears another."""

    def __init__(self) -> None:
        self._reasons: set[str] = set()
        self._open, self._closed = asyncio.Event(), asyncio.Event()
        self._open.set()
        self._listeners: list[Listener] = []

    @property
    def reasons(self) -> frozenset[str]:
        """What holds the run now."""
        return frozenset(self._reasons)

    def subscribe(self, listener: Listener) -> None:
        """Call `listener(reason, held)` at once when a reason appears (held) or goes."""
        self._listeners.append(listener)

    def remove_listeners(self) -> None:
        """Forget the listeners: the run they belong to has ended."""
        self._listeners.clear()

    def hold(self, reason: str) -> None:
        """Close the gate for `reason`; nothing happens when it holds already."""
        if reason not in self._reasons:
            self._reasons.add(reason)
            self._open.clear()
            self._closed.set()
            self._notify_listeners(reason, True)

    def clear(self, reason: str) -> None:
        """Take `reason` back; the gate opens with the last one."""
        if reason in self._reasons:
            self._reasons.discard(reason)
            if not self._reasons:
                self._closed.clear()
                self._open.set()
            self._notify_listeners(reason, False)

    async def wait_until_open(self) -> None:
        """Return when the gate is open."""
        while self._reasons:  # it may have closed again before we came to run
            await self._open.wait()

    async def wait_until_closed(self) -> None:
        """Return when the gate has closed, be it for a moment."""
        await self._closed.wait()

    def _notify_listeners(self, reason: str, held: bool) -> None:
        for listener in tuple(self._listeners):
            listener(reason, held)


class Phase(StrEnum):
    """Where a run is. aborting: it is being made safe, then it is cancelled. ending: it makes safe and takes everything
    down by itself, and must not be cancelled."""

    IDLE = "idle"
    RUNNING = "running"
    HELD = "held"
    ABORTING = "aborting"
    ENDING = "ending"
    ENDED = "ended"


class PhaseTurn(StrEnum):
    """What moves a run from phase to phase."""

    START = "start"
    HOLD = "hold"
    RELEASE = "release"
    STOP = "stop"
    TAKE_DOWN = "take_down"
    END = "end"


# What is not in a row changes nothing: a run that is being aborted cannot be held, one that has ended stays so.
_LAST: dict[PhaseTurn, Phase] = {
    PhaseTurn.STOP: Phase.ABORTING,
    PhaseTurn.TAKE_DOWN: Phase.ENDING,
    PhaseTurn.END: Phase.ENDED,
}
_NEXT: dict[Phase, dict[PhaseTurn, Phase]] = {
    Phase.IDLE: {PhaseTurn.START: Phase.RUNNING, **_LAST},
    Phase.RUNNING: {PhaseTurn.HOLD: Phase.HELD, **_LAST},
    Phase.HELD: {PhaseTurn.RELEASE: Phase.RUNNING, **_LAST},
    Phase.ABORTING: {PhaseTurn.TAKE_DOWN: Phase.ENDING, PhaseTurn.END: Phase.ENDED},
    Phase.ENDING: {PhaseTurn.END: Phase.ENDED},
    Phase.ENDED: {},
}


def get_next_phase(phase: Phase, turn: PhaseTurn) -> Phase:
    """The phase after `turn`."""
    return _NEXT[phase].get(turn, phase)
