"""The paper's warm-up (section 3.1): a cold camera is switched on and watched while it heats itself.

The chamber stays at the ambient temperature; the camera is off until it has cooled to it; the flap is open
throughout the capture so that frames come without a pause. The table takes its place while the camera is still off,
and the flap opens before it is switched on: nothing comes between its start and the first frame. The camera's own
temperature comes with each frame; that of lens and housing would come from a thermal imager, read on its own period
during the capture as every sensor is, and needs no step here.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Self

from pydantic import Field, StringConstraints, model_validator

from thermostand.experiments.parameters import Chamber_degC, FrameCount, StillTable, Wait_s
from thermostand.experiments.sequences import move_table
from thermostand.experiments.steps import (
    Capture,
    CloseFlap,
    CoolDown,
    OpenFlap,
    PowerCamera,
    Prompt,
    Role,
    StartChamber,
    Step,
    StopChamber,
)

CameraName = Annotated[str, StringConstraints(pattern=r"^[ -~]{1,100}$")]
Roll_deg = Annotated[float, Field(ge=-180, le=180)]


class WarmUp(StillTable):
    """Parameters of a warm-up; the paper took 3600 frames every 500 ms at 24 degC, then again rolled by 20 degrees.

    band_K, time_constant_s, cool_down_max_s: as in CoolDown. rolls_deg: about the optical axis, the camera being at
    0 when the run begins. cameras: what the operator mounts, one after another, each with its serial number or none in
    the stand's configuration; empty for the camera that is mounted, with no question asked.
    """

    chamber_degC: Chamber_degC = Field(default=24.0, description="The chamber's set-point throughout.")
    band_K: float = Field(default=0.5, gt=0, le=20, description="The camera is cold when it is this near to the air.")
    time_constant_s: float = Field(
        default=1200.0, gt=0, le=86400, description="With which the camera's slowest part cools down."
    )
    cool_down_max_s: Wait_s = Field(default=7200.0, description="The longest wait for a cold camera.")
    frames: FrameCount = Field(default=3600, description="Frames from the camera's switching on.")
    rolls_deg: tuple[Roll_deg, ...] = Field(
        default=(0.0,),
        min_length=1,
        max_length=36,
        description="Rolls about the optical axis, one warm-up each; somebody has to turn the camera.",
    )
    cameras: tuple[CameraName, ...] = Field(
        default=(), max_length=20, description="What the operator mounts one after another; empty for the one mounted."
    )

    @model_validator(mode="after")
    def _check_unique(self) -> Self:
        if len(set(self.rolls_deg)) < len(self.rolls_deg):
            raise ValueError("rolls_deg has the same roll twice")
        if len(set(self.cameras)) < len(self.cameras):
            raise ValueError("cameras has the same camera twice")
        return self

    @property
    def visits(self) -> int:
        """How many captures the plan has."""
        return len(self.rolls_deg) * max(1, len(self.cameras))


def plan_warm_up(parameters: WarmUp) -> Iterator[Step]:
    """The steps, in order; ends with the chamber stopped, the flap closed and the camera on."""
    mounted, roll_deg = "", 0.0
    for camera in parameters.cameras or ("",):
        for wanted_deg in parameters.rolls_deg:
            yield CloseFlap()
            yield PowerCamera(on=False)
            if camera != mounted:
                yield Prompt(f"mount the camera {camera}, rolled by {wanted_deg:g} deg about its optical axis")
            elif wanted_deg != roll_deg:
                yield Prompt(f"roll the camera about its optical axis, from {roll_deg:g} to {wanted_deg:g} deg")
            mounted, roll_deg = camera, wanted_deg
            yield from _plan_one_warm_up(parameters)


def _plan_one_warm_up(parameters: WarmUp) -> Iterator[Step]:
    """One warm-up of a camera that is off."""
    chamber_degC = parameters.chamber_degC
    yield StartChamber(chamber_degC)
    yield CoolDown(parameters.band_K, parameters.time_constant_s, parameters.cool_down_max_s)
    yield from move_table(parameters.table_position)
    yield OpenFlap()
    yield PowerCamera(on=True)
    yield Capture(parameters.frames, parameters.interval_s, parameters.exposure_s, Role.WARM_UP, chamber_degC)
    yield CloseFlap()
    yield StopChamber()
