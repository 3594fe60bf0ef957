"""A host that is busy makes no silent device in virtual time: its answer is awaited as long as its fake computes it."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from thermostand.drivers.framing.ximc import encode
from thermostand.drivers.sim.units.modbus import RtuEngine, TcpEngine, answer, reads_words
from thermostand.drivers.sim.wire import Engine, LineEngine, LinkFaults, PtyWire, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.line_client import LineClient
from thermostand.drivers.wires.link import SerialSettings, open_link
from thermostand.drivers.wires.ximc_client import XimcClient
from thermostand.foundation.clock import Clock, VirtualClock, WallClock
from thermostand.foundation.errors import Unreachable

TIMEOUT_S, BUSY_S = 0.05, 0.5
LINE = SerialSettings(9600, 1)


class Words:
    unit = 1

    def handle(self, pdu: bytes) -> bytes | None:
        return answer(pdu, {3: reads_words(lambda address, count: range(address, address + count))})


class Controller:
    def feed(self, data: bytes) -> bytes:
        return data[: data.count(b"\0")] + encode("gpos", bytes(14)) if b"gpos" in data else data


@dataclass
class Busy:
    """An engine that computes for a while when it is asked."""

    engine: Engine

    def feed(self, data: bytes) -> bytes:
        threading.Event().wait(BUSY_S)
        return self.engine.feed(data)


async def ask_bus(address: str, clock: Clock) -> bool:
    bus = Bus("bus", BusSettings(address=address, timeout_s=TIMEOUT_S), clock)
    await bus.open()
    try:
        return await bus.read("unit", 1, "holding", 7, 3) == [7, 8, 9]
    finally:
        await bus.close()


def ask_modbus(address: str, clock: Clock) -> bool:
    return asyncio.run(ask_bus(address, clock))


def ask_line(address: str, clock: Clock) -> bool:
    client = LineClient.at("unit", address, LINE, (TIMEOUT_S, 0.0), clock=clock)
    try:
        return client.query(b"abc\n", lambda heard: heard if heard.endswith(b"\n") else None) == b"ABC\n"
    finally:
        client.close()


def ask_stage(address: str, clock: Clock) -> bool:
    client = XimcClient("unit", lambda: open_link("unit", address, LINE), TIMEOUT_S, clock)
    try:
        return client.query("gpos", 14) == bytes(14)
    finally:
        client.close()


CASES: dict[str, tuple[Callable[[], Engine], Callable[[str, Clock], bool], bool]] = {
    "Modbus RTU": (lambda: RtuEngine([Words()]), ask_modbus, True),
    "Modbus TCP": (lambda: TcpEngine([Words()]), ask_modbus, False),
    "line, serial": (lambda: LineEngine(bytes.upper), ask_line, True),
    "line, TCP": (lambda: LineEngine(bytes.upper), ask_line, False),
    "XIMC": (Controller, ask_stage, True),
}


@pytest.fixture(params=CASES)
def case(
    request: pytest.FixtureRequest, tmp_path: Path
) -> Iterator[tuple[PtyWire | TcpWire, Callable[[str, Clock], bool], LinkFaults]]:
    make_engine, ask, is_serial = CASES[request.param]
    faults = LinkFaults()
    wire = (
        PtyWire(tmp_path / "port", Busy(make_engine()), faults)
        if is_serial
        else TcpWire("127.0.0.1", 0, lambda: Busy(make_engine()), faults)
    )
    yield wire, ask, faults
    wire.close()


def test_an_answer_is_awaited_while_the_fake_computes_it(case: tuple[PtyWire | TcpWire, Callable[..., bool], object]):
    wire, ask, _ = case
    assert ask(wire.address, VirtualClock(0, None, wire.settle))


def test_in_real_time_it_is_not(case: tuple[PtyWire | TcpWire, Callable[..., bool], object]):
    wire, ask, _ = case
    with pytest.raises(Unreachable):
        ask(wire.address, WallClock())


def test_a_fake_that_does_not_answer_or_is_late_on_purpose_is_silent(
    case: tuple[PtyWire | TcpWire, Callable[..., bool], LinkFaults],
):
    wire, ask, faults = case
    clock = VirtualClock(0, None, wire.settle)
    faults.silent = True
    with pytest.raises(Unreachable):
        ask(wire.address, clock)
    faults.silent, faults.delay_s = False, 3 * BUSY_S
    with pytest.raises(Unreachable):
        ask(wire.address, clock)
