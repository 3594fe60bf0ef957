"""Julabo circulators and temperature systems, which hold a chamber through their bath. Source: the manuals of FL1201,
SL, Presto and Magio (interface commands, status and error messages).

in_pv_00 -> 24.6        in_sp_00 -> 25.0        in_mode_05 -> 0 or 1      status -> 03 REMOTE START, -01 LOW LEVEL ALARM
out_sp_00 25.0          out_mode_05 1           commands end with CR; the replies with LF, and out has none
"""

from __future__ import annotations

import re

from drivers.devices.chambers.chamber_language import ChamberLanguage, ChamberState, whole_line
from drivers.devices.chambers.chamber_settings import JulaboSettings
from drivers.wires.link import SerialSettings
from foundation.errors import GarbledReply, Refused

_NUMBER = re.compile(r"-?\d{1,3}\.\d{1,2}")
_STATUS = re.compile(r"(-?\d{2}) ([ -~]{1,80})")
_MANUAL = {"00", "01"}
_REMOTE = {"02", "03"}
_ABOUT_A_COMMAND = {"-08", "-09", "-10", "-11", "-13"}  # of the last one; the others are alarms and warnings
_BY_HAND = "it is operated by hand: choose remote control (RS232, USB) at its panel"


def number_of(heard: bytes) -> float | None:
    """The temperature in a reply, degC; None until it has come whole; ValueError when it is none."""
    line = whole_line(heard)
    if line is None:
        return None
    if not _NUMBER.fullmatch(line.strip()):
        raise ValueError("expected a number")
    return float(line)


def status_of(heard: bytes) -> tuple[str, str] | None:
    """Code and words of a reply to `status`; None until it has come whole; ValueError when it is none."""
    line = whole_line(heard)
    if line is None:
        return None
    if (found := _STATUS.fullmatch(line)) is None:
        raise ValueError("expected two digits and a message")
    return found[1], found[2]


class Language(ChamberLanguage):
    """One circulator."""

    def __init__(self, name: str, settings: JulaboSettings) -> None:
        super().__init__(name, settings, SerialSettings(settings.baud, 1, settings.parity, settings.databits))

    def identity(self) -> str:
        """The reply to `version`."""
        return self.client.query(b"version\r", whole_line)

    def state(self) -> ChamberState:
        """Of the bath, and of its status: what that says of a command that it did not take is no alarm."""
        code, words = self._status()
        mode = self.client.query(b"in_mode_05\r", whole_line)
        if mode not in ("0", "1"):
            raise GarbledReply(self._name, f"in_mode_05 was answered by {mode!r}")
        is_alarm = code.startswith("-") and code not in _ABOUT_A_COMMAND
        return ChamberState(
            self.client.query(b"in_pv_00\r", number_of),
            self.client.query(b"in_sp_00\r", number_of),
            mode == "1",
            (f"{code} {words}",) if is_alarm else (),
            by_hand=_BY_HAND if code in _MANUAL else "",
        )

    def set_temperature(self, degC: float) -> None:
        """out_sp_00 25.0."""
        self._tell(f"out_sp_00 {degC:.1f}")

    def humidity_off(self) -> None:
        """It has none."""

    def run(self, on: bool) -> None:
        """out_mode_05 1 or 0."""
        self._tell(f"out_mode_05 {int(on)}")

    def _status(self) -> tuple[str, str]:
        code, words = self.client.query(b"status\r", status_of)
        if code.startswith("-") or code in _MANUAL | _REMOTE:
            return code, words
        raise GarbledReply(self._name, f"unknown status {code} {words}")

    def _tell(self, command: str) -> None:
        """A command is not answered; the status then says when it was not taken."""
        self.client.tell(f"{command}\r".encode("ascii"))
        code, words = self._status()
        if code in _MANUAL:
            raise Refused(self._name, f"{command}: {_BY_HAND}")
        if code in _ABOUT_A_COMMAND:
            hint = f"; {_BY_HAND}" if code == "-09" else ""
            raise Refused(self._name, f"{command}: {code} {words}{hint}")
