"""One run from beginning to end: open everything, record, perform the plan, leave the stand safe in every case."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from contextlib import AsyncExitStack, nullcontext, suppress
from dataclasses import dataclass, replace
from pathlib import Path

from foundation.clock import Clock, VirtualClock, WallClock, seconds_ns
from foundation.errors import ConfigError, SessionError, StandError, StandTripped
from foundation.hub import Hub
from foundation.items import Event, Item
from foundation.progress import late_progress
from foundation.tasks import cancelled, cause_of, failure_text, watched
from recording.repair.salvage import Salvaged, salvage_line, salvage_unfinished
from recording.writing.disk import FILES_LINE, Disk
from recording.writing.recorder import COMPLETE_WITHIN_S, FINISH_WITHIN_S, Recorder
from recording.writing.settings import SessionInfo
from stand.assembly import Assembly, assemble
from stand.clock_watch import ClockWatch
from stand.config.safe_ranges import accepted_text
from stand.one_cpu import one_cpu
from stand.running.camera_temperature import check_temperature
from stand.running.claim import claimed
from stand.running.guarded_run import GuardedRun, run_guarded
from stand.running.order import Order
from stand.running.resume import Interruption
from stand.running.session_files import camera_serials, info_of, recorder_of, session_directory
from stand.running.stop import Interrupted, Stop
from stand.simulator import ControlSocket, Simulator, laboratory_of, relocated

__all__ = ["Interrupted", "resume", "run_real", "run_virtual"]

_OPENING_SAFE_LIMIT_S = 60.0  # for what was opened before something else failed; nothing has been permitted yet


@dataclass(frozen=True, slots=True)
class _Job:
    """What to run and who watches: from the start, in a folder below `out`, or resuming an interruption (`before`)."""

    order: Order
    out: Path
    seed: int | None
    watch: Callable[[Hub], None]
    begun: Callable[[Path], None]
    before: Interruption | None = None

    async def salvaged(self) -> tuple[Salvaged, ...]:
        """What earlier runs that were killed have left unfinished, finished before anything moves."""
        if self.before is not None:
            return self.before.salvaged
        with late_progress("salvage", 1.0) as report:
            return tuple(await asyncio.to_thread(salvage_unfinished, self.out, report))

    def directory(self, clock: Clock) -> Path:
        """The session's folder."""
        return self.before.directory if self.before is not None else session_directory(self.out, self.order, clock)

    def info(self, directory: Path, assembly: Assembly) -> SessionInfo:
        """The session's metadata; SessionError when the camera is another one than before the interruption."""
        if self.before is None:
            return info_of(self.order, directory, assembly)
        if self.before.kept.set_up.camera_on:
            answers, recorded = camera_serials(assembly), self.before.info.camera_serial
            if answers != recorded:
                raise SessionError(f"{directory}: was recorded with camera {recorded}, now {answers} answers")
        return self.before.info


def _nobody(_: Path) -> None:
    """Gets the session and does nothing."""


async def run_virtual(
    order: Order,
    out: Path,
    seed: int | None,
    watch: Callable[[Hub], None],
    begun: Callable[[Path], None] = _nobody,
) -> Path:
    """Run against a simulated laboratory of its own, in virtual time; returns the session's folder.

    The laboratory takes free addresses, not the configured ones: any number of virtual runs go side by side.
    The same order and seed give the same session, byte for byte. `watch` may subscribe to the hub before the start;
    `begun` gets the folder as soon as a run that is killed could be resumed in it.
    Raises Interrupted, StandTripped, SessionError when frames were lost, and what opening or a step raised.
    """
    simulation = order.config.simulation
    if simulation is None:
        raise ConfigError(f"{order.config.name}: virtual time needs a `simulation` section")
    return await _run_virtual(_Job(order, out, seed, watch, begun), seconds_ns(simulation.start.timestamp()))


async def run_real(
    order: Order, out: Path, watch: Callable[[Hub], None], begun: Callable[[Path], None] = _nobody
) -> Path:
    """Run on the host's clock, against the devices at the configured addresses; else as run_virtual."""
    async with Stop() as stop:
        return await _run(_Job(order, out, None, watch, begun), WallClock(), None, stop)


async def resume(before: Interruption, watch: Callable[[Hub], None], downtime_s: float = 60.0) -> Path:
    """Resume an interrupted run, in the time it was run in, and add to its session; raises as run_virtual.

    What is done is not done again. In virtual time the laboratory is a new one with a chamber at room temperature,
    `downtime_s` after the last recorded instant. When the host's clock is before that instant (it was set back since),
    the session continues at that instant, and the offset to UTC is recorded.
    """
    try:
        job = _Job(before.order, before.directory.parent, before.seed, watch, _nobody, before)
        if before.info.clock_source == "virtual":
            return await _run_virtual(job, before.last_ns + seconds_ns(downtime_s))
        async with Stop() as stop:
            return await _run(job, WallClock(before.last_ns + 1), None, stop)
    finally:
        before.release()


async def _run_virtual(job: _Job, start_ns: int) -> Path:
    order = job.order
    laboratory = laboratory_of(
        order.config, virtual=True, seed=job.seed, start_ns=start_ns, is_anywhere=not order.at_configured_addresses
    )
    async with Stop() as stop, AsyncExitStack() as stack:
        stack.enter_context(one_cpu())
        simulator = await _started(laboratory)
        stack.push_async_callback(asyncio.to_thread, simulator.stop)
        control = ControlSocket(simulator.addresses["control"])
        stack.push_async_callback(control.close)
        await control.open()
        clock = VirtualClock(start_ns, control.advance)
        there = replace(job, order=replace(order, config=relocated(order.config, simulator.addresses)))
        return await _run(there, clock, clock.run, stop)


async def _started(laboratory: Mapping[str, object]) -> Simulator:
    """The simulator process; when the run is stopped meanwhile, it is ended again."""
    starting = asyncio.ensure_future(asyncio.to_thread(Simulator, laboratory))
    try:
        return await asyncio.shield(starting)
    except asyncio.CancelledError:
        simulator = await starting
        await asyncio.to_thread(simulator.stop)
        raise


# What drives virtual time, or looks after the real one.
_Time = Callable[[], Coroutine[None, None, None]]


async def _run(job: _Job, clock: Clock, time: _Time | None, stop: Stop) -> Path:
    """The whole run; one on a real stand has it for itself from before anything is opened, or does not touch it."""
    directory = job.directory(clock)
    async with claimed(job.order.config, directory) if isinstance(clock, WallClock) else nullcontext():
        return await _told(job, directory, clock, time, stop)


async def _told(job: _Job, directory: Path, clock: Clock, time: _Time | None, stop: Stop) -> Path:
    """Those notified of trips are also notified of a run that ends by itself before its plan is complete."""
    hub, early = Hub(), _Early()
    job.watch(hub)
    hub.subscribe(early)
    if isinstance(clock, WallClock):
        time = ClockWatch(hub, clock, 0 if job.before is None else job.before.utc_offset_ns).run
    for segment in await job.salvaged():
        hub.publish(Event(clock.now_ns(), "warning", "salvaged", salvage_line(segment)))
    assembly = assemble(job.order.config, hub, clock)
    if accepted := job.order.config.accepted():
        hub.publish(Event(clock.now_ns(), "warning", "limits_accepted", accepted_text(accepted), accepted))
    assembly.notifier.start()
    if job.before is not None and job.before.journal.damage:
        hub.publish(Event(clock.now_ns(), "warning", "journal_damaged", job.before.journal.damage))
    for difference in () if job.before is None else job.before.differences:
        hub.publish(Event(clock.now_ns(), "warning", "stand_differs", str(difference), difference.data()))
    try:
        recorder = await _performed(job, directory, assembly, time, stop, early)
        _check_outcome(directory, recorder, assembly)
    except Exception as raised:
        error = cause_of(raised)
        if stop.fault is None:  # else the guard has notified, or the operator knows
            await _tell_failure(assembly, directory.name, error)
        if isinstance(error, MemoryError):
            raise StandError(f"{directory}: {failure_text(error)}{_unsafe(assembly)}") from raised
        raise
    finally:
        assembly.notifier.close()
    return directory


async def _performed(
    job: _Job, directory: Path, assembly: Assembly, time: _Time | None, stop: Stop, early: _Early
) -> Recorder:
    """From opening everything to closing it."""
    async with AsyncExitStack() as stack:
        disk = None if isinstance(assembly.clock, VirtualClock) else Disk()
        if disk is not None:
            stack.callback(disk.close)
            assembly.stand.chamber.compressor_file.through(disk.line(FILES_LINE).run)
        stack.push_async_callback(assembly.stand.chamber.compressor_file.close)
        background: list[asyncio.Task[None]] = []
        stack.push_async_callback(cancelled, background)
        if time is not None:
            background.append(asyncio.create_task(time()))
        stack.push_async_callback(_close, assembly)
        stack.callback(assembly.stand.gate.let_go)
        stack.push_async_callback(stop.settled)
        stop.watch(assembly.stand)
        await _opened(assembly, background, stop, camera_on=job.before is None or job.before.kept.set_up.camera_on)
        recorder = await _recording(job, directory, assembly, stop, early, disk)
        recording = asyncio.create_task(recorder.run())
        stack.push_async_callback(_finish, recorder, recording, stop)
        tasks = (*background, recording)
        await run_guarded(GuardedRun(job.order, job.seed, job.before, job.begun, assembly, recorder, stop, tasks))
    return recorder


def _check_outcome(directory: Path, recorder: Recorder, assembly: Assembly) -> None:
    """What is wrong with a run that has done its whole plan: nobody may take such a stand for safe, or such a session
    for whole."""
    if unsafe := assembly.stand.safety.unconfirmed:
        raise StandTripped(f"{directory}: complete, but NOT SAFE: {'; '.join(unsafe)}")
    if recorder.frames_lost:
        raise SessionError(f"{directory}: complete, but {recorder.frames_lost} frames were lost; its events say why")


async def _tell_failure(assembly: Assembly, name: str, error: BaseException) -> None:
    ending = "" if isinstance(error, StandTripped) else _unsafe(assembly)
    if failure := await assembly.notifier.tell(f"{name} has failed: {failure_text(error)}{ending}"):
        assembly.hub.publish(Event(assembly.clock.now_ns(), "warning", "notify_failed", failure))


def _unsafe(assembly: Assembly) -> str:
    """What is not confirmed safe, as the end of a sentence; "" when nothing is."""
    unsafe = assembly.stand.safety.unconfirmed
    return f"; NOT SAFE: {'; '.join(unsafe)}" if unsafe else ""


class _Early:
    """A subscriber that keeps the events from before there is a recorder."""

    def __init__(self) -> None:
        self._events: list[Event] | None = []

    def __call__(self, item: Item) -> None:
        if self._events is not None and isinstance(item, Event):
            self._events.append(item)

    def taken(self) -> tuple[Event, ...]:
        """What there was; nothing is kept from now on."""
        events, self._events = self._events or (), None
        return tuple(events)


async def _opened(assembly: Assembly, background: list[asyncio.Task[None]], stop: Stop, *, camera_on: bool) -> None:
    """Open everything; when that fails or is stopped half-way, all that already answers is made safe."""
    try:
        await watched(_open(assembly, camera_on=camera_on), background)
    except BaseException:
        await _made_safe(assembly, stop)
        raise


async def _made_safe(assembly: Assembly, stop: Stop) -> None:
    """Before anything was permitted: all that answers already is made safe."""
    stop.taking_down()
    safety = assembly.stand.safety
    safety.demand()
    try:
        await safety.confirmed(min(_OPENING_SAFE_LIMIT_S, assembly.config.guard.safe_limit_s))
    finally:
        await safety.close()


async def _recording(
    job: _Job, directory: Path, assembly: Assembly, stop: Stop, early: _Early, disk: Disk | None
) -> Recorder:
    """The recorder, started; a disk that refuses it leaves the stand safe, as everything after this does."""
    try:
        recorder = recorder_of(job.order, directory, job.info(directory, assembly), assembly, disk)
        await recorder.begin(early.taken)
    except BaseException:
        await _made_safe(assembly, stop)
        raise
    return recorder


async def _open(assembly: Assembly, *, camera_on: bool) -> None:
    """Connect everything; heat and cold lose what permission somebody left them, the flap is closed, the relay board's
    timer tested, and the camera switched on before anything else may happen, but for a run that is resumed with the
    camera off."""
    devices, stand = assembly.devices, assembly.stand
    await assembly.bus.open()
    await devices.relays.open()
    stand.opened(devices.relays)
    await stand.chamber.permits.withdraw_left_on()
    await devices.regulator.open()
    stand.opened(devices.regulator)
    await devices.regulator.stop()
    await devices.thermometers.open()
    await devices.flap.open()
    stand.opened(devices.flap)
    await devices.flap.move_closed()
    for axis in devices.axes.values():
        await axis.open()
        stand.opened(axis)
    await stand.chamber.test_dead_man()
    if camera_on and devices.cameras:
        await stand.imaging.supply.switch_on()
        for camera in devices.cameras.values():
            await check_temperature(camera, assembly.hub, assembly.clock)


async def _close(assembly: Assembly) -> None:
    devices = assembly.devices
    for device in (*devices.cameras.values(), *devices.axes.values(), devices.flap):
        with suppress(StandError):  # closing never decides a run, and one device must not keep the next from it
            await device.close()
    await assembly.bus.close()


async def _finish(recorder: Recorder, recording: asyncio.Task[None], stop: Stop) -> None:
    await cancelled([recording])
    await recorder.finish(COMPLETE_WITHIN_S if stop.fault is None else FINISH_WITHIN_S)
