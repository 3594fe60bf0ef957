"""The client's half of the simulated camera's wire: what it sends, and what it makes of answers and leaders."""

from __future__ import annotations

import struct
from collections.abc import Iterable
from dataclasses import dataclass

from thermostand.drivers.sim.gige import gvsp
from thermostand.drivers.sim.gige.gvcp import Ack
from thermostand.drivers.sim.gige.gvsp import PacketKind

_ACK = struct.Struct(">HHHH")
_LEADER = struct.Struct(">HHQIIIIIHH")
_IMAGE = 1


def decode_ack(datagram: bytes) -> Ack:
    """The acknowledge in a datagram."""
    status, code, length, req_id = _ACK.unpack_from(datagram)
    assert len(datagram) == _ACK.size + length
    return Ack(code - 1, req_id, datagram[_ACK.size :], status)


def pack_words(words: Iterable[int]) -> bytes:
    """32-bit words: the payload of READREG (addresses), of its acknowledge (values) and of WRITEREG (pairs)."""
    values = tuple(words)
    return struct.pack(f">{len(values)}I", *values)


def pack_read_memory(address: int, count: int) -> bytes:
    """The payload of READMEM."""
    return struct.pack(">IHH", address, 0, count)


@dataclass(frozen=True)
class Packet:
    """One stream packet as received; `data` is what follows the header."""

    kind: PacketKind
    block_id: int
    packet_id: int
    data: bytes
    status: int
    extended: bool = False


def decode_packet(datagram: bytes) -> Packet:
    """The packet in a datagram, whose header has 8 bytes or 20; ValueError when it is of an unknown kind."""
    status, block_id, word = struct.unpack_from(">HHI", datagram)
    is_extended, packet_id = bool(word >> 31), word & 0xFFFFFF
    if is_extended:
        block_id, packet_id = struct.unpack_from(">QI", datagram, 8)
    data = datagram[gvsp.header_size(is_extended) :]
    return Packet(PacketKind(word >> 24 & 0x7F), block_id, packet_id, data, status, is_extended)


def decode_leader(data: bytes) -> gvsp.Leader:
    """The leader in the data of a leader packet of an image."""
    _, payload_type, timestamp, pixel_format, width, height, offset_x, offset_y, _, _ = _LEADER.unpack_from(data)
    assert payload_type == _IMAGE
    return gvsp.Leader(timestamp, pixel_format, width, height, offset_x, offset_y)
