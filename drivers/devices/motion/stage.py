"""One axis of the positioning table: a Standa stage behind an XIMC controller, in mm or degrees.

Positions on the wire are whole steps and 1/256 steps and stay integers up to one conversion in double. Moves always
end upwards, so that the spindle's play lies on the same side at every capture (stage facts from the vendor's profiles).
"""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Self

from pydantic import Field, model_validator

from thermostand.drivers.devices.kinds import Absence, DeviceKind, DriverContext, LockedPlace, Verb, VerbNumber
from thermostand.drivers.devices.motion.motion import MotionArbiter, MotionCommand
from thermostand.drivers.devices.motion.stage_profiles import PROFILES, ProfileName, StageProfile
from thermostand.drivers.settings import Identity, Polled, PollPeriod_s, Range, check_same_device
from thermostand.drivers.wires.link import SerialSettings, open_link
from thermostand.drivers.wires.ximc_client import XimcClient
from thermostand.foundation.addresses import ByteAddress, get_display_address
from thermostand.foundation.clock import Clock, to_ns
from thermostand.foundation.errors import DeviceAlarm, DeviceError, DeviceFault, GarbledReply, Refused, Unreachable
from thermostand.foundation.readings import Channel, Quality, Reading
from thermostand.foundation.workers import Result, WorkerThread

_LINE = SerialSettings(baud=115200, stopbits=2)
_MICROSTEPS = 256
_MICROSTEP_MODE_256 = 9
_POLL_S = 0.1  # round number; nothing was measured
_STOP_LIMIT_S = 2.0  # round number; nothing was measured
_HOME_LIMIT_S = 900.0  # the slowest profile crosses its whole travel at 100 steps/s
# One full step: a stepper that has slipped is off by four.
_ARRIVED_MICROSTEPS = 256

# GETS: MoveSts, MvCmdSts, PWRSts, EncSts, WindSts, CurPosition, uCurPosition, EncPosition, CurSpeed, uCurSpeed, Ipwr,
# Upwr, Iusb, Uusb, CurT, Flags, GPIOFlags, CmdBufFree
_STATUS = struct.Struct("<BBBBBihqih5hIIB4x")
_ENGINE = struct.Struct("<HHIBHhBH12x")  # NomVoltage, NomCurrent, NomSpeed, uNomSpeed, flags, Antiplay, mode, steps
_LEAST_STEPS_S = 0.01  # of a deadline
_TARGET = struct.Struct("<ih6x")
_SERIAL = struct.Struct("<I")

_RUNNING = 0x80  # of MvCmdSts; wait on this, never on MoveSts (vendor source)
_FAILED = 0x40
_COMMAND = 0x3F
_COMMAND_MOVE, _COMMAND_HOME = 0x01, 0x06
_POWER_OFF = 1  # PWRSts
_HOMED = 0x20  # of Flags
_DANGER = 0x01B3FFC0
_EDGES = 0x3  # of GPIOFlags
_NOT_HOMED = "not homed"


class AxisSettings(Polled):
    """A stage behind an XIMC controller; profile: the name of a Standa stage, or another model written out. Lengths in
    its unit.

    limits: lowest and highest target. To reach a target from below, the stage passes the lowest by up to the
    profile's overshoot, which must be free.
    """

    address: ByteAddress
    serial_number: int = Field(ge=0, le=0xFFFFFFFF)
    profile: ProfileName | StageProfile
    limits: Range
    poll_s: PollPeriod_s = 5.0

    @model_validator(mode="after")
    def _within_travel(self) -> Self:
        travel, unit = self.stage.travel, self.unit
        if max(map(abs, self.limits)) > travel:
            raise ValueError(f"limits {self.limits} are beyond the travel of {travel:g} {unit}")
        return self

    @property
    def unit(self) -> Literal["mm", "deg"]:
        """The axis' unit."""
        return self.stage.unit

    @property
    def stage(self) -> StageProfile:
        """The model."""
        return self.profile if isinstance(self.profile, StageProfile) else PROFILES[self.profile]


@dataclass(frozen=True, slots=True)
class _Status:
    """What of GETS is used; `position` in microsteps."""

    command: int
    power: int
    position: int
    flags: int
    gpio: int

    @property
    def running(self) -> bool:
        return bool(self.command & _RUNNING)

    @property
    def homed(self) -> bool:
        return bool(self.flags & _HOMED)

    @property
    def alarm(self) -> str:
        return f"controller alarm, flags 0x{self.flags & _DANGER:08X}" if self.flags & _DANGER else ""

    @property
    def position_fault(self) -> str:
        """Why the position must not be relied upon, "" when it may."""
        if self.alarm or not self.homed:
            return self.alarm or _NOT_HOMED
        return "motor off, the rotor may have moved by up to a step" if self.power == _POWER_OFF else ""

    def answers(self, command: int) -> bool:
        """The last motion is of this kind and has not failed."""
        return self.command & (_COMMAND | _FAILED) == command


class Axis:
    """One axis. Identity and microstep division are checked on every new link before anything else, and at homing.

    A lost link is opened again by the next call. There is one mover: the newest motion wins, and one that was under way
    ends with Superseded.
    """

    def __init__(self, name: str, settings: AxisSettings, clock: Clock) -> None:
        self.name = name
        self._settings = settings
        self.profile = settings.stage
        self._clock = clock
        self._worker: WorkerThread | None = None
        self._client = XimcClient(name, lambda: open_link(name, settings.address, _LINE), clock=clock)
        self._speed_steps_s = 1000.0
        self._changed = ""  # what of the controller's settings is not as delivered
        self._motion = MotionArbiter(name)
        self.identity: Identity | None = None  # which controller has answered
        self._zero_due = False  # homing has begun, and its end was not made the zero of the scale yet

    async def open(self) -> None:
        """Connect and compare serial number and microstep division; Refused when another controller answers."""
        if self._worker is None:
            self._worker = WorkerThread(self.name, self._clock)
        await self._call(self._check_identity)

    async def close(self) -> None:
        """Let go of the port; may be called twice."""
        lane, self._worker = self._worker, None
        if lane is not None:
            await lane.call(self._client.close)
            lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """(position in mm or deg, moving 0/1, homed 0/1); the position is STALE, with the reason, while the controller
        has an alarm, is not homed, or leaves the motor without current; homed has a reason while the controller is set
        otherwise than its profile says."""
        status = await self._call(self._read_status)
        now_ns = self._clock.now_ns()
        homed = self._is_homed(status)
        suspicion = status.position_fault or ("" if homed else _NOT_HOMED)
        position = Reading(
            f"{self.name}.position",
            self._to_units(status.position),
            self.profile.unit,
            now_ns,
            Quality.STALE if suspicion else Quality.GOOD,
            suspicion,
            "alarm" if status.alarm else "",
        )
        return (
            position,
            Reading(f"{self.name}.moving", float(status.running), "1", now_ns),
            Reading(f"{self.name}.homed", float(homed), "1", now_ns, reason=self._changed),
        )

    async def homed(self) -> bool:
        """Return whether the position scale is calibrated."""
        return self._is_homed(await self._call(self._read_status))

    async def home(self) -> float:
        """Run the controller's homing procedure and make its end the zero of the scale.

        Returns the residual: where the scale had this point before, mm or deg (after a power cycle without meaning).
        DeviceAlarm in an alarm, DeviceFault when the procedure does not end homed; Superseded as in move_to.
        """
        turn = self._motion.take()
        await self._call(self._check_identity)  # a power cycle may have brought other settings
        self._refuse_alarm(await self._call(self._read_status))
        await self._call(self._begin_homing, turn)
        status = await self._wait(_HOME_LIMIT_S, turn)
        if not (status.homed and status.answers(_COMMAND_HOME)):
            turn.check()
            raise DeviceFault(self.name, "the homing procedure ended without a home position")
        await self._call(self._set_zero)
        return self._to_units(status.position)

    async def move_to(self, position: float) -> None:
        """Move to `position` (mm or deg), the last stretch upwards, from where the play has been taken up.

        Refused outside the limits or when not homed; DeviceAlarm in an alarm, DeviceFault when the move fails;
        Superseded when it was made safe or sent elsewhere after this was called, or made safe before and not allowed to
        move since.
        """
        low, high = self._settings.limits
        unit = self.profile.unit
        if not low <= position <= high:
            raise Refused(self.name, f"{position} {unit} is outside the limits {low}..{high} {unit}")
        turn = self._motion.take()
        status = await self._call(self._read_status)
        self._refuse_alarm(status)
        if not self._is_homed(status):
            raise Refused(self.name, "not homed; its positions mean nothing until it is")
        target, below = self._to_microsteps(position), self._to_microsteps(position - self.profile.overshoot)
        for stop in (below, target) if status.position > below else (target,):
            status = await self._approach(status.position, stop, turn)

    async def stop(self) -> None:
        """Stop where it is, confirmed; what was under way ends with Superseded. DeviceFault when it does not stop."""
        self._motion.take(safe=True)
        await self._stop()

    def allow(self) -> None:
        """It may move again after it was made safe."""
        self._motion.allow()

    async def make_safe(self) -> None:
        """Soft stop, confirmed; a hard stop when that does not help within 2 s, DeviceFault when nothing does. It stays
        where it is until `allow`."""
        self._motion.bar()
        await self._stop()

    async def _stop(self) -> None:
        for letters in ("sstp", "stop"):
            with contextlib.suppress(DeviceError):  # what counts is whether it stands still
                await self._call(self._send, letters, b"", _is_at_rest)
            if await self._wait_for_rest(_STOP_LIMIT_S):
                return
        raise DeviceFault(self.name, "still moving after a soft and a hard stop")

    async def _wait_for_rest(self, limit_s: float) -> bool:
        deadline_ns = self._clock.now_ns() + to_ns(limit_s)
        while (await self._call(self._read_status)).running:
            if self._clock.now_ns() >= deadline_ns:
                return False
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(_POLL_S))
        return True

    async def _approach(self, start: int, target: int, turn: MotionCommand) -> _Status:
        """One straight move between positions in microsteps; DeviceFault when it ends elsewhere."""

        def carried_out(status: _Status) -> bool:
            return status.position == target or (status.running and status.answers(_COMMAND_MOVE))

        await self._call(self._send, "move", _TARGET.pack(*divmod(target, _MICROSTEPS)), carried_out, turn)
        status = await self._wait(abs(target - start) / _MICROSTEPS / self._speed_steps_s * 1.5 + 2.0, turn)
        if status.command & _FAILED or abs(status.position - target) > _ARRIVED_MICROSTEPS:
            turn.check()
            edge = " at a limit switch" if status.gpio & _EDGES else ""
            stopped, wanted = status.position / _MICROSTEPS, target / _MICROSTEPS
            raise DeviceFault(self.name, f"stopped{edge} at step {stopped:.2f} instead of {wanted:.2f}")
        return status

    async def _wait(self, limit_s: float, turn: MotionCommand) -> _Status:
        """Poll until the controller has finished; stop it in an alarm or after `limit_s` of stand time, and say so."""
        deadline_ns = self._clock.now_ns() + to_ns(limit_s)
        while True:
            status = await self._call(self._read_status)
            if status.running:
                turn.check()
            if status.alarm or (status.running and self._clock.now_ns() >= deadline_ns):
                if status.running:  # not every alarm stops the motor by itself, and a STOP at rest would clear it
                    await self._stop()
                if status.alarm:
                    raise DeviceAlarm(self.name, status.alarm)
                raise DeviceFault(self.name, f"still moving after {limit_s:.0f} s; stopped")
            if not status.running:
                return status
            await self._clock.sleep_until(self._clock.now_ns() + to_ns(_POLL_S))

    def _is_homed(self, status: _Status) -> bool:
        return status.homed and not self._zero_due

    def _refuse_alarm(self, status: _Status) -> None:
        """STOP would clear an alarm, but only an operator may decide that."""
        if status.alarm:
            raise DeviceAlarm(self.name, f"{status.alarm}; it must be looked into before anything moves")

    def _to_units(self, position: int) -> float:
        return position / _MICROSTEPS * self.profile.unit_per_step

    def _to_microsteps(self, position: float) -> int:
        return round(position / self.profile.unit_per_step * _MICROSTEPS)

    async def _call(self, function: Callable[..., Result], *args: object) -> Result:
        if self._worker is None:
            raise Unreachable(self.name, "not open")
        return await self._worker.call(function, *args)

    # Below: in the lane's thread.

    def _check_identity(self) -> None:
        """Leave the link open only when it leads to our controller with our settings."""
        try:
            self._compare_settings()
        except DeviceError:
            self._client.close()
            raise

    def _compare_settings(self) -> None:
        (serial_number,) = _SERIAL.unpack(self._client.query("gser", _SERIAL.size))
        if serial_number != self._settings.serial_number:
            raise Refused(
                self.name,
                f"controller {serial_number} answers at {get_display_address(self._settings.address)}, "
                f"expected {self._settings.serial_number}",
            )
        self.identity = check_same_device(self.name, read_identity(self._client, serial_number), self.identity)
        mode = _ENGINE.unpack(self._client.query("geng", _ENGINE.size))[6]
        if mode != _MICROSTEP_MODE_256:
            raise Refused(self.name, f"microstep mode {mode}, expected {_MICROSTEP_MODE_256} (1/256)")
        speed = read_speed_steps_s(self._client)
        self._speed_steps_s = max(_LEAST_STEPS_S, speed)
        self._changed = describe_changed_settings(self.profile, speed, read_power_off_s(self._client))

    def _connect_identified(self) -> XimcClient:
        """The client, on a link whose other end has been checked."""
        if not self._client.connected:
            self._check_identity()
        return self._client

    def _read_status(self) -> _Status:
        values = _STATUS.unpack(self._connect_identified().query("gets", _STATUS.size))
        return _Status(values[1], values[2], values[5] * _MICROSTEPS + values[6], values[15], values[16])

    def _send(
        self, letters: str, payload: bytes, carried_out: Callable[[_Status], bool], turn: MotionCommand | None = None
    ) -> None:
        """Send a command, while it is its turn. When its acknowledgement is lost the controller's state shows whether
        it was carried out; only if it was not is it sent a second and last time."""
        client = self._connect_identified()
        _check(turn)
        try:
            client.command(letters, payload)
        except (Unreachable, GarbledReply):
            if not carried_out(self._read_status()):
                _check(turn)
                self._connect_identified().command(letters, payload)

    def _begin_homing(self, turn: MotionCommand) -> None:
        """Begin homing. From here on the scale means nothing until its zero is set, even if the controller reports
        one."""
        self._connect_identified()
        turn.check()
        self._zero_due = True
        self._send("home", b"", lambda status: status.running and status.answers(_COMMAND_HOME), turn)

    def _set_zero(self) -> None:
        """HOME leaves the step counter alone (libximc, command_homezero): zero it, and look whether that came."""
        self._send("zero", b"", lambda status: status.position == 0)
        if (position := self._read_status().position) != 0:
            raise DeviceFault(
                self.name, f"the step counter could not be set to zero, it is {position / _MICROSTEPS:.2f}"
            )
        self._zero_due = False


def _check(turn: MotionCommand | None) -> None:
    """A stop needs no turn."""
    if turn is not None:
        turn.check()


def _is_at_rest(status: _Status) -> bool:
    return not status.running


# Which controller has answered (libximc, GETI and GFWV), and whether it is set as it was delivered (GPWR).
_FIRMWARE = struct.Struct("<BBH")  # GFWV: major, minor, release
_MADE = struct.Struct("<4s2s8sBBH12x")  # GETI: manufacturer, its id, product, version of the hardware


def read_identity(client: XimcClient, serial_number: int) -> Identity:
    """Blocking; a controller whose firmware does not know a request does not tell that. Unreachable, GarbledReply."""
    try:
        maker, _, product, *_ = _MADE.unpack(client.query("geti", _MADE.size))
        version = ".".join(map(str, _FIRMWARE.unpack(client.query("gfwv", _FIRMWARE.size))))
    except Refused:
        return Identity("Standa", "XIMC", str(serial_number), "", by_map=True)
    return Identity(_decode_text(maker), _decode_text(product), str(serial_number), version)


_POWER = struct.Struct("<BHHHB6x")  # GPWR: HoldCurrent, CurrReductDelay, PowerOffDelay, CurrentSetTime, PowerFlags
_POWER_OFF_ENABLED = 0x2


def read_power_off_s(client: XimcClient) -> float | None:
    """Read after how long at rest it switches its motor off, None for never; blocking. Unreachable, GarbledReply."""
    _, _, delay_s, _, flags = _POWER.unpack(client.query("gpwr", _POWER.size))
    return float(delay_s) if flags & _POWER_OFF_ENABLED else None


_MOVE = struct.Struct("<IBHHIBB9x")  # Speed, uSpeed, Accel, Decel, AntiplaySpeed, uAntiplaySpeed, MoveFlags
_THOUSANDTHS = 0x1  # of MoveFlags: the speeds are divided by 1000


def read_speed_steps_s(client: XimcClient) -> float:
    """Read the speed at which it moves, full steps/s; blocking. Unreachable, GarbledReply."""
    speed, *_, flags = _MOVE.unpack(client.query("gmov", _MOVE.size))
    return speed / 1000 if flags & _THOUSANDTHS else float(speed)


def describe_changed_settings(profile: StageProfile, speed: float, power_off: float | None) -> str:
    """Return what somebody else has changed, in words; "" when all is as the profile says."""
    pairs = (("speed", speed, profile.speed, "steps/s"), ("power-off delay", power_off, profile.power_off_s, "s"))
    return "; ".join(
        f"{what} {_format_value(is_, unit)}, not {_format_value(wanted, unit)} as in its profile"
        for what, is_, wanted, unit in pairs
        if is_ != wanted
    )


def _format_value(value: float | None, unit: str) -> str:
    return "none" if value is None else f"{value:g} {unit}"


def _decode_text(field: bytes) -> str:
    """Return what is printable of a text field that is filled up with zeros."""
    return "".join(each for each in field.partition(b"\0")[0].decode("latin-1") if each.isprintable()).strip()


def _make(name: str, settings: AxisSettings, around: DriverContext) -> Axis:
    return Axis(name, settings, around.clock)


def _advise(error: DeviceError, name: str, settings: AxisSettings) -> str:
    if isinstance(error, Refused):
        return f"compare axes.{name}.address and serial_number with the controller's label; were two plugs exchanged?"
    if isinstance(error, Unreachable):
        return "is it plugged in and powered, and this user in the group dialout? `stand devices` lists the ports"
    return "look at the stage, remove the cause, and switch its controller off and on"


KIND = DeviceKind(
    name="axis",
    settings=AxisSettings,
    make=_make,
    channels=lambda axis, of_section, map_of: (
        Channel("position", axis.unit, "position"),
        Channel("moving", "1", "flag"),
        Channel("homed", "1", "flag"),
    ),
    section="axes",
    rank=80,
    places=lambda axis: (LockedPlace("wire", axis.address), LockedPlace("number", f"stage {axis.serial_number}")),
    missing=Absence("stages", "a recipe that moves one is refused"),
    advise=_advise,
    verbs=(
        Verb(
            "move",
            "move to a position",
            lambda stand, name, given: stand.move_axis(name, given["position"]),
            lambda axis, _: (VerbNumber("position", axis.unit, *axis.limits),),
        ),
        Verb("stop", "stop where it is", lambda stand, name, given: stand.stop_axis(name)),
        Verb("home", "find the home switch", lambda stand, name, given: stand.home_axis(name)),
    ),
)
