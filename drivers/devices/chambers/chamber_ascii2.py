"""Weiss and Voetsch, ASCII-2 (SIMPAC, SIMCON/32). Source: the maker's interface description by way of public drivers.

    $01I -> 0050.0 0024.6 0080.0 0066.7 ... 01100000000000000000000000000000     nominal, actual pairs, 32 digits; CR
    $01E 0050.0 0080.0 ... 01100000000000000000000000000000                      sets every field and bit at once

There is no checksum, and a write that has no effect (EXTERN is off at the panel) is answered like one that has: what
counts is what is read afterwards. `$01?` describes the fields of a unit, its limits in a form of its own.
"""

from __future__ import annotations

import re
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from thermostand.drivers.devices.chambers.chamber_language import ChamberLanguage, ChamberState, ChamberUnitSettings
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.errors import Unreachable

_FIELD = re.compile(r"-?\d{3,4}\.\d")
_DIGITS = re.compile(r"[01]{26}|[01]{32}")


def parse(heard: bytes) -> tuple[list[float], str] | None:
    """The analog fields and the digits of a reply to I; None until it has come whole; ValueError when it is none."""
    if not heard.endswith((b"\r", b"\n")):
        return None
    fields = [field for field in heard.decode("ascii").strip("\r\n").split(" ") if field]
    if len(fields) < 3 or not _DIGITS.fullmatch(fields[-1]):
        raise ValueError("expected numbers, then digits")
    if not all(_FIELD.fullmatch(field) and len(field) == 6 for field in fields[:-1]):
        raise ValueError("expected numbers of 6 characters")
    return [float(field) for field in fields[:-1]], fields[-1]


def number(value: float) -> str:
    """0025.0, -040.0."""
    return f"{value:06.1f}"


class Ascii2Settings(ChamberUnitSettings):
    """Weiss and Voetsch (SIMPAC, SIMCON/32): ASCII-2 on RS-232/485 or TCP (port 2049). What a field means differs from
    unit to unit: `$01?` describes it.

    write_fields: the fields of the reply, from 0, that a write command takes, in its order. order: of each pair of the
    reply. start_bit, off_bits: digital channels, from 0; the off_bits (humidity, condensation) are set to 0 at each
    start. shows_ramp: the nominal value in the reply moves with a ramp ("show target set-point").
    """

    protocol: Literal["ascii2"]
    unit: int = Field(default=1, ge=0, le=31)
    baud: int = Field(default=9600, ge=1200, le=115200)
    order: Literal["nominal_actual", "actual_nominal"] = "nominal_actual"
    write_fields: tuple[Annotated[int, Field(ge=0, le=63)], ...] = (0, 2, 4, 6, 8, 10, 12)
    start_bit: int = Field(default=1, ge=0, le=31)
    off_bits: tuple[Annotated[int, Field(ge=0, le=31)], ...] = (2,)
    shows_ramp: bool = False
    gap_s: float = Field(default=0.5, ge=0, le=5)  # other drivers pause as long

    @model_validator(mode="after")
    def _distinct(self) -> Self:
        if self.start_bit in self.off_bits:
            raise ValueError(f"start_bit {self.start_bit} is one of off_bits, too")
        nominal = 0 if self.order == "nominal_actual" else 1
        if not self.write_fields or self.write_fields[0] != nominal:
            raise ValueError(f"write_fields has to begin with {nominal}, the nominal temperature")
        return self


Settings = Ascii2Settings


class Ascii2Language(ChamberLanguage):
    """One Weiss or Voetsch chamber."""

    in_force_by = "the nominal value in the reply to I, which a program moves"
    not_reported = (
        "whether a program runs that has not moved it yet, whether EXTERN is on before something is written, a ramp "
        "whose target it shows, and the unit of temperatures, which the stand compares with its own thermometer"
    )

    def __init__(self, name: str, settings: Ascii2Settings) -> None:
        super().__init__(name, settings, SerialSettings(settings.baud, 1))
        self._settings = settings
        self._shape: tuple[int, int] | None = None  # fields and digits of the last reply
        self._way_degC: tuple[float, float] | None = None  # of the last set-point: from where, to where

    def state(self) -> ChamberState:
        """Read the state by I."""
        values, digits = self._read()
        nominal = 0 if self._settings.order == "nominal_actual" else 1
        return ChamberState(
            values[1 - nominal],
            values[nominal],
            _bit(digits, self._settings.start_bit),
            humidity_on=any(_bit(digits, bit) for bit in self._settings.off_bits),
            ramp_degC=values[nominal] if self._settings.shows_ramp else None,
        )

    def set_temperature(self, degC: float) -> None:
        """E with every other field as it is."""
        self._write(degC, {})

    def humidity_off(self) -> None:
        """E with the off_bits 0."""
        self._write(None, dict.fromkeys(self._settings.off_bits, False))

    def run(self, on: bool) -> None:
        """E with the start bit; the off_bits are 0."""
        self._write(None, {**dict.fromkeys(self._settings.off_bits, False), self._settings.start_bit: on})

    def _read(self) -> tuple[list[float], str]:
        return self.client.query(self._bytes("I"), self._answer)

    def _answer(self, heard: bytes) -> tuple[list[float], str] | None:
        """Parse the answer; a unit always sends as many fields and digits: a reply that lost some bytes gives itself
        away."""
        if (found := parse(heard)) is None:
            return None
        if len(found[0]) <= max(*self._settings.write_fields, 1):
            raise ValueError(f"{len(found[0])} fields, and write_fields is {list(self._settings.write_fields)}")
        # No checksum protects a reply: one with another number of fields or digits than the one before it is refused.
        before, self._shape = self._shape, (len(found[0]), len(found[1]))
        if before not in (None, self._shape):
            raise ValueError(f"{self._shape[0]} fields and {self._shape[1]} digits, before {before[0]} and {before[1]}")
        return found

    def _write(self, degC: float | None, bits: dict[int, bool]) -> None:
        """What is not named stays as it was read just before."""
        values, digits = self._read()
        fields = [values[field] for field in self._settings.write_fields]
        if degC is not None:
            self._way_degC = (fields[0], degC)
        fields[0] = self._target_degC(fields[0]) if degC is None else degC
        written = "".join(str(int(bits.get(index, digit == "1"))) for index, digit in enumerate(digits))
        request = self._bytes("E " + " ".join([*map(number, fields), written]))
        try:
            self.client.send(request, lambda heard: heard if heard.endswith((b"\r", b"\n")) else None)
        except Unreachable:  # some units do not answer a write
            if not self.client.connected:
                self._read()  # over a new link; Unreachable when it is gone

    def _target_degC(self, nominal_degC: float) -> float:
        """A nominal value that is on its way is not where it goes: written back, it would end the ramp there."""
        if self._way_degC is None or not self._settings.shows_ramp:
            return nominal_degC
        low_degC, high_degC = sorted(self._way_degC)
        return self._way_degC[1] if low_degC <= nominal_degC <= high_degC else nominal_degC

    def _bytes(self, command: str) -> bytes:
        return f"${self._settings.unit:02d}{command}\r".encode("ascii")


def _bit(digits: str, index: int) -> bool:
    return index < len(digits) and digits[index] == "1"


Language = Ascii2Language
