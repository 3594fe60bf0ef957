"""How punctual frames are in real time: 2 frames/s for 50 s by the whole daemon, polled at 1 Hz, guarded and recording.

A frame's instant is the trigger's on the stand's clock, held against the one at which it was due. The simulated camera
shows a picture that was rendered before, 5 MP of it over the wire, so that the frames' way through the stand is
measured and not the rendering; one that is due while the camera still sends the one before is counted apart. Beside it
a process that does nothing but wait for instants as often: what the machine does to any.
"""

from __future__ import annotations

import asyncio
import shutil
import statistics
from collections.abc import Awaitable, Callable, Generator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

from tests.bench.figures import Figure, make_skipped, report_progress, require_aravis, set_upper_goal
from tests.bench.waiting import compare_with_waiting, compute_p99, run_waiting_process
from tests.system.simulated_orders import simulated_order
from thermostand.drivers.wires.camera_connection import Connection, Shot
from thermostand.foundation.clock import WallClock, to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Item
from thermostand.foundation.readings import Frame
from thermostand.stand.assembly.simulator import Simulator, describe_laboratory
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_real

FRAMES = 101  # so that the 99th percentile is not the longest
INTERVAL_s = 0.5
LIMIT_ms = 2.0
RECIPE = f"""
name: bench
experiments:
  - thermal_cycle:
      equilibrium_s: 1
      set_points_degC: [24]
      soak_s: 1
      reference_frames: {FRAMES}
      interval_s: {INTERVAL_s}
"""


def figures(directory: Path) -> list[Figure]:
    """99th percentile of the deviation from the grid, ms."""
    what = f"frame schedule at {1 / INTERVAL_s:g} fps, deviation"
    require_aravis()
    report_progress(f"{FRAMES} frames in real time")
    order = simulated_order(directory, RECIPE, poll_s=1.0)
    with run_laboratory(order):
        late_ms, bare_ms = measure_deviations_ms(order, directory / "jitter")
    return [make_schedule_figure(what, late_ms, bare_ms)]


@contextmanager
def run_laboratory(order: Order) -> Generator[None]:
    """The simulated one of the order, in real time; its camera renders one picture and shows it from then on."""
    described = describe_laboratory(order.config, virtual=False, seed=None)
    devices = cast("dict[str, dict[str, Any]]", described["devices"])
    for device in devices.values():
        if device["fake"] == "cameras":
            device["settings"]["still"] = True
    simulator = Simulator(described)
    try:
        yield
    finally:
        simulator.stop()


def make_schedule_figure(what: str, late_ms: Sequence[float], bare_ms: Sequence[float], more: str = "") -> Figure:
    """99th percentile of these deviations, and of how many of all frames they are."""
    busy = FRAMES - len(late_ms)
    if busy > FRAMES // 2:
        return make_skipped(what, f"{busy} of {FRAMES} frames came due while the camera was sending")
    seen = f"p99 of {len(late_ms)} frames; median {statistics.median(late_ms):.2f}, greatest {max(late_ms):.2f} ms"
    seen += f"; {busy} more came due while the camera was sending{more}"
    return set_upper_goal(LIMIT_ms, compare_with_waiting(Figure(what, "ms", compute_p99(late_ms), seen), bare_ms))


async def _ignore_session(_: Path) -> None:
    pass


def measure_deviations_ms(
    order: Order, out: Path, begun: Callable[[Path], Awaitable[None]] | None = None
) -> tuple[list[float], list[float]]:
    """How late each frame of the first capture was triggered whose camera was free in time, and how late a process is
    that only waits. `begun` gets the session."""
    triggered_ns: list[int] = []
    arrived_ns: list[int] = []
    clock = WallClock()  # ms beside the stand's own at most, and it looks `lead_ns` ahead

    def follow(item: Item) -> None:
        if isinstance(item, Frame) and len(triggered_ns) < FRAMES:
            triggered_ns.append(item.time_ns - to_ns(item.exposure_s / 2))
            arrived_ns.append(clock.now_ns())

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    with _record_due_times() as dues_ns, run_waiting_process(INTERVAL_s) as bare_ms:
        asyncio.run(run_real(order, out, watch, begun or _ignore_session))
    shutil.rmtree(out)
    frames = zip(triggered_ns, dues_ns, [0, *arrived_ns], strict=False)
    return [(time_ns - due) / 1e6 for time_ns, due, free in frames if free <= due - clock.lead_ns], bare_ms


@contextmanager
def _record_due_times() -> Generator[list[int]]:
    """When each frame of the capture is due on the stand's clock, in the order in which they are triggered."""
    dues_ns: list[int] = []
    trigger = Connection.trigger

    def noted(self: Connection, exposure_s: float, due_ns: int = 0) -> Shot | None:
        shot = trigger(self, exposure_s, due_ns)
        if due_ns and shot is not None:
            dues_ns.append(due_ns)
        return shot

    Connection.trigger = noted
    try:
        yield dues_ns
    finally:
        Connection.trigger = trigger
