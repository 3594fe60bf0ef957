"""How punctual frames are in real time: 2 frames/s for 50 s by the whole daemon, polled at 1 Hz, guarded and recording.

A frame's instant is the trigger's on the stand's clock. The grid begins with the most punctual frame, none can be
early. The simulator renders and sends 5 MP frames on the same machine meanwhile: one that is due while the simulated
camera still sends the one before is that camera's delay, not the stand's, and is counted apart.
"""

from __future__ import annotations

import asyncio
import shutil
import statistics
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path

from drivers.wires.aravis_library import library
from foundation.clock import WallClock, seconds_ns
from foundation.errors import StandError
from foundation.hub import Hub
from foundation.items import Item
from foundation.readings import Frame
from stand.running.order import Order
from stand.running.run import run_real
from stand.simulator import Simulator, laboratory_of
from tests.bench.figures import Figure, at_most, progress, skipped
from tests.system.simulated_orders import simulated_order

FRAMES = 101  # so that the 99th percentile is not the longest
INTERVAL_s = 0.5
LIMIT_ms = 2.0
RECIPE = f"""
name: bench
experiments:
  - thermal_cycle:
      equilibrium_s: 1
      set_points_degC: [24]
      dwell_s: 1
      reference_frames: {FRAMES}
      interval_s: {INTERVAL_s}
"""


def figures(directory: Path) -> list[Figure]:
    """99th percentile of the deviation from the grid, ms."""
    what = f"frame schedule at {1 / INTERVAL_s:g} fps, deviation"
    try:
        library()
    except StandError as error:
        return [skipped(what, error)]
    progress(f"{FRAMES} frames in real time")
    order = simulated_order(directory, RECIPE, poll_s=1.0)
    simulator = Simulator(laboratory_of(order.config, virtual=False, seed=None))
    try:
        late_ms = deviations_ms(order, directory / "jitter")
    finally:
        simulator.stop()
    return [schedule(what, late_ms)]


def schedule(what: str, late_ms: Sequence[float], more: str = "") -> Figure:
    """99th percentile of these deviations, and of how many of all frames they are."""
    busy = FRAMES - len(late_ms)
    if busy > FRAMES // 2:
        return skipped(what, f"{busy} of {FRAMES} frames came due while the camera was sending")
    p99_ms = statistics.quantiles(late_ms, n=100, method="inclusive")[98]
    seen = f"p99 of {len(late_ms)} frames; median {statistics.median(late_ms):.2f}, greatest {max(late_ms):.2f} ms"
    seen += f"; {busy} more came due while the camera was sending{more}"
    return at_most(LIMIT_ms, Figure(what, "ms", p99_ms, seen))


async def _nobody(_: Path) -> None:
    pass


def deviations_ms(order: Order, out: Path, begun: Callable[[Path], Awaitable[None]] | None = None) -> list[float]:
    """How late each frame of the first capture was triggered whose camera was free in time. `begun` gets the
    session."""
    triggered_ns: list[int] = []
    arrived_ns: list[int] = []
    clock = WallClock()  # ms beside the stand's own at most, and it looks `lead_ns` ahead

    def follow(item: Item) -> None:
        if isinstance(item, Frame) and len(triggered_ns) < FRAMES:
            triggered_ns.append(item.time_ns - seconds_ns(item.exposure_s / 2))
            arrived_ns.append(clock.now_ns())

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    asyncio.run(run_real(order, out, watch, begun or _nobody))
    shutil.rmtree(out)
    period_ns = seconds_ns(INTERVAL_s)
    begin_ns = min(time_ns - number * period_ns for number, time_ns in enumerate(triggered_ns))
    due_ns = [begin_ns + number * period_ns for number in range(len(triggered_ns))]
    free_ns = [0, *arrived_ns]
    return [
        (time_ns - due) / 1e6
        for time_ns, due, free in zip(triggered_ns, due_ns, free_ns, strict=False)
        if free <= due - clock.lead_ns
    ]
