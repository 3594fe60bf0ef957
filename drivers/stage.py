"""One axis of the positioning table: a Standa stage behind an XIMC controller, in mm or degrees.

Positions on the wire are whole steps and 1/256 steps and stay integers up to one conversion in double. Moves always
end upwards, so that the spindle's play lies on the same side at every capture (stage facts from the vendor's profiles).
"""

from __future__ import annotations

import contextlib
import struct
from dataclasses import dataclass
from typing import Literal

from drivers.clock import Clock, seconds_ns
from drivers.interface import DeviceFault, GarbledReply, Quality, Reading, Refused, Unreachable
from drivers.lane import Lane
from drivers.link import SerialSettings, open_link
from drivers.ximc_client import XimcClient

_LINE = SerialSettings(baud=115200, stopbits=2)
_MICROSTEPS = 256
_MICROSTEP_MODE_256 = 9
_POLL_S = 0.1
_HOME_LIMIT_S = 900.0  # the slowest profile crosses its whole travel at 100 steps/s

# GETS: MoveSts, MvCmdSts, PWRSts, EncSts, WindSts, CurPosition, uCurPosition, EncPosition, CurSpeed, uCurSpeed, Ipwr,
# Upwr, Iusb, Uusb, CurT, Flags, GPIOFlags, CmdBufFree
_STATUS = struct.Struct("<BBBBBihqih5hIIB4x")
_ENGINE = struct.Struct("<HHIBHhBH12x")  # NomVoltage, NomCurrent, NomSpeed, uNomSpeed, flags, Antiplay, mode, steps
_MOVE = struct.Struct("<IBHHIBB9x")  # Speed, uSpeed, Accel, Decel, AntiplaySpeed, uAntiplaySpeed, MoveFlags
_TARGET = struct.Struct("<ih6x")
_SERIAL = struct.Struct("<I")

_RUNNING = 0x80  # of MvCmdSts; wait on this, never on MoveSts (vendor source)
_FAILED = 0x40
_HOMED = 0x20  # of Flags
_DANGER = 0x01B3FFC0
_EDGES = 0x3  # of GPIOFlags


@dataclass(frozen=True, slots=True)
class Profile:
    """unit per full step, the way ended upwards (in units) before a downward target."""

    unit: Literal["mm", "deg"]
    unit_per_step: float
    overshoot: float


PROFILES: dict[str, Profile] = {
    "8MT160-300": Profile("mm", 0.0025, 0.5),
    "8MR151": Profile("deg", 0.01, 1.0),
}


@dataclass(frozen=True, slots=True)
class AxisSettings:
    """`address`: serial:PATH or tcp:HOST:PORT. `profile`: a key of PROFILES. `limits`: lowest and highest position."""

    address: str
    serial_number: int
    profile: str
    limits: tuple[float, float]


@dataclass(frozen=True, slots=True)
class _Status:
    command: int
    steps: float
    flags: int
    gpio: int

    @property
    def running(self) -> bool:
        return bool(self.command & _RUNNING)


class Axis:
    """One axis. Identity and microstep division are checked at open and again after the link was lost."""

    def __init__(self, name: str, settings: AxisSettings, clock: Clock) -> None:
        if settings.profile not in PROFILES:
            raise ValueError(f"{name}: no stage profile {settings.profile!r}, only {', '.join(PROFILES)}")
        self.name = name
        self._settings = settings
        self._profile = PROFILES[settings.profile]
        self._clock = clock
        self._lane = Lane(name, clock)
        self._client = XimcClient(name, lambda: open_link(name, settings.address, _LINE))
        self._speed_steps_s = 1000.0
        self._checked = False

    async def open(self) -> None:
        """Connect and compare serial number and microstep division; Refused when another controller answers."""
        await self._lane.call(self._check_identity)

    async def close(self) -> None:
        """Let go of the port."""
        await self._lane.call(self._client.close)
        self._lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """(position in mm or deg, moving 0/1, homed 0/1); the position is STALE while the controller has an alarm."""
        status = await self._lane.call(self._status)
        now_ns = self._clock.now_ns()
        alarm = status.flags & _DANGER
        position = Reading(
            f"{self.name}.position",
            status.steps * self._profile.unit_per_step,
            self._profile.unit,
            now_ns,
            Quality.STALE if alarm else Quality.GOOD,
            f"controller flags 0x{alarm:08X}" if alarm else "",
        )
        return (
            position,
            Reading(f"{self.name}.moving", float(status.running), "1", now_ns),
            Reading(f"{self.name}.homed", float(bool(status.flags & _HOMED)), "1", now_ns),
        )

    async def homed(self) -> bool:
        """Whether the position scale is calibrated."""
        return bool((await self._lane.call(self._status)).flags & _HOMED)

    async def home(self) -> float:
        """Run the controller's homing procedure and make its end the zero of the scale.

        Returns the residual: where the scale had this point before, mm or deg (after a power cycle without meaning).
        DeviceFault when the procedure does not end homed.
        """
        await self._lane.call(self._start, "home", b"")
        status = await self._wait(_HOME_LIMIT_S)
        if not status.flags & _HOMED:
            raise DeviceFault(self.name, "the homing procedure ended without a home position")
        await self._lane.call(self._zero)
        return status.steps * self._profile.unit_per_step

    async def move_to(self, position: float) -> None:
        """Move to `position` (mm or deg) from below. Refused outside the limits or when not homed; DeviceFault when
        the move fails."""
        low, high = self._settings.limits
        unit = self._profile.unit
        if not low <= position <= high:
            raise Refused(self.name, f"{position} {unit} is outside the limits {low}..{high} {unit}")
        status = await self._lane.call(self._status)
        if not status.flags & _HOMED:
            raise Refused(self.name, "not homed; its positions mean nothing until it is")
        target_steps = position / self._profile.unit_per_step
        if status.steps >= target_steps:
            below = max(low, position - self._profile.overshoot)
            await self._approach(status.steps, below / self._profile.unit_per_step)
        await self._approach(status.steps, target_steps)

    async def make_safe(self) -> None:
        """Soft stop, confirmed; a hard stop when that does not help within 2 s."""
        await self._lane.call(self._start, "sstp", b"")
        deadline_ns = self._clock.now_ns() + seconds_ns(2.0)
        while (await self._lane.call(self._status)).running:
            if self._clock.now_ns() >= deadline_ns:
                await self._lane.call(self._start, "stop", b"")
                return
            await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(_POLL_S))

    async def _approach(self, from_steps: float, target_steps: float) -> None:
        whole, micro = divmod(round(target_steps * _MICROSTEPS), _MICROSTEPS)
        await self._lane.call(self._start, "move", _TARGET.pack(whole, micro))
        distance = abs(target_steps - from_steps) + self._profile.overshoot / self._profile.unit_per_step
        status = await self._wait(distance / self._speed_steps_s * 1.5 + 2.0)
        reached = whole + micro / _MICROSTEPS
        if status.command & _FAILED or abs(status.steps - reached) > 1.0:
            edge = " at a limit switch" if status.gpio & _EDGES else ""
            raise DeviceFault(self.name, f"stopped{edge} at step {status.steps:.2f} instead of {reached:.2f}")

    async def _wait(self, limit_s: float) -> _Status:
        """Poll until the controller has finished; after `limit_s` of stand time stop softly, and say so."""
        deadline_ns = self._clock.now_ns() + seconds_ns(limit_s)
        while True:
            status = await self._lane.call(self._status)
            if status.flags & _DANGER:
                raise DeviceFault(self.name, f"controller alarm, flags 0x{status.flags & _DANGER:08X}")
            if not status.running:
                return status
            if self._clock.now_ns() >= deadline_ns:
                await self.make_safe()
                raise DeviceFault(self.name, f"still moving after {limit_s:.0f} s; stopped")
            await self._clock.sleep_until(self._clock.now_ns() + seconds_ns(_POLL_S))

    # Below: in the lane's thread.

    def _check_identity(self) -> None:
        (serial_number,) = _SERIAL.unpack(self._client.query("gser", _SERIAL.size))
        if serial_number != self._settings.serial_number:
            self._client.close()
            raise Refused(
                self.name,
                f"controller {serial_number} answers at {self._settings.address}, "
                f"expected {self._settings.serial_number}",
            )
        mode = _ENGINE.unpack(self._client.query("geng", _ENGINE.size))[6]
        if mode != _MICROSTEP_MODE_256:
            raise Refused(self.name, f"microstep mode {mode}, expected {_MICROSTEP_MODE_256} (1/256)")
        self._speed_steps_s = float(max(1, _MOVE.unpack(self._client.query("gmov", _MOVE.size))[0]))
        self._checked = True

    def _status(self) -> _Status:
        if not self._checked:
            self._check_identity()
        try:
            values = _STATUS.unpack(self._client.query("gets", _STATUS.size))
        except Unreachable:
            self._checked = False  # whoever answers next must prove to be the same controller
            raise
        return _Status(command=values[1], steps=values[5] + values[6] / _MICROSTEPS, flags=values[15], gpio=values[16])

    def _zero(self) -> None:
        """HOME leaves the step counter alone (libximc, command_homezero): zero it, and see that it is."""
        with contextlib.suppress(Unreachable, GarbledReply):
            self._client.command("zero")
        if (steps := self._status().steps) != 0:
            raise DeviceFault(self.name, f"the step counter could not be set to zero, it is {steps:.2f}")

    def _start(self, letters: str, payload: bytes) -> None:
        """Send a command once; when its acknowledgement is lost, the controller's state tells whether it came."""
        if not self._checked:
            self._check_identity()
        commands = {"move": 0x01, "stop": 0x05, "home": 0x06, "sstp": 0x08}
        try:
            self._client.command(letters, payload)
        except (Unreachable, GarbledReply):
            if self._status().command & 0x3F != commands[letters]:
                raise
