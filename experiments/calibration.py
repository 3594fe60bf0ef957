"""The paper's calibration (section 6.3): the target at 34 table positions, all at the reference temperature.

Positions are a grid of linear and rotary ones without those left out. The chamber is closed but for the captures, and
the camera comes to equilibrium first. The home checks at both ends show whether the table lost steps in between.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from pydantic import Field, model_validator

from thermostand.experiments.parameters import (
    Chamber_degC,
    Guaranteed,
    Linear_mm,
    MovingTable,
    Rotary_deg,
    TablePosition,
    Wait_s,
)
from thermostand.experiments.sequences import approach_position, capture_at, check_homes, make_soak
from thermostand.experiments.steps import CloseFlap, Role, StartChamber, Step, StopChamber


class CalibrationGrid(MovingTable, Guaranteed):
    """Parameters of a calibration."""

    reference_degC: Chamber_degC = Field(default=24.0, description="The set-point throughout.")
    equilibrium_s: Wait_s = Field(
        default=2700.0, description="The soak at the reference, with the camera on, before the first frames."
    )
    linear_mm: tuple[Linear_mm, ...] = Field(
        min_length=1, max_length=100, description="Positions of the linear stage; each with every rotary position."
    )
    rotary_deg: tuple[Rotary_deg, ...] = Field(
        min_length=1, max_length=100, description="Positions of the rotary stage."
    )
    left_out: tuple[TablePosition, ...] = Field(
        default=(), max_length=1000, description="Pairs of positions that are not visited."
    )

    @model_validator(mode="after")
    def _check_positions(self) -> Self:
        if len(set(self.linear_mm)) < len(self.linear_mm) or len(set(self.rotary_deg)) < len(self.rotary_deg):
            raise ValueError("linear_mm or rotary_deg has the same position twice")
        for position in self.left_out:
            if position.linear_mm not in self.linear_mm or position.rotary_deg not in self.rotary_deg:
                raise ValueError(
                    f"left_out has ({position.linear_mm}, {position.rotary_deg}), which is not in the grid"
                )
        if not self.positions:
            raise ValueError("left_out leaves no position")
        return self

    @property
    def positions(self) -> tuple[TablePosition, ...]:
        """The positions in order of visit: there and back through the rotary positions, so that the table takes short
        ways."""
        grid = (
            TablePosition(linear_mm=linear_mm, rotary_deg=rotary_deg)
            for row, linear_mm in enumerate(self.linear_mm)
            for rotary_deg in (self.rotary_deg if row % 2 == 0 else reversed(self.rotary_deg))
        )
        return tuple(position for position in grid if position not in self.left_out)

    @property
    def visits(self) -> int:
        """How many captures the plan has."""
        return len(self.positions)


def plan_calibration(parameters: CalibrationGrid) -> Iterator[Step]:
    """The steps, in order; ends with the chamber stopped and the flap closed."""
    positions, reference_degC = parameters.positions, parameters.reference_degC
    yield CloseFlap()
    yield StartChamber(reference_degC)
    yield from approach_position(positions[0])
    yield from check_homes()
    yield make_soak(parameters.equilibrium_s, parameters)
    for position in positions:
        yield from capture_at(parameters, position, parameters.frames_per_position, Role.CALIBRATION, reference_degC)
    yield from check_homes()
    yield StopChamber()
