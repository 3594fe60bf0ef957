"""What keeps the table where the plan put it: home checks, and a new approach before frames that need it.

A stage without encoder loses steps in silence; only homing again shows it. The 8MT160 profile switches its motor off
60 s after a move, and the rotor may then relax by up to a full step (2.5 um) while the chamber soaks for an hour.
"""

from __future__ import annotations

from collections.abc import Mapping

from drivers.devices.stage import Axis
from foundation.clock import Clock
from foundation.hub import Hub
from foundation.items import Event
from foundation.readings import Quality

# A stepper that slips loses whole electrical periods of four full steps; what is less than half of one is the switch.
HOME_RESIDUAL_LIMIT_STEPS = 2.0


async def approach(axis: Axis, position: float) -> None:
    """Move to `position` (mm or deg) from below, homing the axis first when it has lost its scale."""
    if not await axis.homed():
        await axis.home()
    await axis.move_to(position)


async def check_home(axis: Axis, hub: Hub, clock: Clock, limit_steps: float = HOME_RESIDUAL_LIMIT_STEPS) -> float:
    """Home again; the residual in mm or deg: how far the scale was off since the axis was last homed.

    Event "home_residual", or the warning "home_residual_large" beyond `limit_steps` full steps: captures since the last
    good home are then suspect. An axis that has lost its scale is homed without a residual (NaN, event "homed").
    """
    profile = axis.profile
    if not await axis.homed():
        await axis.home()
        text = f"{axis.name} had lost its scale and was homed; captures since its last home are suspect"
        hub.publish(Event(clock.now_ns(), "warning", "homed", text, {"axis": axis.name}))
        return float("nan")
    if profile.home_from is not None:
        await axis.move_to(profile.home_from)
    residual = await axis.home()
    steps = residual / profile.unit_per_step
    text = f"{axis.name}: home was at {residual:.5f} {profile.unit} ({steps:.2f} steps)"
    data = {"axis": axis.name, "residual": round(residual, 5), "unit": profile.unit, "steps": round(steps, 2)}
    if abs(steps) > limit_steps:
        text += f", more than {limit_steps:g} steps; captures since its last good home are suspect"
        hub.publish(Event(clock.now_ns(), "warning", "home_residual_large", text, data))
    else:
        hub.publish(Event(clock.now_ns(), "info", "home_residual", text, data))
    return residual


async def ready(axes: Mapping[str, Axis], commanded: Mapping[str, float], hub: Hub, clock: Clock) -> None:
    """Before a capture: approach again, from below, each axis whose position cannot be relied upon.

    `commanded`: where the plan put each axis it moved (mm or deg); the others are left alone. An axis is in doubt when
    its motor is without current, its scale is lost, or it stands a step or more elsewhere (stopped by hand); event
    "re-approached" with the reason. DeviceFault in an alarm.
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
        text = f"{name}: {reason}; approached {position:g} {reading.unit} again"
        data = {"axis": name, "position": position, "unit": reading.unit, "reason": reason}
        hub.publish(Event(clock.now_ns(), "info", "re-approached", text, data))
