"""Advantech ADAM-4015: six RTD inputs over Modbus RTU.

Values at 40001-40006 (function 3), 0..65535 linear over the range of the type code at 40201-40206; an open wire or one
above its range reads FFFF, one below 0000. Name at 40211-40212. The linear law and the name were not seen on a module;
type codes and the words out of range are of the ADAM-4000 manual.
"""

from __future__ import annotations

from collections.abc import Mapping

from thermostand.drivers.sim.units.modbus import ILLEGAL_ADDRESS, ILLEGAL_VALUE, Refusal, reads_words, writes_one
from thermostand.drivers.sim.units.rtd_sensors import CHANNELS, Places, RtdModule, check_span
from thermostand.foundation.clock import Now

VALUES, TYPE_CODES, NAME = 0, 200, 210  # 40001, 40201, 40211
ADAM_4015 = (0x40, 0x15)
FULL_SCALE = 0xFFFF

# Type code -> lowest and highest temperature, degC, for Pt100 (IEC).
RANGES_DEGC = {
    0x20: (-50.0, 150.0),
    0x21: (0.0, 100.0),
    0x22: (0.0, 200.0),
    0x23: (0.0, 400.0),
    0x24: (-200.0, 200.0),
}


class FakeAdam4015(RtdModule):
    """type_codes: range of each channel, written over the bus too. name: the two words that tell the module."""

    def __init__(
        self, plant: Places, clock: Now, unit: int, channels: Mapping[str, int], seed: int, first: int = 0
    ) -> None:
        super().__init__(plant, clock, unit, channels, seed, first)
        self.type_codes = [0x20] * CHANNELS
        self.name = ADAM_4015
        self.functions = {0x03: reads_words(self._read), 0x06: writes_one(self._write)}

    def _read(self, address: int, count: int) -> list[int]:
        if address >= NAME:
            if address + count > NAME + len(self.name):
                raise Refusal(ILLEGAL_ADDRESS)
            return list(self.name[address - NAME :][:count])
        begin, table = (TYPE_CODES, self.type_codes) if address >= TYPE_CODES else (VALUES, None)
        check_span(address, count, begin)
        places = range(address - begin, address - begin + count)
        return [self._word(place) if table is None else table[place] for place in places]

    def _word(self, place: int) -> int:
        low_degC, high_degC = RANGES_DEGC[self.type_codes[place]]
        share = (self.measured_degC(place) - low_degC) / (high_degC - low_degC)
        return round(min(max(share, 0.0), 1.0) * FULL_SCALE)

    def _write(self, address: int, value: int) -> bool:
        check_span(address, 1, TYPE_CODES)
        if value not in RANGES_DEGC:
            raise Refusal(ILLEGAL_VALUE)
        self.type_codes[address - TYPE_CODES] = value
        return True
