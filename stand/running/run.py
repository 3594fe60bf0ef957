"""One run from beginning to end: open everything, record, perform the plan, leave the stand safe whatever happens."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine, Mapping
from contextlib import AsyncExitStack, suppress
from dataclasses import dataclass
from pathlib import Path

from drivers.clock import Clock, VirtualClock, WallClock, seconds_ns
from drivers.interface import ConfigError, SessionError, StandError, StandTripped, Unreachable
from stand.assembly import Assembly, assemble
from stand.commandline.session_text import salvage_line
from stand.hub import Event, Hub, Item
from stand.recording.recorder import Recorder
from stand.recording.salvage import Salvaged, salvage_unfinished
from stand.recording.settings import SessionInfo
from stand.running.performance import Performance, perform
from stand.running.resume import Interruption
from stand.running.session_setup import Order, info_of, recorder_of, session_directory
from stand.running.stop import Interrupted, Stop
from stand.running.tasks import cancelled, watched
from stand.simulator import ControlSocket, Simulator, laboratory_of, one_cpu

__all__ = ["Interrupted", "resume", "run_real", "run_virtual"]

# Real time that an orphaned simulator takes to answer, and to let go of its addresses.
_ORPHAN_ANSWERS_S, _ORPHAN_TRIES, _ORPHAN_PAUSE_S = 5.0, 40, 0.25


@dataclass(frozen=True, slots=True)
class _Job:
    """What to run and who watches: anew, in a folder below `out`, or on from where a run was interrupted (`before`)."""

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
        return tuple(await asyncio.to_thread(salvage_unfinished, self.out))

    def directory(self, clock: Clock) -> Path:
        """The session's folder."""
        return self.before.directory if self.before is not None else session_directory(self.out, self.order, clock)

    def info(self, directory: Path, assembly: Assembly) -> SessionInfo:
        """The session's metadata; SessionError when the camera is another one than before the interruption."""
        if self.before is None:
            return info_of(self.order, directory, assembly)
        if self.before.set_up.camera_on:
            answers, recorded = assembly.devices.camera.identity.serial_number, self.before.info.camera_serial
            if answers != recorded:
                raise SessionError(f"{directory}: was recorded with camera {recorded}, now {answers} answers")
        return self.before.info


def _nobody(_: Path) -> None:
    """Is told of the session and does nothing."""


async def run_virtual(
    order: Order,
    out: Path,
    seed: int | None,
    watch: Callable[[Hub], None],
    begun: Callable[[Path], None] = _nobody,
) -> Path:
    """Run against a simulated laboratory of its own, in virtual time; returns the session's folder.

    The same order and seed give the same session, byte for byte. `watch` may subscribe to the hub before the start;
    `begun` is told the folder as soon as a run that is killed could be resumed in it.
    Raises Interrupted, StandTripped, SessionError when frames were lost, and what opening or a step raised.
    """
    simulation = order.config.simulation
    if simulation is None:
        raise ConfigError(f"{order.config.name}: virtual time needs a `simulation` section")
    return await _run_virtual(_Job(order, out, seed, watch, begun), seconds_ns(simulation.start.timestamp()))


async def run_real(
    order: Order, out: Path, watch: Callable[[Hub], None], begun: Callable[[Path], None] = _nobody
) -> Path:
    """Run on the host's clock, against whatever answers at the configured addresses; else as run_virtual."""
    async with Stop() as stop:
        return await _run(_Job(order, out, None, watch, begun), WallClock(), None, stop)


async def resume(before: Interruption, watch: Callable[[Hub], None], downtime_s: float = 60.0) -> Path:
    """Go on with an interrupted run, in the time it was run in, and add to its session; raises as run_virtual.

    What is done is not done again. In virtual time the laboratory is a new one with a chamber at room temperature,
    `downtime_s` after the last recorded instant. SessionError when the host's clock is before that instant.
    """
    try:
        job = _Job(before.order, before.directory.parent, before.seed, watch, _nobody, before)
        if before.info.clock_source == "virtual":
            return await _run_virtual(job, before.last_ns + seconds_ns(downtime_s))
        clock = WallClock()
        if clock.now_ns() <= before.last_ns:
            raise SessionError(f"{before.directory}: the host's clock is before its last instant; set it right")
        async with Stop() as stop:
            return await _run(job, clock, None, stop)
    finally:
        before.release()


async def _run_virtual(job: _Job, start_ns: int) -> Path:
    laboratory = {**laboratory_of(job.order.config, virtual=True, seed=job.seed), "start_ns": start_ns}
    async with Stop() as stop, AsyncExitStack() as stack:
        stack.enter_context(one_cpu())
        address = str(laboratory["control"])
        simulator = await _started(laboratory, await _orphan_ended(address))
        stack.push_async_callback(asyncio.to_thread, simulator.stop)
        control = ControlSocket(address)
        stack.push_async_callback(control.close)
        await control.open()
        clock = VirtualClock(start_ns, control.advance)
        return await _run(job, clock, clock.run, stop)


async def _orphan_ended(address: str) -> int:
    """End the simulator that a killed daemon has left, which would go on for a minute and knows nothing of the time
    since. Returns how often to try to start a new one, which it keeps from its addresses until it is gone."""
    control = ControlSocket(address)
    try:
        async with asyncio.timeout(_ORPHAN_ANSWERS_S):
            await control.open()
            return _ORPHAN_TRIES if (await control.request({"do": "quit_if_orphaned"}))["quits"] else 1
    except (Unreachable, TimeoutError, ValueError):
        return 1  # nobody is there, or is any more, or no simulator: starting one will say so
    finally:
        await control.close()


async def _started(laboratory: Mapping[str, object], tries: int) -> Simulator:
    """The simulator process; when the run is stopped meanwhile, it is ended again."""
    clock = WallClock()
    while True:
        starting = asyncio.ensure_future(asyncio.to_thread(Simulator, laboratory))
        try:
            return await asyncio.shield(starting)
        except ConfigError:
            tries -= 1
            if tries <= 0:
                raise
            await clock.sleep_until(clock.now_ns() + seconds_ns(_ORPHAN_PAUSE_S))
        except asyncio.CancelledError:
            simulator = await starting
            await asyncio.to_thread(simulator.stop)
            raise


_Time = Callable[[], Coroutine[None, None, None]]


async def _run(job: _Job, clock: Clock, time: _Time | None, stop: Stop) -> Path:
    """The whole run; whoever is told of trips is told, too, of one that ends by itself before its plan is complete."""
    hub, early = Hub(), _Early()
    job.watch(hub)
    hub.subscribe(early)
    for segment in await job.salvaged():
        hub.publish(Event(clock.now_ns(), "warning", "salvaged", salvage_line(segment)))
    assembly = assemble(job.order.config, hub, clock)
    directory = job.directory(clock)
    try:
        recorder = await _performed(job, directory, assembly, time, stop, early)
        _check_outcome(directory, recorder, assembly)
    except Exception as error:
        if stop.fault is None:  # else the guard has told, or the operator knows
            await _tell_failure(assembly, directory.name, error)
        raise
    return directory


async def _performed(
    job: _Job, directory: Path, assembly: Assembly, time: _Time | None, stop: Stop, early: _Early
) -> Recorder:
    """From opening everything to closing it."""
    async with AsyncExitStack() as stack:
        background: list[asyncio.Task[None]] = []
        stack.push_async_callback(cancelled, background)
        if time is not None:
            background.append(asyncio.create_task(time()))
        stack.push_async_callback(_close, assembly)
        stack.callback(assembly.stand.gate.let_go)
        stack.push_async_callback(stop.settled)
        stop.watch(assembly.stand)
        await _opened(assembly, background, stop, camera_on=job.before is None or job.before.set_up.camera_on)
        recorder = await _recording(job, directory, assembly, stop, early)
        recording = asyncio.create_task(recorder.run())
        stack.push_async_callback(_finish, recorder, recording)
        tasks = (*background, recording)
        await perform(Performance(job.order, job.seed, job.before, job.begun, assembly, recorder, stop, tasks))
    return recorder


def _check_outcome(directory: Path, recorder: Recorder, assembly: Assembly) -> None:
    """What is wrong with a run that has done its whole plan: nobody may take such a stand for safe, or such a session
    for whole."""
    if unsafe := assembly.stand.unconfirmed:
        raise StandTripped(f"{directory}: complete, but NOT SAFE: {'; '.join(unsafe)}")
    if recorder.frames_lost:
        raise SessionError(f"{directory}: complete, but {recorder.frames_lost} frames were lost; its events say why")


async def _tell_failure(assembly: Assembly, name: str, error: Exception) -> None:
    unsafe = assembly.stand.unconfirmed
    ending = f"; NOT SAFE: {'; '.join(unsafe)}" if unsafe and not isinstance(error, StandTripped) else ""
    if failure := await assembly.notifier().tell(f"{name} has failed: {error or type(error).__name__}{ending}"):
        assembly.hub.publish(Event(assembly.clock.now_ns(), "warning", "notify_failed", failure))


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
    """Open everything; when that fails or is stopped half-way, whatever already answers is made safe."""
    try:
        await watched(_open(assembly, camera_on=camera_on), background)
    except BaseException:
        stop.taking_down()
        await assembly.stand.make_safe()
        raise


async def _recording(job: _Job, directory: Path, assembly: Assembly, stop: Stop, early: _Early) -> Recorder:
    """The recorder, started; a disk that refuses it leaves the stand safe, as everything after this does."""
    try:
        recorder = recorder_of(job.order, directory, job.info(directory, assembly), assembly)
        recorder.start(early.taken())
    except BaseException:
        stop.taking_down()
        await assembly.stand.make_safe()
        raise
    return recorder


async def _open(assembly: Assembly, *, camera_on: bool) -> None:
    """Connect everything; heat and cold lose what permission somebody left them, the flap is closed and the camera
    switched on before anything else may happen, but for a run that goes on with the camera off."""
    devices = assembly.devices
    await assembly.bus.open()
    await devices.relays.open()
    await assembly.stand.withdraw_permits()
    await devices.regulator.open()
    await devices.regulator.stop()
    await devices.thermometers.open()
    await devices.flap.open()
    await devices.flap.move_closed()
    for axis in devices.axes.values():
        await axis.open()
    if camera_on:
        await assembly.stand.power_camera(on=True)


async def _close(assembly: Assembly) -> None:
    devices = assembly.devices
    for close in (devices.camera.close, *(axis.close for axis in devices.axes.values()), devices.flap.close):
        with suppress(StandError):  # closing never decides a run, and one device must not keep the next from it
            await close()
    await assembly.bus.close()


async def _finish(recorder: Recorder, recording: asyncio.Task[None]) -> None:
    await cancelled([recording])
    await recorder.finish()
