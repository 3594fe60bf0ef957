"""A heating/cooling regulator on the bus: Omron E5CC, registers in two-byte mode, with a real PID inside.

Source: communications manual H175, section 4 (functions, refusals, operation commands). The PID runs at every step of
the plant; nothing depends on when the registers are read.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum, IntEnum
from typing import Any, NamedTuple

from thermostand.drivers.sim.fakes import CONTROL, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.units.modbus import (
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    OPERATION_ERROR,
    BusUnit,
    ModbusRefusal,
    echoes,
    reads_words,
    writes_one,
    writes_words,
)
from thermostand.foundation.clock import NS_PER_S, Now, to_ns

# Heating/cooling PID with two degrees of freedom, as pure functions of its state (Omron calls it 2-PID).
#
# With set point r, measurement y, integral time Ti, derivative time Td and coefficient alpha:
#
#     reference   w = (1 - alpha) r + alpha r / (1 + Ti s)
#     demand      v = (w - y) (1 + 1 / (Ti s)) - Td s y / (1 + Td s / 8)            in K
#     heating     100 % (v - d/2) / Ph,    cooling    100 % (-v - d/2) / Pc         d: dead band, negative = overlap
#
# alpha = 0 is a plain PI-D, alpha = 1 an I-PD; the path from a disturbance to the output does not depend on alpha.
# Proportional bands are in K for 100 %. Ti and Td are those of the side that the demand was on in the step before.
# Sources: E5CC manual H174 (proportional bands, dead band, cooling band, alpha 0.65 by default).

DERIVATIVE_FILTER = 8.0  # Td over the time constant of the derivative's own lag


@dataclass(frozen=True, slots=True)
class Side:
    """Tuning of one output. band_K > 0; integral_s = 0 or derivative_s = 0 switches that action off; limit 0..105 %."""

    band_K: float
    integral_s: float
    derivative_s: float
    limit_pct: float = 100.0


@dataclass(frozen=True, slots=True)
class Gains:
    """Tuning of both outputs; see the formula at the top."""

    heat: Side
    cool: Side
    dead_band_K: float = 0.0
    alpha: float = 0.65


class PidState(NamedTuple):
    """What one step leaves for the next; a tuple, because one is made at every step of the plant."""

    reference_degC: float
    integral_K: float
    measured_degC: float
    slope_K_per_s: float
    demand_K: float


class Outputs(NamedTuple):
    """Manipulated values, %; both at once only with an overlapping (negative) dead band."""

    heat_pct: float
    cool_pct: float


OFF = Outputs(0.0, 0.0)


def start(measured_degC: float) -> PidState:
    """The state at the begin of control: the reference lag begins at the measurement, the integral is empty."""
    return PidState(measured_degC, 0.0, measured_degC, 0.0, 0.0)


def resume(outputs: Outputs, setpoint_degC: float, measured_degC: float, gains: Gains) -> PidState:
    """The state from which the next step gives `outputs` again: no bump from manual back to automatic."""
    half_K = gains.dead_band_K / 2
    if outputs.heat_pct > 0:
        demand_K = outputs.heat_pct / 100 * gains.heat.band_K + half_K
    elif outputs.cool_pct > 0:
        demand_K = -outputs.cool_pct / 100 * gains.cool.band_K - half_K
    else:
        demand_K = 0.0
    error_K = (1 - gains.alpha) * (setpoint_degC - measured_degC)
    return PidState(measured_degC, demand_K - error_K, measured_degC, 0.0, demand_K)


def step(
    state: PidState, setpoint_degC: float, measured_degC: float, dt_s: float, gains: Gains
) -> tuple[Outputs, PidState]:
    """One step: the outputs of the coming dt_s and the next state.

    The integral is frozen while the output is saturated and the error would push it further (conditional
    integration), so that a long ramp does not overshoot.
    """
    side = gains.cool if state.demand_K < 0 else gains.heat
    reference_degC = _lag(state.reference_degC, setpoint_degC, dt_s, side.integral_s)
    error_K = gains.alpha * reference_degC + (1 - gains.alpha) * setpoint_degC - measured_degC
    slope_K_per_s = _lag(
        state.slope_K_per_s,
        (measured_degC - state.measured_degC) / dt_s,
        dt_s,
        side.derivative_s / DERIVATIVE_FILTER,
    )
    demand_K = error_K + state.integral_K - side.derivative_s * slope_K_per_s
    integral_K = state.integral_K
    if side.integral_s > 0 and not _saturates(demand_K, error_K, gains):
        integral_K += error_K * dt_s / side.integral_s
    return compute_outputs(demand_K, gains), PidState(
        reference_degC, integral_K, measured_degC, slope_K_per_s, demand_K
    )


def compute_outputs(demand_K: float, gains: Gains) -> Outputs:
    """A demand (K, heating positive) as the two limited outputs."""
    half_K = gains.dead_band_K / 2
    return Outputs(
        heat_pct=min(gains.heat.limit_pct, max(0.0, 100 * (demand_K - half_K) / gains.heat.band_K)),
        cool_pct=min(gains.cool.limit_pct, max(0.0, 100 * (-demand_K - half_K) / gains.cool.band_K)),
    )


def on_time_ns(begin_ns: int, end_ns: int, duty: float, period_ns: int) -> int:
    """Return how long a time-proportioned output conducts within [begin, end): each period begins with duty x period
    on.

    Times are counted from the begin of the first period, duty is 0..1.
    """
    on_ns = round(min(1.0, max(0.0, duty)) * period_ns)
    periods, into_ns = divmod(begin_ns, period_ns)
    last, last_into_ns = divmod(end_ns, period_ns)
    return (last - periods) * on_ns + min(last_into_ns, on_ns) - min(into_ns, on_ns)


def _lag(value: float, target: float, dt_s: float, time_constant_s: float) -> float:
    """First-order lag, implicit Euler: stable for every time constant, and without lag for 0."""
    return value + (target - value) * dt_s / (time_constant_s + dt_s)


def _saturates(demand_K: float, error_K: float, gains: Gains) -> bool:
    half_K = gains.dead_band_K / 2
    highest_K = gains.heat.band_K * gains.heat.limit_pct / 100 + half_K
    lowest_K = -gains.cool.band_K * gains.cool.limit_pct / 100 - half_K
    return (demand_K >= highest_K and error_K > 0) or (demand_K <= lowest_K and error_K < 0)


# The stored registers of the fake Omron E5CC, two-byte mode: address, value at delivery, range, decimals.
#
# Sources: communications manual H175 section 5 (0x21.., 0x29.., 0x2A.., 0x2C.. to 0x2E..), H186 for 0x2701..0x2723.
# The proportional bands and times are not the factory's but those a commissioning of the simulated chamber found.


PT100_RANGE_DEGC = (-199.9, 500.0)  # input type 1


class Writable(Enum):
    """When a register takes a value over communications."""

    ALWAYS = "always"
    STOPPED = "only while stopped"
    SETUP = "only in setup area 1, which the fake never enters"


DISPLAY = None  # decimals of a temperature: as many as the display shows, register 0x2410


@dataclass(frozen=True, slots=True)
class StoredRegister:
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
ALARM = StoredRegister(0.0, -199.9, 999.9, DISPLAY)
SPARE_SETPOINT = StoredRegister(0.0, *PT100_RANGE_DEGC, DISPLAY)

PARAMETERS = {
    SETPOINT: StoredRegister(0.0, *PT100_RANGE_DEGC, DISPLAY),
    **dict.fromkeys((0x2104, 0x2105, 0x2106), ALARM),
    COOL_BAND: StoredRegister(3.0, 0.1, 999.9, DISPLAY),
    COOL_INTEGRAL: StoredRegister(180, 0, 3999, 0),
    COOL_DERIVATIVE: StoredRegister(20, 0, 3999, 0),
    DEAD_BAND: StoredRegister(0.0, -199.9, 999.9, DISPLAY),
    HEAT_PERIOD: StoredRegister(2, -2, 99, 0, Writable.STOPPED),
    COOL_PERIOD: StoredRegister(20, -2, 99, 0, Writable.STOPPED),
    MV_AT_STOP: StoredRegister(0.0, -105.0, 105.0, 1),
    MV_AT_ERROR: StoredRegister(0.0, -105.0, 105.0, 1),
    0x2705: StoredRegister(0.0, -105.0, 105.0, 1),  # stored only: manual reset, the output of a PD control
    0x2706: StoredRegister(1.0, 0.1, 999.9, DISPLAY),  # stored only: hysteresis of ON/OFF control, heating
    0x2707: StoredRegister(1.0, 0.1, 999.9, DISPLAY),  # and cooling
    0x2713: StoredRegister(0.0, 0.0, 100.0, 1),  # stored only: MV change rate limit, 0 = none
    INPUT_SHIFT: StoredRegister(0.0, -199.9, 999.9, DISPLAY),
    HEAT_BAND: StoredRegister(3.0, 0.1, 999.9, DISPLAY),
    HEAT_INTEGRAL: StoredRegister(180, 0, 3999, 0),
    HEAT_DERIVATIVE: StoredRegister(20, 0, 3999, 0),
    MV_UPPER: StoredRegister(100.0, 0.0, 105.0, 1),
    MV_LOWER: StoredRegister(-100.0, -105.0, 0.0, 1),
    **dict.fromkeys(range(0x290E, 0x2963, 14), SPARE_SETPOINT),
    0x2C00: StoredRegister(1, 0, 29, 0, Writable.SETUP),  # input type: Pt100, -199.9..500.0 degC
    0x2D14: StoredRegister(1, 0, 1, 0, Writable.SETUP),  # 2-PID
    0x2E06: StoredRegister(1, 0, 10, 0, Writable.SETUP),  # output 1: heating
    0x2E07: StoredRegister(2, 0, 10, 0, Writable.SETUP),  # output 2: cooling
}


def read_gains(ram: Mapping[int, float]) -> Gains:
    """The constants of the PID that these registers hold."""
    return Gains(
        heat=Side(ram[HEAT_BAND], ram[HEAT_INTEGRAL], ram[HEAT_DERIVATIVE], ram[MV_UPPER]),
        cool=Side(ram[COOL_BAND], ram[COOL_INTEGRAL], ram[COOL_DERIVATIVE], -ram[MV_LOWER]),
        dead_band_K=ram[DEAD_BAND],
    )


def find_stored_address(address: int) -> int:
    """Return where the value of an address is kept: SP0 is the set point."""
    return SETPOINT if address == SETPOINT_0 else address


def to_word(value: float, decimals: int) -> int:
    """A value as a 16-bit two's complement word with that many decimals."""
    return max(-0x8000, min(0x7FFF, round(value * 10**decimals))) & 0xFFFF


def to_value(word: int, decimals: int) -> float:
    """A word back as a value."""
    return (word - 0x10000 if word & 0x8000 else word) / 10**decimals


# What an E5CC does while it tunes itself: a limit cycle about the set point, and the constants that come of it.
#
# The manual describes the cycle (100 or 40 % of the outputs, about the set point) and that the constants are stored at
# its end. It says neither the formula nor the hysteresis: here those of Ziegler and Nichols, and 0.2 K.


HYSTERESIS_K = 0.2
SWITCHINGS = 6  # the first swing is not yet periodic: two periods after it


@dataclass(frozen=True, slots=True)
class Cycle:
    """Where the limit cycle is: whether it heats, when it switched, and the lowest and highest PV - SP since."""

    heats: bool
    switched_s: tuple[float, ...] = ()
    extremes_K: tuple[float, ...] = ()
    extreme_K: float = 0.0

    @property
    def is_over(self) -> bool:
        """Whether it has shown enough."""
        return len(self.switched_s) >= SWITCHINGS


class Constants(NamedTuple):
    """Band in K for 100 % of the heat, times in s."""

    band_K: float
    integral_s: float
    derivative_s: float


def begin(error_K: float) -> Cycle:
    """Begin a cycle at a PV that is error_K above the set point."""
    return Cycle(heats=error_K < 0, extreme_K=error_K)


def cycle_step(cycle: Cycle, error_K: float, time_s: float) -> Cycle:
    """Advance the cycle after a while at this PV - SP."""
    extreme_K = (min if cycle.heats else max)(cycle.extreme_K, error_K)
    switches = error_K > HYSTERESIS_K if cycle.heats else error_K < -HYSTERESIS_K
    if not switches:
        return replace(cycle, extreme_K=extreme_K)
    return Cycle(not cycle.heats, (*cycle.switched_s, time_s), (*cycle.extremes_K, extreme_K), error_K)


def constants(cycle: Cycle, swing_percent: float) -> Constants:
    """Compute the constants from a cycle that is over, whose output went that far from one end to the other."""
    period_s = (cycle.switched_s[-1] - cycle.switched_s[-5]) / 2
    amplitude_K = (max(cycle.extremes_K[-4:]) - min(cycle.extremes_K[-4:])) / 2
    effective_K = math.sqrt(max(amplitude_K**2 - HYSTERESIS_K**2, 1e-4))
    ultimate_percent_per_K = 2 * swing_percent / (math.pi * effective_K)
    return Constants(100 / (0.6 * ultimate_percent_per_K), period_s / 2, period_s / 8)


MOST_WORDS = 104
STILL_AIR_LAG_S = 30.0  # of a probe that hangs in the laboratory
SHORT_PERIODS_S = {-2: 0.1, -1: 0.2, 0: 0.5}  # coded values of the control period, else whole seconds


class Mode(IntEnum):
    """What the unit is in, by its bit in the high word of the status."""

    RAM = 4
    TUNING = 7
    STOP = 8
    WRITING = 9
    MANUAL = 10


DIFFERS_BIT = 5  # RAM differs from EEPROM


class FakeRegulator(BusUnit):
    """E5CC on the bus as unit `unit`. Powers up stopped, in backup mode, with communications writing disabled.

    Faults: silent; compoway (the factory protocol is selected: no answer on Modbus); sensor_break; ad_error;
    stuck_pv_degC (the PV stays there); pv_offset_K (the probe reads wrong); pv_drift_K_per_h; probe_out (the probe was
    pulled out of the chamber); probe_exchanged (with the thermometer near the camera); display_decimals other than 1;
    setpoint_clamp_degC (a set point is acknowledged but stored inside these limits); acting_degC (another set-point
    than 0x2103 acts: multi-SP or remote SP); ramp_K_per_min (its own SP ramp, from the PV on when it starts).
    eeprom_writes counts worn cells.
    """

    def __init__(self, plant: Plant, clock: Now, unit: int) -> None:
        super().__init__(plant, clock, unit)
        self.eeprom_writes = 0
        self.compoway = False
        self.sensor_break = False
        self.ad_error = False
        self.stuck_pv_degC: float | None = None
        self.pv_offset_K = 0.0
        self.pv_drift_K_per_h = 0.0
        self.probe_out = False
        self.probe_exchanged = False
        self.display_decimals = 1
        self.setpoint_clamp_degC: tuple[float, float] | None = None
        self.acting_degC: float | None = None
        self.ramp_K_per_min: float | None = None
        self._ramped_degC: float | None = None
        self._tuning_share = 1.0
        self._cycle: Cycle | None = None
        self._drifted_K = 0.0
        self._probe_degC = plant.chamber_degC  # by the probe, wherever it is
        self._eeprom = {address: parameter.default for address, parameter in PARAMETERS.items()}
        self.functions = {
            0x03: reads_words(self._read, MOST_WORDS),
            0x06: writes_one(self._write_one),
            0x08: echoes,
            0x10: writes_words(self._write, MOST_WORDS),
        }
        self._measurements = self._make_measurements()
        self._commands = self._operation_commands()
        self._power_up()
        plant.on_step.append(self._on_step)

    # On the wire.

    def handle(self, pdu: bytes) -> bytes | None:
        """The reply to a request; None when silent and for a software reset."""
        return None if self.compoway else super().handle(pdu)

    def _read(self, address: int, count: int) -> list[int]:
        first = find_stored_address(address)
        if first not in PARAMETERS and first not in self._measurements:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return [self._register(find_stored_address(each)) for each in range(address, address + count)]

    def _register(self, address: int) -> int:
        """One register; the holes between the known ones read as 0."""
        if address in self._measurements:
            return self._measurements[address]()
        if address in PARAMETERS:
            return to_word(self._ram[address], self._decimals(address))
        return 0

    def _make_measurements(self) -> dict[int, Callable[[], int]]:
        """The read-only registers; no current transformer is fitted, and status 2 has nothing to say."""
        return {
            0x2000: lambda: to_word(self._shown_degC(), self.display_decimals),
            0x2001: self._status_low,
            0x2002: lambda: to_word(self._target_degC(), self.display_decimals),
            0x2003: lambda: 0,
            0x2004: lambda: to_word(self.outputs.heat_pct, 1),
            0x2005: lambda: to_word(self.outputs.cool_pct, 1),
            0x2406: self._status_low,
            0x2407: self._status_high,
            0x2408: lambda: 0,
            0x2409: lambda: 0,
            0x2410: lambda: self.display_decimals,
        }

    def _status_low(self) -> int:
        heating = self._conducts(self.outputs.heat_pct, HEAT_PERIOD)
        cooling = self._conducts(self.outputs.cool_pct, COOL_PERIOD)
        return self.ad_error << 2 | self.sensor_break << 6 | heating << 8 | cooling << 9

    def _status_high(self) -> int:
        differs = self._ram != self._eeprom
        return differs << DIFFERS_BIT | sum(1 << mode for mode in self._modes)

    def _write_one(self, address: int, value: int) -> bool:
        """FC 06: addresses 0x0000 and 0xFFFF take operation commands (H175 4-4-3)."""
        if address in (0x0000, 0xFFFF):
            return self._command(value)
        self._write(address, [value])
        return True

    def _write(self, address: int, words: Sequence[int]) -> None:
        """Write all or nothing; refused in the order of H175 4-1-3: address, value, operating state."""
        addresses = [find_stored_address(each) for each in range(address, address + len(words))]
        if not all(each in PARAMETERS for each in addresses):
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        values = [to_value(word, self._decimals(each)) for each, word in zip(addresses, words, strict=True)]
        for each, value in zip(addresses, values, strict=True):
            if not PARAMETERS[each].low <= value <= PARAMETERS[each].high:
                raise ModbusRefusal(ILLEGAL_VALUE)
        if (
            Mode.WRITING not in self._modes
            or Mode.TUNING in self._modes
            or not all(self._takes(each) for each in addresses)
        ):
            raise ModbusRefusal(OPERATION_ERROR)
        for each, value in zip(addresses, values, strict=True):
            self._store(each, value, keep=Mode.RAM not in self._modes)

    def _takes(self, address: int) -> bool:
        writable = PARAMETERS[address].writable
        return writable is Writable.ALWAYS or (writable is Writable.STOPPED and Mode.STOP in self._modes)

    def _store(self, address: int, value: float, *, keep: bool) -> None:
        if address == SETPOINT and self.setpoint_clamp_degC is not None:
            low, high = self.setpoint_clamp_degC
            value = min(high, max(low, value))
        self._ram[address] = value
        self._gains = read_gains(self._ram)
        if keep:
            self._eeprom[address] = value
            self.eeprom_writes += 1

    def _decimals(self, address: int) -> int:
        decimals = PARAMETERS[address].decimals
        return self.display_decimals if decimals is None else decimals

    # Operation commands (H175 4-4-3).

    def _command(self, value: int) -> bool:
        """Obey a command; False when it is not to be answered."""
        command = self._commands.get(value)
        if command is None:
            raise ModbusRefusal(ILLEGAL_VALUE)
        if value not in (0x0000, 0x0001) and Mode.WRITING not in self._modes:
            raise ModbusRefusal(OPERATION_ERROR)
        command()
        return value != 0x0600

    def _operation_commands(self) -> dict[int, Callable[[], None]]:
        return {
            0x0000: lambda: self._modes.discard(Mode.WRITING),
            0x0001: lambda: self._modes.add(Mode.WRITING),
            0x0100: lambda: self._modes.discard(Mode.STOP),
            0x0101: self._stop,
            0x0300: lambda: self._modes.discard(Mode.TUNING),
            0x0301: lambda: self._tune(1.0),
            0x0302: lambda: self._tune(0.4),
            0x0400: lambda: self._modes.discard(Mode.RAM),
            0x0401: lambda: self._modes.add(Mode.RAM),
            0x0500: self._save,
            0x0600: self._power_up,
            0x0900: self._automatic,
            0x0901: lambda: self._modes.add(Mode.MANUAL),
            0x0B00: self._initialize,
            0x0C0F: lambda: None,  # cancel alarm latches: there are none
        }

    def _stop(self) -> None:
        self._modes |= {Mode.STOP}
        self._modes -= {Mode.TUNING}
        self._pid = None
        self.outputs = _split_signed(self._ram[MV_AT_STOP])

    def _tune(self, share: float) -> None:
        """A limit cycle with that share of the outputs, around the set point, until it is cancelled or has shown the
        constants, which are stored then."""
        if self._modes & {Mode.STOP, Mode.MANUAL}:
            raise ModbusRefusal(OPERATION_ERROR)
        self._tuning_share, self._cycle = share, None
        self._modes.add(Mode.TUNING)

    def _automatic(self) -> None:
        if Mode.MANUAL in self._modes and Mode.STOP not in self._modes:
            self._pid = resume(self.outputs, self._target_degC(), self._pv_degC(), self._gains)
        self._modes.discard(Mode.MANUAL)

    def _save(self) -> None:
        for address, value in self._ram.items():
            if self._eeprom[address] != value:
                self._store(address, value, keep=True)

    def _initialize(self) -> None:
        """Everything as delivered, the factory protocol included: the unit is gone from Modbus."""
        self._eeprom = {address: parameter.default for address, parameter in PARAMETERS.items()}
        self._power_up()
        self.compoway = True

    def _power_up(self) -> None:
        self._ram = dict(self._eeprom)
        self._gains = read_gains(self._ram)
        self._modes = {Mode.STOP}
        self._pid: PidState | None = None
        self.outputs = OFF

    # On the front panel and at the mains.

    def power_cycle(self) -> None:
        """Switch it off and on again: RAM values, RAM mode and communications writing are gone, and it is stopped."""
        with self._now():
            self._power_up()

    def press_stop(self) -> None:
        """Stop control as with the keys."""
        with self._now():
            self._stop()

    def press_manual(self, heat_pct: float) -> None:
        """Take over as with the keys, and dial in a heating output, %."""
        with self._now():
            self._modes.add(Mode.MANUAL)
            self.outputs = Outputs(heat_pct, 0.0)

    def press_autotune(self, on: bool) -> None:
        """Start autotuning (100 %) as with the keys, or cancel it; a unit that is stopped declines."""
        with self._now():
            if not on:
                self._modes.discard(Mode.TUNING)
            elif not self._modes & {Mode.STOP, Mode.MANUAL}:
                self._tune(1.0)

    def press_automatic(self) -> None:
        """Give control back as with the keys."""
        with self._now():
            self._automatic()

    def press_setpoint(self, setpoint_degC: float) -> None:
        """Change the set point as with the keys; that is kept in EEPROM."""
        with self._now():
            self._store(SETPOINT, setpoint_degC, keep=True)

    # Control.

    def _update_probe(self, dt_s: float) -> None:
        """The probe takes the temperature of its place; in the laboratory, in still air, slowly."""
        plant = self._plant
        if self.probe_out:
            self._probe_degC += (plant.laboratory_degC - self._probe_degC) * dt_s / STILL_AIR_LAG_S
        else:
            self._probe_degC = plant.air_degC if self.probe_exchanged else plant.chamber_degC
        self._drifted_K += self.pv_drift_K_per_h * dt_s / 3600

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        self._update_probe(dt_s)
        self._ramp(dt_s)
        self.outputs = self._control(dt_s)
        heat_pct = self.outputs.heat_pct
        if heat_pct <= 0:
            self._plant.heater_on_fraction = 0.0
            return
        dt_ns = to_ns(dt_s)
        on_ns = on_time_ns(time_ns, time_ns + dt_ns, heat_pct / 100, self._period_ns(HEAT_PERIOD))
        self._plant.heater_on_fraction = on_ns / dt_ns

    def _control(self, dt_s: float) -> Outputs:
        if Mode.STOP in self._modes:
            return _split_signed(self._ram[MV_AT_STOP])
        if Mode.MANUAL in self._modes:
            return self.outputs
        if self.sensor_break or self.ad_error:
            self._pid = None
            return _split_signed(self._ram[MV_AT_ERROR])
        pv_degC = self._pv_degC()
        if Mode.TUNING in self._modes:
            self._pid = None
            return self._step_limit_cycle(pv_degC - self._target_degC())
        outputs, self._pid = step(self._pid or start(pv_degC), self._target_degC(), pv_degC, dt_s, self._gains)
        return outputs

    def _step_limit_cycle(self, error_K: float) -> Outputs:
        """One step of the limit cycle; at its end the constants are those it has shown."""
        upper, lower = (self._tuning_share * self._ram[limit] for limit in (MV_UPPER, MV_LOWER))
        cycle = self._cycle or begin(error_K)
        self._cycle = cycle = cycle_step(cycle, error_K, self._plant.now_ns / NS_PER_S)
        if cycle.is_over:
            found = constants(cycle, upper - lower)
            for addresses, value in zip(TUNED, found, strict=True):
                for address in addresses:
                    known = PARAMETERS[address]
                    value = round(min(known.high, max(known.low, value)), known.decimals or 1)
                    self._store(address, value, keep=Mode.RAM not in self._modes)
            self._modes.discard(Mode.TUNING)
        return _split_signed(upper if cycle.heats else lower)

    def _target_degC(self) -> float:
        """Return where it goes: the internal set point."""
        wanted_degC = self._ram[SETPOINT] if self.acting_degC is None else self.acting_degC
        if self.ramp_K_per_min is None or Mode.STOP in self._modes:
            return wanted_degC
        return self._pv_degC() if self._ramped_degC is None else self._ramped_degC

    def _ramp(self, dt_s: float) -> None:
        if self.ramp_K_per_min is None or Mode.STOP in self._modes:
            self._ramped_degC = None
            return
        at_degC, step_K = self._ramped_degC, self.ramp_K_per_min * dt_s / 60
        at_degC = self._pv_degC() if at_degC is None else at_degC
        self._ramped_degC = at_degC + max(-step_K, min(step_K, self._ram[SETPOINT] - at_degC))

    def _pv_degC(self) -> float:
        if self.stuck_pv_degC is not None:
            return self.stuck_pv_degC
        return self._probe_degC + self._drifted_K + self.pv_offset_K + self._ram[INPUT_SHIFT]

    def _shown_degC(self) -> float:
        low_degC, high_degC = PT100_RANGE_DEGC
        return high_degC if self.sensor_break else min(high_degC, max(low_degC, self._pv_degC()))

    def _period_ns(self, address: int) -> int:
        coded = self._ram[address]
        return to_ns(SHORT_PERIODS_S.get(int(coded), coded))

    def _conducts(self, output_pct: float, period_address: int) -> bool:
        """Return whether a time-proportioned output is on at the instant of the request."""
        return on_time_ns(self._now_ns, self._now_ns + 1, output_pct / 100, self._period_ns(period_address)) > 0


def _split_signed(mv_pct: float) -> Outputs:
    """A signed manipulated value (negative = cooling) as two outputs."""
    return Outputs(max(0.0, mv_pct), max(0.0, -mv_pct))


@fake("regulator", rank=CONTROL)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeRegulator:
    unit = FakeRegulator(bench.plant, bench.clock, settings["unit"])
    bench.on_bus(unit)
    return unit
