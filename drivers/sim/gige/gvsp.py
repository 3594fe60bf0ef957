"""GVSP, the stream protocol of GigE Vision, as a camera speaks it: bytes, no I/O.

One image is one block: packet 0 is the leader, 1..n carry the pixels, n + 1 is the trailer. Everything is big endian
but the pixels. The header has 8 bytes with 16-bit block ids, or 20 with 64-bit ones ("extended"); GigE Vision 2.0,
chapters 23 to 25.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

OK = 0x0000
RESENT = 0x0100
UNAVAILABLE = 0x800C

IP_UDP_HEADER_bytes = 28  # the packet size register counts them

_SHORT = struct.Struct(">HHI")
_EXTENDED = struct.Struct(">HHIQI")
_EXTENDED_BIT = 0x80
_LEADER = struct.Struct(">HHQIIIIIHH")
_TRAILER = struct.Struct(">HHI")
_IMAGE = 1


class PacketKind(IntEnum):
    """What a packet carries."""

    LEADER = 1
    TRAILER = 2
    PAYLOAD = 3


class PixelFormat(IntEnum):
    """PFNC codes; bits 16 to 23 of each are its bits per pixel."""

    MONO8 = 0x01080001
    MONO10 = 0x01100003
    MONO12 = 0x01100005
    MONO16 = 0x01100007
    MONO10PACKED = 0x010C0004
    MONO12PACKED = 0x010C0006
    MONO10P = 0x010A0046
    MONO12P = 0x010C0047

    @property
    def symbol(self) -> str:
        """The format's name in the PFNC, such as Mono12Packed."""
        return self.name.capitalize().replace("packed", "Packed")

    def size_bytes(self, pixels: int) -> int:
        """Bytes of an image."""
        return -(-pixels * (self >> 16 & 0xFF) // 8)


def header_size(extended: bool) -> int:
    """Bytes of a GVSP header."""
    return _EXTENDED.size if extended else _SHORT.size


def make_header(kind: PacketKind, block_id: int, packet_id: int, status: int, extended: bool) -> bytes:
    """The header of one packet."""
    if extended:
        return _EXTENDED.pack(status, 0, (_EXTENDED_BIT | kind) << 24, block_id, packet_id)
    return _SHORT.pack(status, block_id, kind << 24 | packet_id)


@dataclass(frozen=True)
class Leader:
    """What the leader says of an image; `timestamp` in ticks of the camera, sizes in px."""

    timestamp: int
    pixel_format: int
    width: int
    height: int
    offset_x: int = 0
    offset_y: int = 0

    def encode(self) -> bytes:
        """The data of the leader packet (36 bytes, no padding)."""
        return _LEADER.pack(
            0, _IMAGE, self.timestamp, self.pixel_format, self.width, self.height, self.offset_x, self.offset_y, 0, 0
        )


@dataclass(frozen=True)
class ImageBlock:
    """One image cut into packets of `packet_size` bytes (IP and UDP header included), on demand.

    `pixels` are the bytes of the image, rows from the top; they must not change while the block lives.
    """

    block_id: int
    leader: Leader
    pixels: memoryview
    packet_size: int
    extended: bool = False

    @property
    def data_size(self) -> int:
        """Pixel bytes in every payload packet but the last."""
        return self.packet_size - IP_UDP_HEADER_bytes - header_size(self.extended)

    @property
    def trailer_id(self) -> int:
        """Packet id of the trailer, the highest of the block."""
        return -(-len(self.pixels) // self.data_size) + 1

    def packet(self, packet_id: int, status: int = OK) -> tuple[bytes, bytes | memoryview]:
        """Header and data of one packet, for a gathering send; IndexError outside 0..trailer_id."""
        if not 0 <= packet_id <= self.trailer_id:
            raise IndexError(f"packet {packet_id} of {self.trailer_id + 1}")
        if packet_id == 0:
            kind, data = PacketKind.LEADER, self.leader.encode()
        elif packet_id == self.trailer_id:
            kind, data = PacketKind.TRAILER, _TRAILER.pack(0, _IMAGE, self.leader.height)
        else:
            begin = (packet_id - 1) * self.data_size
            kind, data = PacketKind.PAYLOAD, self.pixels[begin : begin + self.data_size]
        return make_header(kind, self.block_id, packet_id, status, self.extended), data


# Pixels as a camera sends them: 8 bits of the scene in any of its formats (GigE Vision 1.2, section 27; PFNC 2.1).


_BITS = {PixelFormat.MONO10: 10, PixelFormat.MONO12: 12, PixelFormat.MONO16: 16}
_IN_THREE_BYTES = {PixelFormat.MONO10PACKED: 10, PixelFormat.MONO12PACKED: 12}
_GAPLESS = {PixelFormat.MONO10P: 10, PixelFormat.MONO12P: 12}


def encode_image(image: NDArray[np.uint8], pixel_format: PixelFormat) -> bytes:
    """The bytes of an image, its 8 bits as the upper ones of each pixel."""
    if pixel_format in _BITS:
        return (image.astype("<u2") << _BITS[pixel_format] - 8).astype("<u2").tobytes()
    if pixel_format in _IN_THREE_BYTES:
        bits = _IN_THREE_BYTES[pixel_format]
        return _pack_in_three_bytes((image.reshape(-1).astype(np.uint16) << bits - 8).astype(np.uint16), bits)
    if pixel_format in _GAPLESS:
        bits = _GAPLESS[pixel_format]
        values = image.reshape(-1, 1).astype(np.uint16) << bits - 8
        return np.packbits(values >> np.arange(bits, dtype=np.uint16) & 1, bitorder="little").tobytes()
    return image.tobytes()


def _pack_in_three_bytes(values: NDArray[np.uint16], bits: int) -> bytes:
    """Pack two pixels in three bytes: upper 8 bits, both lower parts (the first's in the lower half), upper 8 bits."""
    low = bits - 8
    pairs = np.append(values, np.zeros(len(values) % 2, np.uint16)).reshape(-1, 2)
    shared = (pairs[:, 0] & (1 << low) - 1) | (pairs[:, 1] & (1 << low) - 1) << 4
    packed = np.stack([pairs[:, 0] >> low, shared, pairs[:, 1] >> low], axis=1).astype(np.uint8).tobytes()
    return packed[: -(-len(values) * 12 // 8)]


def bin_pixels(image: NDArray[np.uint8], across: int, down: int) -> NDArray[np.uint8]:
    """The mean of so many pixels across and down in the place of each; what does not fill one at the edges is left
    out."""
    if across == down == 1:
        return image
    height, width = image.shape[0] // down, image.shape[1] // across
    parts = image[: height * down, : width * across].reshape(height, down, width, across)
    return parts.mean(axis=(1, 3)).round().astype(np.uint8)
