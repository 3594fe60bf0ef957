"""Julabo circulators and temperature systems, which hold a chamber through their bath. Source: the manuals of FL1201,
SL, Presto and Magio (interface commands, status and error messages).

in_pv_00 -> 24.6        in_sp_00 -> 25.0        in_mode_05 -> 0 or 1      status -> 03 REMOTE START, -01 LOW LEVEL ALARM
out_sp_00 25.0          out_mode_05 1           commands end with CR; the replies with LF, and out has none
in_mode_01 -> 0, 1, 2: T1, T2, T3 acts (sp_00 is T1)       in_mode_04 -> 0 internal, 1 external control
in_sp_06 -> 0 degC, 1 degF on some FP51-SL                 a unit without one of these answers -08, or not at all
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Literal

from pydantic import Field

from thermostand.drivers.devices.chambers.chamber_language import (
    ChamberLanguage,
    ChamberState,
    ChamberUnitSettings,
    parse_line,
)
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.errors import GarbledReply, Refused, Unreachable

_NUMBER = re.compile(r"-?\d{1,3}\.\d{1,2}")
_STATUS = re.compile(r"(-?\d{2}) ([ -~]{1,80})")
_MANUAL = {"00", "01"}
_REMOTE = {"02", "03"}
_ABOUT_A_COMMAND = {"-08", "-09", "-10", "-11", "-13"}  # of the last one; the others are alarms and warnings
_UNKNOWN = "-08"
_QUERIES = {
    "in_mode_01": "which working temperature acts",
    "in_mode_04": "whether a sensor outside is controlled",
    "in_sp_06": "whether temperatures are in degC",
}
_BY_HAND = "it is operated by hand: choose remote control (RS232, USB) at its panel"
_EXTERNAL = (
    "external control is on (in_mode_04 is 1), so its set-point is of another sensor; choose internal at its panel"
)
_DEGF = "its temperatures are in degF (in_sp_06 is 1); choose degC at its panel"


def parse_temperature(heard: bytes) -> float | None:
    """The temperature in a reply, degC; None until it has come whole; ValueError when it is none."""
    line = parse_line(heard)
    if line is None:
        return None
    if not _NUMBER.fullmatch(line.strip()):
        raise ValueError("expected a number")
    return float(line)


def parse_status(heard: bytes) -> tuple[str, str] | None:
    """Code and words of a reply to `status`; None until it has come whole; ValueError when it is none."""
    line = parse_line(heard)
    if line is None:
        return None
    if (found := _STATUS.fullmatch(line)) is None:
        raise ValueError("expected two digits and a message")
    return found[1], found[2]


class JulaboSettings(ChamberUnitSettings):
    """A Julabo circulator or temperature system whose bath holds the chamber: RS-232 (older ones 4800 7E1), USB or TCP.
    Its set-point is the bath's, not the air's. asks_bank, asks_control, asks_unit: whether in_mode_01 (which working
    temperature acts), in_mode_04 (whether a sensor outside is controlled) and in_sp_06 are asked. in_sp_06 is the unit
    of temperatures on some FP51-SL only (0 degC, 1 degF); on a unit where it is another value that may be a bare 1, do
    not ask."""

    protocol: Literal["julabo"]
    baud: int = Field(default=4800, ge=1200, le=115200)
    parity: Literal["N", "E", "O"] = "E"
    databits: Literal[7, 8] = 7
    gap_s: float = Field(default=0.25, ge=0, le=5)  # asked for by the manuals
    asks_bank: bool = True
    asks_control: bool = True
    asks_unit: bool = True


Settings = JulaboSettings


class JulaboLanguage(ChamberLanguage):
    """One circulator."""

    def __init__(self, name: str, settings: JulaboSettings) -> None:
        super().__init__(name, settings, SerialSettings(settings.baud, 1, settings.parity, settings.databits))
        wanted = {
            "in_mode_01": settings.asks_bank,
            "in_mode_04": settings.asks_control,
            "in_sp_06": settings.asks_unit,
        }
        self._asked = [query for query, is_asked in wanted.items() if is_asked]
        self._say()

    def _say(self) -> None:
        """Log what the queries that this unit answers report, and what the others leave open."""
        texts = [f"{query} reports {text}" for query, text in _QUERIES.items() if query in self._asked]
        self.in_force_by = ", ".join((*texts, "status reports whether it is operated by hand"))
        unknown = [text for query, text in _QUERIES.items() if query not in self._asked]
        self.not_reported = f"{', '.join(unknown)}: compare with its panel" if unknown else ""

    def identity(self) -> str:
        """The reply to `version`."""
        return self.client.query(b"version\r", parse_line)

    def state(self) -> ChamberState:
        """Read the state of the bath and of its status: what that says of a command that it did not take is no
        alarm."""
        code, words = self._status()
        mode = self.client.query(b"in_mode_05\r", parse_line)
        if mode not in ("0", "1"):
            raise GarbledReply(self._name, f"in_mode_05 was answered by {mode!r}")
        is_alarm = code.startswith("-") and code not in _ABOUT_A_COMMAND
        return ChamberState(
            self.client.query(b"in_pv_00\r", parse_temperature),
            self.client.query(b"in_sp_00\r", parse_temperature),
            mode == "1",
            (f"{code} {words}",) if is_alarm else (),
            objections=tuple(self._objections(code)),
        )

    def set_temperature(self, degC: float) -> None:
        """out_sp_00 25.0."""
        self._tell(f"out_sp_00 {degC:.1f}")

    def humidity_off(self) -> None:
        """It has none."""

    def run(self, on: bool) -> None:
        """out_mode_05 1 or 0."""
        self._tell(f"out_mode_05 {int(on)}")

    def _objections(self, code: str) -> Iterator[str]:
        if code in _MANUAL:
            yield _BY_HAND
        bank = self._mode("in_mode_01")
        if bank not in ("", "0"):
            name = f"T{int(bank) + 1}" if bank in ("1", "2") else "of another number"
            yield f"working temperature {name} acts (in_mode_01 is {bank}), and T1 is set; choose T1 at its panel"
        control = self._mode("in_mode_04")
        if control not in ("", "0"):
            yield _EXTERNAL
        if self._mode("in_sp_06") == "1":
            yield _DEGF

    def _mode(self, query: str) -> str:
        """A setting that not every unit has; "" when it does not know it, twice, and then it is not asked again."""
        for _ in range(2 if query in self._asked else 0):
            try:
                answer = self.client.query(f"{query}\r".encode("ascii"), parse_line).strip()
            except Unreachable:  # -08 may be in the status only
                if self._status()[0] != _UNKNOWN:
                    raise
                continue
            if answer.isdecimal():
                return answer
            if not (answer.startswith(_UNKNOWN) or query == "in_sp_06"):  # which is a temperature or pressure elsewhere
                raise GarbledReply(self._name, f"{query} was answered by {answer!r}")
        if query in self._asked:
            self._asked.remove(query)
            self._say()
        return ""

    def _status(self) -> tuple[str, str]:
        code, words = self.client.query(b"status\r", parse_status)
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


Language = JulaboLanguage
