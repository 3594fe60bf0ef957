"""One run from beginning to end: on a stand that is opened for it and closed behind it, or as the guest of a daemon."""

from __future__ import annotations

import asyncio
import fcntl
import itertools
import os
from collections.abc import AsyncGenerator, Awaitable, Callable, Generator, Mapping, Sequence
from contextlib import (
    AbstractAsyncContextManager,
    AsyncExitStack,
    asynccontextmanager,
    contextmanager,
    nullcontext,
    suppress,
)
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from thermostand.drivers.devices.motion.flap import FlapSettings
from thermostand.drivers.devices.protocols import Camera
from thermostand.drivers.settings import CameraSettings, OnBus
from thermostand.foundation.clock import Clock, VirtualClock, WallClock, to_ns
from thermostand.foundation.errors import ConfigError, Interrupted, Refused, SessionError, StandError, StandTripped
from thermostand.foundation.events import (
    JOURNAL_DAMAGED,
    LIMITS_OVERRIDDEN,
    NO_CAMERA_TEMPERATURE,
    NO_CONTROL,
    SALVAGED,
    STAND_DIFFERS,
)
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import format_utc
from thermostand.foundation.items import Event, Item
from thermostand.foundation.progress import show_late_progress
from thermostand.foundation.readings import Quality
from thermostand.foundation.repeat_limit import RepeatLimit
from thermostand.foundation.tasks import cancel_all, describe_failure, find_cause
from thermostand.recording.format.manifest import SessionInfo
from thermostand.recording.repair.salvage import BEING_RECORDED, Salvaged, format_salvaged, salvage_unfinished
from thermostand.recording.writing.disk import REPAIR_LINE, DiskCalls, DiskProcess
from thermostand.recording.writing.recorder import COMPLETE_WITHIN_S, FINISH_WITHIN_S, Recorder
from thermostand.stand.assembly.assemble import Assembly, assemble
from thermostand.stand.assembly.simulator import ControlSocket, Simulator, describe_laboratory, relocate
from thermostand.stand.config.safe_ranges import describe_accepted
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.opening.clock_watch import ClockWatch
from thermostand.stand.running.opening.open_stand import OpenStand, Time, open_assembly
from thermostand.stand.running.opening.stand_lock import find_latch_file, lock_stand
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.running.opening.writer_restarts import WriterRestarts
from thermostand.stand.running.order import Order, load_register_maps
from thermostand.stand.running.resume import Interruption, is_of_virtual_time, load_interruption
from thermostand.stand.running.run import Job, Run, Work
from thermostand.stand.running.session_files import (
    choose_session_directory,
    list_camera_serials,
    make_run_recorder,
    make_session_info,
    publish_identities,
)
from thermostand.stand.service.host import Host
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.alerts import send_alerts
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.api.server import serve

# A real stand's file as a rehearsal: the simulated laboratory answers in the place of its devices.

_FOUND_BY = {"address", "width_px", "height_px"}  # of a camera: where it is, and what the simulated sensor may not have
_HEAD = "# A rehearsal of this stand's file: the simulated laboratory in the place of its devices.\n"


def make_rehearsal(order: Order) -> Order:
    """The order on the simulated laboratory. Kept: limits, thermometers, axes, contacts, what the guard allows, what
    the cameras are asked for, and the recipe. Replaced: addresses, and the units on the bus by those that the
    laboratory has; nobody is notified. An order of a simulated stand stays as it is. ConfigError for an axis that it
    does not have."""
    config = order.config
    if config.simulation is not None:
        return order
    remote = load_config(find_packaged("", "simulated"))
    if strange := sorted(config.axes.keys() - remote.axes.keys()):
        known = ", ".join(remote.axes)
        raise ConfigError(f"{config.name}: the simulated laboratory has no axis {strange[0]}, only {known}")
    ports = itertools.count(_FIRST_PORT)
    changed: dict[str, Any] = {}
    for name, kind, settings in (each for each in config.equipment if each.settings is not None):
        if isinstance(settings, OnBus):
            changed[name] = settings.model_copy(update={"registers": kind.simulated_map})
        elif kind.section == "axes":
            changed[name] = settings.model_copy(update={"address": remote.axes[name].address})
        elif kind.section == "cameras":
            changed[name] = _rehearse_camera(settings, remote.cameras["camera"])
        elif kind.section == "flap":
            changed[name] = _rehearse_flap(settings, remote.flap)
        elif hasattr(settings, "address"):
            changed[name] = settings.model_copy(update={"address": f"tcp:127.0.0.1:{next(ports)}"})
    update: dict[str, Any] = config.replace_settings(changed) | {
        "bus": remote.bus,
        "compressor": config.compressor.model_copy(update={"state_file": None}),
        "alerts": remote.alerts,
        "simulation": remote.simulation,
    }
    rehearsal = StandConfig.model_validate(config.model_copy(update=update).model_dump(mode="json", exclude_none=True))
    text = _HEAD + yaml.safe_dump(rehearsal.model_dump(mode="json", exclude_none=True), sort_keys=False)
    return load_register_maps(replace(order, config=rehearsal, config_text=text))


_FIRST_PORT = 15023  # of what has a line of its own


def _rehearse_flap(own: FlapSettings, remote: FlapSettings | None) -> FlapSettings:
    return own.model_copy(
        update={name: getattr(remote, name) for name in ("backend", "backend_address")} if remote is not None else {}
    )


def _rehearse_camera(own: CameraSettings, remote: CameraSettings) -> CameraSettings:
    """The simulated camera, asked for what this stand asks of its own."""
    names = CameraSettings.model_fields.keys() - _FOUND_BY
    return remote.model_copy(update={name: getattr(own, name) for name in names})


# A virtual run and its simulator on one CPU, which no other virtual run of this machine has taken.

_CPU_FOLDER = "/sys/devices/system/cpu/cpu{}"


@contextmanager
def pin_to_one_cpu() -> Generator[None]:
    """Inside, this process and its children (the simulator) run on one of the CPUs they may use.

    In virtual time daemon and simulator take turns, a dozen in each polled second, and never work at once. On one CPU a
    turn is a switch of context; on two it is waking an idle CPU, which takes longer than the answer. Runs side by side
    take different CPUs as long as there are any left.
    """
    usable = os.sched_getaffinity(0)
    cpu, folder = _choose_cpu(sorted(usable))
    _pin_threads({cpu})
    try:
        yield
    finally:
        _pin_threads(usable)
        if folder is not None:
            os.close(folder)


def _choose_cpu(cpus: Sequence[int]) -> tuple[int, int | None]:
    """The first of `cpus` that no other run has taken, and the descriptor that keeps it; when there is none, one by the
    process' number.

    It is taken by a lock on the kernel's own folder for that CPU: no file is left anywhere, and the lock ends with the
    process however that ends.
    """
    for cpu in cpus:
        try:
            folder = os.open(_CPU_FOLDER.format(cpu), os.O_RDONLY)
        except OSError:  # a system without these folders
            continue
        try:
            fcntl.flock(folder, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:  # taken
            os.close(folder)
        else:
            return cpu, folder
    return cpus[os.getpid() % len(cpus)], None


def _pin_threads(cpus: set[int]) -> None:
    """Every thread of this process: one that waits for work in a pool would start the simulator elsewhere."""
    for thread in os.listdir("/proc/self/task"):
        with suppress(ProcessLookupError):  # it has ended meanwhile
            os.sched_setaffinity(int(thread), cpus)


# Checked before the first step: the camera's own temperature, without which no frame is of use.

_TRIES, _PAUSE_S = 3, 1.0  # against single readings that fail; not measured


async def check_temperature(camera: Camera, hub: Hub, clock: Clock) -> None:
    """The camera, which is open, shows its temperature, or is configured to have none, which is reported.

    Refused, with the feature and what the camera offers, when three readings in a row are BAD.
    """
    if not camera.settings.has_temperature:
        hub.publish(NO_CAMERA_TEMPERATURE.at(clock.now_ns()))
        return
    (reading,) = await camera.read()
    for _ in range(_TRIES - 1):
        if reading.quality is not Quality.BAD:
            return
        await clock.sleep_until(clock.now_ns() + to_ns(_PAUSE_S))
        (reading,) = await camera.read()
    if reading.quality is Quality.BAD:
        place = await camera.describe_temperature_place()
        keys = f"cameras.{camera.name}"
        remedy = f"correct {keys}.temperature in the configuration, or say {keys}.has_temperature: false there"
        where = f" ({place})" if place else ""
        raise Refused(camera.name, f"its temperature is BAD before the first step: {reading.reason}{where}; {remedy}")


__all__ = ["Interrupted", "resume", "run_on_stand", "run_real", "run_virtual"]


# What answers the clients of a run, which records in this folder, while inside.
Front = Callable[[StandService, Path], AbstractAsyncContextManager[object]]


async def _ignore_session(_: Path) -> None:
    """Gets the session and does nothing."""


@asynccontextmanager
async def serve_by_socket(service: StandService, session: Path) -> AsyncGenerator[None]:
    """Clients of this machine and user alone: any number of virtual runs go side by side."""
    async with serve(service, session, service.stand, Interface(session.parent), service.shutdown_deadline):
        yield


async def run_virtual(
    order: Order,
    out: Path,
    seed: int | None,
    watch: Callable[[Hub], None],
    begun: Callable[[Path], Awaitable[None]] = _ignore_session,
    front: Front = serve_by_socket,
) -> Path:
    """Run against a simulated laboratory of its own, in virtual time; returns the session's folder.

    Of a real stand's file the devices are replaced.
    The laboratory takes free addresses, not the configured ones: any number of virtual runs go side by side.
    The same order and seed give the same session, byte for byte. `watch` may subscribe to the hub before the start;
    `begun` gets the folder as soon as a run that is killed could be resumed in it; `front` answers from then on.
    Raises Interrupted, StandTripped, SessionError when frames were lost, and what opening or a step raised.
    """
    order = make_rehearsal(order)
    simulation = order.config.simulation
    if simulation is None:
        raise ValueError("a rehearsal has a simulated laboratory")
    return await _run_virtual(Job(order, out, seed, watch, begun), front, to_ns(simulation.start.timestamp()))


async def run_real(
    order: Order,
    out: Path,
    watch: Callable[[Hub], None],
    begun: Callable[[Path], Awaitable[None]] = _ignore_session,
    front: Front = serve_by_socket,
) -> Path:
    """Run on the host's clock, against the devices at the configured addresses; else as run_virtual."""
    return await _run_with_restarts(Job(order, out, None, watch, begun), front, WallClock())


async def resume(
    before: Interruption, watch: Callable[[Hub], None], downtime_s: float = 60.0, front: Front = serve_by_socket
) -> Path:
    """Resume an interrupted run, in the time it was run in, and add to its session; raises as run_virtual.

    What is done is not done again. In virtual time the laboratory is a new one with a chamber at room temperature,
    `downtime_s` after the last recorded instant. When the host's clock is before that instant (it was set back since),
    the session continues at that instant, and the offset to UTC is recorded.
    """
    try:
        job = Job(before.order, before.directory.parent, before.seed, watch, _ignore_session, before)
        if is_of_virtual_time(before):
            return await _run_virtual(job, front, before.last_ns + to_ns(downtime_s))
        return await _run_with_restarts(job, front, WallClock(before.last_ns + 1))
    finally:
        before.release()


async def _run_with_restarts(job: Job, front: Front, clock: WallClock) -> Path:
    """Run on the host's clock. When the process that writes the session is killed, the stand is made safe and closed,
    and the run resumed with another one."""
    restarts, directory = WriterRestarts(), None if job.before is None else job.before.directory
    named = job.begun

    async def begun(folder: Path) -> None:
        nonlocal directory
        directory = folder
        await named(folder)

    job = replace(job, begun=begun)
    while True:
        stop = Stop()
        try:
            async with stop:
                return await _run(job, front, clock, None, stop)
        except StandTripped:
            if directory is None or stop.is_unsafe or not restarts.may_follow(stop.reason, clock.now_ns()):
                raise
        finally:
            if job.before is not None:
                job.before.release()
        await asyncio.to_thread(find_latch_file(job.order.config).reset)
        before = await asyncio.to_thread(partial(load_interruption, directory, job.order.config, reset=True))
        order = replace(before.order, attended=job.order.attended)
        before = replace(before, order=order)
        job, clock = replace(job, order=order, before=before, begun=_ignore_session), WallClock(before.last_ns + 1)


async def run_on_stand(open_stand: OpenStand, job: Job, stop: Stop) -> Path:
    """Run, or resume, on a stand that stays open behind it; returns the session's folder, and raises as run_virtual."""
    hub, early = open_stand.assembly.hub, _EarlyEvents()
    hub.subscribe(early)
    try:
        job.watch(hub)
        await _announce(job, open_stand.assembly, open_stand.disk, has_own=True)
        directory = _choose_directory(job, open_stand.assembly.clock)
        async with _memory_in_words(open_stand.assembly, directory), AsyncExitStack() as stack:
            disk = DiskProcess()
            stack.push_async_callback(disk.end_within, stop.shutdown_deadline)
            stack.callback(open_stand.end_recording)
            stack.push_async_callback(stop.wait_until_aborted)
            stop.watch(open_stand.assembly.stand)
            recorder = await _record_and_run(job, directory, open_stand, early, stop, disk)
            _check_outcome(directory, recorder, open_stand.assembly)
        return directory
    finally:
        open_stand.release_run()
        hub.unsubscribe(early)
        if job.before is not None:
            job.before.release()


async def _run_virtual(job: Job, front: Front, start_ns: int) -> Path:
    order = job.order
    laboratory = describe_laboratory(
        order.config, virtual=True, seed=job.seed, start_ns=start_ns, is_anywhere=not order.at_configured_addresses
    )
    async with Stop() as stop, AsyncExitStack() as stack:
        stack.enter_context(pin_to_one_cpu())
        simulator = await _start_simulator(laboratory)
        stack.push_async_callback(asyncio.to_thread, simulator.stop)
        control = ControlSocket(simulator.addresses["control"])
        stack.push_async_callback(control.close)
        await control.open()
        clock = VirtualClock(start_ns, control.advance, control.settle)
        remote = replace(job, order=replace(order, config=relocate(order.config, simulator.addresses)))
        return await _run(remote, front, clock, clock.run, stop)


async def _start_simulator(laboratory: Mapping[str, object]) -> Simulator:
    """The simulator process; when the run is stopped meanwhile, it is ended again."""
    starting = asyncio.ensure_future(asyncio.to_thread(Simulator, laboratory))
    try:
        return await asyncio.shield(starting)
    except asyncio.CancelledError:
        simulator = await starting
        await asyncio.to_thread(simulator.stop)
        raise


async def _run(job: Job, front: Front, clock: Clock, time: Time | None, stop: Stop) -> Path:
    """The whole run; one on a real stand has it for itself from before anything is opened, or does not touch it."""
    directory = _choose_directory(job, clock)
    async with lock_stand(job.order.config, directory) if isinstance(clock, WallClock) else nullcontext():
        if isinstance(clock, WallClock):
            await asyncio.to_thread(_check_latch, job)
        hub, early = Hub(RepeatLimit()), _EarlyEvents()
        job.watch(hub)
        hub.subscribe(early)
        if isinstance(clock, WallClock):
            time = ClockWatch(hub, clock, 0 if job.before is None else job.before.utc_offset_ns).run
        assembly = assemble(job.order.config, hub, clock)
        await _announce(job, assembly)
        alerts = send_alerts(assembly.config.name, assembly.config.alerts, hub, clock)
        async with alerts, _memory_in_words(assembly, directory):
            async with open_assembly(assembly, time, stop, is_for_one=True) as open_stand:
                answer = partial(_serve_clients, open_stand, directory, front)
                recorder = await _record_and_run(
                    job, directory, open_stand, early, stop, open_stand.disk, answer=answer
                )
            _check_outcome(directory, recorder, assembly)
    return directory


def _check_latch(job: Job) -> None:
    """StandTripped when the stand has tripped and nobody has reset it; a run that is resumed after its trip was
    reset resets it."""
    latch = find_latch_file(job.order.config)
    if job.before is not None and job.before.state.tripped:
        latch.reset()
    elif (fault := latch.read()) is not None:
        since = f" at {format_utc(fault.since_ns)}" if fault.since_ns else ""
        raise StandTripped(f"the stand has tripped{since}: {fault.text}; remove the cause, then `stand reset`")


def _choose_directory(job: Job, clock: Clock) -> Path:
    """The session's folder."""
    return job.before.directory if job.before is not None else choose_session_directory(job.out, job.order, clock)


async def _announce(job: Job, assembly: Assembly, disk: DiskProcess | None = None, *, has_own: bool = False) -> None:
    """Publish what the session has to say before anything moves; what earlier runs that were killed have left is
    completed. has_own: what is being recorded now is the stand's own record, which need not be announced."""
    hub, clock = assembly.hub, assembly.clock
    for segment in await _salvage(job, assembly.clock, disk):
        if has_own and segment.reason == BEING_RECORDED:
            continue
        hub.publish(SALVAGED.at(clock.now_ns(), format_salvaged(segment)))
    if accepted := job.order.config.list_accepted():
        hub.publish(LIMITS_OVERRIDDEN.at(clock.now_ns(), describe_accepted(accepted), **accepted))
    if job.before is not None and job.before.journal.damage:
        hub.publish(JOURNAL_DAMAGED.at(clock.now_ns(), job.before.journal.damage))
    for difference in () if job.before is None else job.before.differences:
        hub.publish(STAND_DIFFERS.at(clock.now_ns(), str(difference), **difference.data()))


async def _salvage(job: Job, clock: Clock, disk: DiskProcess | None) -> tuple[Salvaged, ...]:
    """Return what earlier runs that were killed have left unfinished, finished before anything moves; where a stand is
    open, by the process that touches its disk."""
    if job.before is not None:
        return job.before.salvaged
    if disk is not None:
        repair = DiskCalls(disk, REPAIR_LINE, clock)
        try:
            return tuple(await repair.call(salvage_unfinished, job.out))
        finally:
            repair.close()
    with show_late_progress("repair", 1.0) as report:
        return tuple(await asyncio.to_thread(salvage_unfinished, job.out, report))


@asynccontextmanager
async def _memory_in_words(assembly: Assembly, directory: Path) -> AsyncGenerator[None]:
    """A lack of memory is a StandError that says what is not safe."""
    try:
        yield
    except Exception as raised:
        if isinstance(error := find_cause(raised), MemoryError):
            unsafe = "; ".join(assembly.stand.safety.unconfirmed)
            text = f"{directory}: {describe_failure(error)}{unsafe and f'; NOT SAFE: {unsafe}'}"
            raise StandError(text) from raised
        raise


async def _record_and_run(
    job: Job,
    directory: Path,
    open_stand: OpenStand,
    early: _EarlyEvents,
    stop: Stop,
    disk: DiskProcess | None,
    *,
    answer: Callable[[], Work] | None = None,
) -> Recorder:
    """Record and run, from the camera's start to the end of the recording."""
    is_camera_on = job.before is None or job.before.kept.set_up.camera_on
    async with AsyncExitStack() as stack:
        publish_identities(open_stand.assembly, open_stand.assembly.hub.publish)
        if is_camera_on:
            await open_stand.run_or_make_safe(_power_camera(open_stand.assembly), stop)
        recorder = await open_stand.run_or_make_safe(
            _start_recorder(job, directory, open_stand.assembly, early, disk), stop
        )
        recording = asyncio.create_task(recorder.run())
        stack.push_async_callback(_finish, recorder, recording, stop)
        await Run(job, open_stand, recorder, stop, answer).run(recording)
    return recorder


async def _serve_clients(open_stand: OpenStand, directory: Path, front: Front) -> None:
    """Answer clients of a run by itself until cancelled; it can do without any."""
    assembly = open_stand.assembly
    try:
        async with front(StandService(Host(open_stand)), directory):
            await asyncio.Event().wait()
    except StandError as error:
        assembly.hub.publish(NO_CONTROL.at(assembly.clock.now_ns(), f"the run cannot be queried or paused: {error}"))
        await asyncio.Event().wait()


async def _power_camera(assembly: Assembly) -> None:
    """The camera is switched on before anything else may happen; one that is on and open stays so."""
    supply, cameras = assembly.stand.imaging.supply, assembly.devices.cameras.values()
    if cameras and not (supply.is_on and all(camera.is_usable for camera in cameras)):
        await supply.switch_on()
    elif cameras:
        supply.publish_identities()
    for camera in cameras:
        await check_temperature(camera, assembly.hub, assembly.clock)


async def _start_recorder(
    job: Job, directory: Path, assembly: Assembly, early: _EarlyEvents, disk: DiskProcess | None
) -> Recorder:
    """The recorder, started; a disk that refuses it leaves the stand safe, as everything after this does."""
    recorder = make_run_recorder(job.order, directory, _make_info(job, directory, assembly), assembly, disk)
    await recorder.begin(early.take)
    return recorder


def _make_info(job: Job, directory: Path, assembly: Assembly) -> SessionInfo:
    """The session's metadata; SessionError when the camera is another one than before the interruption."""
    if job.before is None:
        recipe, config = job.order.recipe.name, job.order.config
        return make_session_info(
            recipe, directory.name, config, list_camera_serials(assembly), assembly.clock, job.seed
        )
    if job.before.kept.set_up.camera_on:
        answers, recorded = list_camera_serials(assembly), job.before.info.camera_serial
        if answers != recorded:
            raise SessionError(f"{directory}: was recorded with camera {recorded}, now {answers} answers")
    return job.before.info


def _check_outcome(directory: Path, recorder: Recorder, assembly: Assembly) -> None:
    """Report what is wrong with a run that has done its whole plan: nobody may take such a stand for safe, or such a
    session for whole."""
    if unsafe := assembly.stand.safety.unconfirmed:
        raise StandTripped(f"{directory}: complete, but NOT SAFE: {'; '.join(unsafe)}")
    if recorder.frames_lost:
        raise SessionError(f"{directory}: complete, but {recorder.frames_lost} frames were lost; its events say why")


class _EarlyEvents:
    """A subscriber that keeps the events from before there is a recorder."""

    def __init__(self) -> None:
        self._events: list[Event] | None = []

    def __call__(self, item: Item) -> None:
        if self._events is not None and isinstance(item, Event):
            self._events.append(item)

    def take(self) -> tuple[Event, ...]:
        """Return what there was; nothing is kept from now on."""
        events, self._events = self._events or (), None
        return tuple(events)


async def _finish(recorder: Recorder, recording: asyncio.Task[None], stop: Stop) -> None:
    await cancel_all([recording])
    await recorder.finish(COMPLETE_WITHIN_S if stop.reason is None else FINISH_WITHIN_S, stop.shutdown_deadline)
