"""A fake Standa controller with its stage: XIMC commands in front, a stepper behind, no thread of its own.

What changes by itself (motion, homing, the current in the windings) is worked out when a request arrives, for the
simulated time of that request. HOME leaves the count as it is, as the vendor describes it: the residual of a home
check can be read before ZERO makes the place zero.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Literal

from thermostand.drivers.framing.ximc import XimcDamage, XimcFrame, decode, encode
from thermostand.drivers.sim.fakes import STAGES, Bench, fake
from thermostand.drivers.sim.motion import ximc_table as table
from thermostand.drivers.sim.motion.kinematics import Pace
from thermostand.drivers.sim.motion.stepper import LEFT, RIGHT, Brake, GoTo, Leg, Onward, Shift, Stepper, Stops
from thermostand.drivers.sim.physics.plant import Plant
from thermostand.foundation.clock import Now, to_ns
from thermostand.foundation.documents import Document

PARTIAL_FRAME_S = 0.4  # real seconds of silence inside a frame after which the controller forgets it
MOTION = frozenset({"move", "movr", "left", "rigt", "home", "loft", "sstp"})
SIDES = {"": 0, "left": LEFT, "right": RIGHT}


# The settings of a fake XIMC controller, in RAM and flash, and what they mean for its motion.


class Settings:
    """Named payloads (`mov`, `eng`, ...): those of the delivered profile, zeros for the rest."""

    def __init__(self, profile: table.Profile) -> None:
        self._flash = {name: bytes(struct.calcsize(layout)) for name, layout in table.SETTINGS.items()}
        for name, fields in profile.settings.items():
            self._flash[name] = struct.pack(table.SETTINGS[name], *fields)
        self._ram = dict(self._flash)

    def payload(self, name: str) -> bytes:
        """A setting as it goes over the wire."""
        return self._ram[name]

    def store(self, name: str, payload: bytes) -> bool:
        """Put a setting into RAM, each value corrected into its range; False when that changed one."""
        layout = struct.Struct(table.SETTINGS[name])
        wanted = list(layout.unpack(payload))
        fields = list(wanted)
        for index, (lowest, highest) in table.RANGES.get(name, {}).items():
            fields[index] = min(max(fields[index], lowest), highest)
        self._ram[name] = layout.pack(*fields)
        return fields == wanted

    def save(self) -> None:
        """RAM to flash."""
        self._flash = dict(self._ram)

    def restore(self) -> None:
        """Flash to RAM."""
        self._ram = dict(self._flash)

    def steps(self, full: int, micro: int) -> float:
        """Full steps and microsteps as one number."""
        return full + micro / self._division

    def full_and_micro(self, steps: float) -> tuple[int, int]:
        """The two fields, both with the sign: -0.5 steps is (0, -128) at 1/256."""
        total = round(steps * self._division)
        full = abs(total) // self._division * (1 if total >= 0 else -1)
        return full, total - full * self._division

    def allowed_micro(self, micro: int) -> int:
        """Microsteps corrected to less than one full step."""
        return min(max(micro, 1 - self._division), self._division - 1)

    def stops(self) -> Stops:
        """Return where EDS lets the controller stop the motor: at the switches, at border values, or nowhere."""
        flags, _, left, left_micro, right, right_micro = self._fields("eds")
        by_value = flags & table.BORDER_BY_VALUE
        left_stop = self.steps(left, left_micro) if by_value else None
        right_stop = self.steps(right, right_micro) if by_value else None
        return Stops(
            left_stop if flags & table.BORDER_STOP_LEFT else -math.inf,
            right_stop if flags & table.BORDER_STOP_RIGHT else math.inf,
        )

    def pace(self) -> Pace:
        """The speed and acceleration of MOVE, MOVR, LEFT, RIGT, LOFT and SSTP."""
        speed, micro_speed, *_, flags = self._fields("mov")
        return self._pace(speed, micro_speed, 1000 if flags & table.MOVE_THOUSANDTHS else 1)

    def antiplay_steps(self) -> int:
        """Length of the backlash move."""
        return self._fields("eng")[5]

    def current_mA(self) -> int:
        """Nominal current of the windings."""
        return self._fields("eng")[1]

    def homing(self) -> tuple[Leg, ...]:
        """Fast until the first stop, slowly until the second when enabled, then by HomeDelta in the second direction.
        Only limit switches are wired: motion towards another stop continues to a border."""
        fast, fast_micro, slow, slow_micro, delta, delta_micro, flags = self._fields("hom")
        fast_pace = self._pace(fast, fast_micro)
        first = RIGHT if flags & table.HOME_FIRST_RIGHT else LEFT
        second = RIGHT if flags & table.HOME_SECOND_RIGHT else LEFT
        legs: list[Leg] = [Onward(first, fast_pace, to_switch=flags >> 4 & 3 == table.HOME_STOP_LIMIT)]
        if flags & table.HOME_SECOND_PHASE:
            to_switch = flags >> 6 & 3 == table.HOME_STOP_LIMIT
            legs.append(Onward(second, self._pace(slow, slow_micro), to_switch))
        return (*legs, Shift(second * self.steps(delta, delta_micro), fast_pace))

    def alarm_at_wrong_limit(self) -> bool:
        """SEC: reaching the wrong limit switch raises ALARM."""
        return bool(self._fields("sec")[7] & table.SECURE_ALARM_ON_BORDERS)

    def resting_power(self, rested_ns: int) -> int:
        """PWRSts after a rest: full current until CurrReductDelay, none at all after PowerOffDelay, if enabled."""
        _, reduce_ms, off_s, _, flags = self._fields("pwr")
        if flags & table.POWER_OFF and rested_ns >= to_ns(off_s):
            return table.PWR_OFF
        if flags & table.POWER_REDUCE and rested_ns >= to_ns(reduce_ms / 1000):
            return table.PWR_REDUCED
        return table.PWR_NORMAL

    @property
    def _division(self) -> int:
        """Microsteps per full step: MicrostepMode 1 is full steps, 9 is 1/256."""
        return 2 ** (self._fields("eng")[6] - 1)

    def _fields(self, name: str) -> tuple[int, ...]:
        return struct.unpack(table.SETTINGS[name], self._ram[name])

    def _pace(self, speed: int, micro_speed: int, divisor: int = 1) -> Pace:
        """ENG may limit a speed to the nominal one; accelerations are those of MOV."""
        _, _, accel, decel, *_ = self._fields("mov")
        _, _, nominal, nominal_micro, flags, *_ = self._fields("eng")
        top = self.steps(speed, micro_speed) / divisor
        if flags & table.ENGINE_LIMIT_SPEED:
            top = min(top, self.steps(nominal, nominal_micro))
        return Pace(top, accel, decel)


class XimcEngine:
    """One connection: bytes in, reply bytes out. `monotonic` gives real seconds, for the partial-frame time-out."""

    def __init__(self, axis: FakeAxis, monotonic: Callable[[], float]) -> None:
        self._axis = axis
        self._monotonic = monotonic
        self._partial = b""
        self._heard_s = monotonic()

    def feed(self, data: bytes) -> bytes:
        """Execute the requests that are complete; zero bytes between frames come back one for one."""
        heard_s = self._monotonic()
        if heard_s - self._heard_s > PARTIAL_FRAME_S:
            self._partial = b""
        self._heard_s = heard_s
        received, reply = self._partial + data, b""
        while received:
            frame_start = received.lstrip(b"\0")
            reply += bytes(len(received) - len(frame_start))
            frame, received = decode(frame_start, table.REQUEST_SIZES)
            if frame is None:
                break
            reply += self._axis.handle(frame)
        self._partial = received
        return reply


class FakeAxis:
    """A controller and its stage. `plant.linear_mm_at` or `plant.rotary_deg_at` becomes its mechanical position,
    which is 0 where homing ends; the stage begins `start_steps` to the right of that, count 0, not homed.

    Faults: alarm, ctp_error, danger (any bits of GETS Flags), limit ("left" or "right": a switch that reads closed),
    wrong_limit (a stop at a limit is taken for the other side's), stall_steps (the mechanics cannot pass this position
    to the right), lost_steps (how far the mechanics has fallen back), endless (commands run until SSTP or STOP),
    motor_off, and power_cycle().
    """

    def __init__(
        self,
        plant: Plant,
        clock: Now,
        profile: table.Profile,
        serial_number: int,
        attach: Literal["linear", "rotary"],
        start_steps: float = 2_000.0,
    ) -> None:
        self._plant = plant
        self._clock = clock
        self._profile = profile
        self._serial_number = serial_number
        self._settings = Settings(profile)
        self._stepper = Stepper(profile.switches, start_steps, clock.now_ns())
        self._stepper.stops = self._settings.stops()
        self._clear()
        self.wrong_limit = False
        self.endless = False
        self._lost_steps = 0.0
        if attach == "linear":
            plant.linear_mm_at = self.position_at
        else:
            plant.rotary_deg_at = self.position_at

    def engine(self, monotonic: Callable[[], float] = time.monotonic) -> XimcEngine:
        """A new conversation with this controller."""
        return XimcEngine(self, monotonic)

    def position_at(self, time_ns: int) -> float:
        """Mechanical position in mm or degrees. A motor without current falls into the nearest full step."""
        steps = self._stepper.mechanical(time_ns)
        if self._power(time_ns) == table.PWR_OFF:
            steps = round(steps)
        return steps * self._profile.unit_per_step

    def handle(self, frame: XimcFrame) -> bytes:
        """The reply to one request, whose effect begins at the clock's present time."""
        with self._plant.at(self._clock) as now_ns:
            self._settle(now_ns)
            if frame.damage is XimcDamage.CRC:
                return self._error("errd", table.FLAG_ERRD)
            if frame.damage is XimcDamage.LETTERS or frame.letters in table.SERVICE_SIZES:
                return self._error("errc", table.FLAG_ERRC)
            if frame.letters in table.QUERIES:
                return encode(frame.letters, self._answer(frame.letters, now_ns))
            if frame.letters in table.ACTIONS:
                return self._act(frame, now_ns)
            name = frame.letters[1:]
            if frame.letters[0] == "g":
                return encode(frame.letters, self._settings.payload(name))
            stored = self._settings.store(name, frame.payload)
            self._apply_stops(now_ns)
            return encode(frame.letters) if stored else self._error("errv", table.FLAG_ERRV)

    def power_cycle(self) -> None:
        """Switch it off and on again: settings from flash, count 0, not homed; the stage stays where it is."""
        with self._plant.lock:
            now_ns = self._clock.now_ns()
            self._settings.restore()
            self._stepper.release(now_ns)
            self._stepper.recount(now_ns, 0.0)
            self._apply_stops(now_ns)
            self._clear()

    @property
    def danger(self) -> int:
        """Danger bits of GETS Flags that stand; setting the ALARM bit stops the motor."""
        return self._danger

    @danger.setter
    def danger(self, bits: int) -> None:
        with self._plant.lock:
            now_ns = self._clock.now_ns()
            self._settle(now_ns)
            self._danger = bits
            if bits & table.FLAG_CTP_ERROR:
                self._homed = False
            if bits & table.FLAG_ALARM:
                self._failed = self._failed or self._under_way
                self._finish(now_ns)

    @property
    def alarm(self) -> bool:
        """ALARM stands: motion commands are ignored until STOP."""
        return bool(self._danger & table.FLAG_ALARM)

    @alarm.setter
    def alarm(self, on: bool) -> None:
        self.danger = self._danger & ~table.FLAG_ALARM | (table.FLAG_ALARM if on else 0)

    @property
    def ctp_error(self) -> bool:
        """CTP_ERROR stands: encoder and step count differ."""
        return bool(self._danger & table.FLAG_CTP_ERROR)

    @ctp_error.setter
    def ctp_error(self, on: bool) -> None:
        self.danger = self._danger & ~table.FLAG_CTP_ERROR | (table.FLAG_CTP_ERROR if on else 0)

    @property
    def limit(self) -> str:
        """The limit switch that is stuck closed: "", "left" or "right"; any other side is a KeyError."""
        return next(name for name, side in SIDES.items() if side == self._stepper.stuck_switch)

    @limit.setter
    def limit(self, side: str) -> None:
        with self._plant.lock:
            self._stepper.disturb(self._clock.now_ns())
            self._stepper.stuck_switch = SIDES[side]

    @property
    def stall_steps(self) -> float | None:
        """Mechanical position, steps, which the stage cannot pass to the right; None: nothing in the way."""
        return self._stepper.stall_at

    @stall_steps.setter
    def stall_steps(self, mechanical: float | None) -> None:
        with self._plant.lock:
            self._stepper.disturb(self._clock.now_ns())
            self._stepper.stall_at = mechanical

    @property
    def lost_steps(self) -> float:
        """Steps the mechanics has fallen back by order; those lost at a stall are not in it."""
        return self._lost_steps

    @lost_steps.setter
    def lost_steps(self, steps: float) -> None:
        with self._plant.lock:
            self._stepper.disturb(self._clock.now_ns(), steps - self._lost_steps)
            self._lost_steps = steps

    @property
    def motor_off(self) -> bool:
        """The windings carry no current; False has no effect, the next motion energises them."""
        return self._power(self._clock.now_ns()) == table.PWR_OFF

    @motor_off.setter
    def motor_off(self, off: bool) -> None:
        if off:
            with self._plant.lock:
                now_ns = self._clock.now_ns()
                self._settle(now_ns)
                self._failed = self._failed or self._under_way
                self._finish(now_ns)
                self._stepper.release(now_ns)

    def _clear(self) -> None:
        """The state after power-on."""
        self._command = ""
        self._under_way = False
        self._failed = False
        self._homed = False
        self._errors = 0
        self._danger = 0
        self._target = 0.0
        self._encoder = 0

    def _settle(self, now_ns: int) -> None:
        """Notice that the motion under way has ended."""
        travel = self._stepper.travel(now_ns)
        if not self._under_way or travel.leg is not None:
            return
        if travel.limit:
            self._failed = True
            if self.wrong_limit:
                alarm = table.FLAG_ALARM if self._settings.alarm_at_wrong_limit() else 0
                self._danger |= table.FLAG_BORDERS_SWAP_MISSET | alarm
        elif self.endless and self._command != "sstp":
            return
        elif self._command == "home":
            self._homed = True
        self._finish(now_ns)

    def _finish(self, now_ns: int) -> None:
        self._stepper.halt(now_ns)
        self._under_way = False
        if self._failed or self._command not in ("move", "movr"):
            self._target = self._stepper.count(now_ns)

    def _apply_stops(self, now_ns: int) -> None:
        self._stepper.disturb(now_ns)
        self._stepper.stops = self._settings.stops()

    def _error(self, letters: str, flag: int) -> bytes:
        self._errors |= flag
        return encode(letters)

    def _act(self, frame: XimcFrame, now_ns: int) -> bytes:
        if frame.letters in MOTION:
            return self._move(frame, now_ns)
        match frame.letters:
            case "stop":
                self._stop(now_ns)
            case "pwof" if not self._under_way:
                self._stepper.release(now_ns)
            case "zero":
                self._recount(now_ns, 0.0)
                self._encoder = 0
            case "spos":
                full, micro, encoder, leave = struct.unpack(table.ACTIONS["spos"], frame.payload)
                if not leave & table.SPOS_LEAVE_POSITION:
                    self._recount(now_ns, self._settings.steps(full, micro))
                if not leave & table.SPOS_LEAVE_ENCODER:
                    self._encoder = encoder
            case "save":
                self._settings.save()
            case "read":
                self._settings.restore()
                self._apply_stops(now_ns)
            case _:
                pass  # the sync-in queue, measurements, robust settings and stage memory change nothing here
        return encode(frame.letters)

    def _move(self, frame: XimcFrame, now_ns: int) -> bytes:
        """Begin a motion; in ALARM the request is acknowledged and ignored."""
        if self.alarm:
            return encode(frame.letters)
        corrected = False
        if frame.letters in ("move", "movr"):
            full, micro = struct.unpack(table.ACTIONS[frame.letters], frame.payload)
            allowed = self._settings.allowed_micro(micro)
            corrected = allowed != micro
            self._target = self._settings.steps(full, allowed) + (self._target if frame.letters == "movr" else 0.0)
        if frame.letters == "home":
            self._homed = False
        self._command, self._failed = frame.letters, False
        if frame.letters != "sstp" or self._under_way:
            self._under_way = True
            self._stepper.go(now_ns, *self._legs(frame.letters))
            self._settle(now_ns)
        return self._error("errv", table.FLAG_ERRV) if corrected else encode(frame.letters)

    def _legs(self, letters: str) -> tuple[Leg, ...]:
        pace = self._settings.pace()
        match letters:
            case "move" | "movr":
                return (GoTo(self._target, pace),)
            case "left" | "rigt":
                return (Onward(LEFT if letters == "left" else RIGHT, pace),)
            case "loft":
                antiplay = self._settings.antiplay_steps()
                return Shift(antiplay, pace), Shift(-antiplay, pace)
            case "home":
                return self._settings.homing()
            case _:
                return (Brake(pace.decel),)

    def _stop(self, now_ns: int) -> None:
        """Stand still, forget errors and dangers; a stop out of motion may skip steps, so the scale is lost."""
        if self._stepper.speed(now_ns):
            self._homed = False
        self._command, self._failed = "stop", False
        self._finish(now_ns)
        self._errors = self._danger = 0

    def _recount(self, now_ns: int, count: float) -> None:
        moving_to_target = self._under_way and self._command in ("move", "movr")
        self._target = self._target + count - self._stepper.count(now_ns) if moving_to_target else count
        self._stepper.recount(now_ns, count)

    def _answer(self, letters: str, now_ns: int) -> bytes:
        if letters == "gets":
            return self._status(now_ns)
        values: dict[str, tuple[object, ...]] = {
            "gpos": (*self._settings.full_and_micro(self._stepper.count(now_ns)), self._encoder),
            "geti": (b"XIMC", b"SM", b"XISM-USB", 2, 3, 8),
            "gser": (self._serial_number,),
            "gfwv": (4, 7, 6),
            "gblv": (4, 7, 6),
            "guid": (self._serial_number, 0, 0, 0),
        }
        layout = struct.Struct(table.QUERIES[letters])
        return layout.pack(*values[letters]) if letters in values else bytes(layout.size)

    def _status(self, now_ns: int) -> bytes:
        count = self._settings.full_and_micro(self._stepper.count(now_ns))
        speed = self._settings.full_and_micro(self._stepper.speed(now_ns))
        power = self._power(now_ns)
        current_mA = self._settings.current_mA() if power == table.PWR_NORMAL else 0
        command = table.COMMAND_CODES.get(self._command, 0)
        command |= (table.MVCMD_ERROR if self._failed else 0) | (table.MVCMD_RUNNING if self._under_way else 0)
        return struct.pack(
            table.QUERIES["gets"],
            self._move_state(now_ns),
            command,
            power,
            0,  # no encoder
            table.WINDINGS_OK,
            *count,
            self._encoder,
            *speed,
            current_mA,
            table.SUPPLY_10mV,
            table.USB_mA,
            table.USB_10mV,
            table.PROCESSOR_0_1degC,
            self._flags(),
            self._edges(now_ns),
            table.COMMAND_QUEUE_FREE,
        )

    def _move_state(self, now_ns: int) -> int:
        travel = self._stepper.travel(now_ns)
        if travel.leg is None:
            return table.MOVE_STATE_MOVING if self._under_way else 0
        pace = None if isinstance(travel.leg, Brake) else travel.leg.pace
        at_speed = pace is not None and abs(self._stepper.speed(now_ns)) == pace.speed
        playing = table.MOVE_STATE_ANTIPLAY if self._command == "loft" else 0
        return table.MOVE_STATE_MOVING | (table.MOVE_STATE_TARGET_SPEED if at_speed else 0) | playing

    def _flags(self) -> int:
        homed = table.FLAG_IS_HOMED if self._homed else 0
        return table.FLAG_EEPROM_CONNECTED | self._errors | self._danger | homed

    def _edges(self, now_ns: int) -> int:
        side = self._stepper.closed_switch(now_ns) * (-1 if self.wrong_limit else 1)
        return {LEFT: table.GPIO_LEFT_EDGE, RIGHT: table.GPIO_RIGHT_EDGE}.get(side, 0)

    def _power(self, time_ns: int) -> int:
        """PWRSts at that time."""
        travel = self._stepper.travel(time_ns)
        if not travel.energised:
            return table.PWR_OFF
        if travel.leg is not None:
            return table.PWR_NORMAL
        return self._settings.resting_power(time_ns - travel.rest_ns)


PROFILES = {"8MT160-300": table.LINEAR_8MT160_300, "8MR151": table.ROTARY_8MR151}


class StageSpec(Document, extra="ignore"):
    """Another stage, in mm or degrees, full steps/s and full steps/s2."""

    unit_per_step: float
    travel: float
    speed: float
    acceleration: float
    deceleration: float
    homing_speed: float
    power_off_s: float | None

    @property
    def profile(self) -> table.Profile:
        """Return the profile of the two known stages of this kind, with a switch at each end."""
        stage = table.LINEAR_8MT160_300
        move, power, homing = (stage.settings[name] for name in ("mov", "pwr", "hom"))
        is_off = self.power_off_s is not None
        settings = {
            "mov": (round(self.speed), 0, round(self.acceleration), round(self.deceleration), *move[4:]),
            "pwr": (*power[:2], round(self.power_off_s or 0), power[3], 7 if is_off else 5),
            "hom": (round(self.homing_speed), 0, round(self.homing_speed), *homing[3:]),
        }
        end_steps = round(self.travel / self.unit_per_step)
        switches = replace(stage.switches, right=end_steps - 500)
        return replace(
            stage, unit_per_step=self.unit_per_step, switches=switches, settings={**stage.settings, **settings}
        )


class AxisSpec(Document, extra="ignore"):
    """A stage: where its controller answers and which profile it was delivered with, by name or written out."""

    address: str
    profile: Literal["8MT160-300", "8MR151"] | StageSpec
    serial_number: int

    @property
    def stage(self) -> table.Profile:
        """The profile itself."""
        return self.profile.profile if isinstance(self.profile, StageSpec) else PROFILES[self.profile]


@fake("axes", rank=STAGES)
def _build(bench: Bench, name: str, settings: Mapping[str, Any]) -> FakeAxis:
    spec = AxisSpec.model_validate(settings)
    if name not in ("linear", "rotary"):
        raise ValueError(f"the simulated table has linear and rotary, and no axis {name}")
    axis = FakeAxis(bench.plant, bench.clock, spec.stage, spec.serial_number, name)
    bench.listen(name, spec.address, axis.engine)
    return axis
