"""The paper's main sequence (sections 3.2, 5 and 6.2): set-points up and down, a dwell at each, frames at its end.

The camera is powered throughout and first comes to equilibrium at the reference temperature. The flap is closed but
for the captures. Set-points listed as held out are recorded for validation and never shown to the fitter.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

from experiments.steps import (
    Capture,
    CloseFlap,
    MoveTo,
    OpenFlap,
    Role,
    SetTemperature,
    Soak,
    StartChamber,
    Step,
    StopChamber,
)

Chamber_degC = Annotated[float, Field(ge=-10, le=70)]  # the paper's chamber, section 2


class ThermalCycle(BaseModel):
    """Parameters of a thermal cycle; temperatures are chamber set-points."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    reference_degC: Chamber_degC = 24.0
    equilibrium_s: float = Field(default=2700.0, ge=0)
    set_points_degC: tuple[Chamber_degC, ...] = Field(min_length=1)
    held_out_degC: tuple[Chamber_degC, ...] = ()
    dwell_s: float = Field(default=2700.0, ge=0)
    cycles: int = Field(default=1, ge=1)
    reference_frames: int = Field(default=20, ge=1)
    frames_per_point: int = Field(default=1, ge=1)
    interval_s: float = Field(default=0.5, gt=0)
    exposure_s: float = Field(default=0.1, gt=0)
    table_position: dict[str, float] = Field(default_factory=dict)  # axis -> mm or deg, taken before anything else

    @model_validator(mode="after")
    def _check(self) -> Self:
        unvisited = sorted(set(self.held_out_degC) - set(self.set_points_degC))
        if unvisited:
            raise ValueError(f"held_out_degC has {unvisited}, which set_points_degC never visits")
        if self.reference_degC in self.held_out_degC:
            raise ValueError(f"the reference {self.reference_degC} degC cannot be held out")
        if self.exposure_s > self.interval_s:
            raise ValueError(f"exposure_s {self.exposure_s} does not fit into interval_s {self.interval_s}")
        return self


def thermal_cycle(parameters: ThermalCycle) -> Iterator[Step]:
    """The steps, in order; ends with the chamber stopped and the flap closed."""
    yield CloseFlap()
    yield from (MoveTo(axis, position) for axis, position in parameters.table_position.items())
    yield StartChamber(parameters.reference_degC)
    yield Soak(parameters.equilibrium_s)
    yield from _frames(parameters, parameters.reference_degC, Role.REFERENCE, parameters.reference_frames)
    for _ in range(parameters.cycles):
        for chamber_degC in parameters.set_points_degC:
            yield SetTemperature(chamber_degC)
            yield Soak(parameters.dwell_s)
            role = Role.VALIDATION if chamber_degC in parameters.held_out_degC else Role.FIT
            yield from _frames(parameters, chamber_degC, role, parameters.frames_per_point)
    yield StopChamber()


def _frames(parameters: ThermalCycle, chamber_degC: float, role: Role, frames: int) -> Iterator[Step]:
    yield OpenFlap()
    yield Capture(frames, parameters.interval_s, parameters.exposure_s, role, chamber_degC)
    yield CloseFlap()
