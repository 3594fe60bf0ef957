"""The bus against a tiny responder whose registers hold values derived from their own address."""

from __future__ import annotations

import asyncio
import os
import random
import select
import tty
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest
from pymodbus.simulator import DataType, SimData, SimDevice

from tests.drivers.bus_responder import TIMEOUT_S, Fault, Responder, flip, frame, late, read_is_right
from thermostand.drivers.sim.wire import LinkFaults, PtyWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import DeviceError, GarbledReply, Refused, Unreachable

Serve = Callable[..., Awaitable[str]]  # the fixture serve_modbus


def drop(request: bytes, reply: bytes) -> bytes:
    return b""


def cut(request: bytes, reply: bytes) -> bytes:
    return reply[: len(reply) // 2]


def junk(request: bytes, reply: bytes) -> bytes:
    return b"\x00\x2b\x0e\xff\x17\x03" + reply


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
    monkeypatch.setattr("thermostand.drivers.wires.bus.READ_RETRIES", 0)
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


async def test_a_soak_with_a_fault_in_every_sixth_reply_gives_no_wrong_value(
    bus: Bus, responder: Responder, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(
        "thermostand.drivers.wires.bus.READ_RETRIES", 0
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


@pytest.mark.parametrize(
    "address", ["", "serial:", "tcp:host", "tcp:host:0", "tcp:host:99999", "/dev/ttyUSB0", "udp:a:1"]
)
def test_an_address_that_is_none_is_refused(address: str) -> None:
    with pytest.raises(ValueError, match=r"expected (serial:PATH|tcp:HOST:PORT)"):
        BusSettings(address=address)
