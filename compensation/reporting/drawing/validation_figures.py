"""The figures of a validation in three dimensions. Blue is before, orange after compensation, as in the paper."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thermostand.compensation.reporting.drawing.figures import I_COLOUR, J_COLOUR, new_figure, style
from thermostand.compensation.validation3d.document import AFTER_mm, BEFORE_mm
from thermostand.compensation.validation3d.validate import Deviations, SpatialValidation

AXES = ("X", "Y", "Z")
_BEFORE, _AFTER = I_COLOUR, J_COLOUR
_POSITION_COLOURS = ("#000000", "#009E73", "#CC79A7", "#56B4E9")
_MARKERS = "os^D"
_SPREAD_K = 0.35
"""Between the points of two positions at one temperature, for the eye."""


def bars(validation: SpatialValidation) -> Figure:
    """The form of the paper's figure 15: mean absolute deviation at each temperature, before and after; dashed: the
    paper's means over its temperatures."""
    order = _by_temperature(validation)
    place = np.arange(len(order))
    sides = (
        (validation.before, _BEFORE, -0.2, BEFORE_mm, "before"),
        (validation.after, _AFTER, 0.2, AFTER_mm, "after"),
    )
    with style():
        figure, panels = new_figure(7.4, 3.3, 1, 3)
        for axis, axes in enumerate(panels):
            for one, colour, side, paper_mm, name in sides:
                height, u = one.per_temperature_um[order, axis], one.u_per_temperature_um[order, axis]
                axes.bar(place + side, height, 0.4, yerr=u, color=colour, error_kw={"lw": 0.8}, label=name)
                label = f"mean of the paper's, {name}"
                axes.axhline(1e3 * paper_mm[axis], color=colour, linewidth=0.9, linestyle="--", label=label)
            labels = [f"{degC:z.1f}" for degC in validation.camera_degC[order]]
            axes.set_xticks(place, labels, rotation=90, fontsize=7)
            axes.grid(visible=False, axis="x")
            _label(axes, axis)
        panels[0].set_ylim(bottom=0)
        panels[0].set_ylabel("mean |deviation| (µm)")
        _legend(figure, panels[0])
    return figure


def by_position(validation: SpatialValidation, deviations: Deviations) -> Figure:
    """One variant's deviations at each position, with standard uncertainties."""
    order = _by_temperature(validation)
    degC = validation.camera_degC[order]
    middle = (len(validation.names) - 1) / 2
    with style():
        figure, panels = new_figure(7.4, 2.9, 1, 3)
        for axis, axes in enumerate(panels):
            for index, name in enumerate(validation.names):
                colour = _POSITION_COLOURS[index % len(_POSITION_COLOURS)]
                values, u = (each[order, index, axis] for each in (deviations.translation_um, deviations.u_um))
                places = degC + _SPREAD_K * (index - middle)
                marker = _MARKERS[index % len(_MARKERS)]
                axes.errorbar(places, values, u, fmt=marker, color=colour, ms=3.2, lw=0.7, label=name)
            axes.axhline(0, color="#6b6b6b", linewidth=0.8)
            _label(axes, axis)
        panels[0].set_ylabel("deviation (µm)")
        _legend(figure, panels[0])
    return figure


def _label(axes: Axes, axis: int) -> None:
    axes.set_xlabel("camera (°C)")
    axes.set_title(AXES[axis], loc="left", fontsize="medium", weight="bold")


def _legend(figure: Figure, axes: Axes) -> None:
    handles, labels = axes.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper left", ncols=4, handlelength=1.6)


def _by_temperature(validation: SpatialValidation) -> list[int]:
    """The temperatures but the reference, the coolest camera first."""
    return [int(index) + 1 for index in np.argsort(validation.camera_degC[1:], kind="stable")]
