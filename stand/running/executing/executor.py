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

from thermostand.experiments.known import Undecided
from thermostand.experiments.steps import (
    Capture,
    Decide,
    PlannedStep,
    Role,
    Step,
)
from thermostand.foundation.clock import NS_PER_S, Clock
from thermostand.foundation.errors import ConfigError, DeviceError, Superseded
from thermostand.foundation.events import (
    PLAN_CHANGED,
    RESTORED,
    SOAK_CREDITED,
    SOAK_RESTARTED,
    STEP_BROKEN_OFF,
    UNDECIDED,
    WARM_UP_GAP,
)
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import StepMark, StepState
from thermostand.foundation.tasks import cancelled, first_of
from thermostand.recording.format.restarts import restarted
from thermostand.stand.interlock import Interlocked
from thermostand.stand.running.executing.actions import (
    Action,
    Aim,
    Begin,
    Complete,
    Earn,
    Equilibrate,
    OpenAgain,
    Perform,
    Readies,
    Restore,
    Sleep,
    StartCold,
    Surroundings,
    TakeAgain,
    TakeFrame,
    Wait,
    due_after_ns,
    is_lossy,
    next_action,
    next_due_ns,
    worth_of_soaks,
)
from thermostand.stand.running.executing.camera_gap import OffsetWatch
from thermostand.stand.running.executing.deciding import Decided, change_of_plan, fixed_plan
from thermostand.stand.running.executing.settling_watch import SettlingWatch
from thermostand.stand.running.executing.soaking import Soaking
from thermostand.stand.running.memory.entries import (
    Again,
    Change,
    Cooled,
    Due,
    Extended,
    Readying,
    Restored,
    Skipped,
    Soaked,
    StepChanged,
    Taken,
    data_of,
    edited,
)
from thermostand.stand.running.memory.fold import after, change_text, refusal
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import Plan, RunState, SetUp
from thermostand.stand.stand import Stand

# Brings about again what the steps so far have set up, after something has undone it.


async def restore(
    stand: Stand, log: Logbook, clock: Clock, set_up: SetUp, surroundings: Callable[[], Surroundings]
) -> None:
    """The last set-up of each kind again, but for the flap; it stays closed until the chamber is at its place."""
    disturbances = log.state.disturbances
    await stand.imaging.close_flap()
    for planned in set_up.others.values():
        await stand.gate.passed()
        await planned.step.perform(stand)
    for axis, position in set_up.positions.items():
        await stand.gate.passed()
        await stand.table.move_to(axis, position)
    await stand.gate.passed()
    if set_up.camera_on:
        await stand.imaging.supply.restore()
    else:
        await stand.imaging.power_camera(on=False)
    if set_up.chamber_degC is not None:
        await stand.gate.passed()
        worth, now_ns = worth_of_soaks(log.state, set_up, surroundings()), clock.now_ns()
        if worth.lost:
            await log.write(*(Soaked(now_ns, soak.step_id, 0.0) for soak in worth.lost))
        if worth.text:
            log.tell(SOAK_RESTARTED if worth.lost else SOAK_CREDITED, worth.text)
        await stand.chamber.start(set_up.chamber_degC)
    log.enter(Restored(clock.now_ns(), disturbances))
    log.tell(RESTORED, set_up.text)


def unguarded(error: DeviceError) -> None:
    """Where no guard holds a run, a device error ends it."""
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
        decider: Callable[[Decide], Awaitable[Decided]] = fixed_plan,
        meet: Callable[[DeviceError], None] = unguarded,
    ) -> None:
        self._stand = stand
        self._hub = hub
        self._clock = clock
        self._log = log
        self._flushed = flushed
        self._soaking = Soaking(stand.gate, clock, log, settling)
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
        """What is not done of the plan."""
        while (action := next_action(self._state, self._surroundings())) is not None:
            with self._failing():
                is_done = await self._tried(action)
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
        await self._change(edited(self._clock.now_ns(), from_index, steps))

    async def _change(self, change: Change) -> None:
        """Published before it is journaled, as everything that the recording needs."""
        if reason := refusal(self._state, change):
            raise ConfigError(reason)
        changed = after(self._state, change)
        self._allowed(changed.plan)
        if isinstance(change, Skipped) and (planned := self._state.step(change.step_id)):
            self._mark(planned, StepState.SKIPPED)
        self._log.tell(PLAN_CHANGED, change_text(self._state, change), **{**data_of(change), **changed.size})
        self._changed.set()
        self._changed = asyncio.Event()
        await self._log.write(change)

    def _changes(self) -> asyncio.Event:
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
    def _failing(self) -> Generator[None]:
        """What ends the run inside is the failure of the step under way."""
        try:
            yield
        except (Exception, asyncio.CancelledError):
            if planned := self._state.step(self._state.under_way):
                self._mark(planned, StepState.FAILED)
            raise

    async def _tried(self, action: Action) -> bool:
        """Whether the action came to its end; not so when something has undone the set-up meanwhile."""
        state = self._state
        is_readying = isinstance(action, Readies) or (
            isinstance(action, Earn) and action.soak.step_id != state.plan[state.index].step_id
        )
        if is_readying != state.readying and not isinstance(action, Sleep):
            self._log.enter(Readying(self._clock.now_ns(), is_readying))
        try:
            await self._act(action)
        except (DeviceError, Interlocked) as error:
            if self._state.disturbances == state.disturbances:
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
                await first_of(self._clock.sleep_until(until_ns), self._changed.wait())
            case Wait():
                await stand.gate.passed()
            case Restore(set_up):
                await restore(stand, self._log, self._clock, set_up, self._surroundings)
            case Earn(soak):
                await self._soaking.earn(soak.step_id, self._changes)
            case Equilibrate():
                changes = self._state.changes
                await stand.imaging.supply.equilibrium.regained(
                    lambda: self._state.is_disturbed or self._state.changes != changes
                )
            case OpenAgain():
                await stand.imaging.open_flap()
            case Begin(planned):
                await self._log.write(StepChanged(self._clock.now_ns(), planned.step_id, "started"))
                self._mark(planned, StepState.STARTED)
            case Aim(capture):
                await self._aim(capture)
            case TakeAgain(planned, why, frames_lost):
                await self._begin_again((planned,), why, frames_lost)
            case TakeFrame():
                await self._take(action)
            case Perform(planned):
                await self._perform(planned)
            case Complete(planned):
                if isinstance(planned.step, Capture):
                    await self._flushed()
            case StartCold():
                pass  # what is under way has failed

    async def _conclude(self, action: Action) -> None:
        """What follows when the step under way is done, or has to wait for those before it."""
        match action:
            case Complete(planned) if is_lossy(self._state, self._surroundings(), planned):
                pass  # by the flush: it is taken again
            case Complete(planned) | Perform(planned) if planned.step_id == self._state.under_way:
                self._mark(planned, StepState.DONE)
                await self._flushed()
                await self._log.write(StepChanged(self._clock.now_ns(), planned.step_id, "done"))
            case StartCold(again):
                if planned := self._state.step(self._state.under_way):
                    self._mark(planned, StepState.FAILED)
                await self._begin_again(again, "from a cold camera")
            case _:
                pass

    async def _begin_again(self, again: Plan, how: str, frames_lost: int = 0) -> None:
        """These steps count as neither begun nor done, and no frame of theirs so far: reported before it is journaled,
        so that no frame is ever left out unreported."""
        now_ns, step_ids = self._clock.now_ns(), [planned.step_id for planned in again]
        frames = self._state.frames.get(step_ids[-1], 0)
        self._hub.publish(restarted(now_ns, step_ids[-1], frames, how, frames_lost))
        await self._flushed()
        await self._log.write(Again(now_ns, step_ids, frames_lost))

    async def _perform(self, planned: PlannedStep) -> None:
        step = planned.step
        work = self._decide(planned, step) if isinstance(step, Decide) else step.perform(self._stand)
        await (self._unless_skipped(planned.step_id, work) if step.ends_when_skipped else work)

    async def _decide(self, planned: PlannedStep, step: Decide) -> None:
        """Not again after a kill between the decision and the end of the step."""
        if self._state.is_decided(planned.step_id):
            return
        decided = await self._decider(step)
        if isinstance(decided.answer, Undecided):
            self._log.tell(UNDECIDED, f"{decided.reason}; the fixed plan goes on")
        change = change_of_plan(self._state, planned, decided, self._clock.now_ns())
        if change is None:
            self._log.tell(UNDECIDED, "an operator has changed the plan; nothing more is decided about it")
        else:
            await self._change(change)

    async def _aim(self, capture: Capture) -> None:
        await self._stand.table.approach_again()
        state = self._state
        due_ns = next_due_ns(state.due_ns, capture, self._surroundings(), is_lost=state.is_lost)
        self._log.enter(Due(self._clock.now_ns(), due_ns))

    async def _take(self, frame: TakeFrame) -> None:
        capture, step_id = frame.capture, frame.planned.step_id
        if frame.is_settled:
            self._offsets.settled(capture.chamber_degC)
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
        self._log.enter(Due(now_ns, due_after_ns(frame.due_ns, capture, now_ns), lost=not is_taken))

    async def _unless_skipped(self, step_id: str, work: Coroutine[None, None, None]) -> None:
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
            await cancelled([task])

    def _on_lost_equilibrium(self) -> None:
        """The camera has to be brought back as well; in a plan that has it off that is nothing."""
        self._log.enter(Cooled(self._clock.now_ns()))

    def _mark(self, planned: PlannedStep, state: StepState) -> None:
        now_ns, step = self._clock.now_ns(), planned.step
        self._hub.publish(StepMark(now_ns, planned.step_id, planned.index, step.kind, state, step.parameters))
