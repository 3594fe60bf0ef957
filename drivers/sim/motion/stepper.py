"""A stepper motor with a stage on it: what the controller counts and where the mechanics is, as functions of time.

Two positions in full steps, 1 to the right is +1: the count, which the controller knows, and the mechanical
position, which only switches and the camera see. They differ by the slip: where the count began, and lost steps.
Nothing here runs by itself; every question names its time, and asking changes nothing.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

from thermostand.drivers.sim.motion.kinematics import (
    Pace,
    Path,
    make_rest,
    plan_path_onward,
    plan_path_to,
    plan_path_to_halt,
)
from thermostand.foundation.clock import NS_PER_S, to_ns

LEFT, RIGHT = -1, 1
SWITCH_PLAY = 1 / 256  # steps; a stage stopped by a switch keeps it closed in spite of rounding
HISTORY = 16  # travels kept, so that a picture exposed a moment ago is rendered where the stage then was


@dataclass(frozen=True, slots=True)
class LimitSwitches:
    """Mechanical positions at which the limit switches close, in steps; None where there is none.

    With `turn_steps` the stage is a turntable: the left switch closes once a turn, within `width_steps` of its place.
    """

    left: float
    right: float | None
    turn_steps: float | None = None
    width_steps: float = 10.0

    def closed(self, mechanical: float) -> int:
        """LEFT, RIGHT or 0: the switch that is closed there."""
        if self.turn_steps is not None:
            off = (mechanical - self.left + self.turn_steps / 2) % self.turn_steps - self.turn_steps / 2
            return LEFT if abs(off) <= self.width_steps else 0
        if mechanical <= self.left + SWITCH_PLAY:
            return LEFT
        return RIGHT if self.right is not None and mechanical >= self.right - SWITCH_PLAY else 0

    def ahead(self, mechanical: float, direction: int) -> float:
        """Return where the switch of that side will close for a stage that leaves `mechanical`; infinite if nowhere."""
        if direction == RIGHT:
            return math.inf if self.right is None else self.right
        if self.turn_steps is None:
            return self.left
        return self.left + math.floor((mechanical - self.left) / self.turn_steps) * self.turn_steps


@dataclass(frozen=True, slots=True)
class GoTo:
    """Move to a count."""

    target: float
    pace: Pace


@dataclass(frozen=True, slots=True)
class Shift:
    """Move by a number of steps from wherever the leg begins."""

    steps: float
    pace: Pace


@dataclass(frozen=True, slots=True)
class Onward:
    """Move in a direction for ever; with `to_switch` until the limit switch of that side, which is then no failure."""

    direction: int
    pace: Pace
    to_switch: bool = False


@dataclass(frozen=True, slots=True)
class Brake:
    """Slow down to rest."""

    decel: float


Leg = GoTo | Shift | Onward | Brake


@dataclass(frozen=True, slots=True)
class Stops:
    """Counts at which the controller stops the motor under any command; None: the limit switch of that side;
    infinite: nothing stops it there."""

    left: float | None = None
    right: float | None = None


@dataclass(frozen=True, slots=True)
class Journey:
    """One leg under way, or rest. `slip` is mechanics minus count when it began; `limit` is the side that ended it
    against its will; `energised`: the windings have not been switched off; `rest_ns`: since when a rest lasts."""

    start_ns: int
    path: Path
    slip: float
    leg: Leg | None = None
    legs: tuple[Leg, ...] = ()
    limit: int = 0
    energised: bool = True
    rest_ns: int = 0

    def elapsed_s(self, time_ns: int) -> float:
        """Return the time since it began, never negative."""
        return max(0, time_ns - self.start_ns) / NS_PER_S


@dataclass(frozen=True, slots=True)
class LegEnd:
    """When and at which count a leg ends, and the side of the limit that ends it against its will (0: it ends well)."""

    time_ns: int
    count: float
    limit: int


class Stepper:
    """The motor and its stage. `stops` belongs to the controller; the rest are faults, to be set through `disturb`.

    stall_at: the mechanics cannot pass this position to the right, the count can (steps are lost). stuck_switch: LEFT
    or RIGHT, a switch that reads closed wherever the stage is.
    """

    def __init__(self, switches: LimitSwitches, mechanical: float, time_ns: int) -> None:
        self.switches = switches
        self.stops = Stops()
        self.stall_at: float | None = None
        self.stuck_switch = 0
        resting = Journey(time_ns, make_rest(0.0), mechanical, energised=False, rest_ns=time_ns)
        self._travels: deque[Journey] = deque([resting], maxlen=HISTORY)

    def go(self, time_ns: int, *legs: Leg) -> None:
        """Leave what was under way and do `legs` one after the other, from the present position and speed."""
        travel = self.travel(time_ns)
        count, speed = travel.path.at(travel.elapsed_s(time_ns))
        self._travels.append(_begin(time_ns, count, speed, self._slip(travel, time_ns), legs))

    def halt(self, time_ns: int) -> None:
        """Stand still at once."""
        self._travels.append(self._halt_at(self.travel(time_ns), time_ns))

    def release(self, time_ns: int) -> None:
        """Take the current off the windings."""
        self._travels.append(replace(self._halt_at(self.travel(time_ns), time_ns), energised=False))

    def disturb(self, time_ns: int, lost_steps: float = 0.0) -> None:
        """Begin the rest of the journey afresh, so that faults set after this call act from now on; the mechanics
        falls back by `lost_steps`."""
        travel = self.travel(time_ns)
        slip = self._slip(travel, time_ns) - lost_steps
        path = travel.path.after(travel.elapsed_s(time_ns))
        self._travels.append(replace(travel, start_ns=time_ns, path=path, slip=slip))

    def recount(self, time_ns: int, count: float) -> None:
        """Call the present position `count`; motion towards a place keeps its physical destination."""
        travel = self.travel(time_ns)
        by = count - self.count(time_ns)
        phases = tuple(
            replace(phase, position=phase.position + by)
            for phase in travel.path.after(travel.elapsed_s(time_ns)).phases
        )
        slip = self._slip(travel, time_ns) - by
        self._travels.append(replace(travel, start_ns=time_ns, path=Path(phases, travel.path.end + by), slip=slip))

    def travel(self, time_ns: int) -> Journey:
        """The leg of that time, begun and ended events included. Times before the history give its first entry."""
        travel = next((past for past in reversed(self._travels) if past.start_ns <= time_ns), self._travels[0])
        while (ending := self._find_end(travel)) is not None and ending.time_ns <= time_ns:
            slip = self._slip(travel, ending.time_ns)
            legs = () if ending.limit else travel.legs
            travel = replace(_begin(ending.time_ns, ending.count, 0.0, slip, legs), limit=ending.limit)
        return travel

    def count(self, time_ns: int) -> float:
        """The controller's step count."""
        travel = self.travel(time_ns)
        return travel.path.at(travel.elapsed_s(time_ns))[0]

    def speed(self, time_ns: int) -> float:
        """The motor's present rate, steps/s."""
        travel = self.travel(time_ns)
        return travel.path.at(travel.elapsed_s(time_ns))[1]

    def mechanical(self, time_ns: int) -> float:
        """Return where the stage really is."""
        travel = self.travel(time_ns)
        return travel.path.at(travel.elapsed_s(time_ns))[0] + self._slip(travel, time_ns)

    def closed_switch(self, time_ns: int) -> int:
        """LEFT, RIGHT or 0."""
        return self.stuck_switch or self.switches.closed(self.mechanical(time_ns))

    def _slip(self, travel: Journey, time_ns: int) -> float:
        return self._slip_past(travel, travel.path.highest(travel.elapsed_s(time_ns)))

    def _slip_past(self, travel: Journey, highest: float) -> float:
        """Slip once the count has been to `highest`: the mechanics waits at the obstacle, and turns back with it."""
        if self.stall_at is None:
            return travel.slip
        return min(travel.slip, self._ceiling(travel, self.stall_at) - highest)

    def _ceiling(self, travel: Journey, stall_at: float) -> float:
        """An obstacle behind the stage does not pull it back."""
        return max(stall_at, travel.path.at(0.0)[0] + travel.slip)

    def _halt_at(self, travel: Journey, time_ns: int) -> Journey:
        path = make_rest(travel.path.at(travel.elapsed_s(time_ns))[0])
        rest_ns = time_ns if travel.leg else travel.rest_ns
        return Journey(time_ns, path, self._slip(travel, time_ns), energised=travel.energised, rest_ns=rest_ns)

    def _find_end(self, travel: Journey) -> LegEnd | None:
        """Return how the leg under way will end, None when there is none or it never does."""
        if travel.leg is None:
            return None
        endings = [(travel.path.duration_s, travel.path.end, 0)]
        for direction in (LEFT, RIGHT):
            wanted = isinstance(travel.leg, Onward) and travel.leg.to_switch and travel.leg.direction == direction
            count = self._stop_count(travel, direction, wanted)
            reached_s = travel.path.reaches_s(count, direction)
            if reached_s is not None:
                count = count if reached_s > 0 else travel.path.at(0.0)[0]
                endings.append((reached_s, count, 0 if wanted else direction))
        ends_s, count, limit = min(endings)
        return None if ends_s == math.inf else LegEnd(travel.start_ns + to_ns(ends_s), count, limit)

    def _stop_count(self, travel: Journey, direction: int, wanted: bool) -> float:
        """The count at which motion in `direction` will end, infinite when nothing stops it."""
        stop = self.stops.left if direction == LEFT else self.stops.right
        if stop is not None and not wanted:
            return stop
        if self.stuck_switch == direction:
            return -direction * math.inf
        place = self.switches.ahead(travel.path.at(0.0)[0] + travel.slip, direction)
        if direction == RIGHT:
            blocked = self.stall_at is not None and self._ceiling(travel, self.stall_at) < place
            return math.inf if blocked else place - travel.slip
        turning = max((phase.position for phase in travel.path.phases), default=travel.path.end)
        return place - self._slip_past(travel, turning)


def _begin(time_ns: int, count: float, speed: float, slip: float, legs: tuple[Leg, ...]) -> Journey:
    """The first of `legs`, from `count` and `speed`; at rest when there is none."""
    if not legs:
        return Journey(time_ns, make_rest(count), slip, rest_ns=time_ns)
    return Journey(time_ns, _path(legs[0], count, speed), slip, legs[0], legs[1:])


def _path(leg: Leg, position: float, speed: float) -> Path:
    match leg:
        case GoTo(target, pace):
            return plan_path_to(position, speed, target, pace)
        case Shift(steps, pace):
            return plan_path_to(position, speed, position + steps, pace)
        case Onward(direction, pace):
            return plan_path_onward(position, speed, direction, pace)
        case Brake(decel):
            return plan_path_to_halt(position, speed, decel)
