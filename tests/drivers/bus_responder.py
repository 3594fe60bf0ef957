"""The far end of a serial bus, which answers as it is reported to."""

from __future__ import annotations

import time
from collections.abc import Callable

from pymodbus.framer.rtu import FramerRTU

from thermostand.drivers.wires.bus import Bus

TIMEOUT_S = 0.05
LATE_S = 0.08  # after the time-out, before the quarantine (0.1 s) ends


def word(unit: int, address: int) -> int:
    """What register `address` of `unit` holds."""
    return (address * 251 + unit * 7) & 0xFFFF


def frame(payload: bytes) -> bytes:
    return payload + FramerRTU.compute_CRC(payload).to_bytes(2, "big")


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


def flip(request: bytes, reply: bytes) -> bytes:
    return reply[:4] + bytes([reply[4] ^ 0x10]) + reply[5:]


def late(request: bytes, reply: bytes) -> bytes:
    time.sleep(LATE_S)  # noqa: TID251 - a late reply is late in real seconds
    return reply


async def read_is_right(bus: Bus, address: int, unit: int = 1, count: int = 6) -> bool:
    return await bus.read("dut", unit, "holding", address, count) == [word(unit, address + i) for i in range(count)]
