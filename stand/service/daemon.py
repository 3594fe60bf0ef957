"""The daemon: it owns a stand for days. One guard from its first look to its last; runs of the queue are its guests.

locks -> open, harmless -> the record between runs -> polled and guarded -> clients -> the queue, one run after another
end: the run stopped, the stand safe and tried until it confirms, the record completed, everything closed
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import AbstractAsyncContextManager, AsyncExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import cast

from thermostand.drivers.devices.relays import CAMERA_POWER
from thermostand.experiments.steps import Capture
from thermostand.foundation.clock import NS_PER_S, Clock, WallClock, to_ns
from thermostand.foundation.errors import DeviceError, Interrupted, SessionError, StandError, StandTripped
from thermostand.foundation.events import (
    CAMERA_NOT_OPENED,
    DAEMON_FILE_DAMAGED,
    GUARD,
    IDLE_LOG_NOT_ENDED,
    IDLE_LOG_NOT_RECORDED,
    LIMITS_OVERRIDDEN,
    NOT_REPORTED,
    NOT_RESUMED,
    QUEUE,
    QUEUE_EMPTY,
    QUEUE_STILL_HALTED,
    RECORDING_RESTARTED,
    REPORT,
    REPORTED,
    RUN_END,
    RUN_FAILED,
    SALVAGED,
    EventKind,
)
from thermostand.foundation.files import make_folder
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.repeat_limit import RepeatLimit
from thermostand.foundation.tasks import cancel_all, describe_failure, run_with_background
from thermostand.foundation.worker_process import WorkerProcess
from thermostand.foundation.workers import WorkerThread
from thermostand.recording.reading.run_status import RunOutcome
from thermostand.recording.repair.salvage import format_salvaged, salvage_unfinished
from thermostand.recording.writing.disk import FILES_LINE
from thermostand.recording.writing.recorder import FINISH_WITHIN_S
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.config.check_record import ATTACHMENT
from thermostand.stand.config.safe_ranges import describe_accepted
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.learned_durations import learn_durations
from thermostand.stand.running.executing.settling_watch import preload_for
from thermostand.stand.running.opening.clock_watch import ClockWatch
from thermostand.stand.running.opening.open_stand import OpenStand, open_assembly
from thermostand.stand.running.opening.stand_lock import lock_stand
from thermostand.stand.running.opening.stop import STOPPED, Stop, catch_signals
from thermostand.stand.running.opening.writer_restarts import WriterRestarts
from thermostand.stand.running.resume import Interruption, repair_session
from thermostand.stand.running.run import Job
from thermostand.stand.running.run_control import save_note
from thermostand.stand.running.session_report import report_session
from thermostand.stand.safety.fault import Fault
from thermostand.stand.service import systemd
from thermostand.stand.service.counters import Counters, CountersFile, StoredCounters, load_counters
from thermostand.stand.service.host import Host
from thermostand.stand.service.idle_log import IdleLog
from thermostand.stand.service.queue_file import QueueEntry
from thermostand.stand.service.queue_worker import (
    Halt,
    RunNotes,
    StepWatch,
    Stopped,
    drain,
    is_complete,
    load_queued_interruption,
)
from thermostand.stand.service.rehearsals import Rehearsals
from thermostand.stand.service.run import run_on_stand
from thermostand.stand.service.run_queue import RunQueue, make_note
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.alerts import send_alerts
from thermostand.stand.serving.api_models import Conflict, QueuedRun, Requester
from thermostand.stand.serving.preview_process import MODULE

# What answers the clients of a stand while inside.
Front = Callable[[StandService, Hub, WallClock], AbstractAsyncContextManager[object]]

_ENDS = Fault(STOPPED.rule, "the daemon was ended")
_STOPPED_LOOK_S = 0.1  # whether the run has ended that was stopped
_LOOK_S = 1.0  # at midnight, at what has to be kept, and for the watchdog
_KEEP_EVERY_S = 60.0  # what a kill costs of the counters; round number, nothing was measured
_ENDED_AGAIN_S = 5.0  # between two records that end by themselves


class Daemon(Host):
    """An open stand with its queue and record. `serve` until it is asked to leave, or something fails."""

    def __init__(
        self,
        open_stand: OpenStand,
        orders: RunQueue,
        record: IdleLog,
        kept: StoredCounters,
        keep: CountersFile,
        recorded: Callable[[Path], None] | None = None,
    ) -> None:
        super().__init__(open_stand, orders)
        config = self._assembly.config
        self._orders = orders
        self.record = record
        self.counters = Counters(kept.counters, config.axes, config.chamber.heater_W, self._hub)
        self.service = StandService(self)
        self.has_admitted_run = False  # from the moment it is let in until it has gone
        self._is_draining = False  # until the queue knows how its run has ended
        self._keep = keep
        self._recorded_whole = recorded  # is notified of complete runs with frames
        self._status = systemd.StatusNotice()
        self._leaving, self._wake = asyncio.Event(), asyncio.Event()
        self._is_given_up = False  # an operator does not want to wait for the confirmation that the stand is safe
        self._others: set[asyncio.Task[None]] = set()
        self._extending: list[asyncio.Task[None]] = []
        self._restarts, self._run_id = WriterRestarts(), 0  # after which run that had the stand last
        self._hub.subscribe(self._follow)
        self._recorded_ns = self._turned_ns = 0  # when a record was last begun, or that of a new day, or could not be

    @property
    def has_run(self) -> bool:
        """Whether a run is in the stand, from the moment it is let in until it has gone."""
        return self.has_admitted_run

    @property
    def is_leaving(self) -> bool:
        """Whether it has been asked to leave."""
        return self._orders.leaving

    def get_state_fields(self) -> dict[str, object]:
        """The fields of the state that are a daemon's; disk_free_bytes is 0 when it is not known."""
        recorder = self.record.recorder
        return super().get_state_fields() | {
            "queue_halted": self._orders.queued.halted,
            "counters": {name: round(value, 4) for name, value in self.counters.values.items()},
            "disk_free_bytes": 0 if recorder is None else recorder.disk_free_bytes,
        }

    def queue(self) -> tuple[QueuedRun, ...]:
        """See Host."""
        return self._orders.list_runs()

    def wake(self) -> None:
        """Look at the queue: it may have something to run."""
        self._wake.set()

    def leave(self) -> None:
        """Leave as soon as the stand is confirmed safe; may be called again."""
        if not self._extending:
            self._extending.append(asyncio.create_task(systemd.keep_extending()))
        self._orders.leaving = True
        self.stop()
        if not self._leaving.is_set():
            self._start_task(self.open_stand.start_shutdown_deadline())
        self._leaving.set()

    def stop(self) -> None:
        """The stand is made safe at once; a run that has it ends."""
        for hand in self.manual_tasks:
            hand.cancel()
        if self._orders.stop is not None:
            self._orders.stop(_ENDS if self._orders.leaving else STOPPED)
        else:
            self._assembly.stand.safety.demand()
        if self._leaving.is_set():
            self._is_given_up = self._assembly.stand.safety.give_up()

    def note(self) -> None:
        """Counters are kept for the next start."""
        self._keep.note(StoredCounters(counters=dict(self.counters.values)))

    def reset_queue(self) -> None:
        """Let the queue go on: what halted it has been looked into."""
        self._start_task(self._reset_queue())

    async def serve(self, front: Front) -> None:
        """Serve until `leave`; then the stand is safe. Raises what makes that impossible."""
        async with AsyncExitStack() as stack:
            stack.push_async_callback(cancel_all, self._extending)
            stack.push_async_callback(self._keep.close, self.open_stand.shutdown_deadline)
            await self._record_idle()
            stack.push_async_callback(self._end_record)
            stack.callback(self.note)  # written while the record is ended
            stack.callback(self.open_stand.shutdown_deadline.begin)
            stack.push_async_callback(self.open_stand.close)
            await self.open_stand.latch.restore()
            self.open_stand.prepare()
            await self.open_stand.read_once()
            self.open_stand.start()
            self.open_stand.guard.look()
            catch_signals(self.leave)
            await run_with_background(self._serve(front), self.open_stand.tasks)

    async def _serve(self, front: Front) -> None:
        worker = asyncio.create_task(self._work())
        tasks = [worker, asyncio.create_task(self._supervise()), asyncio.create_task(self._feed_watchdog())]
        try:
            async with front(self.service, self._hub, cast("WallClock", self._clock)):
                systemd.notify_systemd(systemd.READY, "STATUS=idle")
                try:
                    await run_with_background(self._wait_until_left(), tasks)
                finally:
                    await self._end_run(worker)
        finally:
            await cancel_all([*tasks, *self.manual_tasks, *self._others])

    async def _wait_until_left(self) -> None:
        await self._leaving.wait()

    async def _end_run(self, worker: asyncio.Task[None]) -> None:
        """The run has made the stand safe, and completed its session, before anything else ends. One that has not
        begun, or waits for a disk after its end, is not waited for."""
        self._orders.leaving = True
        while self._orders.stop is not None and not worker.done():
            if self._orders.stop.reason is None:  # once: another stop says that nobody wants to wait any more
                self._orders.stop(_ENDS)
            await asyncio.wait([worker], timeout=_STOPPED_LOOK_S)
        if self._is_draining:
            await self.open_stand.shutdown_deadline.wait(worker, FINISH_WITHIN_S)
            await cancel_all([worker])  # it says what the queue does not know
        if self._is_given_up:
            self._assembly.stand.safety.give_up()  # forgotten with the run

    async def _work(self) -> None:
        """The queue, whenever there is something in it and nothing is halted."""
        await self._orders.ready()
        self.wake()
        await self._adopt_camera()
        disk, directory = self._orders.disk, self._orders.directory
        while True:
            await self._wake.wait()
            self._wake.clear()
            queued = self._orders.queued
            if self.open_stand.latch.fault is not None or queued.halted or self._orders.leaving:
                continue
            if not any(entry.is_open for entry in queued.entries):
                continue
            self._is_draining = True
            try:
                await drain(
                    directory, self._run_one, self._clock, self._publish_line, disk, self.open_stand.shutdown_deadline
                )
                self._publish(QUEUE_EMPTY)
            except Exception as error:  # noqa: BLE001 - whatever ends a run does not end the daemon: the queue is halted
                self._publish_line(f"the queue is halted: {describe_failure(error)}")
                await self._restart_recording()
            finally:
                self._is_draining = False
            with suppress(SessionError):
                await self._orders.read()

    async def _restart_recording(self) -> None:
        """Do what an operator would do after the process that writes a run's session was killed: reset, and resume."""
        if self._orders.leaving or self._assembly.stand.safety.unconfirmed:
            return
        if not self._restarts.may_follow(self.open_stand.latch.fault, self._clock.now_ns()):
            return
        self.open_stand.reset()
        self.note()
        if self.open_stand.latch.fault is not None:  # something else is wrong, too
            return
        try:
            await self._orders.read()
            session = next(entry.session for entry in self._orders.queued.entries if entry.id == self._run_id)
            await self._orders.resume(session)
        except StandError as error:
            self._publish(NOT_RESUMED, str(error), run=self._run_id)
            return
        self._publish(RECORDING_RESTARTED, session=session)
        self.wake()

    async def _run_one(self, entry: QueueEntry, notes: RunNotes) -> Path:
        if self._orders.leaving:
            raise Interrupted("the daemon ends")
        if self.open_stand.latch.fault is not None:
            raise StandTripped(f"the stand has tripped: {self.open_stand.latch.fault.text}")
        has_begun = has_ended = False
        self._run_id = entry.id

        def begun() -> None:
            nonlocal has_begun
            has_begun = True
            self._start_task(self._hand_over())

        def follow(item: Item) -> None:
            nonlocal has_ended
            if not isinstance(item, Event) or item.kind != RUN_END:
                return
            # A resumed run states the end of what was killed before it goes on.
            has_ended = has_ended or item.data.get("status") != RunOutcome.INTERRUPTED
            if has_begun and not self._orders.leaving:
                self._start_task(self._record_after_run())

        self.has_admitted_run = True
        self._status.tell(f"run {entry.id} ({entry.recipe})")
        self._hub.subscribe(follow)
        try:
            await cancel_all(list(self.manual_tasks))
            await self._orders.read()
            if self._assembly.stand.chamber.permits.is_granted:
                await self._assembly.stand.chamber.stop()
            return await self._perform(entry, notes, begun)
        except StandError as error:
            if not has_begun and not has_ended and not isinstance(error, Interrupted):
                self._publish(RUN_FAILED, f"run {entry.id} ({entry.recipe}) has not begun: {error}", run=entry.id)
            raise
        finally:
            self._hub.unsubscribe(follow)
            if not self._orders.leaving:
                await self._record_idle()
            self.has_admitted_run = False
            self.note()
            self._status.tell(self.manual_control.doing)

    async def _perform(self, entry: QueueEntry, notes: RunNotes, begun: Callable[[], None]) -> Path:
        """Run the entry on the open stand, or resume it in the session it has; `begun` when its recording goes on
        without the record between runs. Raises as a run does, Stopped when an operator has stopped it: who presses
        stop does not want the next one to begin."""
        orders, hub, clock = self._orders, self._hub, self._clock
        session = orders.directory / entry.session if entry.session else None
        if session is not None and await orders.repair.call(is_complete, session):
            return session  # killed between its end and the note of it
        order = await orders.reading.call(orders.get_order, entry)
        before = None if session is None else await self._interruption(session, order.config)
        watch = StepWatch(frozenset() if before is None else before.kept.done, notes.step_done)

        async def recorded(folder: Path) -> None:
            await notes.begun(folder)
            begun()
            if session is None and (
                text := make_note(Requester(name=entry.added_by, how="queue"), entry.note, entry.tags)
            ):
                try:
                    await save_note(text, folder, orders.notes, hub, clock)
                except SessionError as error:
                    self._publish_line(f"warning: {error}")

        def follow(hub: Hub) -> None:
            hub.subscribe(watch)

        plan = tuple(order.recipe.plan())
        await asyncio.to_thread(preload_for, plan)
        job = Job(order, orders.directory, None, follow, recorded, before)
        try:
            async with Stop(has_signals=False) as orders.stop:
                done = await run_on_stand(self.open_stand, job, orders.stop)
        except Interrupted as error:
            if orders.leaving:
                raise
            follows = any(each.is_open for each in orders.queued.entries)
            reset = "; the next of the queue begins when the stand is reset" if follows else ""
            raise Stopped(f"{error}; it may be resumed{reset}", halts=follows) from error
        finally:
            orders.stop = None
            hub.unsubscribe(watch)
        try:
            await orders.repair.call(learn_durations, orders.directory, order.config)
        except SessionError as error:
            self._publish_line(f"warning: what this run has taught of durations is not kept: {error}")
        if self._recorded_whole is not None and any(isinstance(planned.step, Capture) for planned in plan):
            self._recorded_whole(done)
        return done

    async def _interruption(self, session: Path, config: StandConfig) -> Interruption:
        """Return what is left of its run; Halt when it cannot be resumed. What has to be written for that is written by
        the disk's process."""
        try:
            salvaged = await self._orders.repair.call(repair_session, session)
        except SessionError as error:
            raise Halt(str(error)) from error
        before = await self._orders.reading.call(partial(load_queued_interruption, session, config, reset=True))
        return replace(before, salvaged=(*salvaged, *before.salvaged))

    async def _record_idle(self) -> None:
        """Record between runs, on which heat by hand depends; a disk that refuses it is an event, and no heat by hand
        is permitted."""
        self._recorded_ns = self._clock.now_ns()
        try:
            self.open_stand.recorder = await self.record.get_current()
        except (SessionError, OSError) as error:
            self.open_stand.recorder = None
            self._assembly.stand.safety.demand()
            self._publish(IDLE_LOG_NOT_RECORDED, str(error))

    async def _hand_over(self) -> None:
        """The run records, and its session is known."""
        await self._end_record()
        with suppress(SessionError):
            await self._orders.read()

    async def _record_after_run(self) -> None:
        """The record goes on while the run that has ended is still completed; `_record_idle` says when it cannot."""
        with suppress(SessionError, OSError):
            await self.record.get_current()

    async def _end_record(self) -> None:
        try:
            await self.record.end(FINISH_WITHIN_S)
        except (SessionError, OSError) as error:
            self._publish(IDLE_LOG_NOT_ENDED, str(error))

    async def _supervise(self) -> None:
        """Midnight, a record that has ended by itself, what is kept for the next start, and what systemd shows."""
        kept_ns = self._clock.now_ns()
        while True:
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(_LOOK_S))
            may_begin = not (self.has_admitted_run or self._orders.leaving)
            if may_begin:
                self._status.tell(self.manual_control.doing)
            # Its disk process holds the queue's lock and what the compressor did; a new one would have to take both
            # while calls still wait for the old one. The service starts the daemon again.
            if may_begin and self.open_stand.disk is not None and (ended := self.open_stand.disk.ended):
                raise SessionError(f"{ended}; neither queue nor what the compressor did can be kept without it")
            if may_begin and self._is_midnight():
                await self._start_new_day()
            if may_begin and self._needs_record():
                self.open_stand.end_recording()
                await self._end_record()
                await self._record_idle()
            if self._clock.now_ns() - kept_ns >= _KEEP_EVERY_S * NS_PER_S:
                kept_ns = self._clock.now_ns()
                self.note()

    def _needs_record(self) -> bool:
        """A new one: when the last one has ended by itself, also while the stand is held for that; what the disk has
        refused is tried again after a while."""
        recorder, waited_s = self.record.recorder, (self._clock.now_ns() - self._recorded_ns) / NS_PER_S
        if recorder is None:
            return waited_s >= _KEEP_EVERY_S
        return bool(recorder.writer_ended) and waited_s >= _ENDED_AGAIN_S

    def _is_midnight(self) -> bool:
        """Return whether the record is of yesterday; what the disk has refused is tried again after a while."""
        recorder, waited_ns = self.record.recorder, self._clock.now_ns() - self._turned_ns
        is_of_yesterday = recorder is not None and not recorder.writer_ended and not self.record.is_of_today()
        return is_of_yesterday and waited_ns >= _KEEP_EVERY_S * NS_PER_S

    async def _start_new_day(self) -> None:
        """Today's record takes over from yesterday's in one moment: heat by hand is recorded throughout."""
        self._turned_ns = self._clock.now_ns()
        try:
            recorder = await self.record.begin()
        except (SessionError, OSError) as error:
            self._publish(IDLE_LOG_NOT_ENDED, f"today's record is not begun, yesterday's goes on: {error}")
            return
        if self.open_stand.active_run is None:
            self.open_stand.recorder = recorder
        try:
            await self.record.complete(FINISH_WITHIN_S)
        except (SessionError, OSError) as error:
            self._publish(IDLE_LOG_NOT_ENDED, str(error))

    async def _adopt_camera(self) -> None:
        """A camera that is found powered is opened; one that is off stays off until somebody wants it."""
        stand, devices = self._assembly.stand, self._assembly.devices
        power = self._hub.latest(f"{devices.relays.name}.{CAMERA_POWER}")
        if not devices.cameras or power is None or power.value != 1:
            return
        try:
            await stand.imaging.supply.switch_on()
        except (DeviceError, StandTripped) as error:
            self._publish(CAMERA_NOT_OPENED, str(error))

    async def _feed_watchdog(self) -> None:
        """Feed the watchdog while guard and loop are on time: a disk that hangs is no reason to be killed."""
        limit_s = systemd.watchdog_s()
        every_s = _KEEP_EVERY_S if limit_s is None else limit_s / 3
        while True:
            if limit_s is not None and self.open_stand.guard.is_on_time:
                systemd.notify_systemd(systemd.FED)
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(every_s))

    async def _reset_queue(self) -> None:
        try:
            await self._orders.reset()
        except SessionError as error:
            self._publish(QUEUE_STILL_HALTED, str(error))
        self.wake()

    def check_heat(self) -> None:
        """See Host."""
        recorder = self.record.recorder
        if recorder is None or recorder.folder_lost or recorder.writer_ended:
            raise Conflict("nothing is recorded now, and there is no heat without a recording; see the last events")
        if not self.open_stand.guard.may_permit():
            raise Conflict("the guard does not permit heat now: it waits for fresh readings, or holds the stand")

    def _start_task(self, work: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task = asyncio.create_task(work)
        self._others.add(task)
        task.add_done_callback(self._others.discard)
        return task

    def _follow(self, item: Item) -> None:
        """The hub's subscriber: what has led to a trip is counted when the daemon is killed after it."""
        if isinstance(item, Event) and item.kind.startswith(GUARD):
            self.note()

    def _publish_line(self, line: str) -> None:
        self._publish(QUEUE, line)


# A stand opened for a daemon: its addresses locked, what was left on switched off, the dead man tested.

# The reports of runs that have come to their end, by a process of its own at the lowest priority: a session can be read
# in the morning, and nothing that guards or records waits for it.

_REPORT = "report"


def make_session_report(path: str) -> list[str]:
    """Report a session in its folder; what no temperature explains in it, a sentence each. NotReported. In the process
    that reports."""
    import cv2

    cv2.setNumThreads(1)
    return list(report_session(Path(path), Path(path)).unexplained)


class ReportQueue:
    """One after another. What goes wrong is an event `not_reported`, and nothing else."""

    def __init__(self, hub: Hub, clock: Clock) -> None:
        self._hub = hub
        self._clock = clock
        self._turn = asyncio.Lock()
        self._works: set[asyncio.Task[None]] = set()

    def add(self, session: Path) -> None:
        """Make the session's report, in its folder, when its turn has come; event `reported`."""
        work = asyncio.create_task(self._make_report(session))
        self._works.add(work)
        work.add_done_callback(self._works.discard)

    async def close(self) -> None:
        """Give up what is not made."""
        await cancel_all(list(self._works))

    async def _make_report(self, session: Path) -> None:
        async with self._turn:
            lane, helper = WorkerThread("report", self._clock, patient=False), None
            try:
                helper = WorkerProcess(MODULE, (_REPORT,), "the process that makes reports has ended")
                for line in await lane.call(helper.line(_REPORT).run, make_session_report, str(session)):
                    self._publish(REPORT, line, session=session.name)
                self._publish(REPORTED, session=session.name)
            except (StandError, OSError) as error:
                self._publish(NOT_REPORTED, str(error))
            except Exception as error:  # noqa: BLE001 - a fit that fails ends nothing
                remedy = f"`compensate report {session} -o report.html` tries again"
                self._publish(NOT_REPORTED, f"{session.name}: no report: {describe_failure(error)}; {remedy}")
            finally:
                if helper is not None:
                    helper.close()
                lane.close()

    def _publish(self, kind: EventKind, text: str = "", /, **data: object) -> None:
        self._hub.publish(kind.at(self._clock.now_ns(), text, **data))


async def serve(
    config: StandConfig,
    config_name: str,
    texts: dict[str, str],
    out: Path,
    front: Front,
    *,
    has_reports: bool = False,
) -> None:
    """Own the stand until SIGINT, SIGTERM, SIGQUIT or SIGHUP. texts: config.yaml, target.yaml, and the record of
    `stand check` where there is one. has_reports: whether complete runs with frames are reported.

    InUse when it belongs to another daemon or run: then nothing was touched. Raises what opening raises, and
    StandTripped when the stand could not be confirmed safe at the end.
    """
    async with Stop() as stop, lock_stand(config, None):
        hub, clock = Hub(RepeatLimit()), WallClock()
        await asyncio.to_thread(make_folder, out)
        kept, damage = await asyncio.to_thread(load_counters, out)
        watch = ClockWatch(hub, clock)
        assembly = assemble(config, hub, clock)
        async with AsyncExitStack() as stack:
            open_stand = await stack.enter_async_context(open_assembly(assembly, watch.run, stop, is_for_one=False))
            await stack.enter_async_context(send_alerts(config.name, config.alerts, hub, clock, open_stand.is_well))
            if open_stand.disk is None:
                raise ValueError("a daemon is on the host's clock, and has a process for its disk")
            own = {name: text for name, text in texts.items() if name in ("config.yaml", ATTACHMENT)}
            record = IdleLog(assembly, own, out, clock, stop.shutdown_deadline)
            keep = CountersFile(out, open_stand.disk.line(FILES_LINE).run, hub, clock)
            reports = ReportQueue(hub, clock)
            stack.push_async_callback(reports.close)
            rehearsals = Rehearsals(hub, clock, config_name, out)
            stack.push_async_callback(rehearsals.close)
            orders = RunQueue(open_stand, open_stand.disk, out, config_name, texts, rehearsals.add)
            for segment in await orders.repair.call(salvage_unfinished, out):
                hub.publish(SALVAGED.at(clock.now_ns(), format_salvaged(segment)))
            if accepted := config.list_accepted():
                hub.publish(LIMITS_OVERRIDDEN.at(clock.now_ns(), describe_accepted(accepted), **accepted))
            if damage:
                hub.publish(DAEMON_FILE_DAMAGED.at(clock.now_ns(), damage))
            daemon = Daemon(
                open_stand,
                orders,
                record,
                kept,
                keep,
                recorded=reports.add if has_reports else None,
            )
            await daemon.serve(front)
        if unsafe := assembly.stand.safety.unconfirmed:
            raise StandTripped(f"the daemon ends, but NOT SAFE: {'; '.join(unsafe)}")
