"""Five Pt100 sensors on a six-channel RTD module on the bus: ICP DAS M-7015.

Sources: ICP DAS M-7015 manual 3.1-3.3 and, of the same map family, tM-TH8 manual p. 128, ZT-2005 p. 42, M-7005 p. 134.
The type codes and the name bytes were not confirmed on a module.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from thermostand.drivers.sim.fakes import MEASURE, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.units.modbus import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    BusUnit,
    ModbusRefusal,
    reads_bits,
    reads_words,
    writes_one,
)
from thermostand.foundation.clock import Now

# Pt100 sensors where the plant has them, as the converter of an RTD module sees them, of whatever make it is.


CHANNELS = 6

STILL_AIR_LAG_S = 30.0  # of a sensor that hangs in the laboratory
NOISE_K = 0.003
NOISY_K = 1.0


class RtdModule(BusUnit):
    """A module of six channels as unit `unit`; `channels` says which sensor is on which, counted from `first` on:
    granite_inside, granite_outside, artifact, air, laboratory; any other name hangs in the chamber's air. Channels
    without a sensor are open.

    The noise of a reading is a pure function of (seed, channel, grid time of the plant), however often it is read.
    Faults, by channel number: open_channels, shorted_channels, stuck_degC (the converter gives this and no noise),
    held_degC (the sensor is held there), noisy_channel (1 K instead of 3 mK), offset_K, drift_K_per_h, pulled_out (of
    the chamber). air_exchanged: the air's sensor is where the regulator's probe belongs. silent.
    """

    def __init__(
        self, plant: Plant, clock: Now, unit: int, channels: Mapping[str, int], seed: int, first: int = 0
    ) -> None:
        places: dict[str, Callable[[], float]] = {
            "granite_inside": lambda: plant.granite_inside_degC,
            "granite_outside": lambda: plant.granite_outside_degC,
            "artifact": lambda: plant.artifact_degC,
            "laboratory": lambda: plant.laboratory_degC,
            "air": self._air_of_models_degC,
        }
        if not set(channels.values()) <= set(range(first, first + CHANNELS)):
            raise ValueError(f"thermometer channels {dict(channels)}: expected {first}..{first + CHANNELS - 1}")
        super().__init__(plant, clock, unit)
        self.open_channels: set[int] = set()
        self.shorted_channels: set[int] = set()
        self.stuck_degC: dict[int, float] = {}
        self.held_degC: dict[int, float] = {}
        self.noisy_channel: int | None = None
        self.offset_K: dict[int, float] = {}
        self.drift_K_per_h: dict[int, float] = {}
        self.pulled_out: set[int] = set()
        self.air_exchanged = False
        self.far_air_degC: Callable[[], float | None] = lambda: None  # where "air" hangs far from the camera
        self._first = first
        self._seed = seed
        self._sensors = {number: places.get(name, self._air_degC) for name, number in channels.items()}
        self._drifted_K: dict[int, float] = {}
        self._loose_degC: dict[int, float] = {}  # of the sensors that hang in the laboratory
        self._random = random.Random()
        self._drawn_ns = 0
        self._drawn: dict[int, float] = {}  # noise at that time by channel, in units of its standard deviation
        plant.on_step.append(self._on_step)

    def measured_degC(self, place: int) -> float:
        """Return what the converter sees on the channel at that place of the module, 0 is the first: an open wire is
        far above every range, a short far below."""
        channel = self._first + place
        if channel in self.open_channels or channel not in self._sensors:
            return float("inf")
        if channel in self.shorted_channels:
            return float("-inf")
        if channel in self.stuck_degC:
            return self.stuck_degC[channel]
        noise_K = self._noise(channel) * (NOISY_K if channel == self.noisy_channel else NOISE_K)
        wrong_K = self.offset_K.get(channel, 0.0) + self._drifted_K.get(channel, 0.0)
        probe_degC = self.held_degC.get(channel, self._loose_degC.get(channel, self._sensors[channel]()))
        return probe_degC + noise_K + wrong_K

    def _air_degC(self) -> float:
        return self._plant.chamber_degC if self.air_exchanged else self._plant.air_degC

    def _air_of_models_degC(self) -> float:
        far_degC = self.far_air_degC()
        return self._air_degC() if far_degC is None or self.air_exchanged else far_degC

    def _noise(self, channel: int) -> float:
        """Drawn once in a step of the plant: the values and the fault bits of a poll ask for it alike."""
        if self._drawn_ns != self._plant.now_ns:
            self._drawn_ns, self._drawn = self._plant.now_ns, {}
        if channel not in self._drawn:
            self._random.seed(f"{self._seed} {channel} {self._drawn_ns}")
            self._drawn[channel] = self._random.gauss(0.0, 1.0)
        return self._drawn[channel]

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        for channel, rate_K_per_h in self.drift_K_per_h.items():
            self._drifted_K[channel] = self._drifted_K.get(channel, 0.0) + rate_K_per_h * dt_s / 3600
        if self.pulled_out or self._loose_degC:
            self._loosen(dt_s)

    def _loosen(self, dt_s: float) -> None:
        """Sensors outside go to the laboratory's temperature, in still air; those put back are where they belong."""
        loose, outside_degC = self._loose_degC, self._plant.laboratory_degC
        was = {channel: loose.get(channel, self._sensors[channel]()) for channel in self.pulled_out}
        self._loose_degC = {
            channel: degC + (outside_degC - degC) * dt_s / STILL_AIR_LAG_S for channel, degC in was.items()
        }


def check_span(address: int, count: int, begin: int) -> None:
    """Refusal outside of six addresses from `begin` on."""
    if not begin <= address or address + count > begin + CHANNELS:
        raise ModbusRefusal(ILLEGAL_ADDRESS)


FAULT_BITS = 0x80
FORMAT_COIL = 0x10C
TYPE_CODES = 0x100
OFFSETS = 0x1C0
IDENTITY = 480  # 40481 firmware, 40483 name, low word first (tM-AD5C quick start guide, p. 8)
OVER_RANGE, UNDER_RANGE = 0x7FFF, 0x8000
HEX_FULL_SCALE = 0x7FFF
COIL_ON, COIL_OFF = 0xFF00, 0x0000
READ_NAME, READ_FIRMWARE = 0x00, 0x20  # sub-functions of FC 0x46
M_7015 = bytes.fromhex("00 70 15 00")
FIRMWARE = bytes.fromhex("01 00 00")

# Type code -> lowest and highest temperature, degC, for Pt100 of alpha = 0.00385.
RANGES_DEGC = {
    0x20: (-100.0, 100.0),
    0x21: (0.0, 100.0),
    0x22: (0.0, 200.0),
    0x23: (0.0, 600.0),
    0x2E: (-200.0, 200.0),
    0x80: (-200.0, 600.0),
}


class FakeThermometers(RtdModule):
    """Faults in addition to those of any module: type_codes (the range of each channel, changed over the bus too).
    late_fault_bit: the fault bits are those of the poll before. no_fault_bits: they are refused. name: identity as in
    FC 0x46."""

    def __init__(
        self, plant: Plant, clock: Now, unit: int, channels: Mapping[str, int], seed: int, first: int = 0
    ) -> None:
        super().__init__(plant, clock, unit, channels, seed, first)
        self.name = M_7015
        self.type_codes = [0x20] * CHANNELS
        self.late_fault_bit = False
        self.no_fault_bits = False
        self._register_offsets = [0] * CHANNELS
        self._engineering = False
        self._fault_bits = [False] * CHANNELS
        self.functions = {
            0x01: reads_bits(self._read_coils),
            0x02: reads_bits(self._read_bits),
            0x03: reads_words(self._read_registers),
            0x04: reads_words(self._read_values),
            0x05: writes_one(self._write_coil),
            0x06: writes_one(self._write_register),
            0x46: self._identify,
        }

    def _read_values(self, address: int, count: int) -> list[int]:
        check_span(address, count, 0)
        return [self._word(channel) for channel in range(address, address + count)]

    def _word(self, channel: int) -> int:
        measured_degC = self.measured_degC(channel) + _to_signed(self._register_offsets[channel]) / 10
        low_degC, high_degC = RANGES_DEGC[self.type_codes[channel]]
        if measured_degC > high_degC:
            return OVER_RANGE
        if measured_degC < low_degC:
            return UNDER_RANGE
        full_scale_degC = max(-low_degC, high_degC)
        if self._engineering:  # 0.01 degC, or 0.1 degC on the ranges up to 600 degC
            return round(measured_degC * (100 if full_scale_degC <= 200 else 10)) & 0xFFFF
        return round(measured_degC / full_scale_degC * HEX_FULL_SCALE) & 0xFFFF

    def _read_bits(self, address: int, count: int) -> list[bool]:
        """FC 02: a channel's bit is set when it is over or under its range or its wire is open."""
        check_span(address, count, FAULT_BITS)
        if self.no_fault_bits:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        present = [self._word(channel) in (OVER_RANGE, UNDER_RANGE) for channel in range(CHANNELS)]
        shown = self._fault_bits if self.late_fault_bit else present
        self._fault_bits = present
        return shown[address - FAULT_BITS : address - FAULT_BITS + count]

    def _read_coils(self, address: int, count: int) -> list[bool]:
        if address != FORMAT_COIL or count != 1:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return [self._engineering]

    def _write_coil(self, address: int, value: int) -> bool:
        if address != FORMAT_COIL:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        if value not in (COIL_ON, COIL_OFF):
            raise ModbusRefusal(ILLEGAL_VALUE)
        self._engineering = value == COIL_ON
        return True

    def _read_registers(self, address: int, count: int) -> list[int]:
        if IDENTITY <= address < IDENTITY + 4:
            words = [each[at : at + 2] for each in (b"\0" + FIRMWARE, self.name) for at in (2, 0)]
            if address + count > IDENTITY + 4:
                raise ModbusRefusal(ILLEGAL_ADDRESS)
            return [int.from_bytes(word, "big") for word in words][address - IDENTITY :][:count]
        table, channel = self._table(address)
        check_span(channel, count, 0)
        return table[channel : channel + count]

    def _write_register(self, address: int, value: int) -> bool:
        table, channel = self._table(address)
        if table is self.type_codes and value not in RANGES_DEGC:
            raise ModbusRefusal(ILLEGAL_VALUE)
        table[channel] = value
        return True

    def _table(self, address: int) -> tuple[list[int], int]:
        """The settings an address belongs to, and the channel in them."""
        for begin, table in ((TYPE_CODES, self.type_codes), (OFFSETS, self._register_offsets)):
            if begin <= address < begin + CHANNELS:
                return table, address - begin
        raise ModbusRefusal(ILLEGAL_ADDRESS)

    def _identify(self, data: bytes) -> bytes:
        """FC 0x46, read name and read firmware version."""
        replies = {READ_NAME: self.name, READ_FIRMWARE: FIRMWARE}
        if len(data) != 1 or data[0] not in replies:
            raise ModbusRefusal(ILLEGAL_FUNCTION)
        return data + replies[data[0]]


def _to_signed(word: int) -> int:
    return word - 0x10000 if word & 0x8000 else word


# Advantech ADAM-4015: six RTD inputs over Modbus RTU.
#
# Values at 40001-40006 (function 3), 0..65535 linear over the range of the type code at 40201-40206; an open wire or
# one above its range reads FFFF, one below 0000. Name at 40211-40212. The linear law and the name were not seen on a
# module; type codes and the words out of range are of the ADAM-4000 manual.


ADAM_VALUES, ADAM_TYPE_CODES, ADAM_NAME = 0, 200, 210  # 40001, 40201, 40211
ADAM_4015 = (0x40, 0x15)
ADAM_FULL_SCALE = 0xFFFF

# Type code -> lowest and highest temperature, degC, for Pt100 (IEC).
ADAM_RANGES_DEGC = {
    0x20: (-50.0, 150.0),
    0x21: (0.0, 100.0),
    0x22: (0.0, 200.0),
    0x23: (0.0, 400.0),
    0x24: (-200.0, 200.0),
}


class FakeAdam4015(RtdModule):
    """type_codes: range of each channel, written over the bus too. name: the two words that tell the module."""

    def __init__(
        self, plant: Plant, clock: Now, unit: int, channels: Mapping[str, int], seed: int, first: int = 0
    ) -> None:
        super().__init__(plant, clock, unit, channels, seed, first)
        self.type_codes = [0x20] * CHANNELS
        self.name = ADAM_4015
        self.functions = {0x03: reads_words(self._read), 0x06: writes_one(self._write)}

    def _read(self, address: int, count: int) -> list[int]:
        if address >= ADAM_NAME:
            if address + count > ADAM_NAME + len(self.name):
                raise ModbusRefusal(ILLEGAL_ADDRESS)
            return list(self.name[address - ADAM_NAME :][:count])
        begin, table = (ADAM_TYPE_CODES, self.type_codes) if address >= ADAM_TYPE_CODES else (ADAM_VALUES, None)
        check_span(address, count, begin)
        places = range(address - begin, address - begin + count)
        return [self._word(place) if table is None else table[place] for place in places]

    def _word(self, place: int) -> int:
        low_degC, high_degC = ADAM_RANGES_DEGC[self.type_codes[place]]
        share = (self.measured_degC(place) - low_degC) / (high_degC - low_degC)
        return round(min(max(share, 0.0), 1.0) * ADAM_FULL_SCALE)

    def _write(self, address: int, value: int) -> bool:
        check_span(address, 1, ADAM_TYPE_CODES)
        if value not in ADAM_RANGES_DEGC:
            raise ModbusRefusal(ILLEGAL_VALUE)
        self.type_codes[address - ADAM_TYPE_CODES] = value
        return True


@fake("thermometer_module", rank=MEASURE)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> tuple[RtdModule, ...]:
    """A module for each unit of the make that the register map names. channels: of the sensors, by name."""
    make = FakeAdam4015 if Path(settings["registers"]).stem == "adam-4015" else FakeThermometers
    modules: list[FakeThermometers | FakeAdam4015] = []
    for number, unit in enumerate((settings["unit"], *settings["further_units"])):
        first = number * CHANNELS
        here = {sensor: at for sensor, at in settings["channels"].items() if first <= at < first + CHANNELS}
        modules.append(make(bench.plant, bench.clock, unit, here, bench.seed, first))
        bench.on_bus(modules[-1])
    return tuple(modules)
