"""Runs one plan: each step marked as begun, performed by the stand, marked as done."""

from __future__ import annotations

import asyncio
from collections.abc import Iterable

from drivers.clock import Clock
from experiments.steps import (
    Capture,
    CheckHome,
    CloseFlap,
    CoolDown,
    MoveTo,
    OpenFlap,
    PlannedStep,
    PowerCamera,
    Prompt,
    SetTemperature,
    Soak,
    StartChamber,
    StopChamber,
    kind_of,
    parameters_of,
)
from stand.hub import Hub, StepMark, StepState
from stand.stand import Stand


class Scheduler:
    """Performs steps in order; what a step raises ends the run, after the step is marked as failed."""

    def __init__(self, stand: Stand, hub: Hub, clock: Clock) -> None:
        self._stand = stand
        self._hub = hub
        self._clock = clock

    async def run(self, plan: Iterable[PlannedStep]) -> None:
        """The whole plan."""
        for planned in plan:
            self._mark(planned, StepState.STARTED)
            try:
                await self._perform(planned)
            except (Exception, asyncio.CancelledError):
                self._mark(planned, StepState.FAILED)
                raise
            self._mark(planned, StepState.DONE)

    async def _perform(self, planned: PlannedStep) -> None:
        stand = self._stand
        match planned.step:
            case StartChamber(chamber_degC):
                await stand.start_chamber(chamber_degC)
            case SetTemperature(chamber_degC):
                await stand.set_temperature(chamber_degC)
            case StopChamber():
                await stand.stop_chamber()
            case Soak(duration_s):
                await stand.soak(duration_s)
            case OpenFlap():
                await stand.open_flap()
            case CloseFlap():
                await stand.close_flap()
            case Capture(frames, interval_s, exposure_s):
                await stand.capture(frames, interval_s, exposure_s, planned.step_id)
            case MoveTo(axis, position):
                await stand.move_to(axis, position)
            case PowerCamera(on):
                await stand.power_camera(on=on)
            case CoolDown(band_K, time_constant_s, max_s):
                await stand.cool_down(band_K, time_constant_s, max_s)
            case CheckHome(axis):
                await stand.check_home(axis)
            case Prompt(text):
                await stand.prompt(text)

    def _mark(self, planned: PlannedStep, state: StepState) -> None:
        self._hub.publish(
            StepMark(
                self._clock.now_ns(),
                planned.step_id,
                planned.index,
                kind_of(planned.step),
                state,
                parameters_of(planned.step),
            )
        )
