"""Which XIMC controller has answered: what it tells of itself besides its serial number (libximc, GETI and GFWV)."""

from __future__ import annotations

import struct

from drivers.settings import Identity
from drivers.wires.ximc_client import XimcClient
from foundation.errors import Refused

_FIRMWARE = struct.Struct("<BBH")  # GFWV: major, minor, release
_MADE = struct.Struct("<4s2s8sBBH12x")  # GETI: manufacturer, its id, product, version of the hardware


def identity_of(client: XimcClient, serial_number: int) -> Identity:
    """Blocking; a controller whose firmware does not know a request does not tell that. Unreachable, GarbledReply."""
    try:
        maker, _, product, *_ = _MADE.unpack(client.query("geti", _MADE.size))
        version = ".".join(map(str, _FIRMWARE.unpack(client.query("gfwv", _FIRMWARE.size))))
    except Refused:
        return Identity("Standa", "XIMC", str(serial_number), "", by_map=True)
    return Identity(_text(maker), _text(product), str(serial_number), version)


def _text(field: bytes) -> str:
    """What is printable of a text field that is filled up with zeros."""
    return "".join(each for each in field.partition(b"\0")[0].decode("latin-1") if each.isprintable()).strip()
