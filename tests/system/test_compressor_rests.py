"""What nobody has seen confirmed counts for the compressor's rest, over the wire."""

import asyncio
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from tests.system.conftest import AS_INSTALLED
from tests.system.gateway import gateway
from tests.system.test_guard_wire import Start, bench_from
from tests.system.test_relay_keeper import COMPRESSOR, ON, RELAYS, another_master, seconds_until
from thermostand.foundation.clock import to_ns
from thermostand.stand.chamber.compressor import load_state
from thermostand.stand.config.stand_config import CompressorConfig
from thermostand.stand.running.order import Order

POLLED = AS_INSTALLED

COMPRESSOR_FOR_A_TIME = bytes([RELAYS, 5, 0x02, COMPRESSOR])  # unit, function, address


def keeping(order: Order, path: Path) -> Order:
    compressor = CompressorConfig(state_file=path)
    return replace(order, config=order.config.model_copy(update={"compressor": compressor}))


def start_ns(order: Order) -> int:
    assert order.config.simulation is not None
    return to_ns(order.config.simulation.start.timestamp())


async def test_a_compressor_whose_start_nobody_saw_confirmed_and_that_dropped_rests(
    order: Callable[..., Order], simulator: Start
):
    """The reply to its start is lost, as are all of the board's for longer than the permit lives: it has run, and has
    dropped by itself."""
    ordered = order(bus={"timeout_s": 0.05})
    await asyncio.to_thread(simulator, ordered.config, True)
    with gateway(ordered) as (between, through):
        async with bench_from(through, start_ns(ordered)) as bench:
            started = list[bytes]()

            def loses(request: bytes) -> bool:
                if request[6:].startswith(COMPRESSOR_FOR_A_TIME):
                    started.append(request)
                return bool(started) and request[6] == RELAYS

            await bench.start(10, 290)
            between.loses = loses
            await seconds_until(bench, "compressor_on", 1, 20)
            await seconds_until(bench, "compressor_on", 0, 20)
            between.loses = lambda request: False
            assert len(started) == 1
            assert await seconds_until(bench, "compressor_on", 1, 400) >= 295
            assert bench.trips == []
            await bench.end()


async def test_a_compressor_that_somebody_else_switched_on_is_kept_as_started_and_stopped(
    tmp_path: Path, order: Callable[..., Order], simulator: Start
):
    """While cold is permitted but not wanted, and while nothing is permitted."""
    path = tmp_path / "compressor.json"
    ordered = keeping(order(), path)
    await asyncio.to_thread(simulator, ordered.config, True)
    async with bench_from(ordered, start_ns(ordered)) as bench:
        await bench.start(26, 60)
        for number in (1, 2):
            await another_master(bench, RELAYS, 5, COMPRESSOR, ON)
            switched_ns = bench.clock.now_ns()
            assert await seconds_until(bench, "compressor_on", 0, 20) <= 10
            await bench.wait(1)
            kept = load_state(path, bench.clock.now_ns(), None)
            assert not kept.running
            assert 0 <= kept.since_ns - switched_ns <= to_ns(10)
            assert len(kept.starts_ns) == number
            await bench.assembly.stand.chamber.stop()
            await bench.wait(5)
        await bench.end()
