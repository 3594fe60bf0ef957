"""How long a driver's call holds the event loop: every callback that runs while the call is under way is timed.

The simulated laboratory is another process, in real time; devices are opened as a run opens them. A callback from which
the kernel took the processor for another program says nothing of ours and is left out; one that waits for anything
(a disk, a wire, a lock of a worker thread) counts whole.
"""

from __future__ import annotations

import asyncio
import resource
import time
from asyncio.events import Handle
from collections.abc import Awaitable, Callable, Generator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, cast

from tests.bench.figures import Figure, at_most, progress, skipped
from tests.system.simulated_orders import simulated_order
from thermostand.drivers.framing.aravis_library import library
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import DeviceError, StandError
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly import Assembly, assemble
from thermostand.stand.running.opening.open_stand import close_devices
from thermostand.stand.running.order import Order
from thermostand.stand.simulator import ControlSocket, Simulator, laboratory_of

LIMIT_ms = 5.0
READS, FRAMES = 40, 12
RECIPE = "name: bench\nexperiments: [thermal_cycle: {set_points_degC: [24]}]\n"

Call = Callable[[], Awaitable[object]]


def figures(directory: Path) -> list[Figure]:
    """The longest for each device, ms: while all is well, and while it cannot be reached, its return included."""
    what = "event loop held by a driver's call"
    try:
        library()
    except StandError as error:
        return [skipped(what, error)]
    order = simulated_order(directory, RECIPE)
    simulator = Simulator(laboratory_of(order.config, virtual=False, seed=None))
    try:
        found = asyncio.run(_longest_ms(assemble(order.config, Hub(), WallClock()), ControlSocket(_control(order))))
    finally:
        simulator.stop()
    return [
        at_most(LIMIT_ms, Figure(f"{what}: {name} ({count} callbacks)", "ms", worst_ms))
        for name, (worst_ms, count) in found.items()
    ]


def _control(order: Order) -> str:
    if order.config.simulation is None:
        raise ValueError("the stand is not simulated")
    return order.config.simulation.control


async def _longest_ms(assembly: Assembly, control: ControlSocket) -> dict[str, tuple[float, int]]:
    devices, found = assembly.devices, dict[str, tuple[float, int]]()
    await control.open()
    await assembly.bus.open()
    await devices.relays.open()
    await devices.relays.switch("camera_power", on=True)
    await asyncio.sleep(assembly.config.cameras["camera"].boot_s)
    linear, camera = devices.axes["linear"], devices.cameras["camera"]
    calls: dict[str, list[tuple[Call, int]]] = {
        "regulator": [
            (devices.regulator.open, 1),
            (devices.regulator.read, READS),
            (lambda: devices.regulator.set_temperature(24.0), 5),
        ],
        "relays": [(devices.relays.read, READS), (lambda: devices.relays.hold_on("heater_enable", 1.0), 5)],
        "thermometers": [(devices.thermometers.open, 1), (devices.thermometers.read, READS)],
        "flap": [
            (devices.flap.open, 1),
            (devices.flap.read, READS),
            (devices.flap.move_open, 1),
            (devices.flap.move_closed, 1),
        ],
        "stage": [(linear.open, 1), (linear.read, READS), (linear.home, 1), (lambda: linear.move_to(2.0), 1)],
        "camera": [(camera.open, 1), (camera.read, READS), (camera.grab, FRAMES)],
    }
    for name, works in calls.items():
        progress(f"calls of the {name}")
        with _timed() as callbacks:
            for call, times in works:
                for _ in range(times):
                    await call()
        found[name] = (1e3 * max(callbacks), len(callbacks))
    gone: dict[str, tuple[str, list[Call]]] = {
        "regulator": ("bus.unplugged", [devices.regulator.read]),
        "stage": ("linear.unplugged", [linear.read, lambda: linear.move_to(3.0)]),
        "flap": ("flap.unplugged", [devices.flap.read, devices.flap.move_closed]),
        "camera": ("camera.silent", [camera.grab, camera.read, camera.open]),
    }
    for name, (fault, lost) in gone.items():
        progress(f"{name} while {fault}")
        with _timed() as callbacks:
            for is_broken in (True, False):
                await control.request({"do": "fault", "name": fault, "value": is_broken})
                for call in [*lost, *lost]:
                    with suppress(DeviceError):
                        await call()
        found[f"{name}, {fault}"] = (1e3 * max(callbacks), len(callbacks))
    await control.close()
    await close_devices(assembly)
    return found


@contextmanager
def _timed() -> Generator[list[float]]:
    """How long each callback of the loop takes, s."""
    usual, taken = cast("Any", Handle)._run, list[float]()

    def run(self: Handle) -> None:
        before, begin_s = resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw, time.perf_counter()
        usual(self)
        took_s = time.perf_counter() - begin_s
        if resource.getrusage(resource.RUSAGE_THREAD).ru_nivcsw == before:
            taken.append(took_s)

    cast("Any", Handle)._run = run
    try:
        yield taken
    finally:
        cast("Any", Handle)._run = usual
