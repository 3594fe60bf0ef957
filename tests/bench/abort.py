"""From the operator's Ctrl-C, and from the guard's look at a value above its limit, to the heater confirmed off.

A whole stand in real time against the simulator in a process of its own, heating, polled ten times as often as in a
session, so that a trip finds the bus busy. Confirmed means: the relay driver has read the coil back. After
every trip the simulator is asked, too.
"""

from __future__ import annotations

import asyncio
import math
import os
import random
import signal
import statistics
import time
from collections.abc import AsyncGenerator, Awaitable, Callable
from contextlib import asynccontextmanager, suppress
from dataclasses import replace
from pathlib import Path

from tests.bench.figures import Figure, report_progress, set_upper_goal
from tests.bench.waiting import compare_with_waiting, compute_p99, run_waiting_process
from tests.system.simulated_orders import simulated_order
from thermostand.drivers.devices.relays import Relays
from thermostand.drivers.wires.registers import load_register_map
from thermostand.foundation.clock import WallClock, to_ns
from thermostand.foundation.errors import StandTripped
from thermostand.foundation.hub import Hub
from thermostand.foundation.tasks import cancel_all
from thermostand.stand.assembly.assemble import Assembly, assemble
from thermostand.stand.assembly.simulator import ControlSocket, Simulator, describe_laboratory
from thermostand.stand.assembly.stand import Devices, Stand
from thermostand.stand.chamber.chamber import ChamberLimits
from thermostand.stand.chamber.permits import PermitLimits
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.guarding.guard import Guard
from thermostand.stand.guarding.interlocks import (
    limit_temperature,
)
from thermostand.stand.imaging.camera_supply import SupplyLimits
from thermostand.stand.running.opening.stop import Interrupted, Stop
from thermostand.stand.safety.fault import Watch

TRIPS = 60  # of each kind
LIMIT_ms = 20.0
POLL_s = 0.1
RECIPE = """
name: bench
experiments:
  - thermal_cycle: {set_points_degC: [30]}
"""
HEATER = "heater_enable"

Trip = Callable[[Stand, Assembly], Awaitable[float]]


def figures(directory: Path) -> list[Figure]:
    """99th percentiles of both, ms."""
    config = simulated_order(directory, RECIPE, POLL_s).config
    report_progress(f"abort, {TRIPS} times by the operator and {TRIPS} times by the guard")
    with run_waiting_process() as waited_ms, asyncio.Runner() as runner:
        by_operator, by_guard = runner.run(_measure(config))
    return [make_figure("Ctrl-C", by_operator, waited_ms), make_figure("guard's trip", by_guard, waited_ms)]


def make_figure(what: str, times_ms: list[float], waited_ms: list[float]) -> Figure:
    """99th percentile of these times from `what` to the heater off, beside a process that only waited."""
    seen = f"p99 of {len(times_ms)}; median {statistics.median(times_ms):.1f}, longest {max(times_ms):.1f} ms"
    found = Figure(f"{what} to heater confirmed off", "ms", compute_p99(times_ms), seen)
    return set_upper_goal(LIMIT_ms, compare_with_waiting(found, waited_ms))


class WatchedRelays(Relays):
    """Relays that note when the heater's was confirmed off, the first time after `heater_off_s` was set to NaN."""

    heater_off_s = math.nan

    async def switch(self, channel: str, on: bool) -> None:
        """As ever."""
        await super().switch(channel, on)
        if channel == HEATER and not on and math.isnan(self.heater_off_s):
            self.heater_off_s = time.perf_counter()


async def _measure(config: StandConfig) -> tuple[list[float], list[float]]:
    """ms of each trip by the operator, and by the guard."""
    draw = random.Random(1)
    async with open_polled_stand(config) as (assembly, control):
        times_ms = [
            [
                await measure_trip_ms(assembly, control, trip, draw.uniform(0.0, POLL_s))
                for trip in (_trip_by_operator, _trip_by_guard)
            ]
            for _ in range(TRIPS)
        ]
    by_operator, by_guard = zip(*times_ms, strict=True)
    return list(by_operator), list(by_guard)


async def measure_trip_ms(assembly: Assembly, control: ControlSocket, trip: Trip, delay_s: float) -> float:
    """One trip, `delay_s` after a stand never tripped before has begun to heat."""
    relays = assembly.devices.relays
    config = assembly.config
    permits = PermitLimits(config.guard.heater_hold_s, config.relays.self_test_s, config.compressor)
    chamber = ChamberLimits(config.limits.chamber_degC, permits, config.guard.heater_renew_s)
    supply = SupplyLimits(config.cameras["camera"].boot_s, config.guard.heater_hold_s)
    stand = Stand(assembly.devices, chamber, supply, assembly.hub, assembly.clock)
    for actuator in (relays, assembly.devices.regulator, assembly.devices.flap, *assembly.devices.axes.values()):
        stand.opened(actuator)
    await stand.chamber.start(40.0)
    await _expect_heater(control, 1)
    await assembly.clock.sleep_until(assembly.clock.now_ns() + to_ns(delay_s))
    relays.heater_off_s = math.nan
    begun_s = await trip(stand, assembly)
    await _expect_heater(control, 0)
    return 1e3 * (relays.heater_off_s - begun_s)


async def _trip_by_operator(stand: Stand, assembly: Assembly) -> float:
    """When the signal was sent."""
    begun_s = math.nan
    with suppress(Interrupted):
        async with Stop() as stop:
            stop.watch(stand)
            begun_s = time.perf_counter()
            os.kill(os.getpid(), signal.SIGINT)
            await asyncio.Event().wait()
    return begun_s


async def _trip_by_guard(stand: Stand, assembly: Assembly) -> float:
    """When the guard began to look."""
    begun_s, watching = math.nan, []
    with suppress(StandTripped):
        async with Stop() as stop:
            stop.watch(stand)
            watches = (Watch(limit_temperature("regulator.pv", -273.15)),)
            guard = Guard(
                safety=stand.safety,
                latch=stand.latch,
                watches=watches,
                hub=assembly.hub,
                clock=assembly.clock,
                period_s=1.0,
                stop=stop.trip,
            )
            begun_s = time.perf_counter()
            watching.append(asyncio.create_task(guard.run()))
            await asyncio.Event().wait()
    await asyncio.gather(*watching)
    return begun_s


async def _expect_heater(control: ControlSocket, enabled: int) -> None:
    state = await control.request({"do": "state"})
    if state["heater_enabled"] != enabled:
        raise ValueError(f"the simulated heater's relay is {state['heater_enabled']}, not {enabled}")


@asynccontextmanager
async def open_polled_stand(config: StandConfig) -> AsyncGenerator[tuple[Assembly, ControlSocket]]:
    """A stand with its laboratory in real time, opened (but for the camera) and polled."""
    simulation = config.simulation
    if simulation is None:
        raise ValueError("the bench's configuration has lost its simulation section")
    simulator = await asyncio.to_thread(Simulator, describe_laboratory(config, virtual=False, seed=None))
    control = ControlSocket(simulation.control)
    assembly = _watch_relays(assemble(config, Hub(), WallClock()))
    polling: list[asyncio.Task[None]] = []
    try:
        await control.open()
        await _open(assembly)
        for poller in assembly.make_pollers():
            await poller.first()
            polling.append(asyncio.create_task(poller.run()))
        yield assembly, control
    finally:
        await cancel_all(polling)
        await _close(assembly)
        await control.close()
        await asyncio.to_thread(simulator.stop)


def _watch_relays(assembly: Assembly) -> Assembly:
    section = assembly.config.relays
    register_map = load_register_map(find_packaged("registers", section.registers)).at_unit(section.unit)
    channels = {str(name): number for name, number in section.channels.items()}
    relays = WatchedRelays("relays", assembly.bus, register_map, channels)
    return replace(assembly, devices=replace(assembly.devices, by_name={**assembly.devices.every, "relays": relays}))


def _list_sensors(devices: Devices):
    return (devices.relays, devices.regulator, devices.thermometers, devices.flap, *devices.axes.values())


async def _open(assembly: Assembly) -> None:
    await assembly.bus.open()
    for device in _list_sensors(assembly.devices):
        await device.open()


async def _close(assembly: Assembly) -> None:
    for device in _list_sensors(assembly.devices):
        await device.close()
    await assembly.bus.close()
