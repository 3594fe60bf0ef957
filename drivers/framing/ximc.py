"""XIMC frames for both ends of the wire: letters, payload and CRC; what a payload means is not known here.

A frame is four lower-case ASCII letters, followed by payload and CRC when there is a payload (libximc protocol.xi).
A frame without payload has no CRC. Only the letters determine the size, so a decoder is given the sizes it may meet:

    host:        decode(received, ERROR_SIZES | {"gets": 48})
    controller:  decode(received, every_request_size)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum, auto
from functools import lru_cache

LETTERS_SIZE = 4
CRC_SIZE = 2

# errc: unknown command; errd: the request's CRC was wrong; errv: a value was out of range and has been corrected.
ERROR_SIZES: dict[str, int] = {"errc": 0, "errd": 0, "errv": 0}


class XimcDamage(Enum):
    """Why a frame cannot be used."""

    NONE = auto()
    LETTERS = auto()
    CRC = auto()


@dataclass(frozen=True, slots=True)
class XimcFrame:
    """One frame as received. With XimcDamage.LETTERS its size is unknown and `payload` empty; with XimcDamage.CRC
    `payload` is what arrived. Letters that are no ASCII appear as Latin-1."""

    letters: str
    payload: bytes = b""
    damage: XimcDamage = XimcDamage.NONE


def _crc_of_byte(crc: int) -> int:
    for _ in range(8):
        crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


_CRC_OF_BYTE = tuple(_crc_of_byte(byte) for byte in range(256))


@lru_cache(64)
def crc16(payload: bytes) -> int:
    """CRC-16/MODBUS: start 0xFFFF, reflected polynomial 0xA001. Over the payload only, never the letters.
    A stage at rest says the same at every poll."""
    crc = 0xFFFF
    for byte in payload:
        crc = crc >> 8 ^ _CRC_OF_BYTE[(crc ^ byte) & 0xFF]
    return crc


def frame_size(payload_size: int) -> int:
    """Bytes on the wire of a frame with `payload_size` bytes of payload, e.g. 54 for 48 and 4 for 0."""
    return LETTERS_SIZE + (payload_size + CRC_SIZE if payload_size else 0)


def encode(letters: str, payload: bytes = b"") -> bytes:
    """The frame as bytes, e.g. encode("home") -> b"home"; ValueError unless `letters` are four lower-case letters."""
    if len(letters) != LETTERS_SIZE or not (letters.isascii() and letters.isalpha() and letters.islower()):
        raise ValueError(f"an XIMC command is four lower-case letters, not {letters!r}")
    crc = crc16(payload).to_bytes(CRC_SIZE, "little") if payload else b""
    return letters.encode("ascii") + payload + crc


def decode(received: bytes, payload_sizes: Mapping[str, int]) -> tuple[XimcFrame | None, bytes]:
    """The first frame in `received` and the bytes after it; (None, bytes to keep) while it is incomplete.

    Zero bytes before the letters are resync filling and skipped. Letters not in `payload_sizes` give a frame with
    XimcDamage.LETTERS, and the bytes after it begin right behind the letters.
    """
    received = received.lstrip(b"\0")
    if len(received) < LETTERS_SIZE:
        return None, received
    letters = received[:LETTERS_SIZE].decode("latin-1")
    if letters not in payload_sizes:
        return XimcFrame(letters, damage=XimcDamage.LETTERS), received[LETTERS_SIZE:]
    payload_size = payload_sizes[letters]
    end = frame_size(payload_size)
    if len(received) < end:
        return None, received
    payload = received[LETTERS_SIZE : LETTERS_SIZE + payload_size]
    crc = received[LETTERS_SIZE + payload_size : end]
    intact = not payload_size or int.from_bytes(crc, "little") == crc16(payload)
    return XimcFrame(letters, payload, XimcDamage.NONE if intact else XimcDamage.CRC), received[end:]
