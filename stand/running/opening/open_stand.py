"""A stand from before anything is opened until all is closed: devices, guard, pollers, keeper and safety.

Runs are its guests, one at a time: each brings a plan, a recorder and a journal, and leaves a safe stand. The guard
looks from before the first guest comes until the last has left, and does not pause in between.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncGenerator, Callable, Coroutine, Sequence
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from typing import Protocol, TypeVar, cast

from thermostand.drivers.devices.protocols import Actuator
from thermostand.foundation.clock import VirtualClock, WallClock
from thermostand.foundation.errors import DeviceFault, StandError, Unreachable
from thermostand.foundation.hub import Hub
from thermostand.foundation.repeat_limit import RepeatLimit
from thermostand.foundation.shutdown_deadline import ShutdownDeadline
from thermostand.foundation.tasks import cancel_all, run_with_background
from thermostand.recording.writing.disk import FILES_LINE, LATCH_LINE, DiskProcess
from thermostand.stand.assembly.assemble import Assembly, assemble
from thermostand.stand.assembly.poller import Poller
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.guarding.guard import Guard
from thermostand.stand.guarding.interlocks import Recording
from thermostand.stand.guarding.rules import Announcements
from thermostand.stand.running.opening.holds import keep_flap_closed_in_holds
from thermostand.stand.running.opening.stand_lock import find_latch_file, lock_stand
from thermostand.stand.running.opening.stop import Stop
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import CAMERA_LOST, DISK_LOW, NOT_RECORDED, OPERATOR, STOPPING

_OPENING_SAFE_LIMIT_S = 60.0  # for what was opened before something else failed; nothing has been permitted yet

# What drives virtual time, or looks after the real one.
Time = Callable[[], Coroutine[None, None, None]]
Result = TypeVar("Result")


class RunRecorder(Recording, Protocol):
    """The recorder of what is recorded now, by a run or between runs."""

    def recover_folder(self) -> None:
        """An operator has reset the loss of its folder."""
        ...


class RunHandle(Protocol):
    """The run that has the stand."""

    @property
    def frames_to_come(self) -> bool:
        """Whether its plan still captures."""
        ...

    def trip(self, fault: Fault) -> None:
        """The guard ends the run."""
        ...

    def hold(self, fault: Fault) -> None:
        """The guard holds the run: to be journaled."""
        ...


class OpenStand:
    """The open stand. `recorder` is what heat depends on; set it before `prepare`.

    is_for_one: it is closed with its one guest; else a trip stays until an operator resets it, guest or not. latch:
    whether the stand has tripped. background: tasks that must not end, from the opening on.
    shutdown_deadline: with the disk, when the last guest has left and the stand is safe.
    """

    def __init__(
        self, assembly: Assembly, disk: DiskProcess | None, deadline: ShutdownDeadline, *, is_for_one: bool
    ) -> None:
        self.assembly = assembly
        self.latch = assembly.stand.latch
        self.disk = disk
        self.shutdown_deadline = deadline
        self.is_for_one = is_for_one
        self.background: list[asyncio.Task[None]] = []
        self.recorder: RunRecorder | None = None
        self.active_run: RunHandle | None = None
        self._announced = Announcements()
        self._guard: Guard | None = None
        self._pollers: tuple[Poller, ...] = ()
        self._tasks: list[asyncio.Task[None]] = []

    @property
    def guard(self) -> Guard:
        """The guard, which exists after `prepare`."""
        if self._guard is None:
            raise ValueError("a stand is guarded when it is prepared")
        return self._guard

    def reset(self) -> str:
        """An operator has removed the cause of what is latched: the gate is let go, and what is still wrong trips
        again, which is returned in words; "" when nothing is wrong."""
        if self.latch.fault is not None:
            self._release()
            self.guard.recheck_holds()
        return "" if self._guard is None else self._guard.describe_remaining_faults()

    def is_well(self) -> bool:
        """Return whether the guard looks as often as it must, and finds nothing."""
        return self._guard is not None and self._guard.is_on_time and self.latch.fault is None

    @property
    def tasks(self) -> tuple[asyncio.Task[None], ...]:
        """The tasks whose end ends everything."""
        return (*self.background, *self._tasks)

    def prepare(self) -> None:
        """Guard and pollers, unless there are some. From now on nothing is permitted without the guard."""
        if self._guard is not None:
            return
        self._pollers = self.assembly.make_pollers()
        self._guard = self.assembly.make_guard(
            self._trip,
            self._hold,
            self._release,
            _Recorded(self),
            self._frames_are_due,
            self._announced,
        )
        self._guard.keeps_running = not self.is_for_one

    async def read_once(self) -> None:
        """Every device is read and published now; DeviceError the first time, when one cannot be read."""
        for poller in self._pollers:
            await (poller.poll() if self._tasks else poller.first())

    def start(self) -> None:
        """Poll, guard and keep, unless that goes on already, until the last guest's `rest` or `close`."""
        if self._tasks:
            return
        stand, hub, clock = self.assembly.stand, self.assembly.hub, self.assembly.clock
        works = [
            *(poller.run() for poller in self._pollers),
            self.guard.run(),
            stand.chamber.permit_renewer.run(),
            *((keep_flap_closed_in_holds(stand, hub, clock),) if self.assembly.config.flap is not None else ()),
            stand.imaging.supply.recovery.keep_open(),
        ]
        self._tasks.extend(map(asyncio.create_task, works))

    async def run_or_make_safe(self, work: Coroutine[None, None, Result], stop: Stop) -> Result:
        """Return what `work` returns; when it fails or is stopped before anything was permitted, all that already
        answers is made safe."""
        try:
            return await run_with_background(work, self.tasks)
        except BaseException:
            stop.begin_takedown()
            safety = self.assembly.stand.safety
            safety.demand()
            try:
                await safety.wait_until_confirmed(min(_OPENING_SAFE_LIMIT_S, self.assembly.config.guard.safe_limit_s))
            finally:
                if not self._tasks:
                    await safety.close()
            raise

    async def make_safe_and_stop(self, tasks: Sequence[asyncio.Task[None]] = ()) -> None:
        """The actuators safe, tried until they confirm it, and the guest's `tasks` ended, with the last guest all that
        could move them; then one more look at every device, so that a recording ends with the safe state as read from
        the wire."""
        safety = self.assembly.stand.safety
        try:
            safety.demand()
            await safety.wait_until_confirmed(self.assembly.config.guard.safe_limit_s)
        finally:
            await cancel_all([*tasks, *(self._tasks if self.is_for_one else ())])
            if self.is_for_one:
                await safety.close()
        for poller in self._pollers:
            await poller.poll()

    async def start_shutdown_deadline(self) -> None:
        """Nobody waits long for a disk once the stand is safe."""
        await self.assembly.stand.safety.wait_until_settled()
        self.shutdown_deadline.begin()

    async def close(self) -> None:
        """Safe for the last time; may be called when nothing was started."""
        self.is_for_one = True
        if self._tasks:
            await self.make_safe_and_stop()

    def end_recording(self) -> None:
        """The recording has ended, and nothing is heated before there is another one."""
        self.recorder = None
        if self._guard is not None:
            self._guard.recording_ended()

    def release_run(self) -> None:
        """The guest has gone, and what it alone was held for counts no more. A fault stays until it is reset."""
        self.active_run = None
        if self.is_for_one:
            return
        stand = self.assembly.stand
        self.latch.hold_gate()
        for reason in (STOPPING, OPERATOR, CAMERA_LOST, DISK_LOW, NOT_RECORDED):
            stand.gate.clear(reason)
        self._announced.forget()
        stand.table.forget_positions()
        stand.safety.reset_give_up()
        stand.attended = False

    def _trip(self, fault: Fault) -> None:
        if self.active_run is None:
            return self._hold(fault)
        return self.active_run.trip(fault)

    def _hold(self, fault: Fault) -> None:
        self.latch.hold_gate()
        if self.active_run is not None:
            self.active_run.hold(fault)

    def _frames_are_due(self) -> bool:
        """Return whether frames are due from the camera, which is powered."""
        return (
            self.assembly.stand.imaging.supply.is_on and self.active_run is not None and self.active_run.frames_to_come
        )

    def _release(self) -> None:
        """The guard's hold is over. Of a folder that is lost another one is made."""
        self.latch.reset()
        self.assembly.stand.chamber.permits.clear_intrusions()
        self.assembly.stand.safety.cancel_pending()
        if self.recorder is not None:
            self.recorder.recover_folder()
        self.guard.reset_grace_times()


class _Recorded:
    """What the guard asks of the recording, whichever that is."""

    def __init__(self, open_stand: OpenStand) -> None:
        self._open_stand = open_stand

    @property
    def waiting_since_ns(self) -> int | None:
        return None if self._open_stand.recorder is None else self._open_stand.recorder.waiting_since_ns

    @property
    def folder_lost(self) -> str:
        return "" if self._open_stand.recorder is None else self._open_stand.recorder.folder_lost

    @property
    def writer_ended(self) -> str:
        return "" if self._open_stand.recorder is None else self._open_stand.recorder.writer_ended


@asynccontextmanager
async def open_assembly(
    assembly: Assembly, time: Time | None, stop: Stop, *, is_for_one: bool
) -> AsyncGenerator[OpenStand]:
    """The stand, open and harmless: heat and cold have lost what permission somebody left them, the flap is closed and
    the relay board's timer tested. Everything is closed at the end; what moves has to be safe before that.

    Raises what opening raises; what answered until then was made safe.
    """
    async with AsyncExitStack() as stack:
        disk = None if isinstance(assembly.clock, VirtualClock) else DiskProcess()
        latch = None
        if disk is not None:
            latch = await asyncio.to_thread(find_latch_file, assembly.config)
            stack.push_async_callback(disk.end_within, stop.shutdown_deadline)
            assembly.stand.chamber.compressor_file.delegate_to(disk.line(FILES_LINE).run)
            latch.run = disk.line(LATCH_LINE).run
        stack.push_async_callback(assembly.stand.chamber.compressor_file.close, stop.shutdown_deadline)
        open_stand = OpenStand(assembly, disk, stop.shutdown_deadline, is_for_one=is_for_one)
        assembly.stand.latch.file = latch
        stack.push_async_callback(cancel_all, open_stand.background)
        if time is not None:
            open_stand.background.append(asyncio.create_task(time()))
        stack.push_async_callback(close_devices, assembly)
        stack.callback(assembly.stand.gate.remove_listeners)
        stack.push_async_callback(stop.wait_until_aborted)
        stop.watch(assembly.stand)
        await open_stand.run_or_make_safe(_open_devices(assembly, is_for_one=is_for_one), stop)
        yield open_stand


async def _open_devices(assembly: Assembly, *, is_for_one: bool) -> None:
    """Connect everything; nothing may heat, cool or move before that. DeviceFault when the one run it is for could not
    control: its set-point would not be in force."""
    devices, stand = assembly.devices, assembly.stand
    try:
        await assembly.bus.open()
    except Unreachable as error:
        if assembly.config.simulation is None:
            raise
        remedy = "`stand simulate` starts the simulated laboratory, in another terminal"
        raise Unreachable(error.device, f"{error.text}; {remedy}") from error
    for each in assembly.equipment:
        if not each.kind.is_opened:
            continue
        device = devices.every[each.name]
        await device.open()
        if hasattr(device, "make_safe"):
            stand.opened(cast("Actuator", device))
        if device is devices.relays:
            await stand.chamber.permits.switch_off_left_on()
        elif device is devices.flap:
            await devices.flap.move_closed()
        elif device is devices.regulator:
            await devices.regulator.stop()
            if is_for_one and (objections := (await devices.regulator.in_force()).objections):
                raise DeviceFault(device.name, f"its set-point is not in force: {'; '.join(objections)}")
    await stand.chamber.test_dead_man()


async def make_safe(assembly: Assembly, stop: Stop) -> tuple[str, ...]:
    """Make safe, at the end of a stand without a guard, all that may have moved, and return what has not confirmed it
    within guard.safe_limit_s."""
    stop.begin_takedown()
    await stop.wait_until_aborted()
    safety = assembly.stand.safety
    safety.demand()
    await safety.wait_until_confirmed(assembly.config.guard.safe_limit_s)
    await safety.close()
    return safety.unconfirmed


@asynccontextmanager
async def open_bench(config: StandConfig, command: str) -> AsyncGenerator[Assembly]:
    """A stand that is looked at without a run: locked as for one, nothing is open, and at the end every wire is let go.

    InUse when another program has it: then nothing was touched. ConfigError as `assemble`.
    """
    async with AsyncExitStack() as stack:
        await stack.enter_async_context(lock_stand(config, None, command))
        assembly = assemble(config, Hub(RepeatLimit()), WallClock())
        stack.push_async_callback(assembly.stand.chamber.compressor_file.close)
        stack.push_async_callback(close_devices, assembly)
        yield assembly


async def close_devices(assembly: Assembly) -> None:
    """Let go of every wire; actuators stay as they are."""
    await asyncio.gather(*(_close_quietly(device.close()) for device in assembly.devices.every.values()))
    await assembly.bus.close()


async def _close_quietly(closing: Coroutine[None, None, None]) -> None:
    with suppress(StandError):  # closing never decides a run, and one device must not keep the others from it
        await closing
