"""Five Pt100 sensors on a six-channel RTD module on the bus: ICP DAS M-7015.

Sources: ICP DAS M-7015 manual 3.1-3.3 and, of the same map family, tM-TH8 manual p. 128, ZT-2005 p. 42, M-7005 p. 134.
The type codes and the name bytes were not confirmed on a module.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from thermostand.drivers.sim.fakes import MEASURE, Bench, fake
from thermostand.drivers.sim.units.adam_4015 import FakeAdam4015
from thermostand.drivers.sim.units.modbus import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    Refusal,
    reads_bits,
    reads_words,
    writes_one,
)
from thermostand.drivers.sim.units.rtd_sensors import CHANNELS, Places, RtdModule, check_span
from thermostand.foundation.clock import Now

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
    """Faults beside those of any module: type_codes (the range of each channel, changed over the bus too).
    late_fault_bit: the fault bits are those of the poll before. no_fault_bits: they are refused. name: identity as in
    FC 0x46."""

    def __init__(
        self, plant: Places, clock: Now, unit: int, channels: Mapping[str, int], seed: int, first: int = 0
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
        measured_degC = self.measured_degC(channel) + _signed(self._register_offsets[channel]) / 10
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
            raise Refusal(ILLEGAL_ADDRESS)
        present = [self._word(channel) in (OVER_RANGE, UNDER_RANGE) for channel in range(CHANNELS)]
        shown = self._fault_bits if self.late_fault_bit else present
        self._fault_bits = present
        return shown[address - FAULT_BITS : address - FAULT_BITS + count]

    def _read_coils(self, address: int, count: int) -> list[bool]:
        if address != FORMAT_COIL or count != 1:
            raise Refusal(ILLEGAL_ADDRESS)
        return [self._engineering]

    def _write_coil(self, address: int, value: int) -> bool:
        if address != FORMAT_COIL:
            raise Refusal(ILLEGAL_ADDRESS)
        if value not in (COIL_ON, COIL_OFF):
            raise Refusal(ILLEGAL_VALUE)
        self._engineering = value == COIL_ON
        return True

    def _read_registers(self, address: int, count: int) -> list[int]:
        if IDENTITY <= address < IDENTITY + 4:
            words = [each[at : at + 2] for each in (b"\0" + FIRMWARE, self.name) for at in (2, 0)]
            if address + count > IDENTITY + 4:
                raise Refusal(ILLEGAL_ADDRESS)
            return [int.from_bytes(word, "big") for word in words][address - IDENTITY :][:count]
        table, channel = self._table(address)
        check_span(channel, count, 0)
        return table[channel : channel + count]

    def _write_register(self, address: int, value: int) -> bool:
        table, channel = self._table(address)
        if table is self.type_codes and value not in RANGES_DEGC:
            raise Refusal(ILLEGAL_VALUE)
        table[channel] = value
        return True

    def _table(self, address: int) -> tuple[list[int], int]:
        """The settings an address belongs to, and the channel in them."""
        for begin, table in ((TYPE_CODES, self.type_codes), (OFFSETS, self._register_offsets)):
            if begin <= address < begin + CHANNELS:
                return table, address - begin
        raise Refusal(ILLEGAL_ADDRESS)

    def _identify(self, data: bytes) -> bytes:
        """FC 0x46, read name and read firmware version."""
        replies = {READ_NAME: self.name, READ_FIRMWARE: FIRMWARE}
        if len(data) != 1 or data[0] not in replies:
            raise Refusal(ILLEGAL_FUNCTION)
        return data + replies[data[0]]


def _signed(word: int) -> int:
    return word - 0x10000 if word & 0x8000 else word


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
