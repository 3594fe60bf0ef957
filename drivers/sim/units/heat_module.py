"""A module of four analog outputs on the bus: ICP DAS M-7024, whose first word of heat drives a power controller.

Sources: the fact sheet on modules (host watchdog, safe value, check vectors), and of the same map family the M-7000
address mapping (00260, 00261, 00270, 40489) and the tM-DA1P1R1 quick start guide, p. 14 (30065, 40033, 40097, 40193).
Not confirmed on a module: type codes, the engineering format, which requests start the watchdog's time again, and how
a write is answered that is ignored since the watchdog has tripped.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, Literal

from thermostand.drivers.sim.fakes import OUTPUT, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.units.modbus import (
    ILLEGAL_ADDRESS,
    ILLEGAL_VALUE,
    OPERATION_ERROR,
    BusUnit,
    ModbusRefusal,
    answer,
    reads_bits,
    reads_words,
    writes_one,
    writes_words,
)
from thermostand.foundation.clock import NS_PER_S, Now, to_ns

OUTPUTS = 4
COIL_ON, COIL_OFF = 0xFF00, 0x0000

# Numbers of the manual less the first of their table.
WATCHDOG_MODE, WATCHDOG_ENABLED, ENGINEERING, TRIPPED = 259, 260, 268, 269  # 00260, 00261, 00269, 00270
READ_BACK = 64  # 30065
VALUES, SAFE_VALUES, POWER_ON_VALUES, TYPE_CODES = 32, 96, 192, 256  # 40033, 40097, 40193, 40257
FIRMWARE, NAME, TIMEOUT, TRIPS = 480, 482, 488, 491  # 40481, 40483, 40489, 40492
MODULE_NAME = 0x00702400
FIRMWARE_VERSION = 0x00010300
TENTH_NS = NS_PER_S // 10

RANGES_mA = {0x30: (0.0, 20.0), 0x31: (4.0, 20.0)}
HEX_FULL_SCALE = 0xFFFF

Refreshed = Literal["requests", "writes", "nothing"]


class FakeHeatModule(BusUnit):
    """The module as unit `unit`. Its output `channel` is the current into a power controller of 4 to 20 mA. As
    delivered: 4..20 mA, all values at 4 mA, watchdog off.

    A tripped watchdog puts every output at its safe value; writes to outputs are then acknowledged and ignored until
    the trip is cleared, which a power cycle does not do. refreshed_by: what starts its time again (nothing: it wants
    the DCON broadcast `~**`). refuses: an ignored write is answered with an exception. stuck_mA: the output gives this.
    lost_writes: writes to outputs are acknowledged, not done. safe_fixed: its safe values take no writes. silent.
    slew_mA_per_s: how fast the output goes to its value, None at once (the slew rate of its configuration). name: what
    it says that it is.
    """

    def __init__(self, plant: Plant, clock: Now, unit: int, channel: int) -> None:
        super().__init__(plant, clock, unit)
        self.refuses = False
        self.safe_fixed = False
        self.lost_writes = False
        self.stuck_mA: float | None = None
        self.slew_mA_per_s: float | None = None
        self.name = MODULE_NAME
        self.refreshed_by: Refreshed = "requests"
        self.type_codes = [0x31] * OUTPUTS
        self.values_mA = [4.0] * OUTPUTS
        self.safe_mA = [4.0] * OUTPUTS
        self.power_on_mA = [4.0] * OUTPUTS
        self.coils = {WATCHDOG_MODE: False, WATCHDOG_ENABLED: False, ENGINEERING: True, TRIPPED: False}
        self.timeout_tenths = 0
        self.trips = 0
        self._channel = channel
        self._heard_ns = 0
        self._flows_at_mA = 4.0  # with a slew rate, at _flows_at_ns
        self._flows_at_ns = clock.now_ns()
        self.functions = {
            0x01: reads_bits(self._read_coils),
            0x03: reads_words(self._read_holding),
            0x04: reads_words(self._read_inputs),
            0x05: writes_one(self._write_coil),
            0x06: writes_one(self._write_register),
            0x10: writes_words(self._write_registers),
        }
        plant.on_step.append(self._on_step)

    def handle(self, pdu: bytes) -> bytes | None:
        """The reply to a request."""
        with self._now():
            if self.silent:
                return None
            reply = answer(pdu, self.functions)
            is_write = pdu[0] in (0x05, 0x06, 0x10)
            if self.refreshed_by == "requests" or (self.refreshed_by == "writes" and is_write):
                self._heard_ns = self._now_ns
            return reply

    def power_cycle(self) -> None:
        """Switch it off and on again: power-on values, or the safe ones when the watchdog had tripped."""
        with self._now():
            self.values_mA = list(self.safe_mA if self.coils[TRIPPED] else self.power_on_mA)
            self._heard_ns = self._now_ns

    def write_mA(self, current_mA: float) -> None:
        """Write to the output as another master does."""
        with self._now():
            self.values_mA[self._channel] = current_mA

    def output_mA(self) -> float:
        """Return what flows now."""
        with self._now():
            return self._flows_mA(self._channel)

    # The watchdog's state is a pure function of the last request and the time.

    @contextmanager
    def _now(self) -> Generator[None]:
        with super()._now():
            self._watch(self._now_ns)
            yield

    def _slew(self, time_ns: int) -> None:
        """The output on its way to its value; from here on the way goes to another one."""
        most_mA = (self.slew_mA_per_s or 1e9) * max(0, time_ns - self._flows_at_ns) / NS_PER_S
        left_mA = self.values_mA[self._channel] - self._flows_at_mA
        self._flows_at_mA += max(-most_mA, min(most_mA, left_mA))
        self._flows_at_ns = max(time_ns, self._flows_at_ns)

    def _watch(self, time_ns: int) -> None:
        self._slew(time_ns)
        is_late = time_ns - self._heard_ns >= self.timeout_tenths * TENTH_NS
        if self.coils[WATCHDOG_ENABLED] and self.timeout_tenths and is_late and not self.coils[TRIPPED]:
            self.coils[TRIPPED] = True
            self.trips += 1
            self.values_mA = list(self.safe_mA)

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        self._watch(time_ns)
        before, dt_ns = self._share(), to_ns(dt_s)
        left_ns = self._heard_ns + self.timeout_tenths * TENTH_NS - time_ns
        self._watch(time_ns + dt_ns)
        after = self._share()
        share = 1.0 if before == after else min(1.0, max(0.0, left_ns / dt_ns))
        self._plant.heater_on_fraction = before * share + after * (1.0 - share)

    def _share(self) -> float:
        return min(1.0, max(0.0, (self._flows_mA(self._channel) - 4.0) / 16.0))

    def _flows_mA(self, output: int) -> float:
        if self.slew_mA_per_s is not None and output == self._channel and self.stuck_mA is None:
            return self._flows_at_mA
        return self.values_mA[output] if self.stuck_mA is None or output != self._channel else self.stuck_mA

    # Registers.

    def _read_coils(self, address: int, count: int) -> list[bool]:
        wanted = range(address, address + count)
        if not all(each in self.coils for each in wanted):
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return [self.coils[each] for each in wanted]

    def _write_coil(self, address: int, value: int) -> bool:
        if address not in self.coils:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        if value not in (COIL_ON, COIL_OFF):
            raise ModbusRefusal(ILLEGAL_VALUE)
        if address == TRIPPED:  # 1 clears it
            self.coils[TRIPPED] = self.coils[TRIPPED] and value != COIL_ON
        else:
            self.coils[address] = value == COIL_ON
        self._heard_ns = self._now_ns  # its time begins when it is enabled or cleared
        return True

    def _read_inputs(self, address: int, count: int) -> list[int]:
        if address < READ_BACK or address + count > READ_BACK + OUTPUTS:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        first = address - READ_BACK
        return [self._word(self._flows_mA(each), each) for each in range(first, first + count)]

    def _read_holding(self, address: int, count: int) -> list[int]:
        return [self._holding(each) for each in range(address, address + count)]

    def _holding(self, address: int) -> int:
        known = {
            FIRMWARE: FIRMWARE_VERSION & 0xFFFF,
            FIRMWARE + 1: FIRMWARE_VERSION >> 16,
            NAME: self.name & 0xFFFF,
            NAME + 1: self.name >> 16,
            TIMEOUT: self.timeout_tenths,
            TRIPS: self.trips,
        }
        if address in known:
            return known[address]
        if TYPE_CODES <= address < TYPE_CODES + OUTPUTS:
            return self.type_codes[address - TYPE_CODES]
        table, output = self._table(address)
        return self._word(table[output], output)

    def _write_registers(self, address: int, words: Sequence[int]) -> None:
        for number, word in enumerate(words):
            self._write_register(address + number, word)

    def _write_register(self, address: int, value: int) -> bool:
        if address == TIMEOUT:
            if value > 0xFF:
                raise ModbusRefusal(ILLEGAL_VALUE)
            self.timeout_tenths = value
        elif address == TRIPS and value == 0:
            self.trips = 0
        elif TYPE_CODES <= address < TYPE_CODES + OUTPUTS:
            if value not in RANGES_mA:
                raise ModbusRefusal(ILLEGAL_VALUE)
            self.type_codes[address - TYPE_CODES] = value
        else:
            self._set(*self._table(address), value)
        return True

    def _set(self, table: list[float], output: int, word: int) -> None:
        low_mA, high_mA = RANGES_mA[self.type_codes[output]]
        wanted_mA = word / 1000 if self.coils[ENGINEERING] else low_mA + word / HEX_FULL_SCALE * (high_mA - low_mA)
        if table is self.values_mA and self.lost_writes:
            return
        if table is self.values_mA and self.coils[TRIPPED]:
            if self.refuses:
                raise ModbusRefusal(OPERATION_ERROR)
            if not self.coils[WATCHDOG_MODE]:
                return
            self.coils[TRIPPED] = False
        if table is not self.safe_mA or not self.safe_fixed:
            table[output] = min(high_mA, max(low_mA, wanted_mA))  # out of its range: clamped

    def _table(self, address: int) -> tuple[list[float], int]:
        """The values that an address belongs to, and the output in them."""
        tables = ((VALUES, self.values_mA), (SAFE_VALUES, self.safe_mA), (POWER_ON_VALUES, self.power_on_mA))
        for begin, table in tables:
            if begin <= address < begin + OUTPUTS:
                return table, address - begin
        raise ModbusRefusal(ILLEGAL_ADDRESS)

    def _word(self, current_mA: float, output: int) -> int:
        low_mA, high_mA = RANGES_mA[self.type_codes[output]]
        if self.coils[ENGINEERING]:
            return round(current_mA * 1000)
        return round(min(1.0, max(0.0, (current_mA - low_mA) / (high_mA - low_mA))) * HEX_FULL_SCALE)


@fake("heat_module", rank=OUTPUT)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeHeatModule:
    module = FakeHeatModule(bench.plant, bench.clock, settings["unit"], settings["channel"])
    bench.on_bus(module)
    return module
