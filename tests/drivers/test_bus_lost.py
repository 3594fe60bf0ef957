"""Units that are dead, ports that are gone or taken, and connections that end."""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from tests.drivers.bus_responder import TIMEOUT_S, Fault, Responder, flip, frame, late, read_is_right
from thermostand.drivers.sim.wire import LinkFaults, PtyWire, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.foundation.clock import VirtualClock, WallClock, to_ns
from thermostand.foundation.errors import GarbledReply, Unreachable


class MbapResponder(Responder):
    """The same behind a Modbus TCP gateway, which changes each reply as it is reported to."""

    change: Fault | None = None

    def feed(self, data: bytes) -> bytes:
        reply = super().feed(frame(data[6:]))
        sent = data[:4] + (len(reply) - 2).to_bytes(2, "big") + reply[:-2] if reply else b""
        return self.change(data, sent) if self.change is not None and sent else sent


def numberless(_: bytes, reply: bytes) -> bytes:
    return bytes(2) + reply[2:]


def of_another_unit(_: bytes, reply: bytes) -> bytes:
    return reply[:6] + b"\x02" + reply[7:]


def as_rtu(_: bytes, reply: bytes) -> bytes:
    return frame(reply[6:])


async def test_a_dead_unit_is_skipped_and_probed_at_growing_intervals_and_the_other_keeps_going(
    responder: Responder, tmp_path: Path
) -> None:
    clock = VirtualClock(0)
    driver = asyncio.create_task(clock.run())
    wire = PtyWire(tmp_path / "rs485", responder, LinkFaults())
    bus = Bus("rs485", BusSettings(address=f"serial:{tmp_path / 'rs485'}", timeout_s=TIMEOUT_S), clock)
    await bus.open()
    responder.silent_units = {2}
    asked: list[int] = []
    for second in range(24):
        await clock.sleep_until(to_ns(second))
        before = len(responder.requests)
        with pytest.raises(Unreachable):
            await read_is_right(bus, 0, unit=2)
        asked.append(len(responder.requests) - before)
        assert await read_is_right(bus, 0, unit=1)
    assert [second for second, count in enumerate(asked) if count] == [0, 1, 2, 3, 5, 9, 17]  # then every 10 s
    assert sum(asked) == 3 + 6
    assert bus.counters.skipped == 17
    with pytest.raises(Unreachable):  # a write is never withheld
        await bus.write_coil("relays", 2, 0, 0)
    responder.silent_units = set()
    await clock.sleep_until(to_ns(40))
    assert await read_is_right(bus, 0, unit=2)
    assert await read_is_right(bus, 6, unit=2)
    driver.cancel()
    await bus.close()
    wire.close()


async def test_a_unit_whose_last_reply_was_garbled_is_alive_and_asked_again_as_often(
    bus: Bus, responder: Responder
) -> None:
    """As after a write whose reply was garbled: the next read must not fail at its first garbled reply."""
    responder.fault = flip
    with pytest.raises(GarbledReply):
        await bus.write_coil("dut", 1, 3, 0xFF00)
    responder.fault = flip
    assert await read_is_right(bus, 100)


async def test_unplugged_and_replugged_it_works_again_within_two_seconds(responder: Responder, tmp_path: Path) -> None:
    clock = VirtualClock(0)
    driver = asyncio.create_task(clock.run())
    wire = PtyWire(tmp_path / "rs485", responder, LinkFaults())
    bus = Bus("rs485", BusSettings(address=f"serial:{tmp_path / 'rs485'}", timeout_s=TIMEOUT_S), clock)
    await bus.open()
    assert await read_is_right(bus, 100)
    wire.close()
    for _ in range(3):
        with pytest.raises(Unreachable, match="rs485"):
            await read_is_right(bus, 100)
    wire = PtyWire(tmp_path / "rs485", responder, LinkFaults())
    await clock.sleep_until(to_ns(2))
    assert await read_is_right(bus, 100)
    assert bus.counters.lines_down > 0
    driver.cancel()
    await bus.close()
    wire.close()


async def test_over_tcp_a_late_reply_dies_with_its_connection_and_a_hang_up_costs_nothing() -> None:
    responder = MbapResponder()
    wire = TcpWire("127.0.0.1", 0, lambda: responder, LinkFaults())
    bus = Bus("gateway", BusSettings(address=f"tcp:127.0.0.1:{wire.port}", timeout_s=TIMEOUT_S), WallClock())
    await bus.open()
    responder.fault = late
    assert await read_is_right(bus, 100)
    assert await read_is_right(bus, 200)
    assert bus.counters.silences == 1
    port = wire.port
    wire.close()
    wire = TcpWire("127.0.0.1", port, lambda: responder, LinkFaults())
    assert await read_is_right(bus, 300)
    assert bus.counters.lines_down == 1
    wire.close()
    with pytest.raises(Unreachable, match="cannot open tcp:127"):
        await read_is_right(bus, 400)
    await bus.close()


@asynccontextmanager
async def behind_gateway(faults: LinkFaults, change: Fault | None = None) -> AsyncGenerator[tuple[Bus, MbapResponder]]:
    responder = MbapResponder()
    responder.change = change
    wire = TcpWire("127.0.0.1", 0, lambda: responder, faults)
    bus = Bus("gateway", BusSettings(address=wire.address, timeout_s=2.0), WallClock())
    await bus.open()
    try:
        yield bus, responder
    finally:
        await bus.close()
        wire.close()


async def test_a_gateway_that_closes_after_each_reply_is_read_and_written() -> None:
    async with behind_gateway(LinkFaults(hangs_up=True)) as (bus, responder):
        for address in (100, 200, 300):
            assert await read_is_right(bus, address)
            await bus.write_register("dut", 1, address, 7)
        assert [request[1] for request in responder.requests] == [3, 6] * 3
        assert (bus.counters.silences, bus.counters.garbled) == (0, 0)


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (numberless, "the gateway returned transaction number 0 for 1; is it set to Modbus TCP?"),
        (of_another_unit, "unit 2 answered where unit 1 was asked"),
        (as_rtu, "the reply is a frame of Modbus RTU, and tcp: is Modbus TCP: set the gateway to Modbus TCP"),
    ],
)
async def test_over_tcp_a_reply_to_another_request_is_refused_by_what_is_wrong_with_it(
    change: Fault, sentence: str
) -> None:
    async with behind_gateway(LinkFaults(), change) as (bus, _):
        with pytest.raises(GarbledReply, match=re.escape(sentence)):
            await bus.write_coil("dut", 1, 3, 0xFF00)


async def test_a_second_opener_learns_that_the_port_is_taken(bus: Bus) -> None:
    other = Bus("other", BusSettings(address=bus.address), WallClock())
    with pytest.raises(Unreachable, match="another program"):
        await other.open()
    await other.close()


async def test_a_missing_port_and_a_bus_not_open_say_so(tmp_path: Path) -> None:
    bus = Bus("rs485", BusSettings(address=f"serial:{tmp_path / 'none'}"), WallClock())
    with pytest.raises(Unreachable, match="not open"):
        await bus.read("dut", 1, "holding", 0, 1)
    with pytest.raises(Unreachable, match="No such file"):
        await bus.open()
    await bus.close()
    await bus.close()
