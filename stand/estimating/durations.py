"""How long each step takes: what the recipe and physics state, and what that kind of work usually takes beyond it.

A step's duration depends on what came before (a stage that is there already, a flap that is closed), so the caller
walks the plan with the Situation that each step finds.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from types import MappingProxyType

from thermostand.drivers.devices.cameras.shared_line import explain_overload
from thermostand.drivers.devices.motion.stage import AxisSettings
from thermostand.drivers.devices.motion.stage_profiles import StageProfile
from thermostand.experiments.steps import KnownStand, Price, Situation, Step
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.chamber_model import ChamberModel


def compute_move_s(stage: StageProfile, steps: float) -> float:
    """The time from rest to rest over so many full steps, s: a trapezoid of speed, a triangle when it is short. A
    controller that is set otherwise shows in the overhead."""
    way = abs(steps)
    slow = 1.0 / stage.acceleration + 1.0 / stage.deceleration  # s to start and stop, per step/s
    speed = min(stage.speed, math.sqrt(2.0 * way / slow))
    return way / speed + speed * slow / 2.0 if speed > 0.0 else 0.0


class ConfiguredStand(KnownStand):
    """What is known of a stand by its file, and by its chamber's model."""

    def __init__(self, config: StandConfig, chamber: ChamberModel | None = None) -> None:
        self._config = config
        self._chamber = chamber or ChamberModel()
        self.boot_s = max((camera.boot_s for camera in config.cameras.values()), default=0.0)

    def set_point_way_s(self, from_degC: float, to_degC: float) -> float:
        """The time of a set-point's way, as the stand's ramp goes."""
        return 60.0 * abs(to_degC - from_degC) / self._config.set_point_K_per_min

    def arrival_s(self, from_degC: float, to_degC: float, band_K: float) -> float | None:
        """Return the time to a set-point; None until a recorded run has shown a ramp of this direction."""
        ramps = self._chamber.heating_ramps if to_degC > from_degC else self._chamber.cooling_ramps
        return self._chamber.arrival_s(from_degC, to_degC, band_K) if ramps else None

    def settling_s(self, from_degC: float, to_degC: float, camera_K_per_min: float) -> float:
        """The chamber arrives, the camera follows with its time constant."""
        first_K_per_min = 60.0 * abs(to_degC - from_degC) / self._chamber.camera_time_constant_s
        slowing_s = self._chamber.camera_time_constant_s * math.log(max(1.0, first_K_per_min / camera_K_per_min))
        return self._chamber.arrival_s(from_degC, to_degC) + slowing_s

    def move_s(self, axis: str, begin: float, end: float) -> float:
        """The time of a move as the driver moves: when not from below, past the end first, then up to it."""
        profile = self._axis(axis).stage
        below = end - profile.overshoot
        ways = (begin - below, profile.overshoot) if begin > below else (end - begin,)
        return sum(compute_move_s(profile, way / profile.unit_per_step) for way in ways)

    def to_home_s(self, axis: str, position: float) -> float:
        """The time to the home switch at the speed of homing."""
        stage = self._axis(axis).stage
        return abs(position) / stage.unit_per_step / stage.homing_speed

    def set_point_fault(self, chamber_degC: float) -> str:
        """The stand's limits, and those of each camera."""
        cameras = {f"cameras.{name}.ambient_degC": each.ambient_degC for name, each in self._config.cameras.items()}
        for key, limits_degC in {"limits.chamber_degC": self._config.limits.chamber_degC, **cameras}.items():
            if limits_degC is not None and not limits_degC[0] <= chamber_degC <= limits_degC[1]:
                return f"{chamber_degC} degC is outside {key} {limits_degC[0]}..{limits_degC[1]}"
        return ""

    def camera_fault(self) -> str:
        """Return why no frames can be taken; "" when there is a camera."""
        if self._config.cameras:
            return ""
        return "needs a camera, and this stand has none; name it under cameras in the stand's file"

    def supply_fault(self) -> str:
        """Return why cameras cannot be switched off; "" when relays can do it."""
        if self._config.relays is not None:
            return ""
        return "no relay switches the cameras, which stay on: this stand has no relay board; leave it out"

    def exposure_fault(self, chamber_degC: float) -> str:
        """The dew point of the laboratory's air, where that is known."""
        lowest_degC = math.nan if self._config.dew is None else self._config.dew.lowest_degC(math.nan)
        if math.isnan(lowest_degC) or chamber_degC >= lowest_degC:
            return ""
        return (
            f"at {chamber_degC} degC the open flap lets the laboratory's air in, whose dew point with dew.margin_K is "
            f"{lowest_degC:g} degC; leave the set-point out, or dry the air and change dew"
        )

    def rate_fault(self, cameras: tuple[str, ...], interval_s: float | None) -> str:
        """The stand's cameras, their line and their rates."""
        known = self._config.cameras
        if unknown := [name for name in cameras if name not in known]:
            return f"this stand has no camera {unknown[0]}; it has {', '.join(known) or 'none'}"
        if interval_s is None:
            return ""
        if reason := explain_overload(self._config.cameras, interval_s):
            return reason
        for name, camera in known.items():
            if interval_s < 1 / camera.frame_rate_hz - 1e-9:
                return (
                    f"a frame every {interval_s} s is faster than cameras.{name}.frame_rate_hz {camera.frame_rate_hz}"
                )
        return ""

    def axis_fault(self, axis: str, position: float | None) -> str:
        """The limits: also homing ends at 0, for an axis without scale before it moves."""
        settings = self._axis(axis)
        low, high = settings.limits
        if position is not None and not low <= position <= high:
            return f"{position} {settings.unit} is outside the limits {settings.limits} of {axis}"
        # A home check begins at the profile's place.
        ways = (0.0, settings.stage.home_from if position is None else None)
        outside = [place for place in ways if place is not None and not low <= place <= high]
        if not outside:
            return ""
        return (
            f"homing {axis} goes to {outside[0]:g} {settings.unit}, which axes.{axis}.limits {settings.limits} exclude"
        )

    def _axis(self, name: str) -> AxisSettings:
        axis = next((axis for known, axis in self._config.axes.items() if known == name), None)
        if axis is None:
            raise ConfigError(f"this stand has no axis {name!r}, only {', '.join(self._config.axes) or 'none'}")
        return axis


def price_step(
    step: Step, found: Situation, stand: KnownStand, overheads_s: Mapping[str, float] = MappingProxyType({})
) -> Price:
    """Return what the step takes in the situation it finds; `overheads_s` was learned, by kind of work."""
    usual = step.price(found, stand)
    return replace(usual, overhead_s=overheads_s.get(usual.work, usual.overhead_s))
