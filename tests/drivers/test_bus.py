"""The bus against a tiny responder whose registers hold values derived from their own address."""

from __future__ import annotations

import asyncio
import os
import random
import select
import time
import tty
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path

import pytest
from pymodbus.framer.rtu import FramerRTU
from pymodbus.simulator import DataType, SimData, SimDevice

from drivers.sim.faults import LinkFaults
from drivers.sim.wire import PtyWire, TcpWire
from drivers.wires.bus import Bus, BusSettings
from foundation.clock import VirtualClock, WallClock, seconds_ns
from foundation.errors import DeviceError, GarbledReply, Refused, Unreachable

TIMEOUT_S = 0.05
LATE_S = 0.08  # after the time-out, before the quarantine (0.1 s) ends


def word(unit: int, address: int) -> int:
    """What register `address` of `unit` holds."""
    return (address * 251 + unit * 7) & 0xFFFF


def frame(payload: bytes) -> bytes:
    return payload + FramerRTU.compute_CRC(payload).to_bytes(2, "big")


Serve = Callable[..., Awaitable[str]]  # the fixture serve_modbus
Fault = Callable[[bytes, bytes], bytes]  # (request, true reply) -> what is sent


class Responder:
    """RTU units 1 and 2: FC 03 answers words, FC 01 bits of the address, single writes echo."""

    def __init__(self) -> None:
        self.requests: list[bytes] = []
        self.fault: Fault | None = None  # for the next request
        self.silent_units: set[int] = set()
        self.injected = 0
        self._buffer = b""

    def feed(self, data: bytes) -> bytes:
        self._buffer += data
        if len(self._buffer) < 8:
            return b""
        request, self._buffer = self._buffer[:8], self._buffer[8:]
        self.requests.append(request)
        if request[0] in self.silent_units:
            return b""
        fault, self.fault = self.fault, None
        reply = self._reply(request)
        if fault is None:
            return reply
        self.injected += 1
        return fault(request, reply)

    def _reply(self, request: bytes) -> bytes:
        unit, function = request[:2]
        address, count = int.from_bytes(request[2:4], "big"), int.from_bytes(request[4:6], "big")
        if function in (3, 4):
            words = b"".join(word(unit, address + i).to_bytes(2, "big") for i in range(count))
            return frame(bytes([unit, function, 2 * count]) + words)
        if function in (1, 2):
            bits = sum(((address + i) & 1) << i for i in range(count))
            return frame(bytes([unit, function, -(-count // 8)]) + bits.to_bytes(-(-count // 8), "little"))
        return request


class MbapResponder(Responder):
    """The same behind a Modbus TCP gateway."""

    def feed(self, data: bytes) -> bytes:
        reply = super().feed(frame(data[6:]))
        return data[:4] + (len(reply) - 2).to_bytes(2, "big") + reply[:-2] if reply else b""


class NumberlessResponder(MbapResponder):
    """Its replies have the transaction number 0, whatever was asked."""

    def feed(self, data: bytes) -> bytes:
        reply = super().feed(data)
        return reply and bytes(2) + reply[2:]


def drop(request: bytes, reply: bytes) -> bytes:
    return b""


def flip(request: bytes, reply: bytes) -> bytes:
    return reply[:4] + bytes([reply[4] ^ 0x10]) + reply[5:]


def cut(request: bytes, reply: bytes) -> bytes:
    return reply[: len(reply) // 2]


def junk(request: bytes, reply: bytes) -> bytes:
    return b"\x00\x2b\x0e\xff\x17\x03" + reply


def late(request: bytes, reply: bytes) -> bytes:
    time.sleep(LATE_S)  # noqa: TID251 - a late reply is late in real seconds
    return reply


def echo(request: bytes, reply: bytes) -> bytes:
    return request + reply


def wrong_unit(request: bytes, reply: bytes) -> bytes:
    return frame(b"\x07" + reply[1:-2])


def wrong_function(request: bytes, reply: bytes) -> bytes:
    return frame(bytes([reply[0], reply[1] ^ 7]) + reply[2:-2])


def too_long(request: bytes, reply: bytes) -> bytes:
    return frame(bytes([reply[0], reply[1], reply[2] + 2]) + reply[3:-2] + b"\x12\x34")


def wrong_value(request: bytes, reply: bytes) -> bytes:
    return frame(reply[:5] + bytes([reply[5] ^ 1]))


def exception(code: int) -> Fault:
    return lambda request, reply: frame(bytes([request[0], request[1] | 0x80, code]))


@pytest.fixture
def responder() -> Responder:
    return Responder()


@pytest.fixture
async def bus(responder: Responder, tmp_path: Path) -> AsyncIterator[Bus]:
    wire = PtyWire(tmp_path / "rs485", responder, LinkFaults())
    bus = Bus("rs485", BusSettings(address=f"serial:{tmp_path / 'rs485'}", timeout_s=TIMEOUT_S, gap_s=0.0), WallClock())
    await bus.open()
    yield bus
    await bus.close()
    wire.close()


async def read_is_right(bus: Bus, address: int, unit: int = 1, count: int = 6) -> bool:
    return await bus.read("dut", unit, "holding", address, count) == [word(unit, address + i) for i in range(count)]


async def test_a_pymodbus_server_is_read_and_written_in_all_four_spaces(serve_modbus: Serve) -> None:
    bits = [SimData(0x80, values=[True, False, True, False, False, True], datatype=DataType.BITS)]
    registers = [SimData(0x2000, values=[100, 200, 0xFFFF], datatype=DataType.REGISTERS)]
    address = await serve_modbus([SimDevice(5, simdata=(bits, bits, registers, registers))], [])
    bus = Bus("rs485", BusSettings(address=address, timeout_s=0.5), WallClock())
    await bus.open()
    assert await bus.read("dut", 5, "coil", 0x80, 6) == [1, 0, 1, 0, 0, 1]
    assert await bus.read("dut", 5, "discrete", 0x82, 4) == [1, 0, 0, 1]
    assert await bus.read("dut", 5, "input", 0x2000, 3) == [100, 200, 0xFFFF]
    await bus.write_register("dut", 5, 0x2001, 0xFF9C)
    assert await bus.read("dut", 5, "holding", 0x2000, 3) == [100, 0xFF9C, 0xFFFF]
    await bus.write_registers("dut", 5, 0x2000, [7, 8])
    assert await bus.read("dut", 5, "holding", 0x2000, 3) == [7, 8, 0xFFFF]
    await bus.write_coil("dut", 5, 0x81, 0xFF00)
    assert await bus.read("dut", 5, "coil", 0x80, 3) == [1, 1, 1]
    with pytest.raises(Refused, match="illegal address"):
        await bus.read("dut", 5, "holding", 0x3000, 1)
    await bus.close()


async def test_single_writes_are_on_the_wire_as_the_manuals_print_them(bus: Bus, responder: Responder) -> None:
    await bus.write_coil("relays", 1, 0x0000, 0xFF00)
    await bus.write_register("regulator", 1, 0x0000, 0x0101)
    await bus.write_coil("relays", 1, 0x0200, 150)
    assert responder.requests == [
        bytes.fromhex("01 05 00 00 FF 00 8C 3A"),  # Waveshare protocol V2: relay 0 on
        bytes.fromhex("01 06 00 00 01 01 49 9A"),  # Omron H175: STOP
        frame(bytes.fromhex("01 05 02 00 00 96")),  # relay 0 on for 15 s
    ]


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        (drop, Unreachable),
        (late, Unreachable),
        (flip, GarbledReply),
        (cut, GarbledReply),
        (echo, GarbledReply),
        (wrong_unit, GarbledReply),
        (wrong_function, GarbledReply),
        (too_long, GarbledReply),
        (exception(2), Refused),
        (exception(4), Refused),
        (exception(11), Unreachable),
    ],
)
async def test_a_failed_read_is_asked_again_only_if_that_can_help_and_the_next_is_right(
    bus: Bus, responder: Responder, fault: Fault, error: type[DeviceError]
) -> None:
    responder.fault = fault
    if error.retryable:
        assert await read_is_right(bus, 100)
        assert bus.counters.retries == 1
    else:
        with pytest.raises(error, match=r"dut: unit 1 on rs485: exception"):
            await read_is_right(bus, 100)
    assert await read_is_right(bus, 200)
    counted = {Unreachable: bus.counters.silences, GarbledReply: bus.counters.garbled, Refused: bus.counters.refused}
    assert counted[error] == 1


async def test_a_late_reply_is_not_credited_to_the_next_request(
    bus: Bus, responder: Responder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("drivers.wires.bus.READ_RETRIES", 0)
    responder.fault = late
    with pytest.raises(Unreachable):
        await read_is_right(bus, 100)
    assert await read_is_right(bus, 200)
    assert await read_is_right(bus, 300)


@pytest.mark.parametrize(("fault", "error"), [(drop, Unreachable), (flip, GarbledReply), (wrong_value, GarbledReply)])
async def test_a_write_is_sent_once_whatever_comes_back(
    bus: Bus, responder: Responder, fault: Fault, error: type[DeviceError]
) -> None:
    responder.fault = fault
    with pytest.raises(error):
        await bus.write_coil("dut", 1, 3, 0xFF00)
    assert len(responder.requests) == 1


async def test_the_echo_of_a_write_does_not_pass_for_its_reply(bus: Bus, responder: Responder) -> None:
    responder.fault = echo
    with pytest.raises(GarbledReply, match="local echo"):
        await bus.write_register("dut", 1, 100, 1)
    assert await read_is_right(bus, 100)


async def test_bytes_that_nobody_asked_for_are_thrown_away_before_the_next_request(responder: Responder) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    asyncio.get_running_loop().add_reader(master, lambda: os.write(master, responder.feed(os.read(master, 99))))
    bus = Bus("rs485", BusSettings(address=f"serial:{os.ttyname(slave)}", timeout_s=TIMEOUT_S), WallClock())
    await bus.open()
    os.write(master, frame(bytes([1, 3, 12]) + bytes(12)))  # as a reply to the next request would look
    assert select.select([slave], [], [], 1.0)[0]  # the kernel passes them on a little later
    assert await read_is_right(bus, 100)
    assert bus.counters.stray == 1
    await bus.close()
    asyncio.get_running_loop().remove_reader(master)
    os.close(master)
    os.close(slave)


async def test_bytes_one_by_one_and_junk_before_a_reply_do_no_harm(responder: Responder, tmp_path: Path) -> None:
    wire = PtyWire(tmp_path / "slow", responder, LinkFaults(byte_by_byte=True))
    bus = Bus("rs485", BusSettings(address=f"serial:{tmp_path / 'slow'}", timeout_s=TIMEOUT_S), WallClock())
    await bus.open()
    responder.fault = junk
    assert await read_is_right(bus, 100)
    assert await read_is_right(bus, 200)
    await bus.close()
    wire.close()


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
        await clock.sleep_until(seconds_ns(second))
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
    await clock.sleep_until(seconds_ns(40))
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
    await clock.sleep_until(seconds_ns(2))
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


async def test_over_tcp_a_reply_without_the_number_of_its_request_is_no_reply() -> None:
    wire = TcpWire("127.0.0.1", 0, NumberlessResponder, LinkFaults())
    bus = Bus("gateway", BusSettings(address=f"tcp:127.0.0.1:{wire.port}", timeout_s=TIMEOUT_S), WallClock())
    await bus.open()
    with pytest.raises(GarbledReply):
        await bus.write_coil("dut", 1, 3, 0xFF00)
    await bus.close()
    wire.close()


async def test_a_soak_with_a_fault_in_every_sixth_reply_gives_no_wrong_value(
    bus: Bus, responder: Responder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "drivers.wires.bus.READ_RETRIES", 0
    )  # asking again would hide a shifted reply behind its own value
    seeded = random.Random(2018)
    right = failed = 0
    for _ in range(300):
        if seeded.random() < 0.16:
            responder.fault = seeded.choice([drop, flip, cut, junk, late, wrong_unit, echo])
        address = seeded.randrange(0x2000)
        try:
            assert await read_is_right(bus, address), f"wrong value at {address}"
            right += 1
        except DeviceError:
            failed += 1
    assert responder.injected > 35
    assert right > 245
    assert failed > 25


async def test_a_second_opener_learns_that_the_port_is_taken(bus: Bus) -> None:
    other = Bus("other", BusSettings(address=bus.address), WallClock())
    with pytest.raises(Unreachable, match="another program has it open"):
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


@pytest.mark.parametrize(
    "address", ["", "serial:", "tcp:host", "tcp:host:0", "tcp:host:99999", "/dev/ttyUSB0", "udp:a:1"]
)
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match=r"expected (serial:PATH|tcp:HOST:PORT)"):
        BusSettings(address=address)
