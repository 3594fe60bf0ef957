"""Performs what the table of a run says (stand/running/executing/actions.py), and enters the results.

One loop for a run that continues, was held, tripped, killed or resumed: what it remembers is the logbook's state and
nothing else. A device error that an action meets is the guard's, which holds the run for it or ends it; then, and when
something else has undone the set-up meanwhile, the table says what is next. What else an action raises ends the run.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Coroutine, Generator, Sequence
from contextlib import contextmanager

from thermostand.experiments.adaptive import DecisionPending
from thermostand.experiments.steps import (
    AnySoak,
    Capture,
    Decide,
    PlannedStep,
    Role,
    Soak,
    Step,
)
from thermostand.foundation.clock import NS_PER_S, Clock, to_ns
from thermostand.foundation.errors import ConfigError, DeviceError, DeviceFault, Superseded
from thermostand.foundation.events import (
    FRAME_UNSETTLED,
    PLAN_CHANGED,
    RESTORED,
    SOAK_CREDITED,
    SOAK_LONGER,
    SOAK_RESTARTED,
    SOAK_UNSETTLED,
    STEP_BROKEN_OFF,
    UNDECIDED,
    WARM_UP_GAP,
)
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import StepMark, StepState
from thermostand.foundation.readings import UNSETTLED
from thermostand.foundation.tasks import cancel_all, wait_for_first
from thermostand.recording.format.capture_restarts import make_restart_event
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.running.executing.actions import (
    Action,
    ArmCapture,
    Begin,
    Complete,
    ContinueSoak,
    Equilibrate,
    Perform,
    PreparingAction,
    ReopenFlap,
    RestartCold,
    Restore,
    Retake,
    Sleep,
    Surroundings,
    TakeFrame,
    Wait,
    choose_next_action,
    compute_due_after_ns,
    compute_next_due_ns,
    credit_soaks,
    needs_retake,
)
from thermostand.stand.running.executing.camera_gap import OffsetWatch
from thermostand.stand.running.executing.decisions import Decision, keep_fixed_plan, make_plan_change
from thermostand.stand.running.executing.settling_watch import SettlingWatch
from thermostand.stand.running.memory.entries import (
    Change,
    Cooled,
    Due,
    Extended,
    Preparing,
    Restarted,
    Restored,
    Skipped,
    Soaked,
    StepChanged,
    Taken,
    make_change_data,
    make_edit,
)
from thermostand.stand.running.memory.fold import apply_entry, describe_change, find_refusal
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import Plan, RunState, SetUp, get_duration_ns
from thermostand.stand.safety.gate import Gate
from thermostand.stand.safety.interlock import Interlocked

# Soaks: what they earn, and when the chamber has been in its band for long enough to end one.

_JOURNAL_NS = 60 * NS_PER_S  # of a soak that a kill costs at most


class SoakRunner:
    """Performs the soaks of one run; `settling` sees the chamber and the camera."""

    def __init__(self, gate: Gate, clock: Clock, log: Logbook, settling: SettlingWatch) -> None:
        self._gate = gate
        self._clock = clock
        self._log = log
        self._settling = settling

    async def soak(self, step_id: str, changes: Callable[[], asyncio.Event]) -> None:
        """Earn what a soak still owes while nothing holds the run; returns early when the set-up was disturbed.
        changes: the event of the plan's next change. DeviceFault of the regulator when it ends unsettled and the recipe
        wants that to hold the run; it then owes everything again."""
        self._settling.restart()
        reported_s = 0.0  # until when it goes on at least, as was reported
        while (soak := self._state.step(step_id)) and (remaining_ns := self._state.remaining_ns(soak)):
            if self._is_interrupted() or not isinstance(soak.step, AnySoak):
                return
            begin_ns, soaked_ns = self._clock.now_ns(), get_duration_ns(soak) - remaining_ns
            wait_ns = min(remaining_ns, _JOURNAL_NS, self._compute_judgement_ns(soak.step, soaked_ns))
            await wait_for_first(
                self._clock.sleep_until(begin_ns + wait_ns), self._gate.wait_until_closed(), changes().wait()
            )
            soak = self._state.step(step_id) or soak  # it may be longer now
            step, has_ended = soak.step, False
            if isinstance(step, AnySoak) and not self._is_interrupted() and self._state.remaining_ns(soak):
                soaked_s = (soaked_ns + self._clock.now_ns() - begin_ns) / NS_PER_S
                has_ended = await self._has_ended(step, step_id, soaked_s)
                if isinstance(step, Soak) and not has_ended and soaked_s >= max(reported_s, step.duration_s):
                    reported_s = soaked_s + self._report_extension(step, soak, soaked_s)
            now_ns, whole_ns = self._clock.now_ns(), get_duration_ns(self._state.step(step_id) or soak)
            soaked_ns = min(soaked_ns + now_ns - begin_ns, whole_ns)
            if step_id not in self._state.skipped:
                await self._save_progress(soak, now_ns, soaked_ns, is_over=has_ended or soaked_ns == whole_ns)

    def flags(self) -> tuple[str, ...]:
        """The flags of a frame that is taken now: whether the last soak has not brought the chamber into its band, or
        the chamber has left it since, as one that overshoots does after a soak that was too short."""
        chamber_degC, band_K = self._state.set_up.chamber_degC, self._state.band_K
        if self._state.is_unsettled:
            return (UNSETTLED,)
        if chamber_degC is None or band_K is None:
            return ()
        degC = self._settling.outside_degC(chamber_degC, band_K)
        if degC is None:
            return ()
        self._log.tell(FRAME_UNSETTLED, degC=degC, chamber_degC=chamber_degC, band_K=band_K)
        return (UNSETTLED,)

    async def _save_progress(self, soak: PlannedStep, now_ns: int, soaked_ns: int, *, is_over: bool) -> None:
        """Record the soak time so far; and when it is over, whether the chamber was in its band at last."""
        step, step_id = soak.step, soak.step_id
        is_settled = True
        if is_over and isinstance(step, AnySoak) and self._measure_missing_s(step):
            is_settled = False
            text = f"{self._describe_chamber(step)} at the end of the longest soak"
            if isinstance(step, Soak) and step.unsettled == "hold":
                await self._log.write(Soaked(now_ns, step_id, 0.0))
                raise DeviceFault("regulator", f"{text}; once that is reset, the soak begins again")
            self._log.tell(SOAK_UNSETTLED, text, step_id=step_id)
        ended = "" if not is_over else "settled" if is_settled else "unsettled"
        await self._log.write(Soaked(now_ns, step_id, soaked_ns / NS_PER_S, ended))

    @property
    def _state(self) -> RunState:
        return self._log.state

    def _is_interrupted(self) -> bool:
        """Return whether the soak time stands still."""
        return bool(self._gate.reasons) or self._state.is_setup_invalid

    def _compute_judgement_ns(self, step: AnySoak, soaked_ns: int) -> int:
        """Return how long until a soak with so much soak time may end, ns."""
        if not isinstance(step, Soak):
            return _JOURNAL_NS
        short_ns = to_ns(step.duration_s) - soaked_ns
        return short_ns if short_ns > 0 else max(NS_PER_S, to_ns(self._measure_missing_s(step)))

    async def _has_ended(self, step: AnySoak, step_id: str, soaked_s: float) -> bool:
        """Return whether a soak, so old, may end now."""
        if isinstance(step, Soak):
            return soaked_s >= step.duration_s and not self._measure_missing_s(step)
        return await self._settling.is_settled(step, step_id, soaked_s)

    def _measure_missing_s(self, step: AnySoak) -> float:
        """Return what the chamber was not in the band in the last part before now, s; 0 also when the soak has no band,
        or the chamber is stopped."""
        band_K, chamber_degC = step.guaranteed_K, self._state.set_up.chamber_degC
        if not band_K or chamber_degC is None:
            return 0.0
        return max(0.0, step.last_part_s - self._settling.in_band_s(chamber_degC, band_K))

    def _report_extension(self, step: Soak, soak: PlannedStep, soaked_s: float) -> float:
        """Report that the soak goes on beyond its time; returned is for how long at least, s."""
        by_s = min(self._measure_missing_s(step), get_duration_ns(soak) / NS_PER_S - soaked_s)
        self._log.tell(SOAK_LONGER, self._describe_chamber(step), step_id=soak.step_id, by_s=by_s)
        return by_s

    def _describe_chamber(self, step: AnySoak) -> str:
        """Describe in words where the chamber was."""
        chamber_degC, last_s = self._state.set_up.chamber_degC, step.last_part_s
        was_s = last_s - self._measure_missing_s(step)
        place = f"within {step.guaranteed_K:g} K of {chamber_degC} degC"
        return f"the chamber was {place} for {was_s:.0f} s, not {last_s:.0f} s"


# Brings about again what the steps so far have set up, after something has undone it.


async def restore_set_up(
    stand: Stand, log: Logbook, clock: Clock, set_up: SetUp, surroundings: Callable[[], Surroundings]
) -> None:
    """The last set-up of each kind again, but for the flap; it stays closed until the chamber is at its place."""
    disturbances = log.state.setup_invalidations
    await stand.imaging.close_flap()
    for planned in set_up.others.values():
        await stand.gate.wait_until_open()
        await planned.step.perform(stand)
    for axis, position in set_up.positions.items():
        await stand.gate.wait_until_open()
        await stand.table.move_to(axis, position)
    await stand.gate.wait_until_open()
    if set_up.camera_on:
        await stand.imaging.supply.restore()
    else:
        await stand.imaging.power_camera(on=False)
    if set_up.chamber_degC is not None:
        await stand.gate.wait_until_open()
        credit, now_ns = credit_soaks(log.state, set_up, surroundings()), clock.now_ns()
        if credit.lost:
            await log.write(*(Soaked(now_ns, soak.step_id, 0.0) for soak in credit.lost))
        if credit.text:
            log.tell(SOAK_RESTARTED if credit.lost else SOAK_CREDITED, credit.text)
        await stand.chamber.start(set_up.chamber_degC)
    log.enter(Restored(clock.now_ns(), disturbances))
    log.tell(RESTORED, set_up.text)


def raise_unguarded(error: DeviceError) -> None:
    """Raise a device error, which ends a run that no guard holds."""
    raise error


class Executor:
    """Performs the plan of the logbook's state.

    `flushed` returns when all that was published is on the disk. `settling` decides when a soak may end early,
    `offsets` gets what has settled. `allowed` raises ConfigError when this stand may not do a plan. `lost` says how
    many frames of a capture are not on the disk. `decider` makes the decisions of the plan. `meet` gets a device error
    that an action has met, and holds the run for it before it returns, or ends it.
    """

    def __init__(
        self,
        stand: Stand,
        hub: Hub,
        clock: Clock,
        log: Logbook,
        *,
        flushed: Callable[[], Awaitable[None]],
        settling: SettlingWatch,
        offsets: OffsetWatch,
        allowed: Callable[[Plan], object] = len,
        lost: Callable[[str], int] = lambda _: 0,
        decider: Callable[[Decide], Awaitable[Decision]] = keep_fixed_plan,
        meet: Callable[[DeviceError], None] = raise_unguarded,
    ) -> None:
        self._stand = stand
        self._hub = hub
        self._clock = clock
        self._log = log
        self._flushed = flushed
        self._soaking = SoakRunner(stand.gate, clock, log, settling)
        self._offsets = offsets
        self._allowed = allowed
        self._lost = lost
        self._decider = decider
        self._meet = meet
        self._changed = asyncio.Event()  # set, and replaced, when the plan was changed
        if stand.imaging.supply.equilibrium.is_lost:
            self._on_lost_equilibrium()
        stand.imaging.supply.equilibrium.subscribe(self._on_lost_equilibrium)

    def close(self) -> None:
        """The run is over: what is lost now is not its business."""
        self._stand.imaging.supply.equilibrium.unsubscribe(self._on_lost_equilibrium)

    async def run(self) -> None:
        """Perform what is not done of the plan."""
        while (action := choose_next_action(self._state, self._surroundings())) is not None:
            with self._mark_failure():
                is_done = await self._try(action)
            if is_done:
                await self._conclude(action)

    async def skip(self, step_id: str) -> None:
        """Leave the step out, or break it off: a soak, capture, cool-down or prompt under way ends at once, but the
        pause of a prompt is the operator's. Durable when this returns; ConfigError when it cannot be left out."""
        await self._change(Skipped(self._clock.now_ns(), step_id))

    async def extend(self, step_id: str, by_s: float) -> None:
        """Soak for so much longer; else as `skip`."""
        await self._change(Extended(self._clock.now_ns(), step_id, by_s))

    async def edit(self, from_index: int, steps: Sequence[Step]) -> None:
        """Replace the steps from the place `from_index` on, none of which was begun; else as `skip`."""
        await self._change(make_edit(self._clock.now_ns(), from_index, steps))

    async def _change(self, change: Change) -> None:
        """Published before it is journaled, as everything that the recording needs."""
        if reason := find_refusal(self._state, change):
            raise ConfigError(reason)
        changed = apply_entry(self._state, change)
        self._allowed(changed.plan)
        if isinstance(change, Skipped) and (planned := self._state.step(change.step_id)):
            self._mark(planned, StepState.SKIPPED)
        self._log.tell(
            PLAN_CHANGED, describe_change(self._state, change), **{**make_change_data(change), **changed.size}
        )
        self._changed.set()
        self._changed = asyncio.Event()
        await self._log.write(change)

    def _get_change_event(self) -> asyncio.Event:
        """Set when the plan is changed the next time."""
        return self._changed

    @property
    def _state(self) -> RunState:
        return self._log.state

    def _surroundings(self) -> Surroundings:
        stand, pv = self._stand, self._hub.known("regulator.pv")  # one lost reply costs no soak
        return Surroundings(
            now_ns=self._clock.now_ns(),
            lead_ns=self._clock.lead_ns,
            held=bool(stand.gate.reasons),
            flap_open=stand.imaging.flap_open,
            lost_equilibrium=stand.imaging.supply.equilibrium.is_lost,
            pv_degC=math.nan if pv is None else pv.value,
            frames_lost=self._lost(self._state.under_way),
        )

    @contextmanager
    def _mark_failure(self) -> Generator[None]:
        """Count what ends the run inside as the failure of the step under way."""
        try:
            yield
        except (Exception, asyncio.CancelledError):
            if planned := self._state.step(self._state.under_way):
                self._mark(planned, StepState.FAILED)
            raise

    async def _try(self, action: Action) -> bool:
        """Return whether the action came to its end; not so when something has undone the set-up meanwhile."""
        state = self._state
        is_readying = isinstance(action, PreparingAction) or (
            isinstance(action, ContinueSoak) and action.soak.step_id != state.plan[state.index].step_id
        )
        if is_readying != state.readying and not isinstance(action, Sleep):
            self._log.enter(Preparing(self._clock.now_ns(), is_readying))
        try:
            await self._act(action)
        except (DeviceError, Interlocked) as error:
            if self._state.setup_invalidations == state.setup_invalidations:
                if isinstance(error, Interlocked | Superseded):  # a stop, or somebody's newer order: no fault
                    raise
                self._meet(error)
                if not self._stand.gate.reasons:  # nothing would keep it from being tried again and again
                    raise
            planned = self._state.step(self._state.under_way)
            if planned is not None and not is_readying:
                self._log.tell(STEP_BROKEN_OFF, str(error), step=planned.step.kind)
                self._log.enter(Due(self._clock.now_ns(), None))
            return False
        return True

    async def _act(self, action: Action) -> None:
        stand = self._stand
        match action:
            case Sleep(until_ns):
                await wait_for_first(self._clock.sleep_until(until_ns), self._changed.wait())
            case Wait():
                await stand.gate.wait_until_open()
            case Restore(set_up):
                await restore_set_up(stand, self._log, self._clock, set_up, self._surroundings)
            case ContinueSoak(soak):
                await self._soaking.soak(soak.step_id, self._get_change_event)
            case Equilibrate():
                changes = self._state.changes
                await stand.imaging.supply.equilibrium.wait_until_regained(
                    lambda: self._state.is_setup_invalid or self._state.changes != changes
                )
            case ReopenFlap():
                await stand.imaging.open_flap()
            case Begin(planned):
                await self._log.write(StepChanged(self._clock.now_ns(), planned.step_id, "started"))
                self._mark(planned, StepState.STARTED)
            case ArmCapture(capture):
                await self._arm_capture(capture)
            case Retake(planned, why, frames_lost):
                await self._restart_steps((planned,), why, frames_lost)
            case TakeFrame():
                await self._take_frame(action)
            case Perform(planned):
                await self._perform(planned)
            case Complete(planned):
                if isinstance(planned.step, Capture):
                    await self._flushed()
            case RestartCold():
                pass  # what is under way has failed

    async def _conclude(self, action: Action) -> None:
        """Do what follows when the step under way is done, or has to wait for those before it."""
        match action:
            case Complete(planned) if needs_retake(self._state, self._surroundings(), planned):
                pass  # by the flush: it is taken again
            case Complete(planned) | Perform(planned) if planned.step_id == self._state.under_way:
                self._mark(planned, StepState.DONE)
                await self._flushed()
                await self._log.write(StepChanged(self._clock.now_ns(), planned.step_id, "done"))
            case RestartCold(again):
                if planned := self._state.step(self._state.under_way):
                    self._mark(planned, StepState.FAILED)
                await self._restart_steps(again, "from a cold camera")
            case _:
                pass

    async def _restart_steps(self, again: Plan, how: str, frames_lost: int = 0) -> None:
        """Count these steps as neither begun nor done, and no frame of theirs so far: reported before it is journaled,
        so that no frame is ever left out unreported."""
        now_ns, step_ids = self._clock.now_ns(), [planned.step_id for planned in again]
        frames = self._state.frames.get(step_ids[-1], 0)
        self._hub.publish(make_restart_event(now_ns, step_ids[-1], frames, how, frames_lost))
        await self._flushed()
        await self._log.write(Restarted(now_ns, step_ids, frames_lost))

    async def _perform(self, planned: PlannedStep) -> None:
        step = planned.step
        work = self._decide(planned, step) if isinstance(step, Decide) else step.perform(self._stand)
        await (self._run_unless_skipped(planned.step_id, work) if step.ends_when_skipped else work)

    async def _decide(self, planned: PlannedStep, step: Decide) -> None:
        """Decide, but not again after a kill between the decision and the end of the step."""
        if self._state.is_decided(planned.step_id):
            return
        decided = await self._decider(step)
        if isinstance(decided.answer, DecisionPending):
            self._log.tell(UNDECIDED, f"{decided.reason}; the fixed plan goes on")
        change = make_plan_change(self._state, planned, decided, self._clock.now_ns())
        if change is None:
            self._log.tell(UNDECIDED, "an operator has changed the plan; nothing more is decided about it")
        else:
            await self._change(change)

    async def _arm_capture(self, capture: Capture) -> None:
        await self._stand.table.approach_again()
        state = self._state
        due_ns = compute_next_due_ns(state.due_ns, capture, self._surroundings(), is_lost=state.is_lost)
        self._log.enter(Due(self._clock.now_ns(), due_ns))

    async def _take_frame(self, frame: TakeFrame) -> None:
        capture, step_id = frame.capture, frame.planned.step_id
        if frame.is_settled:
            self._offsets.note_settled(capture.chamber_degC)
        if self._state.was_held and capture.role is Role.WARM_UP:
            # A camera continues to warm up while the run is held: what was not seen of it is reported.
            missing_s = (self._clock.now_ns() - self._state.seen_ns) / NS_PER_S
            self._log.tell(WARM_UP_GAP, missing_s=missing_s)
        flags = () if capture.role is Role.WARM_UP else self._soaking.flags()
        imaging = self._stand.imaging
        is_taken = await imaging.take_frame(capture.exposure_s, step_id, frame.due_ns, capture.cameras, flags)
        now_ns = self._clock.now_ns()
        if is_taken:
            self._log.enter(Taken(now_ns, step_id))
        self._log.enter(Due(now_ns, compute_due_after_ns(frame.due_ns, capture, now_ns), lost=not is_taken))

    async def _run_unless_skipped(self, step_id: str, work: Coroutine[None, None, None]) -> None:
        """The work of a step, broken off when that is left out."""
        task = asyncio.create_task(work)
        try:
            while not task.done() and step_id not in self._state.skipped:
                changed = asyncio.ensure_future(self._changed.wait())
                await asyncio.wait((task, changed), return_when=asyncio.FIRST_COMPLETED)
                changed.cancel()
            if task.done():
                task.result()
        finally:
            await cancel_all([task])

    def _on_lost_equilibrium(self) -> None:
        """The camera has to be brought back as well; in a plan that has it off that is nothing."""
        self._log.enter(Cooled(self._clock.now_ns()))

    def _mark(self, planned: PlannedStep, state: StepState) -> None:
        now_ns, step = self._clock.now_ns(), planned.step
        self._hub.publish(StepMark(now_ns, planned.step_id, planned.index, step.kind, state, step.parameters))
