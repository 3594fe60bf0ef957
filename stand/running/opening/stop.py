"""How a run ends early, for any cause: the actuators are made safe first, then the run is cancelled."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable

from thermostand.foundation.errors import Interrupted, SessionError, StandTripped
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import STOPPING, Gate, Phase, PhaseTurn, get_next_phase

STOPPED_BY_OPERATOR = "operator"  # the rule of a fault that is no fault
STOPPED = Fault(STOPPED_BY_OPERATOR, "stopped by the operator")


class Stop:
    """The one way a run ends early, in any phase: `stop(fault)` for the operator (SIGINT, SIGTERM, SIGQUIT, and SIGHUP,
    when the terminal is closed and nohup does not keep it away), `stop.trip(fault)` for the guard.

    Nothing moves from then on, the stand is made safe, the run cancelled where it waits, once, and not while it is
    being taken down; what it then raises becomes Interrupted or StandTripped with the first reason. While an actuator
    does not confirm that it is safe, a signal a minute after the first ends the wait. Without `has_signals` the signals
    are somebody else's: those of a daemon, whose guest is stopped.

    shutdown_deadline: how long a disk is waited for once the stand is safe; a run that has ended by itself, and is
    stopped while it waits, has no more time than another.
    """

    def __init__(self, *, has_signals: bool = True) -> None:
        self.reason: Fault | None = None  # why the run ends, by the first stop
        self.phase = Phase.IDLE
        self.shutdown_deadline = ShutdownDeadline()
        self._stand: Stand | None = None
        self._aborting: asyncio.Task[None] | None = None
        self._signals = [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT] if has_signals else []
        if has_signals and signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
            self._signals.append(signal.SIGHUP)

    @property
    def is_unsafe(self) -> bool:
        """Whether an actuator of the stand has not confirmed its safe state."""
        return self._stand is not None and bool(self._stand.safety.unconfirmed)

    def watch(self, stand: Stand) -> None:
        """The stand to be made safe; before that a stop only cancels."""
        self._stand = stand
        stand.gate.subscribe(lambda reason, held: self._follow(stand.gate))

    def begin(self) -> None:
        """The plan begins."""
        self._turn(PhaseTurn.START)
        if self._stand is not None:
            self._follow(self._stand.gate)

    def __call__(self, fault: Fault = STOPPED) -> None:
        """Bar motion at once, begin to make safe, and return; the run is cancelled when every actuator was tried."""
        if self._begin_stop(fault) and self._stand is not None:
            self._stand.safety.demand()

    def trip(self, fault: Fault) -> None:
        """The same, for the guard, which demands by itself that the stand is made safe, as soon as this returns."""
        self._begin_stop(fault)

    def _begin_stop(self, fault: Fault) -> bool:
        """Let nothing move from now on, and return whether this stop is the first."""
        self.reason = self.reason or fault
        if self._stand is not None:
            self._stand.gate.hold(STOPPING)  # nothing earns time while the stand is being made safe
        if self.phase in (Phase.ABORTING, Phase.ENDING, Phase.ENDED):
            if self._stand is not None and fault.rule == STOPPED_BY_OPERATOR:
                self._stand.safety.give_up()
            if self.phase is Phase.ENDED:
                self.shutdown_deadline.begin()
            return False
        self._turn(PhaseTurn.STOP)
        if self._stand is None:
            self._run.cancel()
        else:
            self._aborting = asyncio.create_task(self._abort(self._stand))
        return True

    def begin_takedown(self) -> None:
        """Mark that from here on the run makes safe and cleans up by itself and must not be cancelled."""
        self._turn(PhaseTurn.TAKE_DOWN)

    async def wait_until_aborted(self) -> None:
        """Wait until the run is aborted; from then on nothing is cancelled: the clock and the wires may go."""
        self._turn(PhaseTurn.TAKE_DOWN)
        if self._aborting is not None:
            await asyncio.wait([self._aborting])

    def end(self) -> None:
        """Note that the plan has ended, whichever way, and the stand is safe."""
        self._turn(PhaseTurn.END)
        if self.reason is not None:
            self.shutdown_deadline.begin()

    async def _abort(self, stand: Stand) -> None:
        try:
            await stand.safety.wait_until_tried()
        finally:
            if self.phase is Phase.ABORTING:
                self._turn(PhaseTurn.TAKE_DOWN)
                self._run.cancel()

    def _follow(self, gate: Gate) -> None:
        self._turn(PhaseTurn.HOLD if gate.reasons else PhaseTurn.RELEASE)

    def _turn(self, turn: PhaseTurn) -> None:
        self.phase = get_next_phase(self.phase, turn)

    async def __aenter__(self) -> Stop:
        running = asyncio.current_task()
        if running is None:
            raise ValueError("a run is stopped by its task; there is none")
        self._run = running
        for number in self._signals:
            asyncio.get_running_loop().add_signal_handler(number, self)
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        for number in self._signals:
            asyncio.get_running_loop().remove_signal_handler(number)
        if self.reason is None or error is None:
            return
        unsafe = self._stand.safety.unconfirmed if self._stand is not None else ()
        text = f"{self.reason.text}; " + (f"NOT SAFE: {'; '.join(unsafe)}" if unsafe else "the stand is safe")
        if isinstance(error, SessionError):
            text = f"{text}; {error}"
        if isinstance(error, asyncio.CancelledError):
            self._run.uncancel()
        raise (Interrupted(text) if self.reason.rule == STOPPED_BY_OPERATOR else StandTripped(text)) from error


def catch_signals(leave: Callable[[], None]) -> None:
    """The signals that end the daemon call `leave`, each time they come, and for good: nothing may end the process
    while the stand is being made safe."""
    numbers = [signal.SIGINT, signal.SIGTERM, signal.SIGQUIT]
    if signal.getsignal(signal.SIGHUP) is not signal.SIG_IGN:
        numbers.append(signal.SIGHUP)
    for number in numbers:
        asyncio.get_running_loop().add_signal_handler(number, leave)
