"""The paper's warm-up (section 3.1): a cold camera is switched on and watched while it heats itself.

The chamber stays at the ambient temperature; the camera is off until it has cooled to it; the flap is open
throughout the capture so that frames come without a pause.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from experiments.steps import (
    Capture,
    CloseFlap,
    MoveTo,
    OpenFlap,
    PowerCamera,
    Role,
    Soak,
    StartChamber,
    Step,
    StopChamber,
)
from experiments.thermal_cycle import Chamber_degC


class WarmUp(BaseModel):
    """Parameters of a warm-up; the paper took 3600 frames every 500 ms at 24 degC."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    chamber_degC: Chamber_degC = 24.0
    cool_down_s: float = Field(default=7200.0, ge=0)
    frames: int = Field(default=3600, ge=1)
    interval_s: float = Field(default=0.5, gt=0)
    exposure_s: float = Field(default=0.1, gt=0)
    table_position: dict[str, float] = Field(default_factory=dict)  # axis -> mm or deg, taken before anything else

    @model_validator(mode="after")
    def _check(self) -> Self:
        if self.exposure_s > self.interval_s:
            raise ValueError(f"exposure_s {self.exposure_s} does not fit into interval_s {self.interval_s}")
        return self


def warm_up(parameters: WarmUp) -> Iterator[Step]:
    """The steps, in order; ends with the chamber stopped, the flap closed and the camera on."""
    yield CloseFlap()
    yield from (MoveTo(axis, position) for axis, position in parameters.table_position.items())
    yield PowerCamera(on=False)
    yield StartChamber(parameters.chamber_degC)
    yield Soak(parameters.cool_down_s)
    yield OpenFlap()
    yield PowerCamera(on=True)
    yield Capture(
        parameters.frames, parameters.interval_s, parameters.exposure_s, Role.WARM_UP, parameters.chamber_degC
    )
    yield CloseFlap()
    yield StopChamber()
