"""Brings about again what the steps so far have set up, after something has undone it."""

from __future__ import annotations

from collections.abc import Callable

from thermostand.foundation.clock import Clock
from thermostand.foundation.events import RESTORED, SOAK_CREDITED, SOAK_RESTARTED
from thermostand.stand.running.executing.actions import Surroundings, worth_of_soaks
from thermostand.stand.running.memory.entries import Dwell, Restored
from thermostand.stand.running.memory.journal import Logbook
from thermostand.stand.running.memory.state import SetUp
from thermostand.stand.stand import Stand


async def restore(
    stand: Stand, log: Logbook, clock: Clock, set_up: SetUp, surroundings: Callable[[], Surroundings]
) -> None:
    """The last set-up of each kind again, but for the flap; it stays closed until the chamber is at its place."""
    disturbances = log.state.disturbances
    await stand.imaging.close_flap()
    for planned in set_up.others.values():
        await stand.gate.passed()
        await planned.step.perform(stand)
    for axis, position in set_up.positions.items():
        await stand.gate.passed()
        await stand.table.move_to(axis, position)
    await stand.gate.passed()
    if set_up.camera_on:
        await stand.imaging.supply.restore()
    else:
        await stand.imaging.power_camera(on=False)
    if set_up.chamber_degC is not None:
        await stand.gate.passed()
        worth, now_ns = worth_of_soaks(log.state, set_up, surroundings()), clock.now_ns()
        if worth.lost:
            await log.write(*(Dwell(now_ns, soak.step_id, 0.0) for soak in worth.lost))
        if worth.text:
            log.tell(SOAK_RESTARTED if worth.lost else SOAK_CREDITED, worth.text)
        await stand.chamber.start(set_up.chamber_degC)
    log.enter(Restored(clock.now_ns(), disturbances))
    log.tell(RESTORED, set_up.text)
