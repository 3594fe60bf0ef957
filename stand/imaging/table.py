"""The table: moves of its stages, where the plan has put each, and what keeps them there.

A stage without encoder loses steps in silence; only homing again shows it. The 8MT160 profile switches its motor off
60 s after a move, and the rotor may then relax by up to a full step (2.5 um) while the chamber soaks for an hour: home
checks, and a new approach before frames that need it.
"""

from __future__ import annotations

from collections.abc import Mapping

from thermostand.drivers.devices.motion.stage import Axis
from thermostand.foundation.clock import Clock
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.events import HOME_RESIDUAL, HOME_RESIDUAL_LARGE, HOMED, RE_APPROACHED
from thermostand.foundation.hub import Hub
from thermostand.foundation.readings import Quality
from thermostand.stand.safety.interlock import Interlock, Motions

# A stepper that slips loses whole electrical periods of four full steps; what is less than half of one is the switch.
HOME_RESIDUAL_LIMIT_STEPS = 2.0


async def approach(axis: Axis, position: float) -> None:
    """Move to `position` (mm or deg) from below, homing the axis first when it has lost its scale."""
    if not await axis.homed():
        await axis.home()
    await axis.move_to(position)


async def check_home(axis: Axis, hub: Hub, clock: Clock, limit_steps: float = HOME_RESIDUAL_LIMIT_STEPS) -> float:
    """Home again and return the residual in mm or deg: how far the scale was off since the axis was last homed.

    Event "home_residual", or the warning "home_residual_large" beyond `limit_steps` full steps: captures since the last
    good home are then suspect. An axis that has lost its scale is homed without a residual (NaN, event "homed").
    """
    profile = axis.profile
    if not await axis.homed():
        await axis.home()
        hub.publish(HOMED.at(clock.now_ns(), axis=axis.name))
        return float("nan")
    if profile.home_from is not None:
        await axis.move_to(profile.home_from)
    residual = await axis.home()
    steps = residual / profile.unit_per_step
    data = {"axis": axis.name, "residual": round(residual, 5), "unit": profile.unit, "steps": round(steps, 2)}
    if abs(steps) > limit_steps:
        hub.publish(HOME_RESIDUAL_LARGE.at(clock.now_ns(), limit_steps=limit_steps, **data))
    else:
        hub.publish(HOME_RESIDUAL.at(clock.now_ns(), **data))
    return residual


async def prepare_axes(axes: Mapping[str, Axis], commanded: Mapping[str, float], hub: Hub, clock: Clock) -> None:
    """Approach again, before a capture and from below, each axis whose position cannot be relied upon.

    `commanded`: where the plan put each axis it moved (mm or deg); the others are left alone. An axis is uncertain when
    its motor is without current, its scale is lost, or it stands a step or more elsewhere (stopped by hand); event
    "re-approached" with the reason. DeviceAlarm in an alarm.
    """
    for name, position in commanded.items():
        axis = axes[name]
        reading, *_ = await axis.read()
        reason = reading.reason
        if reading.quality is Quality.GOOD:
            if abs(reading.value - position) < axis.profile.unit_per_step:
                continue
            reason = f"stands at {reading.value:.4f} {reading.unit}"
        await approach(axis, position)
        again = RE_APPROACHED.at(clock.now_ns(), axis=name, position=position, unit=reading.unit, reason=reason)
        hub.publish(again)


class Table:
    """The stages by name; what moves is shown in `motions`."""

    def __init__(
        self, axes: Mapping[str, Axis], interlock: Interlock, motions: Motions, hub: Hub, clock: Clock
    ) -> None:
        self._axes = axes
        self._interlock = interlock
        self._motions = motions
        self._hub = hub
        self._clock = clock
        self._commanded: dict[str, float] = {}  # axis -> mm or deg, where the plan put it last

    def forget_positions(self) -> None:
        """Forget the plan's positions: the run that put the stages there is over."""
        self._commanded.clear()

    async def move_to(self, axis: str, position: float) -> None:
        """Move a stage (mm or deg), homing it first when it lost its scale."""
        stage = self._axis(axis)
        self._commanded.pop(axis, None)  # its place is unknown when the move fails
        with self._motions.under_way(axis, f"to {position:g} {stage.profile.unit}"):
            homed = await stage.homed()
            self._interlock.check()  # after every wait: a fault may have closed it meanwhile
            if not homed:
                with self._motions.under_way(axis, f"homing, then to {position:g} {stage.profile.unit}"):
                    await stage.home()
                self._interlock.check()
            await stage.move_to(position)
        self._commanded[axis] = position

    async def check_home(self, axis: str) -> None:
        """Home a stage again, record how far its scale was off, and go back to where the plan had put it."""
        stage = self._axis(axis)
        with self._motions.under_way(axis, "homing"):
            await check_home(stage, self._hub, self._clock)
            self._interlock.check()
            if axis in self._commanded:
                await stage.move_to(self._commanded[axis])

    async def stop(self, axis: str) -> None:
        """Stop a stage where it is."""
        await self._axis(axis).stop()

    async def approach_again(self) -> None:
        """Approach again, before frames and from below, each stage whose motor has been switched off since its move."""
        self._interlock.check()
        with self._motions.under_way("stages", "back to the plan's positions, where they are elsewhere"):
            await prepare_axes(self._axes, self._commanded, self._hub, self._clock)

    def _axis(self, axis: str) -> Axis:
        self._interlock.check()
        if axis not in self._axes:
            raise ConfigError(f"the plan moves axis {axis}, but this stand has {', '.join(self._axes) or 'none'}")
        return self._axes[axis]
