"""Which XIMC controller has answered (libximc, GETI and GFWV), and whether it is set as it was delivered (GPWR)."""

from __future__ import annotations

import struct

from thermostand.drivers.devices.motion.stage_profiles import StageProfile
from thermostand.drivers.settings import Identity
from thermostand.drivers.wires.ximc_client import XimcClient
from thermostand.foundation.errors import Refused

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


_POWER = struct.Struct("<BHHHB6x")  # GPWR: HoldCurrent, CurrReductDelay, PowerOffDelay, CurrentSetTime, PowerFlags
_POWER_OFF_ENABLED = 0x2


def power_off_s(client: XimcClient) -> float | None:
    """After how long at rest it switches its motor off, None for never; blocking. Unreachable, GarbledReply."""
    _, _, delay_s, _, flags = _POWER.unpack(client.query("gpwr", _POWER.size))
    return float(delay_s) if flags & _POWER_OFF_ENABLED else None


_MOVE = struct.Struct("<IBHHIBB9x")  # Speed, uSpeed, Accel, Decel, AntiplaySpeed, uAntiplaySpeed, MoveFlags
_THOUSANDTHS = 0x1  # of MoveFlags: the speeds are divided by 1000


def speed_steps_s(client: XimcClient) -> float:
    """At which it moves, full steps/s; blocking. Unreachable, GarbledReply."""
    speed, *_, flags = _MOVE.unpack(client.query("gmov", _MOVE.size))
    return speed / 1000 if flags & _THOUSANDTHS else float(speed)


def changed_settings(profile: StageProfile, speed: float, power_off: float | None) -> str:
    """What somebody else has changed, in words; "" when all is as the profile says."""
    pairs = (("speed", speed, profile.speed, "steps/s"), ("power-off delay", power_off, profile.power_off_s, "s"))
    return "; ".join(
        f"{what} {_said(is_, unit)}, not {_said(wanted, unit)} as in its profile"
        for what, is_, wanted, unit in pairs
        if is_ != wanted
    )


def _said(value: float | None, unit: str) -> str:
    return "none" if value is None else f"{value:g} {unit}"


def _text(field: bytes) -> str:
    """What is printable of a text field that is filled up with zeros."""
    return "".join(each for each in field.partition(b"\0")[0].decode("latin-1") if each.isprintable()).strip()
