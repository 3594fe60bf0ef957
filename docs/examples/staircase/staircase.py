"""An experiment of one's own: set-points away from the reference, ever further, and back to it after each."""

from __future__ import annotations

from collections.abc import Iterator

from pydantic import Field

from thermostand.experiments.parameters import Chamber_degC, StillTable, Wait_s
from thermostand.experiments.sequences import capture_through_flap, move_table
from thermostand.experiments.steps import CloseFlap, Role, SetTemperature, Soak, StartChamber, Step, StopChamber


class Staircase(StillTable):
    """What a recipe may give; the table's place and how frames are taken come from StillTable."""

    reference_degC: Chamber_degC = 24.0
    stair_K: float = Field(default=6.0, gt=0, le=30)
    stairs: int = Field(default=4, ge=1, le=20)
    soak_s: Wait_s = 2700.0
    frames: int = Field(default=5, ge=1, le=1000)


def staircase(parameters: Staircase) -> Iterator[Step]:
    """The steps, in order; pure: the same parameters give the same steps."""
    reference_degC = parameters.reference_degC
    yield CloseFlap()
    yield from move_table(parameters.table_position)
    yield StartChamber(reference_degC)
    yield Soak(parameters.soak_s)
    yield from capture_through_flap(parameters, parameters.frames, Role.REFERENCE, reference_degC)
    for stair in range(1, parameters.stairs + 1):
        for chamber_degC in (reference_degC + stair * parameters.stair_K, reference_degC):
            yield SetTemperature(chamber_degC)
            yield Soak(parameters.soak_s)
            yield from capture_through_flap(parameters, parameters.frames, Role.FIT, chamber_degC)
    yield StopChamber()
