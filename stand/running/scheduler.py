"""Runs one plan: each step begun, performed and done once, in the record and in the journal.

Before each action, and within dwells and captures, the run waits at the stand's gate. What an interlock or the death of
an earlier daemon has undone is brought about again: the set-up the steps so far have left, and the soaks since the last
set-point, unless the chamber is still (or back) in its band; a camera that was or may have been off is soaked anew
before the next frames. A capture that was interrupted for long is taken again as a whole, a warm-up from a cold camera.
A step is done when all it has recorded is on the disk.
"""

from __future__ import annotations

import asyncio
import math
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass, field

from experiments.steps import (
    AnySoak,
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PlannedStep,
    PowerCamera,
    Prompt,
    Role,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    StopChamber,
    kind_of,
    parameters_of,
)
from foundation.clock import NS_PER_S, Clock, seconds_ns
from foundation.errors import DeviceError
from foundation.hub import Hub
from foundation.items import Event, StepMark, StepState
from recording.format.restarts import restarted
from stand.gate import INTERLOCK
from stand.interlock import Interlocked
from stand.running.camera_offset import OffsetWatch
from stand.running.cold_start import cold_start
from stand.running.earned import Earned, duration_of
from stand.running.journal import Again, Journal, Step
from stand.running.outage import Outage
from stand.running.set_up import SetUp
from stand.running.settling_watch import SettlingWatch
from stand.stand import Stand

# A soak is credited after an interruption when the chamber is this near to its set-point: regulators hold 0.1 K, and a
# chamber left alone for a minute has gone further. The camera, which is slower than the air, has then hardly moved.
BAND_K = 1.0
# A capture that did not go on for longer than this is taken again: its flap was shut meanwhile, and the air is not the
# same any more.
AGAIN_AFTER_S = 60.0
_JOURNAL_NS = 60 * NS_PER_S  # of a dwell that a kill costs at most


@dataclass(frozen=True, slots=True)
class Progress:
    """What an earlier daemon has done. done: ids of steps. earned_s: of soaks, by id; one that is done and not listed
    has earned all of it. frames: on the disk, by the id of a capture that is not done. until_ns: the last instant of
    which anything is known, None when it is not known."""

    done: frozenset[str] = frozenset()
    earned_s: Mapping[str, float] = field(default_factory=dict[str, float])
    frames: Mapping[str, int] = field(default_factory=dict[str, int])
    until_ns: int | None = None


class _ColdStart(Exception):
    """No error, but a way out of wherever the run is: these steps, a warm-up's, have to be done again."""

    def __init__(self, again: tuple[PlannedStep, ...]) -> None:
        super().__init__("the warm-up was interrupted; it begins anew")
        self.again = again


class Scheduler:
    """Performs a plan; what a step raises ends the run, after the step is marked as failed.

    `flushed` returns when all that was published is on the disk. `progress`: go on where an earlier daemon was.
    `settling` tells when a soak may end early, `offsets` is told what has settled.
    """

    def __init__(
        self,
        stand: Stand,
        hub: Hub,
        clock: Clock,
        journal: Journal,
        flushed: Callable[[], Awaitable[None]],
        settling: SettlingWatch,
        offsets: OffsetWatch,
        progress: Progress | None = None,
    ) -> None:
        self._stand = stand
        self._hub = hub
        self._clock = clock
        self._journal = journal
        self._flushed = flushed
        self._settling = settling
        self._offsets = offsets
        self._disturbed = progress is not None  # the set-up has to be brought about before anything else
        progress = progress or Progress()
        self._done = set(progress.done)
        self._earned = Earned(progress.earned_s, self._done, journal, clock)
        self._frames = dict(progress.frames)
        self._plan: tuple[PlannedStep, ...] = ()
        self._begun: set[str] = set()
        self._warming_ns = 0  # when the warm-up's camera was switched on, or gave its last frame
        self._was_held = False  # since then
        self._outage = Outage(stand.gate, clock)  # since the last frame
        if progress.until_ns is not None:
            self._outage.reset(clock.now_ns() - progress.until_ns)
        self._lost_equilibrium = stand.imaging.supply.equilibrium.is_lost  # and the soaks have not been taken back yet
        stand.gate.subscribe(self._on_hold)
        stand.imaging.supply.equilibrium.subscribe(self._on_lost_equilibrium)

    async def run(self, plan: Iterable[PlannedStep]) -> None:
        """What is not done of the plan."""
        self._plan = tuple(plan)
        while True:
            try:
                return await self._walk()
            except _ColdStart as needed:
                self._disturbed = True  # the steps before the first of these have to be brought about, too
                await self._begin_anew(needed.again, "from a cold camera")

    async def _walk(self) -> None:
        set_up = SetUp()
        for planned in self._plan:
            if planned.step_id not in self._done:
                # A soak depends on what it has earned itself as on those before it.
                needed = set_up.after(planned) if isinstance(planned.step, AnySoak) else set_up
                await self._ready(planned, needed)
                await self._run_step(planned, needed)
            set_up = set_up.after(planned)

    async def _begin_anew(self, again: tuple[PlannedStep, ...], how: str) -> None:
        """These steps count as neither begun nor done, and no frame of theirs so far: told before it is journaled, so
        that no frame is ever left out that nobody was told of."""
        now_ns, step_ids = self._clock.now_ns(), [planned.step_id for planned in again]
        self._hub.publish(restarted(now_ns, step_ids[-1], self._frames.pop(step_ids[-1], 0), how))
        await self._flushed()
        await self._journal.write(Again(now_ns, step_ids))
        self._done.difference_update(step_ids)
        self._begun.difference_update(step_ids)

    async def _run_step(self, planned: PlannedStep, set_up: SetUp) -> None:
        await self._begin(planned)
        self._mark(planned, StepState.STARTED)
        try:
            await self._perform_undisturbed(planned, set_up)
            if isinstance(planned.step, Capture):
                await self._flushed()
        except (Exception, asyncio.CancelledError):
            self._mark(planned, StepState.FAILED)
            raise
        self._mark(planned, StepState.DONE)
        await self._flushed()
        self._earned.forget(planned.step_id)
        self._done.add(planned.step_id)
        await self._journal.write(Step(self._clock.now_ns(), planned.step_id, "done"))

    async def _begin(self, planned: PlannedStep) -> None:
        self._begun.add(planned.step_id)
        await self._journal.write(Step(self._clock.now_ns(), planned.step_id, "started"))

    async def _perform_undisturbed(self, planned: PlannedStep, set_up: SetUp) -> None:
        """The step; once more after an interlock that made it fail has been cleared."""
        while True:
            try:
                await self._perform(planned, set_up)
            except (DeviceError, Interlocked) as error:
                if not self._disturbed:
                    raise
                text = f"{kind_of(planned.step)} was broken off by an interlock ({error})"
                self._hub.publish(Event(self._clock.now_ns(), "warning", "step_broken_off", text))
                await self._ready(planned, set_up)
            else:
                return

    async def _perform(self, planned: PlannedStep, set_up: SetUp) -> None:
        stand = self._stand
        match planned.step:
            case StartChamber(chamber_degC):
                await stand.chamber.start(chamber_degC)
            case SetTemperature(chamber_degC):
                await stand.chamber.set_temperature(chamber_degC)
            case StopChamber():
                await stand.chamber.stop()
            case Soak() | SoakUntilSettled():
                await self._soak(planned, set_up)
            case OpenFlap():
                await stand.imaging.open_flap()
            case CloseFlap():
                await stand.imaging.close_flap()
            case Capture() as capture:
                await self._capture(planned, capture, set_up)
            case MoveTo(axis, position):
                await stand.table.move_to(axis, position)
            case PowerCamera(on):
                self._warming_ns, self._was_held = self._clock.now_ns(), False
                self._outage.reset()
                self._lost_equilibrium = False
                supply = stand.imaging.supply
                supply.equilibrium.forget()
                await (supply.switch_on() if on else supply.switch_off())
            case CoolDown(band_K, time_constant_s, max_s):
                await stand.imaging.supply.cool_down(band_K, time_constant_s, max_s)
            case CheckHome(axis):
                await stand.table.check_home(axis)
            case Prompt(text):
                await stand.prompt(text)

    async def _capture(self, planned: PlannedStep, capture: Capture, set_up: SetUp) -> None:
        """The frames that are not there yet, on a grid of absolute deadlines: those missed while the run was held or a
        lost camera opened anew are skipped, not made up for by a burst. All of them when that took long."""
        step_id = planned.step_id
        if not self._frames.get(step_id) and capture.role is not Role.WARM_UP:
            self._outage.reset()
        await self._stand.table.approach_again()
        lead_ns = self._clock.lead_ns  # the camera is told of a frame before its instant, and prepared when it comes
        due_ns, interval_ns = self._clock.now_ns() + lead_ns, seconds_ns(capture.interval_s)
        is_lost = False  # the camera was, a moment ago
        while self._frames.get(step_id, 0) < capture.frames:
            await self._clock.sleep_until(due_ns - lead_ns)
            if is_lost or not self._is_ready(set_up):
                await self._ready(planned, set_up)
                await self._stand.table.approach_again()
                due_ns += max(is_lost, math.ceil((self._clock.now_ns() - due_ns) / interval_ns)) * interval_ns
                is_lost = False
                continue
            await self._again_after_outage(planned, capture)
            if not self._frames.get(step_id) and set_up.soaks and capture.role is not Role.WARM_UP:
                self._offsets.settled(capture.chamber_degC)
            self._tell_missing(capture)
            is_lost = not await self._stand.imaging.take_frame(capture.exposure_s, step_id, due_ns)
            if not is_lost:
                self._warming_ns = self._clock.now_ns()
                self._outage.reset()
                self._frames[step_id] = self._frames.get(step_id, 0) + 1
            # To the latest deadline that has passed: a free-running camera gives its frame up to a period late.
            due_ns += max(1, (self._clock.now_ns() - due_ns) // interval_ns) * interval_ns

    def _is_ready(self, set_up: SetUp) -> bool:
        """Whether nothing holds the run, and nothing has undone what the steps have set up."""
        is_shut = set_up.flap_open and not self._stand.imaging.flap_open  # in a hold
        return not (self._stand.gate.reasons or self._disturbed or is_shut)

    async def _again_after_outage(self, planned: PlannedStep, capture: Capture) -> None:
        """A capture that was interrupted for long has no frame any more; a warm-up has to begin with a cold camera."""
        if self._outage.length_ns <= seconds_ns(AGAIN_AFTER_S):
            return
        if capture.role is Role.WARM_UP and (again := cold_start(self._plan, self._done, self._begun)):
            raise _ColdStart(again)
        if self._frames.get(planned.step_id):
            length_s = self._outage.length_ns / NS_PER_S
            await self._begin_anew((planned,), f"it was interrupted for {length_s:.0f} s")
            await self._begin(planned)

    def _tell_missing(self, capture: Capture) -> None:
        """A camera goes on warming up while the run is held: what was not seen of it is told."""
        was_held, self._was_held = self._was_held, False
        if was_held and capture.role is Role.WARM_UP:
            missing_s = (self._clock.now_ns() - self._warming_ns) / NS_PER_S
            text = f"the run was held: the camera has warmed up for {missing_s:.1f} s without a frame"
            self._tell("warning", "warm_up_gap", text)

    async def _soak(self, planned: PlannedStep, set_up: SetUp) -> None:
        """All of a soak, with everything that has to be restored on the way."""
        while self._earned.owed_ns(planned):
            await self._ready(planned, set_up)
            await self._dwell(planned)

    async def _dwell(self, planned: PlannedStep) -> None:
        """Earn what a soak still owes, while the gate is open; returns early when the set-up was disturbed."""
        self._settling.restart()
        duration_ns = duration_of(planned)
        while (owed_ns := self._earned.owed_ns(planned)) and not self._disturbed:
            begin_ns = self._clock.now_ns()
            await self._sleep_while_open(begin_ns + min(owed_ns, _JOURNAL_NS))
            is_settled = await self._is_settled(planned, duration_ns - owed_ns + self._clock.now_ns() - begin_ns)
            earned_ns = duration_ns - owed_ns + min(self._clock.now_ns() - begin_ns, owed_ns)
            await self._earned.earn(planned, duration_ns if is_settled else earned_ns)
            if self._stand.gate.reasons:
                await self._stand.gate.passed()
                self._settling.restart()

    async def _is_settled(self, planned: PlannedStep, soaked_ns: int) -> bool:
        if not isinstance(planned.step, SoakUntilSettled) or self._stand.gate.reasons or self._disturbed:
            return False
        return await self._settling.is_settled(planned.step, planned.step_id, soaked_ns / NS_PER_S)

    async def _sleep_while_open(self, until_ns: int) -> None:
        """Until then, or until the gate closes."""
        tasks = [
            asyncio.ensure_future(self._clock.sleep_until(until_ns)),
            asyncio.ensure_future(self._stand.gate.closed()),
        ]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            for task in tasks:
                task.cancel()

    async def _ready(self, planned: PlannedStep, set_up: SetUp) -> None:
        """Return when nothing holds the run and everything is as the steps before `planned` have left it."""
        with self._outage.counted():
            while True:
                await self._stand.gate.passed()
                if self._disturbed and (again := cold_start(self._plan, self._done, self._begun)):
                    raise _ColdStart(again)
                try:
                    await self._make_ready(planned, set_up)
                except (DeviceError, Interlocked):
                    if not self._disturbed:
                        raise
                if not self._disturbed and not self._stand.gate.reasons:
                    return

    async def _make_ready(self, planned: PlannedStep, set_up: SetUp) -> None:
        """Returns early when it is disturbed."""
        stand = self._stand
        if self._disturbed:
            self._disturbed = False
            await self._restore(set_up)
        for soak in set_up.soaks:
            if soak != planned:
                await self._dwell(soak)
        if set_up.camera_on and isinstance(planned.step, OpenFlap | Capture):
            await stand.imaging.supply.equilibrium.regained(lambda: self._disturbed)
        await stand.gate.passed()
        is_wanted_open = set_up.flap_open and not isinstance(planned.step, CloseFlap)
        if is_wanted_open and not stand.imaging.flap_open and not self._disturbed:
            await stand.imaging.open_flap()

    async def _restore(self, set_up: SetUp) -> None:
        """The last set-up of each kind again, but for the flap; it stays closed until the chamber is at its place."""
        stand = self._stand
        await stand.imaging.close_flap()
        for axis, position in set_up.positions.items():
            await stand.gate.passed()
            await stand.table.move_to(axis, position)
        await stand.gate.passed()
        if set_up.camera_on:
            await stand.imaging.supply.restore()
        else:
            stand.imaging.supply.equilibrium.forget()
            await stand.imaging.supply.switch_off()
        if set_up.chamber_degC is not None:
            await stand.gate.passed()
            await self._credit_soaks(set_up, set_up.chamber_degC)
            await stand.chamber.start(set_up.chamber_degC)
        else:
            self._lost_equilibrium = False
        self._tell("info", "restored", set_up.text)

    async def _credit_soaks(self, set_up: SetUp, chamber_degC: float) -> None:
        """Soaks since the last set-point keep what they have earned only if the chamber is in its band."""
        begun = [soak for soak in set_up.soaks if self._earned.is_begun(soak)]
        pv = self._hub.known("regulator.pv")  # one lost reply costs no soak
        pv_degC = math.nan if pv is None else pv.value
        is_cold, self._lost_equilibrium = self._lost_equilibrium and set_up.camera_on, False
        if not begun:
            return
        if is_cold:
            await self._earned.lose(begun)
            return self._tell("warning", "soak_restarted", "the camera was or may have been off; it soaks anew")
        if abs(pv_degC - chamber_degC) <= BAND_K:
            self._tell(
                "info", "soak_credited", f"the chamber is at {pv_degC:.2f} degC, within {BAND_K:g} K of its set-point"
            )
            return
        await self._earned.lose(begun)
        text = f"the chamber is at {pv_degC:.2f} degC, not within {BAND_K:g} K of its set-point; it soaks anew"
        self._tell("warning", "soak_restarted", text)

    def _on_hold(self, reason: str, held: bool) -> None:
        """An interlock makes the stand safe: nothing is as it was."""
        self._disturbed = self._disturbed or (held and reason == INTERLOCK)
        self._was_held = self._was_held or held

    def _on_lost_equilibrium(self) -> None:
        """The camera has to be brought back as well; in a plan that has it off that is nothing."""
        self._disturbed = self._lost_equilibrium = True

    def _tell(self, level: str, kind: str, text: str) -> None:
        self._hub.publish(Event(self._clock.now_ns(), level, kind, text))

    def _mark(self, planned: PlannedStep, state: StepState) -> None:
        now_ns, kind = self._clock.now_ns(), kind_of(planned.step)
        self._hub.publish(StepMark(now_ns, planned.step_id, planned.index, kind, state, parameters_of(planned.step)))
