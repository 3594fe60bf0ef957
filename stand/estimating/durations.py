"""How long each step takes: what the recipe and physics state, and what that kind of work usually takes beyond it.

A step's duration depends on what came before (a stage that is there already, a flap that is closed), so the caller
walks the plan with the Situation that each step finds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType

from drivers.devices.motion.stage import AxisSettings
from drivers.devices.motion.stage_profiles import StageProfile
from experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PowerCamera,
    SetTemperature,
    Soak,
    SoakUntilSettled,
    StartChamber,
    Step,
    estimate_s,
    kind_of,
    last_part_s,
    longest_s,
)
from foundation.errors import ConfigError
from stand.config.stand_config import StandConfig
from stand.estimating.chamber_model import ChamberModel

# Until recorded nights have shown better, s: a flap's travel with its confirmation, homing from near the switch.
_FLAP_TRAVEL_S = 3.0
_FLAP_AT_REST_S = 0.2
_HOMING_S = 15.0
_MOVE_CONFIRMED_S = 0.1

COOL_DOWN_AS_FOUND = "cool down as found"  # of a camera that the run finds as warm as it happens to be

LABORATORY_degC = 24.0  # where the chamber begins a night; the paper's room (section 3.1)


def move_s(stage: StageProfile, steps: float) -> float:
    """From rest to rest over so many full steps, s: a trapezoid of speed, a triangle when it is short. A controller
    that is set otherwise shows in the overhead."""
    way = abs(steps)
    slow = 1.0 / stage.acceleration + 1.0 / stage.deceleration  # s to start and stop, per step/s
    speed = min(stage.speed, math.sqrt(2.0 * way / slow))
    return way / speed + speed * slow / 2.0 if speed > 0.0 else 0.0


@dataclass(frozen=True, slots=True)
class Situation:
    """What a step finds: the flap, whether the plan has had the camera on (before that its temperature is unknown),
    where each axis stands (mm or deg; one that is missing is not homed), the last two set-points, and what was soaked
    since, s: the first soak is taken to begin when the chamber sets off from the one to the other."""

    flap_open: bool = False
    camera_was_on: bool = False
    positions: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    from_degC: float = LABORATORY_degC
    to_degC: float = LABORATORY_degC
    soaked_s: float = 0.0

    def after(self, step: Step) -> Situation:
        """What the step leaves behind."""
        match step:
            case OpenFlap():
                return replace(self, flap_open=True)
            case CloseFlap():
                return replace(self, flap_open=False)
            case PowerCamera(on=True) | Capture():
                return replace(self, camera_was_on=True)
            case StartChamber(chamber_degC) | SetTemperature(chamber_degC):
                return replace(self, from_degC=self.to_degC, to_degC=chamber_degC, soaked_s=0.0)
            case Soak(duration_s):
                return replace(self, soaked_s=self.soaked_s + duration_s)
            case MoveTo(axis, position):
                return replace(self, positions=MappingProxyType({**self.positions, axis: position}))
            case _:
                return self


@dataclass(frozen=True, slots=True)
class Expectation:
    """`stated_s` follows from the step and its situation; `overhead_s` is what `work` of this kind takes beyond it."""

    work: str
    stated_s: float
    overhead_s: float

    @property
    def duration_s(self) -> float:
        """Together, s."""
        return max(0.0, self.stated_s + self.overhead_s)


def expect(
    step: Step,
    found: Situation,
    config: StandConfig,
    overheads_s: Mapping[str, float] = MappingProxyType({}),
    chamber: ChamberModel | None = None,
) -> Expectation:
    """What the step takes in the situation it finds; `overheads_s` was learned, by kind of work, with `chamber`."""
    usual = _usual(step, found, config, chamber or ChamberModel())
    return replace(usual, overhead_s=overheads_s.get(usual.work, usual.overhead_s))


def axis_of(config: StandConfig, name: str) -> AxisSettings:
    """The stand's axis of that name; ConfigError when it has none."""
    axis = next((axis for known, axis in config.axes.items() if known == name), None)
    if axis is None:
        raise ConfigError(f"this stand has no axis {name!r}, only {', '.join(config.axes) or 'none'}")
    return axis


def soak_s(soak: Soak, found: Situation, chamber: ChamberModel) -> float:
    """How long the soak is expected to take, s: until the chamber has been in its band for its last part, too, once
    recorded runs have shown how fast it is."""
    ramps = chamber.heating_ramps if found.to_degC > found.from_degC else chamber.cooling_ramps
    if not soak.band_K or not ramps:
        return soak.duration_s
    arrives_s = chamber.arrival_s(found.from_degC, found.to_degC, soak.band_K) - found.soaked_s
    return min(longest_s(soak), max(soak.duration_s, arrives_s + last_part_s(soak)))


def settling_s(soak: SoakUntilSettled, found: Situation, chamber: ChamberModel) -> float:
    """How long the soak is expected to take, s: the chamber arrives, the camera follows with its time constant until it
    is slow enough, and then it has to stay so. How the image drifts is unknown until it was seen once."""
    gap_K = abs(found.to_degC - found.from_degC)
    first_K_per_min = 60.0 * gap_K / chamber.camera_time_constant_s
    slowing_s = chamber.camera_time_constant_s * math.log(max(1.0, first_K_per_min / soak.camera_K_per_min))
    expected_s = chamber.arrival_s(found.from_degC, found.to_degC) + slowing_s + soak.window_s
    return min(soak.max_s, max(soak.min_s, expected_s))


def _usual(step: Step, found: Situation, config: StandConfig, chamber: ChamberModel) -> Expectation:
    match step:
        case OpenFlap() | CloseFlap():
            travels = found.flap_open is not isinstance(step, OpenFlap)
            work = "flap travel" if travels else "flap at rest"
            return Expectation(work, 0.0, _FLAP_TRAVEL_S if travels else _FLAP_AT_REST_S)
        case MoveTo(axis, position):
            stage = axis_of(config, axis)
            if axis not in found.positions:
                return Expectation(f"home and move {axis}", _move_s(stage, 0.0, position), _HOMING_S)
            return Expectation(f"move {axis}", _move_s(stage, found.positions[axis], position), _MOVE_CONFIRMED_S)
        case CheckHome(axis):
            stage, position = axis_of(config, axis), found.positions.get(axis, 0.0)
            return Expectation(
                f"check home {axis}", _to_home_s(stage, position) + _move_s(stage, 0.0, position), _HOMING_S
            )
        case StartChamber(chamber_degC) | SetTemperature(chamber_degC):
            way_s = 60.0 * abs(chamber_degC - found.to_degC) / config.set_point_K_per_min
            return Expectation(kind_of(step), way_s, 0.0)
        case CoolDown():
            work = kind_of(step) if found.camera_was_on else COOL_DOWN_AS_FOUND
            return Expectation(work, estimate_s(step, _boot_s(config)), 0.0)
        case Soak():
            return Expectation(kind_of(step), soak_s(step, found, chamber), 0.0)
        case SoakUntilSettled():
            return Expectation(kind_of(step), settling_s(step, found, chamber), 0.0)
        case _:
            return Expectation(kind_of(step), estimate_s(step, _boot_s(config)), 0.0)


def _boot_s(config: StandConfig) -> float:
    return max((camera.boot_s for camera in config.cameras.values()), default=0.0)


def _move_s(axis: AxisSettings, begin: float, end: float) -> float:
    """As the driver moves: when not from below, past the end first, then up to it."""
    profile = axis.stage
    below = end - profile.overshoot
    ways = (begin - below, profile.overshoot) if begin > below else (end - begin,)
    return sum(move_s(profile, way / profile.unit_per_step) for way in ways)


def _to_home_s(axis: AxisSettings, position: float) -> float:
    return abs(position) / axis.stage.unit_per_step / axis.stage.homing_speed
