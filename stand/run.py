"""One run from beginning to end: open everything, record, perform the plan, leave the stand safe whatever happens."""

from __future__ import annotations

import asyncio
import importlib.metadata
import platform
import signal
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from drivers.clock import NS_PER_S, Clock, VirtualClock, WallClock
from drivers.interface import ConfigError, StandError, StandTripped
from stand.assembly import Assembly, assemble
from stand.config import StandConfig
from stand.hub import Event, Hub
from stand.interlocks import Fault
from stand.recipe import Recipe
from stand.recorder import Recorder, RecordingSettings, SessionInfo
from stand.scheduler import Scheduler
from stand.simulator import ControlSocket, Simulator, laboratory_of


@dataclass(frozen=True, slots=True)
class Order:
    """What to run: the checked files and their texts (they are attached to the recording)."""

    config: StandConfig
    recipe: Recipe
    config_text: str
    recipe_text: str
    target_text: str


class Interrupted(StandError):
    """The operator ended the run (Ctrl-C or SIGTERM); the stand was made safe first."""


async def run_virtual(order: Order, out: Path, seed: int | None, watch: Callable[[Hub], None]) -> Path:
    """Run against a simulated laboratory of its own, in virtual time; returns the session's folder.

    The same order and seed give the same session, byte for byte. `watch` may subscribe to the hub before the start.
    """
    laboratory = laboratory_of(order.config, virtual=True, seed=seed)
    simulation = order.config.simulation
    if simulation is None:
        raise ConfigError(f"{order.config.name}: virtual time needs a `simulation` section")
    simulator = await asyncio.to_thread(Simulator, laboratory)
    control = ControlSocket(simulation.control)
    try:
        await control.open()
        clock = VirtualClock(round(simulation.start.timestamp()) * NS_PER_S, control.advance)
        return await _run(order, out, clock, clock.run, watch)
    finally:
        await control.close()
        await asyncio.to_thread(simulator.stop)


async def run_real(order: Order, out: Path, watch: Callable[[Hub], None]) -> Path:
    """Run on the host's clock, against whatever answers at the configured addresses; returns the session's folder."""
    return await _run(order, out, WallClock(), None, watch)


async def _run(
    order: Order,
    out: Path,
    clock: Clock,
    time: Callable[[], Coroutine[None, None, None]] | None,
    watch: Callable[[Hub], None],
) -> Path:
    hub = Hub()
    watch(hub)
    assembly = assemble(order.config, hub, clock)
    directory = _session_directory(out, order, clock)
    async with AsyncExitStack() as stack:
        background: list[asyncio.Task[None]] = []
        stack.push_async_callback(_cancel, background)
        if time is not None:
            background.append(asyncio.create_task(time()))
        stack.push_async_callback(_close, assembly)
        await _watched(_open(assembly), background)
        recorder = Recorder(
            directory,
            _session_info(order, directory, clock, assembly),
            {"config.yaml": order.config_text, "recipe.yaml": order.recipe_text, "target.yaml": order.target_text},
            _kinds(order.config),
            hub,
            clock,
            RecordingSettings(order.config.recording.frame_encoding, order.config.recording.telemetry_commit_s),
        )
        recorder.start()
        stack.push_async_callback(recorder.finish)
        background.append(asyncio.create_task(recorder.run()))
        await _perform(assembly, order.recipe, background)
    return directory


async def _perform(assembly: Assembly, recipe: Recipe, background: list[asyncio.Task[None]]) -> None:
    """Poll, guard and run the plan; on every way out the actuators are safe before anything else is taken down."""
    hub, clock, stand = assembly.hub, assembly.clock, assembly.stand
    pollers = assembly.pollers()
    stopping: list[Fault] = []
    plan = asyncio.create_task(Scheduler(stand, hub, clock).run(recipe.plan()))

    def abort(fault: Fault) -> None:
        stopping.append(fault)
        plan.cancel()

    try:
        for poller in pollers:
            await _watched(poller.first(), background)
        background.extend(asyncio.create_task(poller.run()) for poller in pollers)
        background.append(asyncio.create_task(assembly.guard(abort).run()))
        hub.publish(Event(clock.now_ns(), "info", "run.start", f"recipe {recipe.name}"))
        with _signals(assembly, abort):
            await _watched(plan, background)
    except asyncio.CancelledError:
        if not stopping:
            raise
        hub.publish(Event(clock.now_ns(), "error", "run.end", f"aborted: {stopping[0].text}"))
        if stopping[0].rule == "operator":
            raise Interrupted(stopping[0].text) from None
        raise StandTripped(f"the run was aborted: {stopping[0].text}") from None
    except BaseException as error:
        hub.publish(Event(clock.now_ns(), "error", "run.end", f"failed: {error}"))
        raise
    else:
        hub.publish(Event(clock.now_ns(), "info", "run.end", "complete"))
    finally:
        plan.cancel()
        if not stopping:  # else that was the first thing done
            await stand.make_safe()
        # One more look at every device, so that the recording ends with the safe state as the wire tells it.
        for poller in pollers:
            await poller.poll()


class _signals:
    """SIGINT and SIGTERM make the stand safe, then abort the plan."""

    def __init__(self, assembly: Assembly, abort: Callable[[Fault], None]) -> None:
        self._assembly = assembly
        self._abort = abort
        self._task: asyncio.Task[None] | None = None

    def __enter__(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, self._stop)

    def __exit__(self, *_: object) -> None:
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().remove_signal_handler(number)

    def _stop(self) -> None:
        if self._task is None:
            self._task = asyncio.create_task(self._make_safe())

    async def _make_safe(self) -> None:
        fault = Fault("operator", "stopped by the operator")
        self._assembly.stand.latch(fault)
        await self._assembly.stand.make_safe()
        self._abort(fault)


async def _watched(
    work: Coroutine[None, None, None] | asyncio.Task[None], background: list[asyncio.Task[None]]
) -> None:
    """Await `work`, but raise at once what a background task raises: without time or polls nothing would wake it."""
    task = asyncio.ensure_future(work)
    try:
        pending = set(background)
        while not task.done():
            done, _ = await asyncio.wait({task, *pending}, return_when=asyncio.FIRST_COMPLETED)
            for finished in done - {task}:
                pending.discard(finished)
                finished.result()
        await task
    finally:
        task.cancel()


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
    await devices.camera.close()
    for axis in devices.axes.values():
        await axis.close()
    await devices.flap.close()
    await assembly.bus.close()


async def _cancel(tasks: list[asyncio.Task[None]]) -> None:
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)


def _session_directory(out: Path, order: Order, clock: Clock) -> Path:
    started = datetime.fromtimestamp(clock.now_ns() / NS_PER_S, UTC)
    directory = out / f"{started:%Y%m%dT%H%M%SZ}-{order.recipe.name}"
    if directory.exists():
        raise ConfigError(f"{directory}: this session exists already; choose another --out or move it away")
    return directory


def _session_info(order: Order, directory: Path, clock: Clock, assembly: Assembly) -> SessionInfo:
    return SessionInfo(
        session_id=directory.name,
        recipe=order.recipe.name,
        operator=order.config.operator,
        camera_serial=assembly.devices.camera.identity.serial_number,
        software_version=importlib.metadata.version("thermostand"),
        clock_source="virtual" if isinstance(clock, VirtualClock) else "wall",
        host=platform.node(),
    )


def _kinds(config: StandConfig) -> dict[str, str]:
    """Device name -> what kind of device it is, for the recorder's topics."""
    kinds = {name: name for name in ("regulator", "relays", "thermometers", "camera", "flap")}
    return {**kinds, **{str(name): "axis" for name in config.axes}}
