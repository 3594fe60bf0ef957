"""The settings of a fake XIMC controller, in RAM and flash, and what they mean for its motion."""

from __future__ import annotations

import math
import struct

from thermostand.drivers.sim.motion import ximc_table as table
from thermostand.drivers.sim.motion.kinematics import Pace
from thermostand.drivers.sim.motion.stepper import LEFT, RIGHT, Leg, Run, Shift, Stops
from thermostand.foundation.clock import seconds_ns


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
        """Where EDS lets the controller stop the motor: at the switches, at border values, or nowhere."""
        flags, _, left, left_micro, right, right_micro = self._fields("eds")
        by_value = flags & table.BORDER_BY_VALUE
        left_stop = self.steps(left, left_micro) if by_value else None
        right_stop = self.steps(right, right_micro) if by_value else None
        return Stops(
            left_stop if flags & table.BORDER_STOP_LEFT else -math.inf,
            right_stop if flags & table.BORDER_STOP_RIGHT else math.inf,
        )

    def pace(self) -> Pace:
        """Of MOVE, MOVR, LEFT, RIGT, LOFT and SSTP."""
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
        legs: list[Leg] = [Run(first, fast_pace, to_switch=flags >> 4 & 3 == table.HOME_STOP_LIMIT)]
        if flags & table.HOME_SECOND_PHASE:
            to_switch = flags >> 6 & 3 == table.HOME_STOP_LIMIT
            legs.append(Run(second, self._pace(slow, slow_micro), to_switch))
        return (*legs, Shift(second * self.steps(delta, delta_micro), fast_pace))

    def alarm_at_wrong_limit(self) -> bool:
        """SEC: reaching the wrong limit switch raises ALARM."""
        return bool(self._fields("sec")[7] & table.SECURE_ALARM_ON_BORDERS)

    def resting_power(self, rested_ns: int) -> int:
        """PWRSts after a rest: full current until CurrReductDelay, none at all after PowerOffDelay, if enabled."""
        _, reduce_ms, off_s, _, flags = self._fields("pwr")
        if flags & table.POWER_OFF and rested_ns >= seconds_ns(off_s):
            return table.PWR_OFF
        if flags & table.POWER_REDUCE and rested_ns >= seconds_ns(reduce_ms / 1000):
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
