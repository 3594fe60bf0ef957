"""The paper's validation in three dimensions (section 6.3): the target at V0..V3, at each of 12 temperatures.

The first temperature is the reference: what the table does to the target is known from there. The paper counts 12
temperatures in its text and shows 11 deviations from the reference. At each temperature the target goes back to V0
at the end; how far it is then from where it was is the table's own share of the deviations. With `until: settled` a
dwell ends when the camera, which sees the target at V0 meanwhile, has settled, at the latest after `soak_s`.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from pydantic import Field, model_validator

from thermostand.experiments.parameters import (
    Chamber_degC,
    FrameCount,
    Guaranteed,
    MovingTable,
    TablePosition,
    Until,
    Wait_s,
    check_until,
)
from thermostand.experiments.sequences import approach_position, capture_at, check_homes, make_set_point_soak, make_soak
from thermostand.experiments.steps import CloseFlap, Role, SetTemperature, StartChamber, Step, StopChamber


class Validation(MovingTable, Guaranteed):
    """Parameters of a validation; temperatures are chamber set-points, the first one is the reference.

    positions: V0, V1, ... in order of visit. check_home_every: temperatures between two home checks.
    """

    temperatures_degC: tuple[Chamber_degC, ...] = Field(
        min_length=2, max_length=100, description="The chamber's set-points; the first one is the reference."
    )
    positions: tuple[TablePosition, ...] = Field(
        min_length=2, max_length=100, description="V0, V1, ... in the order of their visits at each temperature."
    )
    equilibrium_s: Wait_s = Field(
        default=2700.0, description="The soak at the reference, with the camera on, before the first frames."
    )
    soak_s: Wait_s = Field(default=2700.0, description="The soak at each temperature.")
    until: Until = None
    reference_frames: FrameCount = Field(default=20, description="Frames at each position at the reference.")
    check_home_every: int = Field(default=3, ge=1, le=100, description="Temperatures between two home checks.")

    @model_validator(mode="after")
    def _check_possible(self) -> Self:
        if len(set(self.temperatures_degC)) < len(self.temperatures_degC):
            raise ValueError("temperatures_degC has the same temperature twice")
        if len(set(self.positions)) < len(self.positions):
            raise ValueError("positions has the same position twice; going back to the first is in the plan already")
        check_until(self.until, self.soak_s)
        return self

    @property
    def visits(self) -> int:
        """How many captures the plan has."""
        return len(self.temperatures_degC) * (len(self.positions) + 1)


def plan_validation(parameters: Validation) -> Iterator[Step]:
    """The steps, in order; ends with the chamber stopped and the flap closed."""
    reference_degC, *others_degC = parameters.temperatures_degC
    yield CloseFlap()
    yield StartChamber(reference_degC)
    yield from approach_position(parameters.positions[0])
    yield from check_homes()
    yield make_soak(parameters.equilibrium_s, parameters)
    yield from _plan_poses(parameters, reference_degC, parameters.reference_frames)
    for number, chamber_degC in enumerate(others_degC, start=1):
        if number % parameters.check_home_every == 0:
            yield from check_homes()
        yield SetTemperature(chamber_degC)
        yield make_set_point_soak(parameters.soak_s, parameters.until, parameters, parameters.exposure_s, chamber_degC)
        yield from _plan_poses(parameters, chamber_degC, parameters.frames_per_position)
    yield from check_homes()
    yield StopChamber()


def _plan_poses(parameters: Validation, chamber_degC: float, frames: int) -> Iterator[Step]:
    """Every position in turn, and the first once more."""
    for position in parameters.positions:
        yield from capture_at(parameters, position, frames, Role.POSE, chamber_degC)
    yield from capture_at(parameters, parameters.positions[0], frames, Role.REPEATABILITY, chamber_degC)
