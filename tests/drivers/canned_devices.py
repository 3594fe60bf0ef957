"""Modbus, XIMC and the flap's variables, on damaged replies."""

from __future__ import annotations

import struct
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any

from tests.drivers.canned_line import Feed, Line, Parser
from thermostand.drivers.devices.motion.flap import Flap, FlapSettings
from thermostand.drivers.wires.modbus_client import BusSettings, ModbusClient, SerialClient, TcpClient, WireFault
from thermostand.drivers.wires.ximc_client import XimcClient
from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.errors import DeviceError, GarbledReply
from thermostand.foundation.readings import Quality

# ------------------------------------------------------------------------------------------------------------- Modbus

_MODBUS: list[tuple[Callable[[ModbusClient], list[int] | None], bytes]] = [
    (lambda client: client.read(1, "holding", 0x2000, 6), bytes.fromhex("01 03 0c 00fa000000fa000001c20000")),
    (lambda client: client.read(2, "input", 0, 6), bytes.fromhex("02 04 0c 2ccd2cd080017fff0000ffe2")),
    (lambda client: client.read(1, "coil", 0, 8), bytes.fromhex("01 01 01 05")),
    (lambda client: client.read(2, "discrete", 0x80, 6), bytes.fromhex("02 02 01 04")),
    (lambda client: client.write_register(1, 0x2103, 250), bytes.fromhex("01 06 2103 00fa")),
    (lambda client: client.write_coil(1, 0x200, 150), bytes.fromhex("01 05 0200 0096")),
    (lambda client: client.write_registers(1, 0x0ADE, [0, 0x41C8]), bytes.fromhex("01 10 0ade 0002")),
    (lambda client: client.read(1, "holding", 0x2000, 6), bytes.fromhex("01 83 02")),
]


def crc(data: bytes) -> bytes:
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


def _mbap(transaction: int, reply: bytes) -> bytes:
    return struct.pack(">HHH", transaction, 0, len(reply)) + reply


class _CannedModbus(ModbusClient):
    """The client with our line in the place of the port."""

    def __init__(self, kind: str) -> None:
        super().__init__(BusSettings(address=f"{kind}:{'/dev/x' if kind == 'serial' else '127.0.0.1:502'}"))
        self.wire = Line()
        base: Any = SerialClient if self.serial else TcpClient
        place = {"port": "/dev/x"} if self.serial else {"host": "127.0.0.1"}
        own = {
            "connect": lambda canned: True,
            "send": lambda canned, request, addr=None: self.wire.write(request),
            "recv": lambda canned, size: self.wire.read(1.0),
            "close": lambda canned: None,
        }
        self._canned = type("Canned", (base,), own)(**place, timeout=1.0, retries=0, trace_packet=self._trace)

    def _make(self) -> Any:
        return self._canned

    def begin(self, reply: bytes) -> None:
        """`reply` is for the next request, whose transaction number is 1."""
        self._canned.number = 0
        self.wire.begin(reply)


def modbus(kind: str) -> Parser:
    def framed(reply: bytes) -> bytes:
        return reply + crc(reply) if kind == "serial" else struct.pack(">HHH", 1, 0, len(reply)) + reply

    def make() -> Feed:
        client = _CannedModbus(kind)

        def feed(number: int, wire: bytes) -> bool:
            client.begin(wire)
            call, reply = _MODBUS[number]
            try:
                values = call(client)
            except WireFault:
                return False
            # What was accepted stands in what came, with its own checksum or transaction number.
            if values is None:
                assert framed(reply) in wire
                return True
            head = reply[:3] if reply[1] < 0x80 else bytes([1, 3, 12])
            data = _packed(values, head[1])
            assert len(data) == head[2]
            assert any(framed(head + found) in wire for found in _variants(data, head[1]))
            return True

        return feed

    return Parser([framed(reply) for _, reply in _MODBUS], make, frozenset({len(_MODBUS) - 1}))


def _packed(values: list[int], function: int) -> bytes:
    if function in (3, 4):
        return struct.pack(f">{len(values)}H", *values)
    return bytes([sum(bit << place for place, bit in enumerate(values))])


def _variants(data: bytes, function: int) -> list[bytes]:
    """Bits behind the last one asked for are any."""
    return [data] if function in (1, 3, 4) else [bytes([data[0] | high << 6]) for high in range(4)]


# --------------------------------------------------------------------------------------------------------------- XIMC

_XIMC = {
    "gser": bytes.fromhex("34120000"),
    "gets": bytes.fromhex(
        "01810000000090010000ceff000000000000000000000000000000fa00000000000a00000020000000000000000000000a"
    ),
    "gmov": bytes.fromhex("8813000000204e204ee80300000000cccccccccccccccccc"),
}
_STATUS_SIZE = 48


def ximc() -> Parser:
    replies = {letters: payload[:_STATUS_SIZE] for letters, payload in _XIMC.items()}
    names = list(replies)

    def make() -> Feed:
        line = Line()
        client = XimcClient("stage", lambda: line)

        def feed(number: int, wire: bytes) -> bool:
            line.begin(wire)
            letters = names[number]
            with suppress(DeviceError):
                payload = client.query(letters, len(replies[letters]))
                assert letters.encode() + payload + crc(payload) in wire
                return True
            return False

        return feed

    return Parser([b"\0" + letters.encode() + payload + crc(payload) for letters, payload in replies.items()], make)


# --------------------------------------------------------------------------------------------------------------- flap

_VARIABLES = bytes.fromhex(
    "f401ac0df40100000000e8030000000000000000000000ff0f640000000000008813000000e0930400000000000000000000000000"
)


class _CannedFlap(Flap):
    """A flap whose controller answers every request with `reply`."""

    reply = b""

    def ctrl_transfer(self, *request: object) -> bytes:
        return self.reply

    def _find(self) -> Any:
        self._device = self
        return self


def _at_once(coroutine: Coroutine[Any, Any, Any]) -> Any:
    """What a coroutine gives that waits for nothing."""
    try:
        coroutine.send(None)
    except StopIteration as ended:
        return ended.value
    raise AssertionError("it waits")


def jrk() -> Parser:
    def make() -> Feed:
        flap = _CannedFlap("flap", FlapSettings(serial_number="1"), VirtualClock(0), None)
        _at_once(flap.open())

        def feed(number: int, wire: bytes) -> bool:
            flap.reply = wire
            with suppress(GarbledReply):
                position, current = _at_once(flap.read())
                assert len(wire) == len(_VARIABLES)
                halting, scaled = int.from_bytes(wire[18:20], "little"), int.from_bytes(wire[6:8], "little")
                assert current.value == int.from_bytes(wire[25:27], "little")
                assert (position.quality is Quality.GOOD) == (halting in (0, 1))
                assert (position.quality is Quality.BAD) == bool(halting & 0x20)
                assert halting & 0x20 or abs(position.value * 3000 + 500 - scaled) < 1e-6
                return True
            return False

        return feed

    return Parser([_VARIABLES], make)
