"""A run as the guest of an open stand: journaled, and the stand made safe on every way out."""

from __future__ import annotations

import asyncio
import importlib.metadata
import math
from collections.abc import Awaitable, Callable, Coroutine
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from thermostand.foundation.clock import Clock, VirtualClock, get_boot, to_ns, utc_offset_ns
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import DeviceError, NotReset, StandTripped
from thermostand.foundation.events import (
    AT_AMBIENT,
    FRAMES_RESUMED,
    FRAMES_STOPPED,
    GAP,
    NOT_AT_AMBIENT,
    RESET,
    RUN_END,
    RUN_RESUME,
    RUN_START,
    TELEMETRY_NOT_SAVED,
    TELEMETRY_SAVED_AGAIN,
    TO_AMBIENT,
)
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import format_duration, format_local
from thermostand.foundation.items import Event, Item
from thermostand.foundation.tasks import describe_failure, find_cause, run_with_background
from thermostand.foundation.workers import WorkerThread
from thermostand.markers.target import Target
from thermostand.recording.reading.run_status import RunOutcome
from thermostand.recording.writing.disk import NOTES_LINE, DiskCalls
from thermostand.recording.writing.recorder import Recorder
from thermostand.stand.assembly.assemble import Assembly
from thermostand.stand.assembly.stand import Stand
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.run_estimate import estimate_plan
from thermostand.stand.guarding.rules import AIR, LABORATORY, compute_dew_limit_degC, list_cold_parts
from thermostand.stand.running.executing.camera_gap import OffsetGap, OffsetWatch, explain_possible_power_loss
from thermostand.stand.running.executing.decisions import Decider
from thermostand.stand.running.executing.executor import Executor
from thermostand.stand.running.executing.settling_watch import SettlingWatch, preload_for
from thermostand.stand.running.memory.entries import Ended, Gap, JournalEntry, Reset
from thermostand.stand.running.memory.fold import fold
from thermostand.stand.running.memory.journal import Journal, Logbook
from thermostand.stand.running.opening.holds import end_endless_holds
from thermostand.stand.running.opening.open_stand import OpenStand
from thermostand.stand.running.opening.stop import STOPPED_BY_OPERATOR, Stop
from thermostand.stand.running.order import Order, check_plan
from thermostand.stand.running.resume import Interruption, hash_plan, make_begin_entry
from thermostand.stand.running.run_control import RunControl
from thermostand.stand.running.session_report import DECIDES
from thermostand.stand.running.status import EtaSlip, StatusBoard
from thermostand.stand.safety.fault import Fault, get_value
from thermostand.stand.safety.gate import DISK_LOW, INTERLOCK, NOT_RECORDED, Gate
from thermostand.stand.safety.interlock import Interlocked
from thermostand.stand.serving.api.server import preload

# The end of a run whose plan is done: the chamber comes back to the laboratory's temperature, so that a person who
# opens it finds nothing cold that water would settle on, and nothing hot.
#
# It remembers nothing: what is read says whether it is done. A run that is resumed here continues it.

_LOOK_S = 10.0  # the chamber takes minutes
_AGAIN_S = 60.0  # after a device that did not do what was commanded
_FOLLOWS_K = 1.0  # the set-point follows the laboratory in such steps


# The end of a run and no step of its plan, so that plans, ids and hashes stay; on by default, off on the simulated
# stand.
async def bring_to_ambient(stand: Stand, hub: Hub, clock: Clock, config: StandConfig) -> None:
    """Bring the chamber to ambient until it is done, `ending.max_s` are over, or it is cancelled; a hold is waited for.
    Events: `to_ambient`, and `at_ambient` or `not_at_ambient` (a warning). Nothing happens on a stand that is there, or
    is not asked to."""
    lacks = _describe_not_ambient(hub, config)
    if not config.ending.to_ambient or not lacks:
        return
    set_point_degC = _compute_ambient_degC(hub, config)
    hub.publish(TO_AMBIENT.at(clock.now_ns(), lacks, ambient_degC=set_point_degC))
    until_ns, running_degC = clock.now_ns() + to_ns(config.ending.max_s), math.nan

    def held(reason: str, _: bool) -> None:
        nonlocal running_degC
        if reason == INTERLOCK:  # the guard stops the chamber, be it for a moment between two looks
            running_degC = math.nan

    stand.gate.subscribe(held)
    while (lacks := _describe_not_ambient(hub, config)) and clock.now_ns() < until_ns:
        await stand.gate.wait_until_open()
        set_point_degC, wait_s = _compute_ambient_degC(hub, config), _LOOK_S
        if not abs(set_point_degC - running_degC) <= _FOLLOWS_K:
            try:
                await stand.imaging.close_flap()
                await stand.chamber.start(set_point_degC)
                running_degC = set_point_degC
            except (DeviceError, Interlocked):  # the guard says what is wrong, and holds
                wait_s = _AGAIN_S
        await clock.sleep_until(clock.now_ns() + to_ns(wait_s))
    if lacks:
        hub.publish(NOT_AT_AMBIENT.at(clock.now_ns(), lacks, after_s=config.ending.max_s))
    else:
        hub.publish(AT_AMBIENT.at(clock.now_ns()))
    with suppress(DeviceError):  # the plan is done: what follows makes everything safe until it confirms
        await stand.chamber.stop()


def _compute_ambient_degC(hub: Hub, config: StandConfig) -> float:
    """Return the temperature to end at, within the stand's limits."""
    measured_degC = get_value(hub, LABORATORY)
    low_degC, high_degC = config.set_points_degC
    wanted_degC = config.ending.ambient_degC if math.isnan(measured_degC) else measured_degC
    return min(max(wanted_degC, low_degC), high_degC)


def _describe_not_ambient(hub: Hub, config: StandConfig) -> str:
    """Return what has not reached the laboratory's temperature yet, in words; "" when all has. Air that cannot be read
    may be anywhere: the guard ends that; other parts that cannot be read are not waited for."""
    ambient_degC, band_K = _compute_ambient_degC(hub, config), config.ending.band_K
    air_degC = get_value(hub, AIR)
    if not abs(air_degC - ambient_degC) <= band_K:
        return "the air's temperature is not known" if math.isnan(air_degC) else f"the air is {air_degC:.1f} degC"
    dew_degC = compute_dew_limit_degC(config, hub)
    lowest_degC = ambient_degC - band_K if math.isnan(dew_degC) else min(dew_degC, ambient_degC)
    cold = [(get_value(hub, channel), channel) for channel in list_cold_parts(config)]
    value_degC, channel = min((each for each in cold if each[0] < lowest_degC), default=(math.nan, ""))
    return f"{channel} is {value_degC:.1f} degC, and may have to be {lowest_degC:.1f}" if channel else ""


# The recorder's events that hold a run, and those that let it continue.
_HOLDING: dict[str, str] = {FRAMES_STOPPED: DISK_LOW, TELEMETRY_NOT_SAVED: NOT_RECORDED}
# A run in virtual time that is held for so many times the longest pause ends.
_VIRTUAL_PAUSES = 2
_RELEASING: dict[str, str] = {FRAMES_RESUMED: DISK_LOW, TELEMETRY_SAVED_AGAIN: NOT_RECORDED}


Work = Coroutine[None, None, None]


@dataclass(frozen=True, slots=True)
class Job:
    """What to run and who watches: from the start, in a folder below `out`, or resuming an interruption (`before`).

    begun: gets the folder when its journal is on the disk.
    """

    order: Order
    out: Path
    seed: int | None
    watch: Callable[[Hub], None]
    begun: Callable[[Path], Awaitable[None]]
    before: Interruption | None = None


class Run:
    """A run on an open stand: it reads, begins its journal, performs its plan and leaves the stand safe.

    answer: reports clients about it from the beginning of its journal on, when it has the stand for itself. course:
    what may be asked of it, None before that.
    """

    def __init__(
        self, job: Job, open_stand: OpenStand, recorder: Recorder, stop: Stop, answer: Callable[[], Work] | None = None
    ) -> None:
        assembly, plan, before = open_stand.assembly, tuple(job.order.recipe.plan()), job.before
        preload_for(plan)
        self.job = job
        self.recorder = recorder
        self.stop = stop
        self.log = Logbook(assembly.hub, assembly.clock, fold(plan, ()) if before is None else before.state)
        self.course: RunControl | None = None
        self._answer = answer
        self._open_stand = open_stand
        self._assembly = assembly
        assembly.stand.attended = job.order.attended

    @property
    def frames_to_come(self) -> bool:
        """Whether the plan still captures."""
        return self.log.state.frames_to_come

    def trip(self, fault: Fault) -> None:
        """The guard ends the run."""
        self.stop.trip(fault)
        self.log.tripped(fault)

    def hold(self, fault: Fault) -> None:
        """The guard holds the run."""
        self.log.tripped(fault)

    async def run(self, recording: asyncio.Task[None]) -> None:
        """The whole plan, or what is not done of it; the actuators are safe before anything else is taken down. The end
        of `recording` ends the run."""
        open_stand, assembly, stop, log = self._open_stand, self._assembly, self.stop, self.log
        open_stand.active_run, open_stand.recorder = self, self.recorder
        open_stand.prepare()
        preload()
        target = parse_document(self.job.order.target_text, Target, "target.yaml")
        settling = SettlingWatch(assembly.stand, assembly.hub, assembly.clock, target)
        watchers: list[asyncio.Task[None]] = []
        ended = Ended(0, "failed", "")
        async with AsyncExitStack() as leaving:
            try:
                executor = await run_with_background(self._begin(settling, leaving), (*open_stand.tasks, recording))
                self.course = self._make_control(await self._make_board(leaving), executor, leaving)
                if self._answer is not None:
                    watchers.append(asyncio.create_task(self._answer()))
                open_stand.start()
                if isinstance(assembly.clock, VirtualClock):
                    limit_h = _VIRTUAL_PAUSES * assembly.config.guard.pause_limit_h
                    gate, clock = assembly.stand.gate, assembly.clock
                    endless = end_endless_holds(gate, assembly.hub, clock, open_stand.latch, limit_h)
                    watchers.append(asyncio.create_task(endless))
                stop.begin()
                await run_with_background(executor.run(), [*open_stand.tasks, recording, *watchers])
                at_last = bring_to_ambient(assembly.stand, assembly.hub, assembly.clock, assembly.config)
                await run_with_background(at_last, [*open_stand.tasks, recording, *watchers])
                ended = Ended(0, "complete", "complete")
            except BaseException as error:
                ended = _make_end(stop.reason, error)
                raise
            finally:
                stop.begin_takedown()
                assembly.stand.gate.remove_listeners()  # what an operator presses now holds nothing
                try:
                    log.tell(RUN_END, ended.text, status=ended.status)
                finally:  # also when a subscriber fails
                    await open_stand.make_safe_and_stop(watchers)
                    settling.close()
                    stop.end()
                    await log.end(ended, stop.shutdown_deadline)

    async def _begin(self, settling: SettlingWatch, leaving: AsyncExitStack) -> Executor:
        """Everything read and judged once, and the journal begun or continued: nothing moves before that."""
        open_stand, assembly, log, before, recorder = (
            self._open_stand,
            self._assembly,
            self.log,
            self.job.before,
            self.recorder,
        )
        await open_stand.read_once()
        if before is None:
            log.tell(RUN_START, **self._make_begin_data())
        else:
            self._report_interruption(before)
        if not open_stand.guard.look():
            raise StandTripped("a rule of the guard is violated")
        await recorder.flush()  # a session with a journal can be opened and resumed
        journal = Journal.create(recorder.directory) if before is None else before.journal
        await log.begin(journal, *self._make_first_entries(), disk=recorder.disk)
        recorder.watch_file(journal)
        with assembly.clock.hold():
            await self.job.begun(recorder.directory)
        gate, hub, clock = assembly.stand.gate, assembly.hub, assembly.clock
        gate.subscribe(log.note_hold)
        if open_stand.latch.fault is not None:  # by the first look, when there was no journal yet
            log.tripped(open_stand.latch.fault)
            log.note_hold(INTERLOCK, True)
        holding = _hold_while_not_recorded(gate)
        hub.subscribe(holding)
        leaving.callback(hub.unsubscribe, holding)
        if before is not None:
            _judge_camera(before, assembly)
        gap = before and OffsetGap(before.camera.offsets_K, before.last_ns, clock.now_ns())
        offsets = OffsetWatch(hub, clock, gap)
        leaving.callback(offsets.close)
        allowed = partial(check_plan, config=self.job.order.config)
        executor = Executor(
            assembly.stand,
            hub,
            clock,
            log,
            flushed=recorder.flush,
            settling=settling,
            offsets=offsets,
            allowed=allowed,
            lost=recorder.count_lost,
            decider=Decider(recorder.directory, clock, DECIDES).decide,
            meet=open_stand.guard.handle_step_error,
        )
        leaving.callback(executor.close)
        return executor

    async def _make_board(self, leaving: AsyncExitStack) -> StatusBoard:
        """The published state of the run, from before its first step on."""
        assembly, recorder, state, before = self._assembly, self.recorder, self.log.state, self.job.before
        kept = state if before is None else before.kept
        lane = WorkerThread("estimate", assembly.clock, patient=False)  # nothing moves yet: the disk may take its time
        leaving.callback(lane.close)
        estimate = await lane.call(estimate_plan, state.plan, self.job.order.config, recorder.directory.parent)
        gate, clock, open_stand = assembly.stand.gate, assembly.clock, self._open_stand
        name = self.job.order.recipe.name
        supply = assembly.stand.imaging.supply

        def soaked_again_s() -> float | None:
            return supply.equilibrium.soaked_s() if supply.is_on else None

        latch = open_stand.latch
        board = StatusBoard(
            name, estimate, kept, gate, self.stop, latch, recorder=recorder, clock=clock, soaked_again_s=soaked_again_s
        )
        assembly.hub.subscribe(board)
        leaving.callback(assembly.hub.unsubscribe, board)
        if not isinstance(clock, VirtualClock):  # there nobody waits for the end
            slip = EtaSlip(assembly.hub, clock, board.left_s, partial(utc_offset_ns, clock))
            assembly.hub.subscribe(slip)
            leaving.callback(assembly.hub.unsubscribe, slip)
        return board

    def _make_control(self, board: StatusBoard, executor: Executor, leaving: AsyncExitStack) -> RunControl:
        assembly, recorder = self._assembly, self.recorder
        notes = DiskCalls(recorder.disk, NOTES_LINE, assembly.clock)
        leaving.callback(notes.close)
        course = RunControl(assembly, recorder.directory, self.stop, self.log, executor, board, notes)
        assembly.hub.subscribe(course)
        leaving.callback(assembly.hub.unsubscribe, course)
        return course

    def _make_begin_data(self) -> dict[str, object]:
        """Return, for a resume, whether the host has run on since, and which plan it is, should the journal have lost
        that. For counts of what is done: how many steps and frames the plan has. For who watches: the session. Which
        packages have made steps of it."""
        plan, boot = hash_plan(self.job.order.recipe.plan()), get_boot(self._assembly.clock)
        names = {"recipe": self.job.order.recipe.name, "session": self.recorder.directory.name}
        data: dict[str, object] = {**self.log.state.size, "plan": plan, "seed": self.job.seed, **names}
        if packages := self.job.order.recipe.packages:
            data["packages"] = packages
        return data if boot is None else {**data, "boot_id": boot.id}

    def _make_first_entries(self) -> tuple[JournalEntry, ...]:
        now_ns, before = self._assembly.clock.now_ns(), self.job.before
        if before is None:
            return (make_begin_entry(self.job.order, self.recorder.directory.name, now_ns, self.job.seed),)
        reset = (Reset(now_ns),) if before.state.tripped else ()
        return (*reset, Gap(before.last_ns, now_ns))

    def _report_interruption(self, before: Interruption) -> None:
        """The end of the run that was interrupted, the gap since, and that it is resumed."""
        clock, log = self._assembly.clock, self.log
        now_ns, last_utc_ns = clock.now_ns(), before.last_ns + before.utc_offset_ns
        if before.state.ended is None:
            ended = f"interrupted: killed after {format_local(last_utc_ns)}"
            log.tell(RUN_END, ended, status=RunOutcome.INTERRUPTED)
        to_utc_ns = now_ns + utc_offset_ns(clock)
        log.tell(GAP, format_duration(now_ns - before.last_ns), from_ns=last_utc_ns, to_ns=to_utc_ns)
        if before.state.tripped:
            log.tell(RESET, str(before.state.tripped))
        version = importlib.metadata.version("thermostand")
        log.tell(RUN_RESUME, version=version, steps_done=len(before.kept.done), **self._make_begin_data())


def _judge_camera(before: Interruption, assembly: Assembly) -> None:
    """A camera that the plan has on, and that may have been off since, has lost its equilibrium."""
    stand, boot = assembly.stand, get_boot(assembly.clock)
    if not assembly.devices.cameras:
        return
    if not before.kept.set_up.camera_on:
        stand.imaging.supply.last = before.camera.last
    elif reason := explain_possible_power_loss(
        before.camera,
        None if boot is None else boot.id,
        stand.imaging.supply.was_on,
        assembly.hub.latest("camera.temperature"),
    ):
        stand.imaging.supply.equilibrium.lose(reason)


def _make_end(fault: Fault | None, error: BaseException) -> Ended:
    """Return how a run ended that did not come to its end."""
    if fault is None:
        cause = find_cause(error)
        if isinstance(cause, NotReset):
            return Ended(0, "tripped", f"aborted: {cause}")
        reason = "cancelled" if isinstance(cause, asyncio.CancelledError) else describe_failure(cause)
        return Ended(0, "failed", f"failed: {reason}")
    return Ended(0, "stopped" if fault.rule == STOPPED_BY_OPERATOR else "tripped", f"aborted: {fault.text}")


def _hold_while_not_recorded(gate: Gate) -> Callable[[Item], None]:
    """A subscriber: the run waits while the recorder cannot record frames, or telemetry."""

    def follow(item: Item) -> None:
        if isinstance(item, Event) and item.kind in _HOLDING:
            gate.hold(_HOLDING[item.kind])
        if isinstance(item, Event) and item.kind in _RELEASING:
            gate.clear(_RELEASING[item.kind])

    return follow
