"""The Modbus engines over bytes, and read by pymodbus over a real pseudo-terminal and a real socket."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pymodbus.client import ModbusSerialClient
from pymodbus.exceptions import ModbusIOException

from tests.sim.unit_bench import gateway_master, serial_master
from thermostand.drivers.sim.units.modbus import (
    ILLEGAL_ADDRESS,
    ModbusRefusal,
    RtuEngine,
    TcpEngine,
    answer,
    crc16,
    echoes,
    reads_bits,
    reads_words,
    writes_bits,
    writes_one,
    writes_words,
)
from thermostand.drivers.sim.wire import LinkFaults


class Store:
    """A unit whose register n holds n and whose bit n is set when n is odd; addresses from 0x1000 do not exist."""

    def __init__(self, unit: int) -> None:
        self.unit = unit
        self.written: list[tuple[int, tuple[int, ...]]] = []

    def _words(self, address: int, count: int) -> Sequence[int]:
        if address + count > 0x1000:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return range(address, address + count)

    def _write(self, address: int, values: Sequence[int]) -> None:
        self.written.append((address, tuple(values)))

    def _write_one(self, address: int, value: int) -> bool:
        self._write(address, [value])
        return True

    def handle(self, pdu: bytes) -> bytes | None:
        bits = reads_bits(lambda address, count: [n % 2 == 1 for n in self._words(address, count)])
        one = writes_one(self._write_one)
        words = reads_words(self._words)
        functions = {0x01: bits, 0x02: bits, 0x03: words, 0x04: words, 0x05: one, 0x06: one, 0x08: echoes}
        return answer(pdu, functions | {0x0F: writes_bits(self._write), 0x10: writes_words(self._write)})


def frame(text: str) -> bytes:
    """Hex of an RTU frame without its CRC -> the frame with it."""
    body = bytes.fromhex(text)
    return body + crc16(body)


CASES = [
    ("01 01 00 00 00 0A", "01 01 02 AA 02"),
    ("01 02 00 01 00 03", "01 02 01 05"),
    ("01 03 00 10 00 02", "01 03 04 00 10 00 11"),
    ("01 04 0F FF 00 01", "01 04 02 0F FF"),
    ("01 05 00 00 FF 00", "01 05 00 00 FF 00"),
    ("01 06 00 00 01 01", "01 06 00 00 01 01"),
    ("01 08 00 00 12 34", "01 08 00 00 12 34"),
    ("01 0F 00 02 00 09 02 FF 01", "01 0F 00 02 00 09"),
    ("01 10 00 01 00 02 04 00 0A 01 02", "01 10 00 01 00 02"),
    ("01 03 10 00 00 01", "01 83 02"),
    ("01 03 00 00 00 00", "01 83 03"),
    ("01 03 00 00 00 7E", "01 83 03"),
    ("01 01 00 00 07 D1", "01 81 03"),
    ("01 08 00 01 00 00", "01 88 03"),
    ("01 10 00 01 00 02 02 00 0A", "01 90 03"),
    ("01 46 00", "01 C6 01"),
    ("01 2B 0E 01 00", "01 AB 01"),
]


@pytest.mark.parametrize(("request_hex", "reply_hex"), CASES)
def test_a_request_gets_its_reply_whole_and_byte_by_byte(request_hex: str, reply_hex: str) -> None:
    request, reply = frame(request_hex), frame(reply_hex)
    assert RtuEngine([Store(1)]).feed(request) == reply
    engine = RtuEngine([Store(1)])
    assert [engine.feed(bytes([byte])) for byte in request] == [b""] * (len(request) - 1) + [reply]


@pytest.mark.parametrize(("request_hex", "reply_hex"), CASES[:-1])
def test_bytes_after_a_request_do_not_spoil_it_nor_the_next(request_hex: str, reply_hex: str) -> None:
    engine = RtuEngine([Store(1)])
    assert engine.feed(frame(request_hex) + b"\x01\x03") == frame(reply_hex)
    assert engine.feed(frame(request_hex)) == frame(reply_hex)


@pytest.mark.parametrize(("request_hex", "reply_hex"), CASES)
def test_the_gateway_gives_the_same_replies_in_mbap_frames(request_hex: str, reply_hex: str) -> None:
    request, reply = (
        struct.pack(">HHH", 0xBEEF, 0, len(body)) + body for body in map(bytes.fromhex, (request_hex, reply_hex))
    )
    engine = TcpEngine([Store(1)])
    assert engine.feed(request + request[:3]) == reply
    assert engine.feed(request[3:]) == reply
    assert b"".join(engine.feed(bytes([byte])) for byte in request) == reply


def test_the_crc_is_that_of_the_manuals() -> None:
    assert crc16(bytes.fromhex("010600000101")) == bytes.fromhex("499A")
    assert crc16(bytes.fromhex("01050000FF00")) == bytes.fromhex("8C3A")
    assert crc16(bytes.fromhex("010800001234")) == bytes.fromhex("ED7C")


@given(junk=st.binary(max_size=300))
def test_a_request_after_garbage_is_answered(junk: bytes) -> None:
    request = frame("01 03 00 10 00 02")
    replies = RtuEngine([Store(1)]).feed(junk + request)
    assert replies.endswith(frame("01 03 04 00 10 00 11"))


@given(junk=st.binary(max_size=40), data=st.data())
def test_garbage_in_ugly_chunks_does_not_lose_the_request(junk: bytes, data: st.DataObject) -> None:
    stream = junk + frame("11 10 00 01 00 02 04 00 0A 01 02")
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=5)))
    store = Store(0x11)
    engine = RtuEngine([store])
    for begin, end in zip([0, *cuts], [*cuts, len(stream)], strict=True):
        engine.feed(stream[begin:end])
    assert store.written[-1] == (1, (0x000A, 0x0102))


@given(address=st.integers(0, 0xF00), count=st.integers(1, 125), flipped=st.integers(0, 63))
def test_a_request_with_a_flipped_bit_is_never_answered(address: int, count: int, flipped: int) -> None:
    request = bytearray(frame(f"01 03 {address:04X} {count:04X}"))
    request[flipped // 8] ^= 1 << flipped % 8
    assert RtuEngine([Store(1)]).feed(bytes(request)) == b""


def test_an_unknown_unit_stays_silent_on_the_bus_and_behind_the_gateway() -> None:
    assert RtuEngine([Store(1)]).feed(frame("02 03 00 00 00 01")) == b""
    assert TcpEngine([Store(1)]).feed(bytes.fromhex("0001 0000 0006 02 03 0000 0001")) == b""


def test_everyone_obeys_a_broadcast_and_nobody_answers() -> None:
    units = [Store(1), Store(2)]
    assert RtuEngine(units).feed(frame("00 06 00 05 00 07")) == b""
    assert [unit.written for unit in units] == [[(5, (7,))], [(5, (7,))]]


def test_two_requests_in_one_piece_get_two_replies_in_order() -> None:
    stream = frame("01 03 00 01 00 01") + frame("02 03 00 02 00 01")
    assert RtuEngine([Store(1), Store(2)]).feed(stream) == frame("01 03 02 00 01") + frame("02 03 02 00 02")


def test_a_header_of_another_protocol_is_skipped_behind_the_gateway() -> None:
    good = bytes.fromhex("0001 0000 0006 01 03 0000 0001")
    assert TcpEngine([Store(1)]).feed(b"GET / HTTP/1.1\r\n" + good).endswith(bytes.fromhex("01 03 02 0000"))


@pytest.fixture
def bus(tmp_path: Path) -> Iterator[tuple[LinkFaults, ModbusSerialClient]]:
    faults = LinkFaults()
    with serial_master(tmp_path / "bus", [Store(1), Store(7)], faults) as client:
        yield faults, client


def test_pymodbus_reads_and_writes_over_a_pseudo_terminal(bus: tuple[LinkFaults, ModbusSerialClient]) -> None:
    _, client = bus
    assert client.read_holding_registers(0x123, count=100, device_id=7).registers == list(range(0x123, 0x187))
    assert client.read_discrete_inputs(5, count=3, device_id=1).bits[:3] == [True, False, True]
    assert not client.write_coils(3, [True, False], device_id=1).isError()
    assert not client.write_registers(3, [1, 2, 3], device_id=7).isError()
    refused = client.read_holding_registers(0x1000, count=1, device_id=1)
    assert (refused.isError(), refused.exception_code) == (True, 2)


def test_pymodbus_gets_no_answer_from_a_missing_unit(bus: tuple[LinkFaults, ModbusSerialClient]) -> None:
    faults, client = bus
    client.comm_params.timeout_connect = 0.1
    with pytest.raises(ModbusIOException):
        client.read_holding_registers(0, count=1, device_id=9)
    client.comm_params.timeout_connect = 3.0
    faults.byte_by_byte = True
    assert client.read_holding_registers(0x42, count=2, device_id=1).registers == [0x42, 0x43]


def test_pymodbus_reads_through_the_gateway() -> None:
    units = [Store(1), Store(2)]
    with gateway_master(units) as client:
        assert client.read_input_registers(0x20, count=3, device_id=2).registers == [0x20, 0x21, 0x22]
        assert not client.write_register(9, 99, device_id=1).isError()
        assert units[0].written == [(9, (99,))]
