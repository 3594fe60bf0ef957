"""Regulators of other makes on the bus, as far as their manuals say: Eurotherm 3200, Watlow EZ-ZONE PM and F4T; and the
controller of a Binder chamber, as far as two public drivers agree.

Sources: Eurotherm HA028651 issue 7 (parameter addresses, status word); Watlow EZ-ZONE PM and F4T user's guides (Modbus
map 1). Registers are plain words, a float is two of them, its low word first. The control is proportional over 5 K:
these are for the wire, not for how well they control.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence

from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.units.modbus import (
    ILLEGAL_ADDRESS,
    BusUnit,
    ModbusRefusal,
    reads_words,
    writes_one,
    writes_words,
)
from thermostand.foundation.clock import NS_PER_S, Now

BAND_K = 5.0
REMOTE_FALLS_BACK_s = 10.0  # how long a remote set point lives unless it is written again
AUTOMATIC, MANUAL, OFF = 10, 54, 62  # Watlow's words
DEGC, DEGF = 15, 30
NO, YES = 59, 106


def float_words(value: float) -> list[int]:
    """A 32-bit float as two words, the low one first: 25.0 -> 0000 41C8."""
    high, low = struct.unpack(">HH", struct.pack(">f", value))
    return [low, high]


def _words_float(words: Sequence[int]) -> float:
    low, high = words
    (value,) = struct.unpack(">f", struct.pack(">HH", high, low))
    return float(value)


class _Regulator(BusUnit):
    """What they share: the wire, the probe, the output. `silent`; `stuck_pv_degC`; `eeprom_writes`."""

    def __init__(self, plant: Plant, clock: Now, unit: int) -> None:
        super().__init__(plant, clock, unit)
        self.stuck_pv_degC: float | None = None
        self.eeprom_writes = 0
        self.functions = {
            0x03: reads_words(self._read_words),
            0x06: writes_one(self._write_one),
            0x10: writes_words(self._write_words),
        }
        plant.on_step.append(self._on_step)

    def _read_words(self, address: int, count: int) -> list[int]:
        return [self._word(each) for each in range(address, address + count)]

    def _write_one(self, address: int, value: int) -> bool:
        self._write_words(address, [value])
        return True

    def _word(self, address: int) -> int:
        raise NotImplementedError

    def _write_words(self, address: int, words: Sequence[int]) -> None:
        raise NotImplementedError

    def _output_percent(self) -> float:
        """Positive heats, negative cools."""
        raise NotImplementedError

    def _pv_degC(self) -> float:
        return self._plant.chamber_degC if self.stuck_pv_degC is None else self.stuck_pv_degC

    def _towards(self, setpoint_degC: float) -> float:
        return max(-100.0, min(100.0, (setpoint_degC - self._pv_degC()) / BAND_K * 100))

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        self._now_ns = time_ns
        self._plant.heater_on_fraction = max(0.0, self._output_percent() / 100)


class FakeEurotherm(_Regulator):
    """3200 series: integers in 0.1 degC. Powers up in automatic at its local set point (`local_degC`, EEPROM). A remote
    set point that is not refreshed for 10 s is given up, with its bit in the status. Manual begins with the output that
    automatic had. Faults: rate_K_per_min (a ramp of its own); sensor_break; loop_break; lost (the next write to this
    register never arrives)."""

    def __init__(self, plant: Plant, clock: Now, unit: int) -> None:
        super().__init__(plant, clock, unit)
        self.local_degC = 20.0
        self.sensor_break = False
        self.loop_break = False
        self.lost: int | None = None
        self.manual = False
        self.rate_K_per_min: float | None = None
        self._ramped_degC = self.local_degC
        self._remote_degC = 0.0
        self._remote_since_ns: int | None = None
        self._remote_selected = False
        self._manual_percent = 0.0
        self._now_ns = clock.now_ns()

    @property
    def _remote_lives(self) -> bool:
        since_ns = self._remote_since_ns
        return since_ns is not None and self._now_ns - since_ns <= REMOTE_FALLS_BACK_s * NS_PER_S

    def _setpoint_degC(self) -> float:
        target_degC = self._remote_degC if self._remote_selected and self._remote_lives else self.local_degC
        return target_degC if self.rate_K_per_min is None else self._ramped_degC

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        super()._on_step(time_ns, dt_s)
        if self.rate_K_per_min is not None:
            step_K = self.rate_K_per_min * dt_s / 60
            self._ramped_degC += max(-step_K, min(step_K, self._remote_degC - self._ramped_degC))

    def _output_percent(self) -> float:
        if self.manual or self.sensor_break:
            return self._manual_percent if self.manual else 0.0
        return self._towards(self._setpoint_degC())

    def _word(self, address: int) -> int:
        words: dict[int, Callable[[], float]] = {
            1: lambda: 10 * self._pv_degC(),
            2: lambda: 10 * self.local_degC,
            3: lambda: 10 * self._manual_percent,
            4: lambda: 10 * self._output_percent(),
            5: lambda: 10 * self._setpoint_degC(),
            15: lambda: 0,
            24: lambda: 10 * self.local_degC,
            26: lambda: 10 * self._remote_degC,
            75: self._status,
            273: lambda: int(self.manual),
            276: lambda: int(self._remote_selected),
        }
        return round(words[address]()) & 0xFFFF if address in words else 0

    def _status(self) -> int:
        lost = self._remote_selected and not self._remote_lives
        return self.manual << 4 | self.sensor_break << 5 | self.loop_break << 6 | lost << 14

    def handle(self, pdu: bytes) -> bytes | None:
        """None for a request that has not arrived."""
        if self.lost is not None and pdu[0] == 0x06 and int.from_bytes(pdu[1:3], "big") == self.lost:
            self.lost = None
            return None
        return super().handle(pdu)

    def _write_words(self, address: int, words: Sequence[int]) -> None:
        if len(words) != 1:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        value = words[0] - 0x10000 if words[0] & 0x8000 else words[0]
        match address:
            case 2 | 24:
                self.local_degC = value / 10
                self.eeprom_writes += 1
            case 3:
                self._manual_percent = value / 10
            case 26:
                self._remote_degC, self._remote_since_ns = value / 10, self._now_ns
            case 273:
                self._manual_percent = self._output_percent()  # bumpless
                self.manual = bool(value)
            case 276:
                self._remote_selected = bool(value)
            case _:
                raise ModbusRefusal(ILLEGAL_ADDRESS)


class _Watlow(_Regulator):
    """Floats of two words, low word first; a set point is saved to EEPROM while saving is on. high_first: a gateway
    that gives the high word first. profile_degC: a profile runs, and goes there."""

    MODE, SETPOINT, OUTPUT, PV = 0, 0, 0, 0

    def __init__(self, plant: Plant, clock: Now, unit: int) -> None:
        super().__init__(plant, clock, unit)
        self.mode = OFF
        self.setpoint_degC = 24.0
        self.saving = True
        self.high_first = False
        self.limits_degC = (-70.0, 180.0)
        self.profile_degC: float | None = None

    @property
    def acting_degC(self) -> float:
        return self.setpoint_degC if self.profile_degC is None else self.profile_degC

    def _output_percent(self) -> float:
        return self._towards(self.acting_degC) if self.mode == AUTOMATIC else 0.0

    def _floats(self) -> dict[int, float]:
        return {self.PV: self._pv_degC(), self.SETPOINT: self.setpoint_degC, self.OUTPUT: self._output_percent()}

    def _whole(self) -> dict[int, int]:
        return {self.MODE: self.mode}

    def _word(self, address: int) -> int:
        for begin, value in self._floats().items():
            if address in (begin, begin + 1):
                words = float_words(value)
                return (words[::-1] if self.high_first else words)[address - begin]
        return self._whole().get(address, 0)

    def _write_words(self, address: int, words: Sequence[int]) -> None:
        if address == self.SETPOINT and len(words) == 2:
            wanted_degC = _words_float(words[::-1] if self.high_first else words)
            low_degC, high_degC = self.limits_degC
            self.setpoint_degC = min(high_degC, max(low_degC, wanted_degC))  # clamped, and acknowledged
            self.eeprom_writes += self.saving
        elif address == self.MODE and len(words) == 1 and words[0] in (AUTOMATIC, MANUAL, OFF):
            self.mode = words[0]
        else:
            raise ModbusRefusal(ILLEGAL_ADDRESS)


class FakeEzZone(_Watlow):
    """EZ-ZONE PM, loop 1. comms_unit: degF as delivered."""

    MODE, SETPOINT, OUTPUT, PV = 1880, 2160, 1904, 360

    def __init__(self, plant: Plant, clock: Now, unit: int) -> None:
        super().__init__(plant, clock, unit)
        self.comms_unit = DEGF

    def _whole(self) -> dict[int, int]:
        return {self.MODE: self.mode, 2490: self.comms_unit, 2494: YES if self.saving else NO}

    def _write_words(self, address: int, words: Sequence[int]) -> None:
        if address == 2494 and list(words) in ([NO], [YES]):
            self.saving = list(words) == [YES]
        else:
            super()._write_words(address, words)


class FakeF4t(_Watlow):
    """F4T, loop 1, Modbus map 1."""

    MODE, SETPOINT, OUTPUT, PV = 2730, 2782, 2808, 27586

    def _floats(self) -> dict[int, float]:
        low_degC, high_degC = self.limits_degC
        return {**super()._floats(), 2774: low_degC, 2776: high_degC, 2810: self.acting_degC}


class FakeBinder(_Watlow):
    """MK 53: 0x0800 in 0x1A22 is manual operation, in which it controls; 0 is idle. door_open: bit 0 of 0x1007."""

    MODE, SETPOINT, PV = 0x1A22, 0x1581, 0x11A9
    IDLE, BY_HAND = 0, 0x0800

    def __init__(self, plant: Plant, clock: Now, unit: int) -> None:
        super().__init__(plant, clock, unit)
        self.mode = self.IDLE
        self.door_open = False

    def _output_percent(self) -> float:
        return self._towards(self.acting_degC) if self.mode == self.BY_HAND else 0.0

    def _floats(self) -> dict[int, float]:
        return {self.PV: self._pv_degC(), self.SETPOINT: self.setpoint_degC, 0x156F: 22.0, 0x1077: self.acting_degC}

    def _whole(self) -> dict[int, int]:
        return {self.MODE: self.mode, 0x1007: int(self.door_open)}

    def _write_words(self, address: int, words: Sequence[int]) -> None:
        if address == self.MODE and list(words) in ([self.IDLE], [self.BY_HAND]):
            self.mode = words[0]
        else:
            super()._write_words(address, words)
