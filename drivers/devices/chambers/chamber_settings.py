"""The settings of climate chambers with a controller of their own, by the language that they speak."""

from __future__ import annotations

from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from thermostand.drivers.settings import Line, Polled, Range
from thermostand.foundation.addresses import ByteAddress


class ChamberUnitSettings(Polled):
    """What the chambers have in common. address: `serial:PATH` or `tcp:HOST:PORT`. identity: text that must be in what
    the unit says of itself; "" accepts any. limits_at_panel_degC: the set-point limits that somebody has set at the
    panel, for a make that does not tell them. timeout_s, gap_s: real seconds for a reply, and between two requests."""

    address: ByteAddress
    identity: Line = ""
    limits_at_panel_degC: Range | None = None
    timeout_s: float = Field(default=1.0, gt=0, le=10)
    gap_s: float = Field(default=0.1, ge=0, le=5)


class EspecSettings(ChamberUnitSettings):
    """ESPEC P300, SCP-220 and their relatives: ASCII lines. unit: of an RS-485 line, none for RS-232 and TCP (port
    10001). quick_timer: a timer of the chamber that stops it 10 min after the last renewal, unverified on a unit."""

    protocol: Literal["espec"]
    unit: int | None = Field(default=None, ge=1, le=16)
    baud: int = Field(default=19200, ge=1200, le=115200)
    quick_timer: bool = False


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


ClimateChamberSettings = Annotated[
    EspecSettings | CtsSettings | Ascii2Settings | SimservSettings | JulaboSettings, Field(discriminator="protocol")
]
