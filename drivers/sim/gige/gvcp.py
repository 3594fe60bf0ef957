"""GVCP, the control protocol of GigE Vision, as bytes: both roles, no I/O.

Everything is big endian. A command is `0x42, flags, command, length, req_id` and its payload; an acknowledge is
`status, command + 1, length, req_id` and its payload (GigE Vision 2.0, chapters 14 to 18).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

PORT = 3956
ACK_WANTED = 0x01
EXTENDED_IDS = 0x10  # of PACKETRESEND: 64-bit block id, 32-bit packet ids

READ_LIMIT_bytes = 512  # of one READMEM: clients keep buffers of 1024 bytes

_KEY = 0x42
_COMMAND = struct.Struct(">BBHHH")
_ACK = struct.Struct(">HHHH")
_RESEND = struct.Struct(">HHII")
_RESEND_EXTENDED = struct.Struct(">HHIIQ")
_PACKET_ID_MASK = 0xFFFFFF


class GvcpCommand(IntEnum):
    """Command codes; the acknowledge has the code plus one."""

    DISCOVERY = 0x0002
    PACKETRESEND = 0x0040
    READREG = 0x0080
    WRITEREG = 0x0082
    READMEM = 0x0084
    WRITEMEM = 0x0086
    PENDING = 0x0088


class GvcpStatus(IntEnum):
    """Status codes of an acknowledge; UNAVAILABLE also stands in a stream packet."""

    OK = 0x0000
    NOT_IMPLEMENTED = 0x8001
    BAD_PARAMETER = 0x8002
    BAD_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    UNAVAILABLE = 0x800C


_NO_COMMAND = 0xFFFF  # the code of an acknowledge is that of its command plus 1, in 16 bits


class Malformed(ValueError):
    """These bytes are no GVCP datagram: a device stays silent."""


class Nack(Exception):
    """The command was understood and refused; `status` says why."""

    def __init__(self, status: GvcpStatus, reason: str) -> None:
        super().__init__(f"{reason} ({status.name}, {status:#06x})")
        self.status = status


@dataclass(frozen=True)
class GvcpRequest:
    """A command; `command` may be a code that Command does not know."""

    command: int
    req_id: int
    payload: bytes = b""
    flags: int = ACK_WANTED

    def encode(self) -> bytes:
        """The datagram."""
        return _COMMAND.pack(_KEY, self.flags, self.command, len(self.payload), self.req_id) + self.payload


@dataclass(frozen=True)
class Ack:
    """An acknowledge; `command` is that of the request, not the code on the wire."""

    command: int
    req_id: int
    payload: bytes = b""
    status: int = GvcpStatus.OK

    def encode(self) -> bytes:
        """The datagram."""
        return _ACK.pack(self.status, self.command + 1, len(self.payload), self.req_id) + self.payload


def make_pending(request: bytes, time_ms: int) -> bytes:
    """PENDING_ACK to a command: its answer takes so long."""
    req_id = _COMMAND.unpack_from(request)[-1]
    return Ack(GvcpCommand.PENDING, req_id, struct.pack(">HH", 0, time_ms)).encode()


def decode_request(datagram: bytes) -> GvcpRequest:
    """The command in a datagram; bytes behind its stated length are ignored. Malformed when it is none."""
    if len(datagram) < _COMMAND.size:
        raise Malformed(f"{len(datagram)} bytes are no GVCP header")
    key, flags, command, length, req_id = _COMMAND.unpack_from(datagram)
    if key != _KEY:
        raise Malformed(f"key {key:#04x} instead of {_KEY:#04x}")
    if command == _NO_COMMAND:
        raise Malformed(f"command {command:#06x}, which no acknowledge can answer")
    return GvcpRequest(command, req_id, _get_body(datagram, length), flags)


def _get_body(datagram: bytes, length: int) -> bytes:
    body = datagram[8 : 8 + length]
    if len(body) < length:
        raise Malformed(f"{len(body)} of {length} payload bytes")
    return body


# ----------------------------------------------------------------------------------------------- payloads of commands


def unpack_words(payload: bytes) -> tuple[int, ...]:
    """The 32-bit words of a payload; Nack when it is empty or no multiple of 4 bytes."""
    if not payload or len(payload) % 4:
        raise Nack(GvcpStatus.BAD_PARAMETER, f"{len(payload)} bytes are no words")
    return struct.unpack(f">{len(payload) // 4}I", payload)


def unpack_read_memory(payload: bytes) -> tuple[int, int]:
    """Address and count (bytes) of READMEM; Nack when it asks for too much or off the 4-byte grid."""
    if len(payload) != 8:
        raise Nack(GvcpStatus.BAD_PARAMETER, f"READMEM of {len(payload)} bytes")
    address, _, count = struct.unpack(">IHH", payload)
    if count == 0 or count > READ_LIMIT_bytes:
        raise Nack(GvcpStatus.BAD_PARAMETER, f"READMEM asks for {count} bytes")
    if address % 4 or count % 4:
        raise Nack(GvcpStatus.BAD_ALIGNMENT, f"READMEM of {count} bytes at {address:#x}")
    return address, count


def pack_write_memory(address: int, data: bytes) -> bytes:
    """The payload of WRITEMEM, and of the acknowledge of READMEM."""
    return struct.pack(">I", address) + data


def unpack_write_memory(payload: bytes) -> tuple[int, bytes]:
    """Address and data of WRITEMEM; Nack when empty or off the 4-byte grid."""
    if len(payload) <= 4:
        raise Nack(GvcpStatus.BAD_PARAMETER, f"WRITEMEM of {len(payload)} bytes")
    address, data = int.from_bytes(payload[:4], "big"), payload[4:]
    if address % 4 or len(data) % 4:
        raise Nack(GvcpStatus.BAD_ALIGNMENT, f"WRITEMEM of {len(data)} bytes at {address:#x}")
    return address, data


def pack_written(count: int) -> bytes:
    """The payload of the acknowledge of WRITEREG (registers written) and WRITEMEM (bytes written)."""
    return struct.pack(">HH", 0, count)


@dataclass(frozen=True)
class Resend:
    """A PACKETRESEND: packets `first` to `last`, both included, of one block."""

    block_id: int
    first: int
    last: int
    extended: bool = False

    def request(self, req_id: int) -> GvcpRequest:
        """The command; it is not acknowledged."""
        if self.extended:
            payload = _RESEND_EXTENDED.pack(0, 0, self.first, self.last, self.block_id)
            return GvcpRequest(GvcpCommand.PACKETRESEND, req_id, payload, flags=EXTENDED_IDS)
        return GvcpRequest(
            GvcpCommand.PACKETRESEND, req_id, _RESEND.pack(0, self.block_id, self.first, self.last), flags=0
        )


def unpack_resend(request: GvcpRequest) -> Resend:
    """Return what a PACKETRESEND asks for; Nack when it is too short."""
    extended = bool(request.flags & EXTENDED_IDS)
    layout = _RESEND_EXTENDED if extended else _RESEND
    if len(request.payload) < layout.size:
        raise Nack(GvcpStatus.BAD_PARAMETER, f"PACKETRESEND of {len(request.payload)} bytes")
    if extended:
        _, _, first, last, block_id = layout.unpack_from(request.payload)
        return Resend(block_id, first, last, extended=True)
    _, block_id, first, last = layout.unpack_from(request.payload)
    return Resend(block_id, first & _PACKET_ID_MASK, last & _PACKET_ID_MASK)
