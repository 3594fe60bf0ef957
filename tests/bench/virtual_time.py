"""How much faster than real a whole stand runs in virtual time, every device polled, beside time that only moves.

Ours: a recipe of two soaks through `run_virtual` (daemon here, simulator in its own process, Modbus TCP, XIMC on
pseudo-terminals, USB, GigE); only the soaks are timed, so start-up and the recipe's two frames are not in it. Limit:
the same simulator, moved through its control socket by the same steps with nobody polling.
"""

from __future__ import annotations

import asyncio
import itertools
import shutil
import time
from pathlib import Path

from tests.bench.figures import Figure, compare, make_absolute, measure_in_turns, report_progress, require_aravis
from tests.system.simulated_orders import simulated_order
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item, StepMark, StepState
from thermostand.stand.assembly.simulator import ControlSocket, Simulator, describe_laboratory
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import pin_to_one_cpu, run_virtual

ROUNDS = 5
SOAK_s = 1800.0
STEP_s = 5.0  # the shortest poll period of configs/simulated.yaml: every device and the guard act on its multiples
RECIPE = f"""
name: bench
experiments:
  - thermal_cycle: {{equilibrium_s: {SOAK_s}, set_points_degC: [30], soak_s: {SOAK_s}, reference_frames: 1}}
"""


def figures(directory: Path) -> list[Figure]:
    """Simulated seconds per second, and bare control-socket round trips per second."""
    what = "virtual time, whole stand polled"
    require_aravis()
    order = simulated_order(directory, RECIPE)
    sessions = (directory / f"run-{number}" for number in itertools.count())
    trips_per_s: list[float] = []

    def run() -> float:
        report_progress(f"{what}: a run of two soaks of {SOAK_s:g} s")
        return _soaked_per_second(order, next(sessions))

    def limit() -> float:
        with pin_to_one_cpu():  # as the run does
            trips_per_s.append(asyncio.run(_round_trips_per_second(order)))
        return trips_per_s[-1] * STEP_s

    ours, bare = measure_in_turns(run, limit, ROUNDS)
    return [
        compare(what, "sim s/s", f"bare control-socket advances of {STEP_s:g} s", ours, bare),
        make_absolute(f"bare control-socket advance of {STEP_s:g} s", "round trips/s", trips_per_s[1:]),
    ]


def _soaked_per_second(order: Order, out: Path) -> float:
    """Simulated over real duration of the soaks of one run."""
    begun_s: dict[str, float] = {}
    soaks: list[tuple[float, float]] = []

    def follow(item: Item) -> None:
        if isinstance(item, StepMark) and item.kind == "soak":
            if item.state is StepState.STARTED:
                begun_s[item.step_id] = time.perf_counter()
            elif item.state is StepState.DONE:
                soaks.append((SOAK_s, time.perf_counter() - begun_s[item.step_id]))

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    asyncio.run(run_virtual(order, out, None, watch))
    shutil.rmtree(out)
    simulated_s, real_s = map(sum, zip(*soaks, strict=True))
    return simulated_s / real_s


async def _round_trips_per_second(order: Order) -> float:
    """`advance` by steps over as much simulated time as one run soaks."""
    simulation = order.config.simulation
    if simulation is None:
        raise ValueError("the bench's configuration has lost its simulation section")
    simulator = Simulator(describe_laboratory(order.config, virtual=True, seed=None))
    control = ControlSocket(simulation.control)
    try:
        await control.open()
        now_ns = round(simulation.start.timestamp()) * NS_PER_S
        steps = round(2 * SOAK_s / STEP_s)
        begin_s = time.perf_counter()
        for number in range(1, steps + 1):
            await control.advance(now_ns + number * to_ns(STEP_s))
        return steps / (time.perf_counter() - begin_s)
    finally:
        await control.close()
        simulator.stop()
