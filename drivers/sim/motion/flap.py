"""A fake Pololu Jrk G2 21v3 with the flap's actuator on it: native USB control transfers in front, a shutter behind.

Positions are scaled feedback, 0..4095. Offsets and request numbers: Jrk G2 user's guide, sections 9 to 14.
"""

from __future__ import annotations

import struct
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from thermostand.drivers.sim.fakes import FLAP, Bench, fake
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.drivers.sim.usb import Stall, TimedOut, UsbServer
from thermostand.foundation.addresses import parse_tcp_address
from thermostand.foundation.clock import NS_PER_S, Now

VENDOR_ID, PRODUCT_ID_21V3 = 0x1FFB, 0x00C5
FULL_SCALE = 4095
FULL_DUTY = 600
TRAVEL_PER_S = 3_000.0  # scaled units per s at full duty
MOVING_mA, STALLED_mA, VIN_mV = 150, 800, 12_040
LONGEST_REPLY = 128

ERROR_AWAITING_COMMAND, ERROR_NO_POWER, ERROR_FEEDBACK_DISCONNECT = 0x1, 0x2, 0x20
ERROR_SOFT_OVER_CURRENT, ERROR_HARD_OVER_CURRENT = 0x40, 0x2000
LATCHED_ERRORS = 0x2067  # enabled and latched in the delivered settings: bits 0, 1, 2, 5, 6 and 13

SETTINGS_SIZE = 0x76
INPUT_MODE, INPUT_MODE_SERIAL, DEAD_ZONE = 0x03, 0, 0x21
ACCELERATIONS = (0x60, 0x62, 0x64, 0x66)
MAX_DUTY_FORWARD, MAX_DUTY_REVERSE = 0x68, 0x6A
DELIVERED_SETTINGS: dict[int, tuple[str, int]] = {
    0x02: ("B", 0x08),  # options: detect a disconnected feedback
    INPUT_MODE: ("B", INPUT_MODE_SERIAL),
    0x18: ("B", 1),  # feedback mode: analog
    0x19: ("H", 0),
    0x1B: ("H", FULL_SCALE),
    0x1D: ("H", 0),
    0x1F: ("H", FULL_SCALE),
    DEAD_ZONE: ("B", 0),
    0x26: ("H", 0),  # serial timeout: off
    0x2A: ("H", LATCHED_ERRORS),
    0x2C: ("H", LATCHED_ERRORS),
    0x51: ("H", 3),
    0x5A: ("H", 10),
    0x5E: ("H", FULL_DUTY),
    **dict.fromkeys(ACCELERATIONS, ("H", FULL_DUTY)),
    MAX_DUTY_FORWARD: ("H", FULL_DUTY),
    MAX_DUTY_REVERSE: ("H", FULL_DUTY),
}

# input, target, feedback, scaled feedback, integral, duty target, duty, current/PID flags, PID count, errors halting,
# errors occurred, force mode, VIN, current, (0x1B) 4 unused, reset cause, up time, (0x24..0x30) 13 unused, last duty,
# chopping counts.
VARIABLES = struct.Struct("<HHHHhhhBBHHHBHH4xBI13xhBB")


@dataclass(frozen=True, slots=True)
class FlapDrive:
    """The motor driven from `position` towards `wanted` since `start_ns`, as far as `reachable`, at `speed` units/s."""

    start_ns: int
    position: float
    wanted: float
    reachable: float
    speed: float

    def at(self, time_ns: int) -> float:
        """Scaled position."""
        way = self.speed * max(0, time_ns - self.start_ns) / NS_PER_S
        distance = self.reachable - self.position
        return self.reachable if abs(distance) <= way else self.position + (way if distance > 0 else -way)


class FakeFlap:
    """The controller and its flap; `plant.flap_open_at` becomes its openness, 0 closed to 1 open.

    Faults: jam_position (the flap cannot pass this position), active_errors (error bits that stand: ERROR_NO_POWER,
    ERROR_FEEDBACK_DISCONNECT, ...), input_mode (0 serial), unplugged, stall, timeout, short_read, and restart().
    """

    vendor_id = VENDOR_ID
    product_id = PRODUCT_ID_21V3
    release = 0x0109

    def __init__(
        self,
        plant: Plant,
        clock: Now,
        serial_number: str,
        open_position: int = 3_500,
        closed_position: int = 500,
    ) -> None:
        self.strings = {1: "Pololu Corporation", 2: "Pololu Jrk G2 21v3", 3: serial_number, 6: "0000000000000000"}
        self.address = 1
        self.stall = False
        self.timeout = False
        self.short_read = False
        self._plant = plant
        self._clock = clock
        self._open_position = open_position
        self._closed_position = closed_position
        self._unplugged = False
        self._active_errors = 0
        self._jam: float | None = None
        self._lowest, self._highest = 0.0, float(FULL_SCALE)
        self._eeprom = _make_delivered_settings()
        standing = FlapDrive(clock.now_ns(), closed_position, closed_position, closed_position, 0.0)
        self._drives: deque[FlapDrive] = deque([standing], maxlen=16)
        self.restart(reset_cause=0)
        plant.flap_open_at = self.open_at

    def open_at(self, time_ns: int) -> float:
        """Openness, 0 closed to 1 open, at any time not long past."""
        travel = self._open_position - self._closed_position
        return min(1.0, max(0.0, (self._position(time_ns) - self._closed_position) / travel))

    @property
    def unplugged(self) -> bool:
        """Whether it is no longer on the bus; plugged in again it has a new address and old handles stay dead."""
        return self._unplugged

    @unplugged.setter
    def unplugged(self, unplugged: bool) -> None:
        self.address += self._unplugged and not unplugged
        self._unplugged = unplugged

    @property
    def jam_position(self) -> float | None:
        """Scaled position of an obstacle; set where the flap is, it holds it in both directions."""
        return self._jam

    @jam_position.setter
    def jam_position(self, position: float | None) -> None:
        with self._plant.lock:
            now = self._position(self._clock.now_ns())
            self._jam = position
            self._lowest = 0.0 if position is None or now < position else float(position)
            self._highest = float(FULL_SCALE if position is None or now > position else position)
            self._redrive()

    @property
    def active_errors(self) -> int:
        """Error bits whose cause stands; they halt the motor and stay latched until cleared after the cause is gone."""
        return self._active_errors

    @active_errors.setter
    def active_errors(self, bits: int) -> None:
        with self._plant.lock:
            self._active_errors = bits
            self._halt(bits)

    @property
    def input_mode(self) -> int:
        """Setting 0x03 in RAM; unless it is serial, 0, targets from USB do not act."""
        return self._ram[INPUT_MODE]

    @input_mode.setter
    def input_mode(self, mode: int) -> None:
        self._ram[INPUT_MODE] = mode

    def restart(self, reset_cause: int = 1) -> None:
        """The controller restarts: up time 0, settings from EEPROM, motor off, awaiting a command."""
        with self._plant.lock:
            self._started_ns = self._clock.now_ns()
            self._reset_cause = reset_cause
            self._target = 0
            self._reload()
            self._halting = self._occurred = 0
            self._halt(ERROR_AWAITING_COMMAND | self._active_errors)

    def control_transfer(
        self, request_type: int, request: int, value: int, index: int, length_or_data: int | bytes
    ) -> bytes:
        """One transfer at the clock's present time: what was read, or b"" for a write; raises
        drivers.sim.usb.TransferFailed."""
        with self._plant.at(self._clock):
            if self.timeout:
                raise TimedOut
            if self.stall:
                raise Stall
            if isinstance(length_or_data, int):
                reply = self._read(request_type, request, value, index)
                reply = reply[index:][: min(length_or_data, LONGEST_REPLY)]
                return reply[: len(reply) // 2] if self.short_read else reply
            self._write(request_type, request, value, index, length_or_data)
            return b""

    def _read(self, request_type: int, request: int, value: int, index: int) -> bytes:
        """The block to read from; clearing by `value` acts after the block was taken."""
        match request_type, request:
            case 0xC0, 0xE5 if index < VARIABLES.size:
                block = self._variables()
                if value & 1:
                    self._halting &= self._active_errors | ERROR_AWAITING_COMMAND
                    self._redrive()
                if value & 2:
                    self._occurred = self._active_errors
                return block
            case 0xC0, 0xE3 if index < SETTINGS_SIZE:
                return bytes(self._eeprom)
            case 0xC0, 0xEA if index < SETTINGS_SIZE:
                return bytes(self._ram)
            case 0xC0, 0x20:
                return bytes(LONGEST_REPLY)
            case _:
                raise Stall

    def _write(self, request_type: int, request: int, value: int, index: int, data: bytes) -> None:
        match request_type, request:
            case 0x40, 0x84 if value <= FULL_SCALE:
                self._set_target(value)
            case 0x40, 0x87:
                self._halt(ERROR_AWAITING_COMMAND)
            case 0x40, 0x13 if value < 0x100 and index < SETTINGS_SIZE:
                self._eeprom[index] = value
            case 0x40, 0xE6 if index + len(data) <= SETTINGS_SIZE:
                self._ram[index : index + len(data)] = data
                self._redrive()
            case 0x40, 0xF2 | 0xF4:
                duty = struct.unpack("<h", struct.pack("<H", value))[0]
                self._force(1 if request == 0xF2 else 2, max(-FULL_DUTY, min(FULL_DUTY, duty)))
            case 0x40, 0x10:
                self._reload()
                if not value & 1:
                    self._halting = self._occurred = 0
                    self._halt(ERROR_AWAITING_COMMAND | self._active_errors)
            case _:
                raise Stall

    def _set_target(self, target: int) -> None:
        if self.input_mode != INPUT_MODE_SERIAL:
            return
        self._target = target
        self._force_mode = self._forced_duty = 0
        self._halting &= ~ERROR_AWAITING_COMMAND
        self._redrive()

    def _force(self, mode: int, duty: int) -> None:
        self._force_mode, self._forced_duty = mode, duty
        self._halting &= ~ERROR_AWAITING_COMMAND
        self._redrive()

    def _halt(self, errors: int) -> None:
        self._halting |= errors
        self._occurred |= errors
        self._redrive()

    def _reload(self) -> None:
        self._ram = bytearray(self._eeprom)
        self._force_mode = self._forced_duty = 0

    def _setting(self, offset: int) -> int:
        return struct.unpack_from("<H", self._ram, offset)[0]

    def _position(self, time_ns: int) -> float:
        drive = next((past for past in reversed(self._drives) if past.start_ns <= time_ns), self._drives[0])
        return drive.at(time_ns)

    def _redrive(self) -> None:
        """Begin a new drive from where the flap is, towards what is asked for now."""
        now_ns = self._clock.now_ns()
        position = self._position(now_ns)
        wanted = position
        if self._halting:
            duty = 0
        elif self._force_mode:
            wanted = FULL_SCALE if self._forced_duty > 0 else 0
            duty = abs(self._forced_duty)
        else:
            if abs(self._target - position) > self._ram[DEAD_ZONE]:
                wanted = self._target
            duty = min(FULL_DUTY, self._setting(MAX_DUTY_FORWARD if wanted > position else MAX_DUTY_REVERSE))
        reachable = min(max(wanted, self._lowest), self._highest) if duty else position
        self._drives.append(FlapDrive(now_ns, position, wanted, reachable, TRAVEL_PER_S * duty / FULL_DUTY))

    def _variables(self) -> bytes:
        now_ns = self._clock.now_ns()
        drive = self._drives[-1]
        position = drive.at(now_ns)
        moving, driven = position != drive.reachable, drive.speed > 0 and position != drive.wanted
        duty = round(drive.speed / TRAVEL_PER_S * FULL_DUTY) * (1 if drive.wanted > position else -1) if driven else 0
        disconnected = self._active_errors & ERROR_FEEDBACK_DISCONNECT
        feedback = FULL_SCALE if disconnected else round(position)
        return VARIABLES.pack(
            self._target,
            self._target,
            feedback,
            feedback,
            0,
            duty,
            duty,
            0,
            0,
            (now_ns - self._started_ns) // 10_000_000 & 0xFFFF,
            self._halting,
            self._occurred,
            self._force_mode,
            0 if self._active_errors & ERROR_NO_POWER else VIN_mV,
            0 if not driven else MOVING_mA if moving else STALLED_mA,
            self._reset_cause,
            (now_ns - self._started_ns) // 1_000_000 & 0xFFFF_FFFF,
            duty,
            0,
            0,
        )


def _make_delivered_settings() -> bytearray:
    block = bytearray(SETTINGS_SIZE)
    for offset, (kind, value) in DELIVERED_SETTINGS.items():
        struct.pack_into(f"<{kind}", block, offset, value)
    return block


@fake("flap", rank=FLAP)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeFlap:
    flap = FakeFlap(bench.plant, bench.clock, settings["serial_number"])
    bus = UsbServer(*parse_tcp_address(settings["backend_address"] or "", may_be_free=True), [flap])
    bench.register_address(name, bus.address, bus.close)
    return flap
