"""One run from beginning to end: open everything, record, perform the plan, leave the stand safe whatever happens."""

from __future__ import annotations

import asyncio
import signal
from collections.abc import Callable, Coroutine, Mapping
from contextlib import AsyncExitStack, suppress
from pathlib import Path

from drivers.clock import Clock, VirtualClock, WallClock, seconds_ns
from drivers.interface import ConfigError, SessionError, StandError, StandTripped
from stand.assembly import Assembly, assemble
from stand.hub import Event, Hub
from stand.interlocks import Fault
from stand.recipe import Recipe
from stand.recording.recorder import Recorder
from stand.recording.salvage import salvage_unfinished
from stand.scheduler import Scheduler
from stand.session_setup import Order, recorder_of, session_directory
from stand.session_text import salvage_line
from stand.simulator import ControlSocket, Simulator, laboratory_of
from stand.stand import Stand


class Interrupted(StandError):
    """The operator ended the run (Ctrl-C or SIGTERM); the text says whether the stand confirmed its safe state."""


async def run_virtual(order: Order, out: Path, seed: int | None, watch: Callable[[Hub], None]) -> Path:
    """Run against a simulated laboratory of its own, in virtual time; returns the session's folder.

    The same order and seed give the same session, byte for byte. `watch` may subscribe to the hub before the start.
    Raises Interrupted, StandTripped, SessionError when frames were lost, and what opening or a step raised.
    """
    laboratory = laboratory_of(order.config, virtual=True, seed=seed)
    simulation = order.config.simulation
    if simulation is None:
        raise ConfigError(f"{order.config.name}: virtual time needs a `simulation` section")
    start_ns = seconds_ns(simulation.start.timestamp())
    async with Stop() as stop, AsyncExitStack() as stack:
        simulator = await _started(laboratory)
        stack.push_async_callback(asyncio.to_thread, simulator.stop)
        control = ControlSocket(simulation.control)
        stack.push_async_callback(control.close)
        await control.open()
        clock = VirtualClock(start_ns, control.advance)
        return await _run(order, out, clock, clock.run, watch, stop)


async def run_real(order: Order, out: Path, watch: Callable[[Hub], None]) -> Path:
    """Run on the host's clock, against whatever answers at the configured addresses; else as run_virtual."""
    async with Stop() as stop:
        return await _run(order, out, WallClock(), None, watch, stop)


class Stop:
    """The one way a run ends early, for the guard and for the operator (SIGINT, SIGTERM): `stop(fault)`.

    The run is cancelled where it waits, once, and not while it is being taken down; what it then raises becomes
    Interrupted or StandTripped with the first reason. The stand's own latch is closed first.
    """

    def __init__(self) -> None:
        self.stand: Stand | None = None
        self.fault: Fault | None = None
        self._cancellable = True

    def __call__(self, fault: Fault) -> None:
        """Latch and cancel; making safe is the caller's next step, and the run's last."""
        self.fault = self.fault or fault
        if self.stand is not None:
            self.stand.latch(fault)
        if self._cancellable:
            self.taking_down()
            self._run.cancel()

    def taking_down(self) -> None:
        """From here on the run cleans up and must not be cancelled."""
        self._cancellable = False

    async def __aenter__(self) -> Stop:
        running = asyncio.current_task()
        if running is None:
            raise ValueError("a run is stopped by its task; there is none")
        self._run = running
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, self, Fault("operator", "stopped by the operator"))
        return self

    async def __aexit__(self, kind: type[BaseException] | None, error: BaseException | None, _: object) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().remove_signal_handler(number)
        if self.fault is None or error is None:
            return
        unsafe = self.stand.unconfirmed if self.stand is not None else ()
        text = f"{self.fault.text}; " + (f"NOT SAFE: {'; '.join(unsafe)}" if unsafe else "the stand is safe")
        if isinstance(error, SessionError):
            text = f"{text}; {error}"
        if isinstance(error, asyncio.CancelledError):
            self._run.uncancel()
        raise (Interrupted(text) if self.fault.rule == "operator" else StandTripped(text)) from error


async def _started(laboratory: Mapping[str, object]) -> Simulator:
    """The simulator process; when the run is stopped meanwhile, it is ended again."""
    starting = asyncio.ensure_future(asyncio.to_thread(Simulator, laboratory))
    try:
        return await asyncio.shield(starting)
    except asyncio.CancelledError:
        simulator = await starting
        await asyncio.to_thread(simulator.stop)
        raise


async def _run(
    order: Order,
    out: Path,
    clock: Clock,
    time: Callable[[], Coroutine[None, None, None]] | None,
    watch: Callable[[Hub], None],
    stop: Stop,
) -> Path:
    hub = Hub()
    watch(hub)
    await _salvage(out, hub, clock)
    assembly = assemble(order.config, hub, clock)
    directory = session_directory(out, order, clock)
    async with AsyncExitStack() as stack:
        background: list[asyncio.Task[None]] = []
        stack.push_async_callback(_cancel, background)
        if time is not None:
            background.append(asyncio.create_task(time()))
        stack.push_async_callback(_close, assembly)
        stop.stand = assembly.stand
        await _opened(assembly, background, stop)
        recorder = recorder_of(order, directory, assembly)
        recorder.start()
        recording = asyncio.create_task(recorder.run())
        stack.push_async_callback(_finish, recorder, recording)
        await _perform(assembly, order.recipe, [*background, recording], stop)
    if recorder.frames_lost:
        raise SessionError(f"{directory}: complete, but {recorder.frames_lost} frames were lost; its events say why")
    return directory


async def _salvage(out: Path, hub: Hub, clock: Clock) -> None:
    """Finish what an earlier run that was killed has left unfinished, before anything moves."""
    for segment in await asyncio.to_thread(salvage_unfinished, out):
        hub.publish(Event(clock.now_ns(), "warning", "salvaged", salvage_line(segment)))


async def _perform(assembly: Assembly, recipe: Recipe, background: list[asyncio.Task[None]], stop: Stop) -> None:
    """Poll, guard and run the plan; on every way out the actuators are safe before anything else is taken down."""
    hub, clock, stand = assembly.hub, assembly.clock, assembly.stand
    pollers, guard = assembly.pollers(), assembly.guard(stop)
    watchers: list[asyncio.Task[None]] = []
    try:
        for poller in pollers:
            await _watched(poller.first(), background)
        hub.publish(Event(clock.now_ns(), "info", "run.start", f"recipe {recipe.name}"))
        await guard.check()  # nothing moves before the rules have held once
        watchers.extend(asyncio.create_task(poller.run()) for poller in pollers)
        watchers.append(asyncio.create_task(guard.run()))
        await _watched(Scheduler(stand, hub, clock).run(recipe.plan()), [*background, *watchers])
    except BaseException as error:
        reason = f"aborted: {stop.fault.text}" if stop.fault is not None else f"failed: {error or 'cancelled'}"
        hub.publish(Event(clock.now_ns(), "error", "run.end", reason))
        raise
    else:
        hub.publish(Event(clock.now_ns(), "info", "run.end", "complete"))
    finally:
        stop.taking_down()
        await stand.make_safe()
        await _cancel(watchers)
        # One more look at every device, so that the recording ends with the safe state as the wire tells it.
        for poller in pollers:
            await poller.poll()


async def _watched(work: Coroutine[None, None, None], background: list[asyncio.Task[None]]) -> None:
    """Await `work`, but raise at once what a background task raises: without time or polls nothing would wake it.

    On any other way out than its own, `work` has ended before this returns.
    """
    task = asyncio.create_task(work)
    try:
        pending = set(background)
        while not task.done():
            done, _ = await asyncio.wait({task, *pending}, return_when=asyncio.FIRST_COMPLETED)
            for finished in done - {task}:
                pending.discard(finished)
                finished.result()
        await task
    finally:
        await _cancel([task])


async def _opened(assembly: Assembly, background: list[asyncio.Task[None]], stop: Stop) -> None:
    """Open everything; when that fails or is stopped half-way, whatever already answers is made safe."""
    try:
        await _watched(_open(assembly), background)
    except BaseException:
        stop.taking_down()
        await assembly.stand.make_safe()
        raise


async def _open(assembly: Assembly) -> None:
    """Connect everything; the flap is closed and the camera switched on before anything else may happen."""
    devices = assembly.devices
    await assembly.bus.open()
    await devices.relays.open()
    await devices.regulator.open()
    await devices.regulator.stop()
    await devices.thermometers.open()
    await devices.flap.open()
    await devices.flap.move_closed()
    for axis in devices.axes.values():
        await axis.open()
    await assembly.stand.power_camera(on=True)


async def _close(assembly: Assembly) -> None:
    devices = assembly.devices
    for close in (devices.camera.close, *(axis.close for axis in devices.axes.values()), devices.flap.close):
        with suppress(StandError):  # closing never decides a run, and one device must not keep the next from it
            await close()
    await assembly.bus.close()


async def _finish(recorder: Recorder, recording: asyncio.Task[None]) -> None:
    await _cancel([recording])
    await recorder.finish()


async def _cancel(tasks: list[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
