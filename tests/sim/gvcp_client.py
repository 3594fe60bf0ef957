"""The client's half of the simulated camera's wire: what it sends, and what it makes of answers and leaders."""

from __future__ import annotations

import struct
from collections.abc import Iterable

from thermostand.drivers.sim.gige import gvsp
from thermostand.drivers.sim.gige.gvcp import Ack, Malformed

_ACK = struct.Struct(">HHHH")
_LEADER = struct.Struct(">HHQIIIIIHH")
_IMAGE = 1


def decode_ack(datagram: bytes) -> Ack:
    """The acknowledge in a datagram; bytes behind its stated length are ignored. Malformed when it is none."""
    if len(datagram) < _ACK.size:
        raise Malformed(f"{len(datagram)} bytes are no GVCP header")
    status, code, length, req_id = _ACK.unpack_from(datagram)
    if code == 0:
        raise Malformed("an acknowledge of no command")
    body = datagram[_ACK.size : _ACK.size + length]
    if len(body) < length:
        raise Malformed(f"{len(body)} of {length} payload bytes")
    return Ack(code - 1, req_id, body, status)


def pack_words(words: Iterable[int]) -> bytes:
    """32-bit words: the payload of READREG (addresses), of its acknowledge (values) and of WRITEREG (pairs)."""
    values = tuple(words)
    return struct.pack(f">{len(values)}I", *values)


def pack_read_memory(address: int, count: int) -> bytes:
    """The payload of READMEM."""
    return struct.pack(">IHH", address, 0, count)


def decode_leader(data: bytes) -> gvsp.Leader:
    """The leader in the data of a leader packet; gvsp.Malformed when short or no image."""
    if len(data) < _LEADER.size:
        raise gvsp.Malformed(f"leader of {len(data)} bytes")
    _, payload_type, timestamp, pixel_format, width, height, offset_x, offset_y, _, _ = _LEADER.unpack_from(data)
    if payload_type != _IMAGE:
        raise gvsp.Malformed(f"payload of type {payload_type:#x}")
    return gvsp.Leader(timestamp, pixel_format, width, height, offset_x, offset_y)
