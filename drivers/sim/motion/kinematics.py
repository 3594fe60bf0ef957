"""Motion with bounded acceleration as a pure function of time: phases of constant acceleration in a row.

Positions are in steps, speeds in steps/s, accelerations in steps/s2; times are s since the path began.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Pace:
    """How fast to go: top speed, acceleration and deceleration, all positive (speed 0 = does not get under way)."""

    speed: float
    accel: float
    decel: float


@dataclass(frozen=True, slots=True)
class MotionPhase:
    """A stretch of constant acceleration within which the speed keeps its sign."""

    duration_s: float
    position: float
    speed: float
    accel: float

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Position and speed `elapsed_s` after the phase began."""
        if elapsed_s == 0.0 or (self.speed == 0.0 and self.accel == 0.0):
            return self.position, self.speed
        speed = self.speed + self.accel * elapsed_s
        return self.position + 0.5 * (self.speed + speed) * elapsed_s, speed

    def direction(self) -> int:
        """1 to the right (rising positions), -1 to the left, 0 at rest."""
        leading = self.speed or self.accel
        return (leading > 0) - (leading < 0)


@dataclass(frozen=True, slots=True)
class Path:
    """Phases in a row, then rest at `end`; `end` is NaN when the last phase never ends."""

    phases: tuple[MotionPhase, ...]
    end: float

    @property
    def duration_s(self) -> float:
        """The time until rest, inf when it never comes."""
        return sum(phase.duration_s for phase in self.phases)

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Position and speed at `elapsed_s`."""
        for phase in self.phases:
            if elapsed_s < phase.duration_s:
                return phase.at(elapsed_s)
            elapsed_s -= phase.duration_s
        return self.end, 0.0

    def after(self, elapsed_s: float) -> Path:
        """Return what remains of it at `elapsed_s`."""
        for index, phase in enumerate(self.phases):
            if elapsed_s < phase.duration_s:
                position, speed = phase.at(elapsed_s)
                rest = MotionPhase(phase.duration_s - elapsed_s, position, speed, phase.accel)
                return Path((rest, *self.phases[index + 1 :]), self.end)
            elapsed_s -= phase.duration_s
        return Path((), self.end)

    def highest(self, until_s: float) -> float:
        """The largest position up to `until_s`: speeds keep their sign within a phase, so only the ends matter."""
        highest = self.at(until_s)[0]
        for phase in self.phases:
            if until_s <= 0:
                break
            highest = max(highest, phase.position)
            until_s -= phase.duration_s
        return highest

    def reaches_s(self, level: float, direction: int) -> float | None:
        """Return when it first moves in `direction` (1 or -1) at or beyond `level`; None when it never does."""
        begun_s = 0.0
        for phase in self.phases:
            if phase.direction() == direction:
                within_s = _crossing_s(phase, level, direction)
                if within_s <= phase.duration_s:
                    return begun_s + within_s
            begun_s += phase.duration_s
        return None


def make_rest(position: float) -> Path:
    """Standing at `position`."""
    return Path((), position)


def plan_path_to(position: float, speed: float, target: float, pace: Pace) -> Path:
    """Plan the path from a moving start to rest at `target`; turns round when the target lies behind or too near to
    stop."""
    if pace.speed == 0:
        return plan_path_onward(position, speed, 1, pace)
    halt = position + speed * abs(speed) / (2 * pace.decel)
    if speed * (target - halt) < 0:
        return _join(plan_path_to_halt(position, speed, pace.decel), plan_path_to(halt, 0.0, target, pace))
    direction = 1 if target >= position else -1
    distance, entry = abs(target - position), abs(speed)
    reach = distance + entry**2 / (2 * pace.accel)
    top = min(pace.speed, math.sqrt(2 * reach * pace.accel * pace.decel / (pace.accel + pace.decel)))
    if top == 0:
        return make_rest(target)
    gain = pace.accel if top >= entry else -pace.decel
    cruise = distance - (top**2 - entry**2) / (2 * gain) - top**2 / (2 * pace.decel)
    stretches = [((top - entry) / gain, gain), (max(0.0, cruise) / top, 0.0), (top / pace.decel, -pace.decel)]
    return Path(_phases(position, speed, [(duration_s, direction * accel) for duration_s, accel in stretches]), target)


def plan_path_onward(position: float, speed: float, direction: int, pace: Pace) -> Path:
    """Plan the path from a moving start to the top speed in `direction` (1 or -1), for ever."""
    if speed * direction < 0:
        halt = plan_path_to_halt(position, speed, pace.decel)
        return _join(halt, plan_path_onward(halt.end, 0.0, direction, pace))
    entry = abs(speed)
    gain = pace.accel if pace.speed >= entry else -pace.decel
    stretches = [((pace.speed - entry) / gain, direction * gain), (math.inf, 0.0)]
    return Path(_phases(position, speed, stretches), math.nan)


def plan_path_to_halt(position: float, speed: float, decel: float) -> Path:
    """Braking to rest."""
    end = position + speed * abs(speed) / (2 * decel)
    return Path(_phases(position, speed, [(abs(speed) / decel, -math.copysign(decel, speed))]), end)


def _phases(position: float, speed: float, stretches: list[tuple[float, float]]) -> tuple[MotionPhase, ...]:
    """Stretches (duration_s, acceleration) laid end to end, empty ones left out."""
    phases: list[MotionPhase] = []
    for duration_s, accel in stretches:
        if duration_s > 0:
            phases.append(MotionPhase(duration_s, position, speed, accel))
            if duration_s < math.inf:
                position, speed = phases[-1].at(duration_s)
    return tuple(phases)


def _join(first: Path, second: Path) -> Path:
    return Path(first.phases + second.phases, second.end)


def _crossing_s(phase: MotionPhase, level: float, direction: int) -> float:
    """Return the time within a phase moving in `direction` until it is at or beyond `level`; inf when the phase turns
    first."""
    distance = direction * (level - phase.position)
    if distance <= 0:
        return 0.0
    speed, accel = abs(phase.speed), direction * phase.accel
    exit_squared = speed**2 + 2 * accel * distance
    if exit_squared < 0 or speed + exit_squared == 0:
        return math.inf
    return 2 * distance / (speed + math.sqrt(exit_squared))
