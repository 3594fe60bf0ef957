"""Watches the rules, and waits for nothing but the time: no disk, no bus, no client.

Each look judges the latest readings. While all is well it allows the permits to be renewed (chamber.PermitRenewer does
that); when a rule objects it latches the stand and demands that it is made safe (safety.making_safe does that).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.errors import DeviceError
from thermostand.foundation.events import GUARD_LATE, HOLD_ENDED, HOLD_STAYS, guard_rule
from thermostand.foundation.hub import Hub
from thermostand.stand.guarding.interlocks import (
    NOT_RECORDED,
)
from thermostand.stand.guarding.step_errors import StepErrors
from thermostand.stand.safety.fault import Fault, Watch
from thermostand.stand.safety.latch import Latch
from thermostand.stand.safety.making_safe import Safety

_GUARD_FAILED = guard_rule("guard_failed", "the guard itself has failed")
LATE_PERIODS = 2  # one look may be late by as much as a period without anything being wrong
_STRADDLING_S = 1.0  # a reply that lay in a buffer while the process was stopped is read within this after it continues
# Round number; nothing was measured.
_ENDINGS_PER_H = 3  # of holds that end by themselves; what comes back more often needs an operator


@dataclass(kw_only=True)
class Guard:
    """Every `period_s` the rules.

    On a fault `stop(fault)` ends the run, or `hold(fault)` lets it wait; the trip is recorded, and the stand is made
    safe. A hold stays until the latch is cleared, but for one that ends by itself: `release()`, which
    clears it, is then called when no rule objects any more and the stand has confirmed that it is safe, at most three
    times an hour. Without a `hold` every trip aborts. A guard that fails aborts. One that `keeps_running` looks on
    after an abort, which stays latched: that of a stand on which further runs follow.

    met: device errors that steps have met, whose watches are among `watches`.

    latch: gets each fault before anything else is done or reported about it; it waits for a disk for a quarter of a
    second at most.

    A look that comes late (the process was stopped, the host suspended, the loop held up) is an event, and permits then
    wait for a GOOD reading of each of `vital`, the channels that heat depends on, taken since. What is too old
    only because of it is given time to be renewed (Watch.after_gap_s).
    """

    safety: Safety
    latch: Latch
    watches: tuple[Watch, ...]
    hub: Hub
    clock: Clock
    period_s: float
    stop: Callable[[Fault], None]
    hold: Callable[[Fault], None] | None = None
    release: Callable[[], None] | None = None
    cut_camera: Callable[[], None] | None = None
    step_errors: StepErrors = field(default_factory=lambda: StepErrors({}))
    vital: tuple[str, ...] = ()
    keeps_running: bool = False
    _ended: bool = False
    _looked_ns: int | None = None
    _fresh_after_ns: int = 0
    _late_ns: int | None = None  # of the last look that came late
    _endings_ns: list[int] = field(default_factory=list[int])
    _is_excusing: bool = False  # the last look passed over an objection because of a look that came late
    _warned: set[int] = field(default_factory=set[int])  # watches whose warning stands

    def look(self) -> bool:
        """Return whether the run continues; False when the run is being aborted."""
        self._check_own_timing()
        faults = self._check_rules()
        fault = next((each for each in faults if each.action == "abort" or self.hold is None), None)
        if fault is not None and not self._is_kept:
            self._abort(fault)
            return self.keeps_running
        self._update_hold(faults)
        return True

    def handle_step_error(self, error: DeviceError) -> None:
        """A step has met it: when this returns the stand is held for it, as by its rule, or aborted."""
        self.step_errors.note(error)
        self.look()

    def may_permit(self) -> bool:
        """Return whether heat and cold may be permitted for another while: the guard looks, finds all well, and has
        fresh readings."""
        if self._ended or self.held is not None or self._looked_ns is None:
            return False
        if self.clock.now_ns() - self._looked_ns > LATE_PERIODS * to_ns(self.period_s):
            return False
        good_ns = [self.hub.last_good_ns(channel) for channel in self.vital]
        return all(time_ns is not None and time_ns >= self._fresh_after_ns for time_ns in good_ns)

    @property
    def held(self) -> Fault | None:
        """What the stand was made safe for, and nobody has reset."""
        return self.latch.fault

    @property
    def is_on_time(self) -> bool:
        """Whether it looks as often as it must."""
        now_ns, late_ns = self.clock.now_ns(), LATE_PERIODS * to_ns(self.period_s)
        return not self._ended and self._looked_ns is not None and now_ns - self._looked_ns <= late_ns

    def reset_grace_times(self) -> None:
        """The latch was reset: every grace time begins again, and what was met is forgotten."""
        self.step_errors.clear_answered()
        for watch in self.watches:
            watch.since_ns = None

    def recheck_holds(self) -> None:
        """What is wrong still holds again, what has no grace time before anything moves."""
        self._update_hold(self._check_rules())

    def describe_remaining_faults(self) -> str:
        """Return, for an operator who has just reset, what holds the stand again, or will once it has lasted for its
        grace time; "" when no rule objects to anything."""
        if self.held is not None:
            return f"held again: {self.held.text}"
        lasting = [
            f"{watch.objection.text}, which counts again once it has lasted for {watch.grace_s:g} s"
            for watch in self.watches
            if watch.objection is not None and watch.action != "warn"
        ]
        return "; ".join(lasting)

    def recording_ended(self) -> None:
        """Note that nothing is recorded from now on. A hold for what was not on the disk in time ends with that, and
        its cause may last."""
        fault = self.held
        if fault is None or fault.rule != NOT_RECORDED or not fault.ends_itself or self.release is None:
            return
        self.hub.publish(HOLD_ENDED.at(self.clock.now_ns(), fault.text, rule=fault.rule))
        self.release()

    async def run(self) -> None:
        """Watch until cancelled or aborted."""
        try:
            due_ns = self.clock.now_ns()
            while self.look():
                due_ns = max(due_ns + to_ns(self.period_s), self.clock.now_ns())
                await self.clock.sleep_until(due_ns)
        except Exception as error:
            self.keeps_running = False
            self._abort(Fault(_GUARD_FAILED, f"the guard failed ({type(error).__name__}: {error})"))
            raise

    @property
    def _is_kept(self) -> bool:
        """Whether the stand is already held for a fault that aborts."""
        return self.keeps_running and self.held is not None and self.held.action == "abort"

    def _abort(self, fault: Fault) -> None:
        if self.held is None or self.held.action != "abort":
            self.latch.trip(fault)
        self._ended = not self.keeps_running
        try:
            # The run's stop latches and leaves the demand for safety to the line below: a run that cannot be ended must
            # not keep the guard from its own.
            self.stop(fault)  # first: nothing moves any more that making safe would have to overtake
        finally:
            self._make_safe(fault)

    def _update_hold(self, faults: list[Fault]) -> None:
        """Begin a hold, replace one that would end by itself by one that does not, or end it."""
        lasting = next((fault for fault in faults if not fault.ends_itself), None)
        if self.held is None and faults:
            self._begin_hold(lasting or faults[0])
        elif self.held is not None and self.held.ends_itself:
            if lasting is not None:
                self._begin_hold(lasting)
            elif not faults and not self._is_excusing and self.safety.is_confirmed:
                self._end_hold(self.held)

    def _begin_hold(self, fault: Fault) -> None:
        if self.hold is None:
            return
        self.latch.trip(fault)
        self.hold(fault)
        self._make_safe(fault)

    def _end_hold(self, fault: Fault) -> None:
        now_ns = self.clock.now_ns()
        self._endings_ns = [time_ns for time_ns in self._endings_ns if now_ns - time_ns < to_ns(3600)]
        data: dict[str, object] = {"rule": fault.rule, "endings_in_last_h": len(self._endings_ns)}
        if self.release is None or len(self._endings_ns) >= _ENDINGS_PER_H:
            text = (
                f"{fault.text}; this has held the stand more than {_ENDINGS_PER_H} times in an hour, so it stays held: "
                "`stand reset` continues"
            )
            self.latch.trip(Fault(fault.rule, text, fault.action))
            self.hub.publish(HOLD_STAYS.at(now_ns, text, **data))
            return
        self._endings_ns.append(now_ns)
        self.hub.publish(HOLD_ENDED.at(now_ns, fault.text, **data))
        self.release()

    def _check_own_timing(self) -> None:
        """Lateness counts from the last look: any cause of a delay counts, also a stopped process."""
        now_ns = self.clock.now_ns()
        looked_ns, self._looked_ns = self._looked_ns, now_ns
        if looked_ns is None or now_ns - looked_ns <= LATE_PERIODS * to_ns(self.period_s):
            return
        self._late_ns, self._fresh_after_ns = now_ns, now_ns + to_ns(_STRADDLING_S)
        gap_s = (now_ns - looked_ns) / NS_PER_S
        self.hub.publish(GUARD_LATE.at(now_ns, gap_s=gap_s, from_ns=looked_ns, to_ns=now_ns))

    def _check_rules(self) -> list[Fault]:
        """Return the rules that trip; those that only warn are published when they begin. Every rule is asked: some
        remember."""
        now_ns = self.clock.now_ns()
        faults: list[Fault] = []
        self._is_excusing = False
        for index, watch in enumerate(self.watches):
            fault = watch.check(self.hub, now_ns)
            if fault and self._late_ns is not None and now_ns - self._late_ns < to_ns(watch.after_gap_s):
                fault, self._is_excusing = None, True
            if watch.action != "warn":
                if fault is not None:
                    faults.append(fault)
            elif fault is None:
                self._warned.discard(index)
            elif index not in self._warned:
                self._warned.add(index)
                self.hub.publish(fault.make_event(now_ns))
        return faults

    def _make_safe(self, fault: Fault) -> None:
        """Demanded before anything is published: a listener may fail."""
        self.safety.demand()
        if fault.cuts_camera and self.cut_camera is not None:
            self.cut_camera()
        self.hub.publish(fault.make_event(self.clock.now_ns()))
