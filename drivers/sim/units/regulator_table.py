"""The stored registers of the fake Omron E5CC, two-byte mode: address, value at delivery, range, decimals.

Sources: communications manual H175 section 5 (0x21.., 0x29.., 0x2A.., 0x2C.. to 0x2E..), H186 for 0x2701..0x2723.
The proportional bands and times are not the factory's but those a commissioning of the simulated chamber found.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import Enum

from thermostand.drivers.sim.units.pid import Gains, Side

PT100_RANGE_DEGC = (-199.9, 500.0)  # input type 1


class Writable(Enum):
    """When a register takes a value over communications."""

    ALWAYS = "always"
    STOPPED = "only while stopped"
    SETUP = "only in setup area 1, which the fake never enters"


DISPLAY = None  # decimals of a temperature: as many as the display shows, register 0x2410


@dataclass(frozen=True, slots=True)
class Parameter:
    """One stored register: value at delivery, range, decimals on the wire."""

    default: float
    low: float
    high: float
    decimals: int | None
    writable: Writable = Writable.ALWAYS


SETPOINT = 0x2103
COOL_BAND, COOL_INTEGRAL, COOL_DERIVATIVE, DEAD_BAND = 0x2701, 0x2702, 0x2703, 0x2704
HEAT_PERIOD, COOL_PERIOD = 0x2708, 0x2709
MV_AT_STOP, MV_AT_ERROR = 0x270F, 0x2711
INPUT_SHIFT = 0x2723
HEAT_BAND, HEAT_INTEGRAL, HEAT_DERIVATIVE = 0x2A00, 0x2A01, 0x2A02
MV_UPPER, MV_LOWER = 0x2A05, 0x2A06
TUNED = (HEAT_BAND, COOL_BAND), (HEAT_INTEGRAL, COOL_INTEGRAL), (HEAT_DERIVATIVE, COOL_DERIVATIVE)  # by autotuning
SETPOINT_0 = 0x2900  # the same set point as 0x2103 while multi-SP is off

# Stored only. Alarm 1: value, upper and lower limit of an alarm of type 0. SP1..SP7 while multi-SP is off.
ALARM = Parameter(0.0, -199.9, 999.9, DISPLAY)
SPARE_SETPOINT = Parameter(0.0, *PT100_RANGE_DEGC, DISPLAY)

PARAMETERS = {
    SETPOINT: Parameter(0.0, *PT100_RANGE_DEGC, DISPLAY),
    **dict.fromkeys((0x2104, 0x2105, 0x2106), ALARM),
    COOL_BAND: Parameter(3.0, 0.1, 999.9, DISPLAY),
    COOL_INTEGRAL: Parameter(180, 0, 3999, 0),
    COOL_DERIVATIVE: Parameter(20, 0, 3999, 0),
    DEAD_BAND: Parameter(0.0, -199.9, 999.9, DISPLAY),
    HEAT_PERIOD: Parameter(2, -2, 99, 0, Writable.STOPPED),
    COOL_PERIOD: Parameter(20, -2, 99, 0, Writable.STOPPED),
    MV_AT_STOP: Parameter(0.0, -105.0, 105.0, 1),
    MV_AT_ERROR: Parameter(0.0, -105.0, 105.0, 1),
    0x2705: Parameter(0.0, -105.0, 105.0, 1),  # stored only: manual reset, the output of a PD control
    0x2706: Parameter(1.0, 0.1, 999.9, DISPLAY),  # stored only: hysteresis of ON/OFF control, heating
    0x2707: Parameter(1.0, 0.1, 999.9, DISPLAY),  # and cooling
    0x2713: Parameter(0.0, 0.0, 100.0, 1),  # stored only: MV change rate limit, 0 = none
    INPUT_SHIFT: Parameter(0.0, -199.9, 999.9, DISPLAY),
    HEAT_BAND: Parameter(3.0, 0.1, 999.9, DISPLAY),
    HEAT_INTEGRAL: Parameter(180, 0, 3999, 0),
    HEAT_DERIVATIVE: Parameter(20, 0, 3999, 0),
    MV_UPPER: Parameter(100.0, 0.0, 105.0, 1),
    MV_LOWER: Parameter(-100.0, -105.0, 0.0, 1),
    **dict.fromkeys(range(0x290E, 0x2963, 14), SPARE_SETPOINT),
    0x2C00: Parameter(1, 0, 29, 0, Writable.SETUP),  # input type: Pt100, -199.9..500.0 degC
    0x2D14: Parameter(1, 0, 1, 0, Writable.SETUP),  # 2-PID
    0x2E06: Parameter(1, 0, 10, 0, Writable.SETUP),  # output 1: heating
    0x2E07: Parameter(2, 0, 10, 0, Writable.SETUP),  # output 2: cooling
}


def gains_of(ram: Mapping[int, float]) -> Gains:
    """The constants of the PID that these registers hold."""
    return Gains(
        heat=Side(ram[HEAT_BAND], ram[HEAT_INTEGRAL], ram[HEAT_DERIVATIVE], ram[MV_UPPER]),
        cool=Side(ram[COOL_BAND], ram[COOL_INTEGRAL], ram[COOL_DERIVATIVE], -ram[MV_LOWER]),
        dead_band_K=ram[DEAD_BAND],
    )


def stored_at(address: int) -> int:
    """Where the value of an address is kept: SP0 is the set point."""
    return SETPOINT if address == SETPOINT_0 else address


def to_word(value: float, decimals: int) -> int:
    """A value as a 16-bit two's complement word with that many decimals."""
    return max(-0x8000, min(0x7FFF, round(value * 10**decimals))) & 0xFFFF


def to_value(word: int, decimals: int) -> float:
    """A word back as a value."""
    return (word - 0x10000 if word & 0x8000 else word) / 10**decimals
