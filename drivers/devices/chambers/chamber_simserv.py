"""Weiss and Voetsch with SIMPAC or LabEvent: SIMSERV over TCP. Source: public drivers, two of which agree on each
command but 10010.

11004¶1¶1      -> 1¶24.98     actual temperature: command, chamber, argument; CR, and CR LF behind the reply
11001¶1¶1¶30.0 -> 1           a set-point: 1 is done, a negative number says why not; ¶ is one byte, B6
"""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from thermostand.drivers.devices.chambers.chamber_language import (
    PROGRAM,
    ChamberLanguage,
    ChamberState,
    ChamberUnitSettings,
)
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.addresses import ByteAddress
from thermostand.foundation.errors import GarbledReply, Refused

_MARK = "\xb6"  # a byte of Latin-1, not of UTF-8
_NUMBER = re.compile(r"-?\d+(?:\.\d+)?")
_REFUSAL = re.compile(r"-\d{1,2}")
_REFUSALS = {
    "-4": "it knows no such system",
    "-5": "it does not know this command",
    "-6": "it does not take these parameters",
    "-8": "it has no such channel",
}
_TEMPERATURE = 1  # the first control variable; the second one is humidity
_TYPE, _SERIAL_NUMBER = 1, 3  # what 99997 is asked for
_RUNNING, _ALARM = 2, 8  # bits of 10012
_IN_PROGRAM = "4"  # of 10010
_MOST_MESSAGES = 50  # round number; nothing was measured
_ALARM_MESSAGE = "1"  # of 17005
_GRADIENTS = {11066: "upwards", 11070: "downwards"}  # K/min, 0 for none


def parse_reply(heard: bytes) -> tuple[str, list[str]] | None:
    """Code and values of a reply: ("1", ["24.98"]), ("-5", []); None until it has come whole; ValueError when it is
    none."""
    if not heard.endswith(b"\r\n"):
        return None
    code, *values = heard[:-2].decode("latin-1").split(_MARK)
    if not (code == "1" or (_REFUSAL.fullmatch(code) and not values)):
        raise ValueError("expected 1 and its values, or a negative code")
    return code, values


class SimservSettings(ChamberUnitSettings):
    """Weiss and Voetsch with SIMPAC or LabEvent: SIMSERV over TCP (port 2049). chamber: its number there.
    start_channel, off_channels: digital channels, as `14001` counts them; the off_channels (humidity, condensation) are
    set to 0 at each start. allows_gradient: one that is set at the unit is wanted; it is not asked for then."""

    protocol: Literal["simserv"]
    address: Annotated[ByteAddress, Field(pattern="^tcp:")]
    chamber: int = Field(default=1, ge=1, le=99)
    start_channel: int = Field(default=1, ge=0, le=99)
    off_channels: tuple[Annotated[int, Field(ge=0, le=99)], ...] = ()
    allows_gradient: bool = False

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        if self.start_channel in self.off_channels:
            raise ValueError(f"start_channel {self.start_channel} is one of off_channels, too")
        return self


Settings = SimservSettings


class SimservLanguage(ChamberLanguage):
    """One Weiss or Voetsch chamber."""

    in_force_by = "11002 reports the set-point, 10010 whether a program runs, 11066 and 11070 whether a gradient is set"
    not_reported = "the unit of temperatures, which the stand compares with its own thermometer, and who has the panel"

    def __init__(self, name: str, settings: SimservSettings) -> None:
        super().__init__(name, settings, SerialSettings(9600, 1))  # the line is of no meaning over TCP
        self._settings = settings

    def identity(self) -> str:
        """Read the unit's type and serial number."""
        return f"{self._text(99997, _TYPE)}, serial number {self._text(99997, _SERIAL_NUMBER)}"

    def limits_degC(self) -> tuple[float, float] | None:
        """Read the limits by 11007 and 11009."""
        low_degC, high_degC = sorted((self._number(11007, _TEMPERATURE), self._number(11009, _TEMPERATURE)))
        return low_degC, high_degC

    def state(self) -> ChamberState:
        """Temperatures, its state, the start channel, its messages while it says that there is an alarm."""
        flags = int(self._number(10012))
        return ChamberState(
            self._number(11004, _TEMPERATURE),
            self._number(11002, _TEMPERATURE),
            bool(flags & _RUNNING) or self._is_on(self._settings.start_channel),
            self._alarms() if flags & _ALARM else (),
            humidity_on=any(self._is_on(channel) for channel in self._settings.off_channels),
            objections=(*((PROGRAM,) if self._text(10010) == _IN_PROGRAM else ()), *self._gradients()),
        )

    def set_temperature(self, degC: float) -> None:
        """11001."""
        self._tell(11001, _TEMPERATURE, f"{degC:.1f}")

    def humidity_off(self) -> None:
        """The off_channels to 0."""
        for channel in self._settings.off_channels:
            self._tell(14001, channel, 0)

    def run(self, on: bool) -> None:
        """The start channel; a program of its own goes on without it, and is ended first."""
        if not on and self._text(10010) == _IN_PROGRAM:
            self._tell(19015)
        self._tell(14001, self._settings.start_channel, int(on))

    def _gradients(self) -> tuple[str, ...]:
        """Read the gradients that are set; a unit that has none refuses the question."""
        if self._settings.allows_gradient:
            return ()
        found: list[str] = []
        for command, way in _GRADIENTS.items():
            try:
                K_per_min = self._number(command, _TEMPERATURE)
            except Refused:
                continue
            if K_per_min > 0:
                found.append(
                    f"a gradient of {K_per_min:g} K/min {way} is set ({command}), and the set-point is reached only by "
                    "it; set it to 0 at the panel, or allow it by allows_gradient"
                )
        return tuple(found)

    def _alarms(self) -> tuple[str, ...]:
        """The texts of the alarms that stand, of all its messages."""
        count = min(int(self._number(17002)), _MOST_MESSAGES)
        standing = [
            index
            for index in range(1, count + 1)
            if self._text(17009, index) == "1" and self._text(17005, index) == _ALARM_MESSAGE
        ]
        return tuple(self._text(17007, index) for index in standing) or ("an alarm",)

    def _is_on(self, channel: int) -> bool:
        return self._text(14003, channel) == "1"

    def _number(self, command: int, *arguments: object) -> float:
        text = self._text(command, *arguments)
        if not _NUMBER.fullmatch(text):
            raise GarbledReply(self._name, f"{command} was answered by {text!r}, which is no number")
        return float(text)

    def _text(self, command: int, *arguments: object) -> str:
        """The one value of a read."""
        values = self._taken(command, self.client.query(self._request(command, arguments), parse_reply))
        if len(values) != 1:
            raise GarbledReply(self._name, f"{command} was answered by {len(values)} values")
        return values[0].strip()

    def _tell(self, command: int, *arguments: object) -> None:
        self._taken(command, self.client.send(self._request(command, arguments), parse_reply))

    def _taken(self, command: int, reply: tuple[str, list[str]]) -> list[str]:
        code, values = reply
        if code != "1":
            raise Refused(self._name, f"{command}: {_REFUSALS.get(code, 'it refuses that')} ({code})")
        return values

    def _request(self, command: int, arguments: tuple[object, ...]) -> bytes:
        words = [str(command), str(self._settings.chamber), *map(str, arguments)]
        return (_MARK.join(words) + "\r").encode("latin-1")


Language = SimservLanguage
