"""A board of eight relays on the bus: Waveshare Modbus RTU Relay, protocol V2.

Source: waveshare.com/wiki/Template:Modbus_RTU_Relay_Protocol_V2. The numbers of the version and address registers, and
that a repeated timed-on starts its time again, were not confirmed on a board.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from thermostand.drivers.sim.fakes import CONTACTS, SWITCHES, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.units.modbus import (
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    ILLEGAL_VALUE,
    BusUnit,
    ModbusRefusal,
    reads_bits,
    reads_words,
    writes_bits,
    writes_one,
)
from thermostand.foundation.clock import NS_PER_S, Now, to_ns

RELAYS = 8
ALL_RELAYS = 0x00FF
TIMED_ON, TIMED_OFF = 0x0200, 0x0400
TIMED_UNIT_NS = NS_PER_S // 10
LONGEST_TIME = 0x7FFF
ON, OFF, TOGGLE = 0xFF00, 0x0000, 0x5500
ADDRESS_REGISTER, VERSION_REGISTER = 0x4000, 0x8000
VERSION = 200  # V2.00


@dataclass(frozen=True, slots=True)
class Relay:
    """One relay since its last command: `closed` until `until_ns`, then the opposite; None = for good."""

    closed: bool = False
    until_ns: int | None = None

    def closed_at(self, time_ns: int) -> bool:
        """Return whether the contact is closed at a time after the command."""
        return self.closed if self.until_ns is None or time_ns < self.until_ns else not self.closed

    def closed_share(self, time_ns: int, dt_ns: int) -> float:
        """The closed share of the dt_ns from a time after the command on."""
        if self.until_ns is None:
            return float(self.closed)
        share = min(1.0, max(0.0, (self.until_ns - time_ns) / dt_ns))
        return share if self.closed else 1.0 - share


class FakeRelays(BusUnit):
    """The board as unit `unit`; `channels` says which relay, counted from 0, switches which contact of the plant:
    heater_enable, compressor, camera_power, heat (the SSR of a stand without a controller). All relays are open at
    power-up. closed_inputs: of the eight digital inputs that some of these boards have, None for one without.

    Faults: silent; lost_writes (acknowledged, not done); welded (names of contacts that stay closed regardless of
    the coil); rearms False (a repeated timed-on does not start its time again); times False (a timed-on stays on).
    """

    def __init__(self, plant: Plant, clock: Now, unit: int, channels: Mapping[str, int]) -> None:
        switches = {
            "heater_enable": "heater_enabled",
            "compressor": "compressor_on",
            "camera_power": "camera_powered",
            "heat": "heater_on_fraction",
        }
        if not channels.keys() <= switches.keys() or not set(channels.values()) <= set(range(RELAYS)):
            raise ValueError(f"relay channels {dict(channels)}: expected {', '.join(switches)} -> 0..{RELAYS - 1}")
        super().__init__(plant, clock, unit)
        self.version = VERSION
        self.lost_writes = False
        self.welded: set[str] = set()
        self.closed_inputs: set[int] | None = None
        self.rearms = True
        self.times = True
        self._channels = dict(channels)
        self._switches = switches
        self._relays = [Relay()] * RELAYS
        self.functions = {
            0x01: reads_bits(self._read_coils),
            0x02: reads_bits(self._read_inputs),
            0x03: reads_words(self._read_registers),
            0x05: writes_one(self._write_coil),
            0x06: writes_one(self._write_register),
            0x0F: writes_bits(self._write_coils),
        }
        plant.on_step.append(self._on_step)

    def power_cycle(self) -> None:
        """Switch it off and on again: every relay is open."""
        with self._now():
            self._relays = [Relay()] * RELAYS
            self._switch(self._now_ns)

    def closed(self, channel: str) -> bool:
        """Return whether the contact of that name conducts now, which a welded one always does."""
        with self._now():
            return self._conducts(channel, self._now_ns)

    def _read_coils(self, address: int, count: int) -> list[bool]:
        _check_span(address, count)
        return [relay.closed_at(self._now_ns) for relay in self._relays[address : address + count]]

    def _read_inputs(self, address: int, count: int) -> list[bool]:
        if self.closed_inputs is None:
            raise ModbusRefusal(ILLEGAL_FUNCTION)
        _check_span(address, count)
        return [channel in self.closed_inputs for channel in range(address, address + count)]

    def _write_coil(self, address: int, value: int) -> bool:
        """FC 05: one relay, all of them, or one for a time; the reply always repeats the request."""
        base, relay = address & 0xFF00, address & 0xFF
        if base in (TIMED_ON, TIMED_OFF) and relay < RELAYS:
            self._set_timed(relay, value, closed=base == TIMED_ON)
        elif address < RELAYS or address == ALL_RELAYS:
            if value not in (ON, OFF, TOGGLE):
                raise ModbusRefusal(ILLEGAL_VALUE)
            for each in range(RELAYS) if address == ALL_RELAYS else (address,):
                self._set(each, Relay(not self._read_coils(each, 1)[0] if value == TOGGLE else value == ON))
        else:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        self._switch(self._now_ns)
        return True

    def _set_timed(self, relay: int, time: int, *, closed: bool) -> None:
        if not 1 <= time <= LONGEST_TIME:
            raise ModbusRefusal(ILLEGAL_VALUE)
        last = self._relays[relay]
        runs = last.closed == closed and last.until_ns is not None and self._now_ns < last.until_ns
        if self.rearms or not runs:
            self._set(relay, Relay(closed, self._now_ns + time * TIMED_UNIT_NS if self.times else None))

    def _write_coils(self, address: int, bits: Sequence[bool]) -> None:
        _check_span(address, len(bits))
        for relay, closed in enumerate(bits, address):
            self._set(relay, Relay(closed))
        self._switch(self._now_ns)

    def _set(self, relay: int, state: Relay) -> None:
        if not self.lost_writes:
            self._relays[relay] = state

    def _read_registers(self, address: int, count: int) -> list[int]:
        values = {ADDRESS_REGISTER: self.unit, VERSION_REGISTER: self.version}
        if address not in values or count != 1:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        return [values[address]]

    def _write_register(self, address: int, value: int) -> bool:
        if address != ADDRESS_REGISTER:
            raise ModbusRefusal(ILLEGAL_ADDRESS)
        if not 1 <= value <= 255:
            raise ModbusRefusal(ILLEGAL_VALUE)
        self.unit = value
        return True

    # Behind the relays. A relay's state is a pure function of its last command and the time, so that a run does not
    # depend on when the coils are read; the plant takes it over at the begin of each of its steps.

    def _on_step(self, time_ns: int, dt_s: float) -> None:
        self._switch(time_ns)
        if "heat" in self._channels:  # pulses end within a step
            relay = self._relays[self._channels["heat"]]
            share = relay.closed_share(time_ns, to_ns(dt_s))
            self._plant.heater_on_fraction = 1.0 if "heat" in self.welded else share

    def _switch(self, time_ns: int) -> None:
        for channel in self._channels:
            setattr(self._plant, self._switches[channel], self._conducts(channel, time_ns))

    def _conducts(self, channel: str, time_ns: int) -> bool:
        return channel in self.welded or self._relays[self._channels[channel]].closed_at(time_ns)


def _check_span(address: int, count: int) -> None:
    if address + count > RELAYS:
        raise ModbusRefusal(ILLEGAL_ADDRESS)


@fake("relays", rank=SWITCHES)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeRelays:
    board = FakeRelays(bench.plant, bench.clock, settings["unit"], settings["channels"])
    bench.on_bus(board)
    return board


@fake("inputs", rank=CONTACTS)
def _build_inputs(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeRelays:
    """Build the inputs of the relay board, or of a board of its own. Contacts that are well while closed begin so."""
    board = bench.fakes.get("relays")
    if not isinstance(board, FakeRelays) or board.unit != settings["unit"]:
        board = FakeRelays(bench.plant, bench.clock, settings["unit"], {})
        bench.on_bus(board)
    contacts = settings["contacts"].values()
    board.closed_inputs = {each["channel"] for each in contacts if each["fault_when"] == "open"}
    return board
