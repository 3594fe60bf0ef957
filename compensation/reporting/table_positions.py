"""Where the table held the target: the positions of calibration and validation, from the recorded moves."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thermostand.compensation.calibration.visits import visits_for
from thermostand.compensation.reporting.drawing.figures import (
    FULL_WIDTH_IN,
    GREY,
    J_COLOUR,
    legend_above,
    new_figure,
    style,
)
from thermostand.experiments.steps import Role
from thermostand.foundation.items import StepMark
from thermostand.markers.target import Target

_LABEL_MM = 12.0


@dataclass(frozen=True, slots=True)
class TablePositions:
    """(linear mm, rotary deg) of the captures, each place once, in order of the first visit; poses are V0, V1, ..."""

    calibration: tuple[tuple[float, float], ...] = ()
    poses: tuple[tuple[float, float], ...] = ()


def table_positions(sessions: Sequence[Sequence[StepMark]]) -> TablePositions:
    """Of the steps of all these sessions. SessionError when they do not record where the table stood."""
    return TablePositions(_places(sessions, Role.CALIBRATION), _places(sessions, Role.POSE))


def _places(sessions: Sequence[Sequence[StepMark]], role: Role) -> tuple[tuple[float, float], ...]:
    visits = [visit for steps in sessions for visit in visits_for(steps, {str(role)}).values()]
    return tuple(dict.fromkeys((visit.sent["linear"], visit.sent["rotary"]) for visit in visits))


def positions_figure(positions: TablePositions, target: Target) -> Figure:
    """The target at each position, seen from above: the camera looks from the left."""
    half_mm = float(np.ptp(target.coordinates_mm()[:, 0])) / 2
    with style():
        figure, (axes,) = new_figure(FULL_WIDTH_IN, 3.6, 1, 1)
        _targets(axes, positions.calibration, half_mm, GREY, 0.9, "calibration")
        _targets(axes, positions.poses, half_mm, J_COLOUR, 2.2, "validation")
        for number, (linear_mm, rotary_deg) in enumerate(positions.poses):
            x, y = _end(linear_mm, rotary_deg, half_mm + _LABEL_MM)
            axes.text(x, y, f"V{number}", color=J_COLOUR, ha="center", va="center", fontweight="bold")
        axes.set(xlabel="linear table, away from the camera (mm)", ylabel="across (mm)")
        axes.set_aspect("equal")
        axes.margins(0.08)
        legend_above(axes)
    return figure


def _targets(
    axes: Axes, places: Sequence[tuple[float, float]], half_mm: float, colour: str, width: float, name: str
) -> None:
    label: str | None = f"{name}, {len(places)} positions"
    for linear_mm, rotary_deg in places:
        ends = np.array([_end(linear_mm, rotary_deg, side * half_mm) for side in (-1, 1)])
        axes.plot(*ends.T, color=colour, linewidth=width, solid_capstyle="round", label=label)
        label = None


def _end(linear_mm: float, rotary_deg: float, away_mm: float) -> tuple[float, float]:
    """A point of the target this far from its middle."""
    angle_rad = np.deg2rad(rotary_deg)
    return linear_mm + away_mm * float(np.sin(angle_rad)), away_mm * float(np.cos(angle_rad))
