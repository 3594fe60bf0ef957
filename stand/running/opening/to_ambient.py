"""The end of a run whose plan is done: the chamber comes back to the laboratory's temperature, so that a person who
opens it finds nothing cold that water would settle on, and nothing hot.

It remembers nothing: what is read says whether it is done. A run that is resumed here continues it.
"""

from __future__ import annotations

import math
from contextlib import suppress

from thermostand.foundation.clock import Clock, seconds_ns
from thermostand.foundation.errors import DeviceError
from thermostand.foundation.events import AT_AMBIENT, NOT_AT_AMBIENT, TO_AMBIENT
from thermostand.foundation.hub import Hub
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.fault import value_of
from thermostand.stand.gate import INTERLOCK
from thermostand.stand.guarding.rules import AIR, LABORATORY, cold_parts, dew_limit_degC
from thermostand.stand.interlock import Interlocked
from thermostand.stand.stand import Stand

_LOOK_S = 10.0
_AGAIN_S = 60.0  # after a device that did not do what was commanded
_FOLLOWS_K = 1.0  # the set-point follows the laboratory in such steps


async def to_ambient(stand: Stand, hub: Hub, clock: Clock, config: StandConfig) -> None:
    """Until it is done, `ending.max_s` are over, or it is cancelled; a hold is waited for. Events: `to_ambient`, and
    `at_ambient` or `not_at_ambient` (a warning). Nothing happens on a stand that is there, or is not asked to."""
    lacks = _lacks(hub, config)
    if not config.ending.to_ambient or not lacks:
        return
    set_point_degC = _ambient_degC(hub, config)
    hub.publish(TO_AMBIENT.at(clock.now_ns(), lacks, ambient_degC=set_point_degC))
    until_ns, running_degC = clock.now_ns() + seconds_ns(config.ending.max_s), math.nan

    def held(reason: str, _: bool) -> None:
        nonlocal running_degC
        if reason == INTERLOCK:  # the guard stops the chamber, be it for a moment between two looks
            running_degC = math.nan

    stand.gate.subscribe(held)
    while (lacks := _lacks(hub, config)) and clock.now_ns() < until_ns:
        await stand.gate.passed()
        set_point_degC, wait_s = _ambient_degC(hub, config), _LOOK_S
        if not abs(set_point_degC - running_degC) <= _FOLLOWS_K:
            try:
                await stand.imaging.close_flap()
                await stand.chamber.start(set_point_degC)
                running_degC = set_point_degC
            except (DeviceError, Interlocked):  # the guard says what is wrong, and holds
                wait_s = _AGAIN_S
        await clock.sleep_until(clock.now_ns() + seconds_ns(wait_s))
    if lacks:
        hub.publish(NOT_AT_AMBIENT.at(clock.now_ns(), lacks, after_s=config.ending.max_s))
    else:
        hub.publish(AT_AMBIENT.at(clock.now_ns()))
    with suppress(DeviceError):  # the plan is done: what follows makes everything safe until it confirms
        await stand.chamber.stop()


def _ambient_degC(hub: Hub, config: StandConfig) -> float:
    """Where to, within the stand's limits."""
    measured_degC = value_of(hub, LABORATORY)
    low_degC, high_degC = config.set_points_degC
    wanted_degC = config.ending.ambient_degC if math.isnan(measured_degC) else measured_degC
    return min(max(wanted_degC, low_degC), high_degC)


def _lacks(hub: Hub, config: StandConfig) -> str:
    """What has not reached the laboratory's temperature yet, in words; "" when all has. Air that
    cannot be read may be anywhere: the guard ends that; other parts that cannot be read are not waited for."""
    ambient_degC, band_K = _ambient_degC(hub, config), config.ending.band_K
    air_degC = value_of(hub, AIR)
    if not abs(air_degC - ambient_degC) <= band_K:
        return "the air's temperature is not known" if math.isnan(air_degC) else f"the air is {air_degC:.1f} degC"
    dew_degC = dew_limit_degC(config, hub)
    lowest_degC = ambient_degC - band_K if math.isnan(dew_degC) else min(dew_degC, ambient_degC)
    cold = [(value_of(hub, channel), channel) for channel in cold_parts(config)]
    value_degC, channel = min((each for each in cold if each[0] < lowest_degC), default=(math.nan, ""))
    return f"{channel} is {value_degC:.1f} degC, and may have to be {lowest_degC:.1f}" if channel else ""
