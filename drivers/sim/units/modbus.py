"""The slave's side of Modbus: RTU and TCP engines over the same units, and the standard functions over a unit's store.

A unit answers a PDU (function code and data; no unit id, no CRC) with a PDU, or with None when it stays silent. A unit
id without a unit stays silent, on RTU as behind the gateway; unit 0 is a broadcast: everyone obeys, nobody answers.
Sources: Modbus Application Protocol 1.1b3 (chapters 6 and 7), Modbus over Serial Line 1.02 (2.5.1, appendix B).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from contextlib import contextmanager
from typing import Protocol

from thermostand.drivers.sim.physics.plant import Plant
from thermostand.foundation.clock import Now

ILLEGAL_FUNCTION = 1
ILLEGAL_ADDRESS = 2
ILLEGAL_VALUE = 3
OPERATION_ERROR = 4

BROADCAST = 0
LONGEST_RTU_FRAME = 256
LONGEST_MBAP_LENGTH = 254

# Length of a whole request, unit id and CRC included; 0x0F and 0x10 carry a byte count in their seventh byte.
FIXED_LENGTHS = {0x01: 8, 0x02: 8, 0x03: 8, 0x04: 8, 0x05: 8, 0x06: 8, 0x08: 8, 0x46: 5}
COUNTED_FUNCTIONS = (0x0F, 0x10)

Handler = Callable[[bytes], bytes | None]


class Unit(Protocol):
    """A device on the bus."""

    @property
    def unit(self) -> int:
        """The unit's address, 1..255."""
        ...

    def handle(self, pdu: bytes) -> bytes | None:
        """The reply to a request, e.g. 03 20 00 00 01 -> 03 02 00 F0; None for silence."""
        ...


class BusUnit:
    """A unit with the plant behind it. functions: what it offers, by function code. silent: it does not answer."""

    functions: Mapping[int, Handler]

    def __init__(self, plant: Plant, clock: Now, unit: int) -> None:
        self.unit = unit
        self.silent = False
        self._plant = plant
        self._clock = clock
        self._now_ns = clock.now_ns()

    def handle(self, pdu: bytes) -> bytes | None:
        """The reply to a request."""
        with self._now():
            return None if self.silent else answer(pdu, self.functions)

    @contextmanager
    def _now(self) -> Generator[None]:
        """The plant at the clock's present time, _now_ns."""
        with self._plant.at(self._clock) as self._now_ns:
            yield


class ModbusRefusal(Exception):
    """The unit answers with an exception code, 1..4."""

    def __init__(self, code: int) -> None:
        super().__init__(f"exception {code}")
        self.code = code


# The units' side: one request PDU over the functions a unit offers.


def answer(pdu: bytes, functions: Mapping[int, Handler]) -> bytes | None:
    """The reply of the handler of the PDU's function code; an exception reply when there is none or it refuses."""
    code, data = pdu[0], pdu[1:]
    handler = functions.get(code)
    try:
        if handler is None:
            raise ModbusRefusal(ILLEGAL_FUNCTION)
        reply = handler(data)
    except ModbusRefusal as refusal:
        return bytes([code | 0x80, refusal.code])
    except struct.error:  # too short or too long for its function
        return bytes([code | 0x80, ILLEGAL_VALUE])
    return None if reply is None else bytes([code]) + reply


def reads_words(read: Callable[[int, int], Sequence[int]], limit: int = 125) -> Handler:
    """FC 03 and 04 over `read(address, count) -> words` of 0..0xFFFF."""

    def handler(data: bytes) -> bytes:
        address, count = struct.unpack(">HH", data)
        if not 1 <= count <= limit:
            raise ModbusRefusal(ILLEGAL_VALUE)
        words = read(address, count)
        return struct.pack(f">B{count}H", 2 * count, *words)

    return handler


def reads_bits(read: Callable[[int, int], Sequence[bool]]) -> Handler:
    """FC 01 and 02 over `read(address, count) -> bits`; the first bit is the lowest of the first byte."""

    def handler(data: bytes) -> bytes:
        address, count = struct.unpack(">HH", data)
        if not 1 <= count <= 2000:
            raise ModbusRefusal(ILLEGAL_VALUE)
        number = sum(bit << position for position, bit in enumerate(read(address, count)))
        size = (count + 7) // 8
        return bytes([size]) + number.to_bytes(size, "little")

    return handler


def writes_one(write: Callable[[int, int], bool]) -> Handler:
    """FC 05 and 06 over `write(address, value) -> whether to answer`; the reply repeats the request."""

    def handler(data: bytes) -> bytes | None:
        address, value = struct.unpack(">HH", data)
        return data if write(address, value) else None

    return handler


def writes_words(write: Callable[[int, Sequence[int]], None], limit: int = 123) -> Handler:
    """FC 10 over `write(address, words)`."""

    def handler(data: bytes) -> bytes:
        address, count, size = struct.unpack_from(">HHB", data)
        if not 1 <= count <= limit or size != 2 * count:
            raise ModbusRefusal(ILLEGAL_VALUE)
        write(address, struct.unpack(f">{count}H", data[5:]))
        return data[:4]

    return handler


def writes_bits(write: Callable[[int, Sequence[bool]], None]) -> Handler:
    """FC 0F over `write(address, bits)`."""

    def handler(data: bytes) -> bytes:
        address, count, size = struct.unpack_from(">HHB", data)
        if not 1 <= count <= 1968 or size != (count + 7) // 8 or len(data) != 5 + size:
            raise ModbusRefusal(ILLEGAL_VALUE)
        number = int.from_bytes(data[5:], "little")
        write(address, [bool(number >> position & 1) for position in range(count)])
        return data[:4]

    return handler


def echoes(data: bytes) -> bytes:
    """FC 08, sub-function 0: the request comes back."""
    if data[:2] != b"\x00\x00":
        raise ModbusRefusal(ILLEGAL_VALUE)
    return data


# The wire's side.


def _crc_of_byte(crc: int) -> int:
    for _ in range(8):
        crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


CRC_OF_BYTE = tuple(_crc_of_byte(byte) for byte in range(256))


def crc16(data: bytes) -> bytes:
    """The two CRC bytes of an RTU frame, low byte first: crc16(01 06 00 00 01 01) = 49 9A."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ CRC_OF_BYTE[(crc ^ byte) & 0xFF]
    return crc.to_bytes(2, "little")


class RtuEngine:
    """Modbus RTU requests in, replies out, for the units of one bus.

    Frames are separated by their length and CRC, not by the silence between them, which a pseudo-terminal does not
    keep: data that do not end in a good frame are dropped as soon as a good frame follows.
    """

    def __init__(self, units: Iterable[Unit]) -> None:
        self._units = tuple(units)
        self._buffer = b""

    def feed(self, data: bytes) -> bytes:
        """Take bytes as they came; the replies to the requests they complete."""
        self._buffer += data
        replies = b""
        while (found := self._find()) is not None:
            begin, end = found
            frame, self._buffer = self._buffer[begin:end], self._buffer[end:]
            reply = _dispatch(self._units, frame[0], frame[1:-2])
            if reply is not None:
                replies += (body := frame[:1] + reply) + crc16(body)
        self._buffer = self._buffer[-LONGEST_RTU_FRAME:]
        return replies

    def _find(self) -> tuple[int, int] | None:
        """Begin and end of the first good frame in the buffer, None when there is none yet."""
        for begin in range(len(self._buffer) - 3):
            length = _frame_length(self._buffer, begin)
            frame = self._buffer[begin : begin + length]
            if 0 < length == len(frame) and crc16(frame[:-2]) == frame[-2:]:
                return begin, begin + length
        return None


def _frame_length(data: bytes, begin: int) -> int:
    """The length of the request that may begin at `begin`, 0 when it is unknown."""
    function = data[begin + 1]
    if function in FIXED_LENGTHS:
        return FIXED_LENGTHS[function]
    if function in COUNTED_FUNCTIONS:
        return 9 + data[begin + 6] if len(data) > begin + 6 else 0
    # An unknown function deserves its exception reply: it is a frame when all that has come is one.
    return len(data)


class TcpEngine:
    """Modbus TCP requests in, replies out: a gateway in front of the units of one bus."""

    def __init__(self, units: Iterable[Unit]) -> None:
        self._units = tuple(units)
        self._buffer = b""

    def feed(self, data: bytes) -> bytes:
        """Take bytes as they came; the replies to the requests they complete."""
        self._buffer += data
        replies = b""
        while len(self._buffer) >= 7:
            transaction, protocol, length, unit = struct.unpack_from(">HHHB", self._buffer)
            if protocol != 0 or not 2 <= length <= LONGEST_MBAP_LENGTH:
                self._buffer = self._buffer[1:]  # not a header: look for one from the next byte on
                continue
            if len(self._buffer) < 6 + length:
                break
            pdu, self._buffer = self._buffer[7 : 6 + length], self._buffer[6 + length :]
            reply = _dispatch(self._units, unit, pdu)
            if reply is not None:
                replies += struct.pack(">HHHB", transaction, 0, 1 + len(reply), unit) + reply
        return replies


def _dispatch(units: Sequence[Unit], address: int, pdu: bytes) -> bytes | None:
    """The reply of the unit with that address; None when there is none."""
    if address == BROADCAST:
        for unit in units:
            unit.handle(pdu)
        return None
    for unit in units:
        if unit.unit == address:
            return unit.handle(pdu)
    return None
