"""The paper's main sequence (sections 3.2, 5 and 6.2): set-points up and down, a dwell at each, frames at its end.

The camera is powered throughout and first comes to equilibrium at the reference temperature. The flap is closed but
for the captures. Set-points listed as held out are recorded for validation and never shown to the fitter.

With `until: settled` a dwell ends when the camera has settled, at the latest after `soak_s`; the flap then opens for
short looks at the target too.

With `until: known` (experimental) the visits are decided one after the other, and the cycle ends when enough is known
(experiments/adaptive.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Self

from pydantic import Field, model_validator

from thermostand.experiments.adaptive import MOST_VISITS, begin_cycle, plan_fixed_visits
from thermostand.experiments.parameters import (
    Chamber_degC,
    FrameCount,
    Guaranteed,
    Known,
    StillTable,
    UntilSettledOrKnown,
    Wait_s,
    check_until,
)
from thermostand.experiments.sequences import capture_through_flap, make_set_point_soak, make_soak, move_table
from thermostand.experiments.steps import SOAK_BAND_K, CloseFlap, Role, SetTemperature, StartChamber, Step, StopChamber


class ThermalCycle(StillTable, Guaranteed):
    """Parameters of a thermal cycle; temperatures are chamber set-points."""

    reference_degC: Chamber_degC = Field(default=24.0, description="The set-point that drift is counted from.")
    equilibrium_s: Wait_s = Field(
        default=2700.0, description="The soak at the reference, with the camera on, before the first frames."
    )
    set_points_degC: tuple[Chamber_degC, ...] = Field(
        min_length=1, max_length=1000, description="The chamber's set-points in the order of their visits."
    )
    held_out_degC: tuple[Chamber_degC, ...] = Field(
        default=(), max_length=1000, description="Those of them that no fit sees, to judge it by."
    )
    # The paper's 45 min (section 3.2). On drawn cameras (60 to 69) dwells of 29 min leave 0.85 times as much 90 min
    # after a change in the median and 1.8 times in the worst case, but 1.5 and 2.3 times 4 h after it.
    soak_s: Wait_s = Field(default=2700.0, description="The soak at each set-point.")
    until: UntilSettledOrKnown = None
    cycles: int = Field(default=1, ge=1, le=100, description="How often the set-points are gone through.")
    reference_frames: FrameCount = Field(default=20, description="Frames at the reference, at the beginning.")
    frames_per_point: FrameCount = Field(default=1, description="Frames at each set-point.")

    @model_validator(mode="after")
    def _check_possible(self) -> Self:
        unvisited = sorted(set(self.held_out_degC) - set(self.set_points_degC))
        if unvisited:
            raise ValueError(f"held_out_degC has {unvisited}, which set_points_degC never visits")
        if self.reference_degC in self.held_out_degC:
            raise ValueError(f"the reference {self.reference_degC} degC cannot be held out")
        if isinstance(self.until, Known) and (self.band_K, self.unsettled) != (SOAK_BAND_K, "mark"):
            raise ValueError("band_K and unsettled are not for until: known, whose soaks have the usual band")
        if not isinstance(self.until, Known):
            check_until(self.until, self.soak_s)
        elif self.visits > MOST_VISITS:
            raise ValueError(f"until: known is for cycles of at most {MOST_VISITS} visits, this one has {self.visits}")
        elif min(self.set_points_degC) == max(self.set_points_degC):
            raise ValueError("until: known needs set_points_degC that span the range in which the model is wanted")
        return self

    @property
    def visits(self) -> int:
        """How often a set-point is visited, over all cycles."""
        return len(self.set_points_degC) * self.cycles


def plan_thermal_cycle(parameters: ThermalCycle) -> Iterator[Step]:
    """The steps, in order; ends with the chamber stopped and the flap closed."""
    yield CloseFlap()
    yield from move_table(parameters.table_position)
    yield StartChamber(parameters.reference_degC)
    yield make_soak(parameters.equilibrium_s, parameters)
    yield from capture_through_flap(parameters, parameters.reference_frames, Role.REFERENCE, parameters.reference_degC)
    if isinstance(parameters.until, Known):
        yield from _plan_adaptive_cycle(parameters, parameters.until)
        return
    for _ in range(parameters.cycles):
        for chamber_degC in parameters.set_points_degC:
            yield SetTemperature(chamber_degC)
            yield make_set_point_soak(
                parameters.soak_s, parameters.until, parameters, parameters.exposure_s, chamber_degC
            )
            role = Role.VALIDATION if chamber_degC in parameters.held_out_degC else Role.FIT
            yield from capture_through_flap(parameters, parameters.frames_per_point, role, chamber_degC)
    yield StopChamber()


def _plan_adaptive_cycle(parameters: ThermalCycle, known: Known) -> Iterator[Step]:
    decide = begin_cycle(
        known,
        parameters.set_points_degC * parameters.cycles,
        parameters.held_out_degC,
        parameters.soak_s,
        parameters.frames_per_point,
        parameters,
    )
    yield decide
    yield from plan_fixed_visits(decide)
    yield StopChamber()
