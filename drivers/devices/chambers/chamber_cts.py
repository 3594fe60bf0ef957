"""CTS (ITC, Cadimac): short ASCII commands, framed on RS-232, bare over TCP. Source: the maker's interface manual.

A0  -> A0 024.5 025.0      actual and set temperature          a0 025.0 -> a     s1 1 -> s1     s1 0 -> s1
P   -> P002, the program that runs, 000 for none                R1  -> R1 ab up down end: a active, b running
O   -> O, start, error, unused, flags (x4: door closed); its length differs from unit to unit
S   -> S, run, error, not paused, humidity on, 4 more, code    F -> F and 32 characters of error text
framed: STX, 80+address, text, CHK, ETX; between STX and ETX every byte has bit 7 set, CHK = XOR of address and text
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from functools import reduce
from operator import xor
from typing import Literal, TypeVar

from pydantic import Field

from thermostand.drivers.devices.chambers.chamber_language import (
    PROGRAM,
    ChamberLanguage,
    ChamberState,
    ChamberUnitSettings,
)
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.errors import Refused

Found = TypeVar("Found")

_STX, _ETX, _HIGH = 0x02, 0x03, 0x80
_TEMPERATURES = re.compile(r"A0 (-?\d{2,3}\.\d) (-?\d{2,3}\.\d)")
_STATE = re.compile(r"S([01?]{8})(.)", re.DOTALL)
_DOOR_CLOSED = 0x04
_NO_PROGRAM = 0
_NO_ERROR = {0x00, 0x30}  # code bytes


def wrap_frame(unit: int, text: str) -> bytes:
    """The frame of a text: framed(1, "O") = 02 81 CF CE 03."""
    body = bytes([_HIGH | unit, *(byte | _HIGH for byte in text.encode("latin-1"))])
    return bytes([_STX, *body, reduce(xor, body) | _HIGH, _ETX])


def unwrap_frame(unit: int, heard: bytes) -> str | None:
    """The text of the frame that has come; None until it is whole; ValueError when it is none, or another unit's."""
    if not heard.endswith(bytes([_ETX])) or len(heard) < 4:
        return None
    body, check = heard[1:-2], heard[-2]
    if heard[0] != _STX or reduce(xor, body) | _HIGH != check or not all(byte & _HIGH for byte in body):
        raise ValueError("not a frame, or a wrong checksum")
    if body[0] != _HIGH | unit:
        raise ValueError(f"unit {body[0] & 0x7F} has answered, not {unit}")
    return bytes(byte & 0x7F for byte in body[1:]).decode("latin-1")


class CtsSettings(ChamberUnitSettings):
    """CTS (ITC, Cadimac): framed ASCII on RS-232 (19200 8O1), bare text over TCP (port 1080). door_reply: how many
    characters this unit's reply to O has, whose flags tell whether its door is closed; none: it is not asked.
    program_reply, ramp_reply: the same of P, the number of the program that runs, and of R1, its ramp, whose length no
    manual at hand states."""

    protocol: Literal["cts"]
    unit: int = Field(default=1, ge=1, le=32)
    baud: int = Field(default=19200, ge=1200, le=115200)
    parity: Literal["N", "E", "O"] = "O"
    door_reply: int | None = Field(default=None, ge=5, le=64)
    program_reply: int | None = Field(default=4, ge=2, le=8)
    ramp_reply: int | None = Field(default=None, ge=6, le=64)


Settings = CtsSettings


class CtsLanguage(ChamberLanguage):
    """One CTS chamber."""

    not_reported = "the unit of temperatures, which the stand compares with its own thermometer, and who has the panel"

    def __init__(self, name: str, settings: CtsSettings) -> None:
        self._is_serial = settings.address.startswith("serial:")  # a frame has no bytes of flow control, bare text may
        super().__init__(name, settings, SerialSettings(settings.baud, 1, settings.parity), is_text=self._is_serial)
        self._unit = settings.unit
        self._door_reply = settings.door_reply
        self._program_reply, self._ramp_reply = settings.program_reply, settings.ramp_reply
        asked = {"P whether a program runs": settings.program_reply, "R1 whether a ramp does": settings.ramp_reply}
        self.in_force_by = ", ".join(
            ("A0 reports the set-point", *(text for text, is_asked in asked.items() if is_asked))
        )
        if unasked := [text for text, is_asked in asked.items() if not is_asked]:
            self.not_reported = f"{', '.join(unasked)} (not asked); {self.not_reported}"

    def state(self) -> ChamberState:
        """Read the state by A0, S, and F when there is an error."""
        actual, nominal = self.client.query(*self._asked("A0", 14, self._temperatures))
        flags, code = self.client.query(*self._asked("S", 10, self._flags))
        alarms = (self._error_text(code),) if flags[1] == "1" or ord(code) & 0x7F not in _NO_ERROR else ()
        if flags[2] == "0":
            alarms = (*alarms, "it is paused")
        is_open = self._door_reply is not None and self.client.query(*self._asked("O", self._door_reply, _parse_door))
        return ChamberState(
            actual,
            nominal,
            flags[0] == "1",
            alarms,
            humidity_on=flags[3] == "1",
            door_open=bool(is_open),
            objections=tuple(self._objections()),
        )

    def set_temperature(self, degC: float) -> None:
        """a0 025.0."""
        self.client.send(*self._asked(f"a0 {degC:05.1f}", 1, _expecting("a")))

    def humidity_off(self) -> None:
        """Refuse: the channel of humidity control differs from unit to unit, so the panel must switch it off."""
        raise Refused(self._name, "humidity is on, and can only be switched off at the panel: do so, and start again")

    def run(self, on: bool) -> None:
        """s1 1 or s1 0."""
        self.client.send(*self._asked(f"s1 {int(on)}", 2, _expecting("s1")))

    def _objections(self) -> Iterator[str]:
        if self._program_reply is not None:
            number = self.client.query(*self._asked("P", self._program_reply, _parse_program))
            if number != _NO_PROGRAM:
                yield f"{PROGRAM} (number {number})"
        if self._ramp_reply is not None and self.client.query(*self._asked("R1", self._ramp_reply, _parse_ramps)):
            yield "a ramp of its own runs (R1), and the set-point is reached only by it; end it at the panel"

    def _error_text(self, code: str) -> str:
        text = self.client.query(*self._asked("F", 33, lambda text: text[1:].strip() if text[:1] == "F" else None))
        return text or f"error {code!r}"

    def _temperatures(self, text: str) -> tuple[float, float] | None:
        found = _TEMPERATURES.fullmatch(text)
        return (float(found[1]), float(found[2])) if found else None

    def _flags(self, text: str) -> tuple[str, str] | None:
        found = _STATE.fullmatch(text)
        return (found[1], found[2]) if found else None

    def _asked(
        self, text: str, length: int, parse: Callable[[str], Found | None]
    ) -> tuple[bytes, Callable[[bytes], Found | None]]:
        """The request, and what makes its answer of the bytes that have come; a bare text ends at its length."""

        def answer(heard: bytes) -> Found | None:
            if self._is_serial:
                reply = unwrap_frame(self._unit, heard)
            else:
                reply = heard.decode("latin-1") if len(heard) >= length else None
            if reply is None:
                return None
            if len(reply) != length or (found := parse(reply)) is None:
                raise ValueError(f"not a reply to {text!r}")
            return found

        return wrap_frame(self._unit, text) if self._is_serial else text.encode("ascii"), answer


def _parse_program(text: str) -> int | None:
    return int(text[1:]) if text[:1] == "P" and text[1:].isdecimal() else None


def _parse_ramps(text: str) -> bool | None:
    found = re.match(r"R1 ([01])([01]) ", text)
    return found[2] == "1" if found else None


def _parse_door(text: str) -> bool | None:
    """Parse the reply to O, start, error, unused, flags: bit 2 is set while the door is closed (example of the
    manual)."""
    return not ord(text[4]) & _DOOR_CLOSED if text[:1] == "O" else None


def _expecting(word: str) -> Callable[[str], str | None]:
    return lambda text: word if text == word else None


Language = CtsLanguage
