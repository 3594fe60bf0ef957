"""ESPEC P300 and SCP-220: lines of ASCII. Source: the makers' communication manuals by way of two public drivers.

TEMP?                 26.4,0.0,140.0,-50.0     actual, set, high limit, low limit
MON?                  24.1,100,CONSTANT,0      temperature, humidity (empty without one), mode, number of alarms
TEMP, S23.0           OK:TEMP, S23.0           NA:DATA OUT OF RANGE, NA:PROTECT ON, ... when refused, also for reads
"""

from __future__ import annotations

import re
from typing import Literal

from pydantic import Field

from thermostand.drivers.devices.chambers.chamber_language import (
    PROGRAM,
    ChamberLanguage,
    ChamberState,
    ChamberUnitSettings,
    parse_line,
)
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.errors import GarbledReply, Refused

_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
_MODES = {"OFF": False, "STANDBY": False, "CONSTANT": True, "RUN": True}
_HINTS = {"PROTECT ON": "the panel's protection is on: remote control is refused until somebody takes it off"}
_TIMER = "0:10"


def _numbers(text: str, count: int) -> list[float]:
    fields = [field.strip(" ") for field in text.split(",")]
    if len(fields) != count or not all(_NUMBER.fullmatch(field) for field in fields):
        raise ValueError(f"expected {count} numbers")
    return [float(field) for field in fields]


class EspecSettings(ChamberUnitSettings):
    """ESPEC P300, SCP-220 and their relatives: ASCII lines. unit: of an RS-485 line, none for RS-232 and TCP (port
    10001). quick_timer: a timer of the chamber that stops it 10 min after the last renewal, unverified on a unit."""

    protocol: Literal["espec"]
    unit: int | None = Field(default=None, ge=1, le=16)
    baud: int = Field(default=19200, ge=1200, le=115200)
    quick_timer: bool = False


Settings = EspecSettings


class EspecLanguage(ChamberLanguage):
    """One ESPEC chamber."""

    in_force_by = "TEMP? reports the set-point that acts, MON? whether a program runs"
    not_reported = "the unit of temperatures, which the stand compares with its own thermometer"

    def __init__(self, name: str, settings: EspecSettings) -> None:
        super().__init__(name, settings, SerialSettings(settings.baud, 1))
        self._prefix = "" if settings.unit is None else f"{settings.unit},"
        self._quick_timer = settings.quick_timer
        if settings.quick_timer:
            self.dead_man = "its quick timer, which stops it 10 min after the last renewal (unverified on a unit)"

    def identity(self) -> str:
        """The reply to TYPE?, such as T,T,S2,160.0."""
        return self._ask("TYPE?")

    def limits_degC(self) -> tuple[float, float] | None:
        """Read the limits by TEMP?."""
        _, _, high_degC, low_degC = self._temperatures()
        return low_degC, high_degC

    def state(self) -> ChamberState:
        """Read the state by TEMP?, MON?, HUMI? and ALARM?."""
        actual_degC, set_degC, _, _ = self._temperatures()
        _, humidity, mode, alarms = self.client.query(self._bytes("MON?"), self._monitor)
        word = (mode.split() or [""])[0]
        if word not in _MODES:
            raise GarbledReply(self._name, f"unknown mode {mode!r}")
        codes = self._ask("ALARM?").split(",")[1:] if alarms else []
        return ChamberState(
            actual_degC,
            set_degC,
            _MODES[word],
            tuple(f"alarm {code.strip()}" for code in codes),
            self._humidity_on() if humidity else None,
            objections=(PROGRAM,) if word == "RUN" else (),
        )

    def set_temperature(self, degC: float) -> None:
        """TEMP, S23.0."""
        self._tell(f"TEMP, S{degC:.1f}")

    def humidity_off(self) -> None:
        """HUMI,SOFF."""
        self._tell("HUMI,SOFF")

    def run(self, on: bool) -> None:
        """MODE,CONSTANT or MODE,STANDBY."""
        self._tell("MODE,CONSTANT" if on else "MODE,STANDBY")
        if on:
            self.renew()

    def renew(self) -> None:
        """The quick timer begins again."""
        if self._quick_timer:
            self._tell(f"TIMER WRITE,NO0,{_TIMER},STANDBY")
            self._tell("TIMER,ON,0")

    def _temperatures(self) -> list[float]:
        return self.client.query(self._bytes("TEMP?"), self._limited)

    def _limited(self, heard: bytes) -> list[float] | None:
        """Actual, set, high and low limit; None until they have come whole."""
        line = parse_line(heard)
        if line is None:
            return None
        self._refuse(line, "TEMP?")
        return _numbers(line, 4)

    def _monitor(self, heard: bytes) -> tuple[float, str, str, int] | None:
        """Temperature, humidity, mode, number of alarms; None until they have come whole."""
        line = parse_line(heard)
        if line is None:
            return None
        self._refuse(line, "MON?")
        fields = [field.strip(" ") for field in line.split(",")]
        if len(fields) < 4 or not _NUMBER.fullmatch(fields[0]) or not fields[-1].isdigit():
            raise ValueError("expected temperature, humidity, mode, number of alarms")
        return float(fields[0]), fields[1], fields[2], int(fields[-1])

    def _humidity_on(self) -> bool:
        """`25,85,100,0`: the set value is no number when it is off."""
        fields = self._ask("HUMI?").split(",")
        return len(fields) > 1 and bool(_NUMBER.fullmatch(fields[1].strip()))

    def _ask(self, command: str) -> str:
        line = self.client.query(self._bytes(command), parse_line)
        self._refuse(line, command)
        return line

    def _tell(self, command: str) -> None:
        line = self.client.send(self._bytes(command), parse_line)
        self._refuse(line, command)
        if not line.startswith("OK:"):
            raise GarbledReply(self._name, f"{command!r} was answered by {line!r}")

    def _refuse(self, line: str, command: str) -> None:
        if line.startswith("NA:"):
            reason = line.removeprefix("NA:").strip()
            hint = next((text for word, text in _HINTS.items() if word in reason), "")
            raise Refused(self._name, f"{command}: {reason}{f'; {hint}' if hint else ''}")

    def _bytes(self, command: str) -> bytes:
        return f"{self._prefix}{command}\r\n".encode("ascii")


Language = EspecLanguage
