"""Five Pt100 sensors on a six-channel RTD module on the bus: ICP DAS M-7015.

Sources: ICP DAS M-7015 manual 3.1-3.3 and, of the same map family, tM-TH8 manual p. 128, ZT-2005 p. 42, M-7005 p. 134.
The type codes and the name bytes were not confirmed on a module.
"""

from __future__ import annotations

import random
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from typing import Protocol

from drivers.sim.modbus import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    Refusal,
    Timeline,
    answer,
    reads_bits,
    reads_words,
    writes_one,
)
from foundation.clock import Now

CHANNELS = 6
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

STILL_AIR_LAG_S = 30.0  # of a sensor that hangs in the laboratory
NOISE_K = 0.003
NOISY_K = 1.0

# Type code -> lowest and highest temperature, degC, for Pt100 of alpha = 0.00385.
RANGES_DEGC = {
    0x20: (-100.0, 100.0),
    0x21: (0.0, 100.0),
    0x22: (0.0, 200.0),
    0x23: (0.0, 600.0),
    0x2E: (-200.0, 200.0),
    0x80: (-200.0, 600.0),
}


class Places(Timeline, Protocol):
    """Where the sensors of the plant sit; temperatures at grid time now_ns."""

    now_ns: int
    granite_inside_degC: float
    granite_outside_degC: float
    artifact_degC: float
    air_degC: float
    chamber_degC: float
    laboratory_degC: float


class FakeThermometers:
    """The module as unit `unit`; `channels` says which sensor is on which of its channels 0..5: granite_inside,
    granite_outside, artifact, air, laboratory. Channels without a sensor are open.

    The noise of a reading is a pure function of (seed, channel, grid time of the plant), however often it is read.
    type_codes: range of each channel, changed over the bus too. Faults, by channel number: open_channels,
    shorted_channels, stuck_degC (the converter gives this and no noise), held_degC (the sensor is held there),
    noisy_channel (1 K instead of 3 mK), offset_K, drift_K_per_h, pulled_out (of the chamber). air_exchanged: the air's
    sensor is where the regulator's probe belongs. late_fault_bit: the fault bits are those of the poll before.
    no_fault_bits: they are refused. name: identity as in FC 0x46. silent.
    """

    def __init__(self, plant: Places, clock: Now, unit: int, channels: Mapping[str, int], seed: int) -> None:
        places: dict[str, Callable[[], float]] = {
            "granite_inside": lambda: plant.granite_inside_degC,
            "granite_outside": lambda: plant.granite_outside_degC,
            "artifact": lambda: plant.artifact_degC,
            "air": lambda: plant.chamber_degC if self.air_exchanged else plant.air_degC,
            "laboratory": lambda: plant.laboratory_degC,
        }
        if not channels.keys() <= places.keys() or not set(channels.values()) <= set(range(CHANNELS)):
            raise ValueError(
                f"thermometer channels {dict(channels)}: expected {', '.join(places)} -> 0..{CHANNELS - 1}"
            )
        self.unit = unit
        self.silent = False
        self.name = M_7015
        self.type_codes = [0x20] * CHANNELS
        self.open_channels: set[int] = set()
        self.shorted_channels: set[int] = set()
        self.stuck_degC: dict[int, float] = {}
        self.held_degC: dict[int, float] = {}
        self.noisy_channel: int | None = None
        self.offset_K: dict[int, float] = {}
        self.drift_K_per_h: dict[int, float] = {}
        self.pulled_out: set[int] = set()
        self.air_exchanged = False
        self.late_fault_bit = False
        self.no_fault_bits = False
        self._plant = plant
        self._clock = clock
        self._seed = seed
        self._sensors = {number: places[name] for name, number in channels.items()}
        self._drifted_K: dict[int, float] = {}
        self._loose_degC: dict[int, float] = {}  # of the sensors that hang in the laboratory
        self._drawn_ns = 0
        self._drawn: dict[int, float] = {}  # noise at that time by channel, in units of its standard deviation
        self._register_offsets = [0] * CHANNELS
        self._engineering = False
        self._fault_bits = [False] * CHANNELS
        self._functions = {
            0x01: reads_bits(self._read_coils),
            0x02: reads_bits(self._read_bits),
            0x03: reads_words(self._read_registers),
            0x04: reads_words(self._read_values),
            0x05: writes_one(self._write_coil),
            0x06: writes_one(self._write_register),
            0x46: self._identify,
        }
        plant.on_step.append(self._on_step)

    def handle(self, pdu: bytes) -> bytes | None:
        """The reply to a request."""
        with self._now():
            return None if self.silent else answer(pdu, self._functions)

    def _read_values(self, address: int, count: int) -> list[int]:
        _check_span(address, count, 0)
        return [self._word(channel) for channel in range(address, address + count)]

    def _word(self, channel: int) -> int:
        measured_degC = self._measured_degC(channel)
        low_degC, high_degC = RANGES_DEGC[self.type_codes[channel]]
        if measured_degC > high_degC:
            return OVER_RANGE
        if measured_degC < low_degC:
            return UNDER_RANGE
        full_scale_degC = max(-low_degC, high_degC)
        if self._engineering:  # 0.01 degC, or 0.1 degC on the ranges up to 600 degC
            return round(measured_degC * (100 if full_scale_degC <= 200 else 10)) & 0xFFFF
        return round(measured_degC / full_scale_degC * HEX_FULL_SCALE) & 0xFFFF

    def _measured_degC(self, channel: int) -> float:
        """What the module's converter sees: an open wire is far above every range, a short far below."""
        if channel in self.open_channels or channel not in self._sensors:
            return float("inf")
        if channel in self.shorted_channels:
            return float("-inf")
        if channel in self.stuck_degC:
            return self.stuck_degC[channel]
        noise_K = self._noise(channel) * (NOISY_K if channel == self.noisy_channel else NOISE_K)
        wrong_K = self.offset_K.get(channel, 0.0) + self._drifted_K.get(channel, 0.0)
        felt_degC = self.held_degC.get(channel, self._loose_degC.get(channel, self._sensors[channel]()))
        return felt_degC + noise_K + wrong_K + _signed(self._register_offsets[channel]) / 10

    def _noise(self, channel: int) -> float:
        """Drawn once in a step of the plant: the values and the fault bits of a poll ask for it alike."""
        if self._drawn_ns != self._plant.now_ns:
            self._drawn_ns, self._drawn = self._plant.now_ns, {}
        if channel not in self._drawn:
            self._drawn[channel] = random.Random(f"{self._seed} {channel} {self._drawn_ns}").gauss(0.0, 1.0)
        return self._drawn[channel]

    def _read_bits(self, address: int, count: int) -> list[bool]:
        """FC 02: a channel's bit is set when it is over or under its range or its wire is open."""
        _check_span(address, count, FAULT_BITS)
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
        _check_span(channel, count, 0)
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

    @contextmanager
    def _now(self) -> Generator[None]:
        with self._plant.lock:
            self._plant.advance(self._clock.now_ns())
            yield

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


def _check_span(address: int, count: int, begin: int) -> None:
    if not begin <= address or address + count > begin + CHANNELS:
        raise Refusal(ILLEGAL_ADDRESS)


def _signed(word: int) -> int:
    return word - 0x10000 if word & 0x8000 else word
