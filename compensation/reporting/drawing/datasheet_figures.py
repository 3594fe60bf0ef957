"""The figures of a datasheet: how the image moves over the air's temperature, and while the camera warms itself."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thermostand.compensation.datasheet.datasheet import UNITS, Datasheet, Visits, Warming
from thermostand.compensation.reporting.drawing.figures import (
    FULL_WIDTH_IN,
    GREY,
    I_COLOUR,
    J_COLOUR,
    legend_above,
    new_figure,
    style,
)

_LABELS = ("shift I (px)", "shift J (px)", "change of scale (ppm)", "turn (µrad)")
_COLOURS = (I_COLOUR, J_COLOUR, "#009E73", "#CC79A7")


def over_temperature(sheet: Datasheet) -> Figure:
    """Each visit: full after heating, open after cooling; the line is the stated coefficient at the reference."""
    quantities = list(sheet.quantities[: len(UNITS)])
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 5.2, 2, 2, share=False)
        for motion, axes in enumerate(panels):
            for visits in sheet.visits:
                _visits(axes, visits, motion)
            one, first = quantities[motion], sheet.visits[0]
            ends = np.array([first.air_degC.min(), first.air_degC.max()])
            if np.isfinite(one.value):
                label = f"{one.value:.3g} {one.unit} at the reference".replace("-", "−")
                at = first.moved[0, motion] + one.value * (ends - first.air_degC[0])
                axes.plot(ends, at, color=GREY, linewidth=0.9, linestyle="--", label=label)
            axes.set_ylabel(_LABELS[motion])
            legend_above(axes)
        for axes in panels[2:]:
            axes.set_xlabel("air near the camera (°C)")
    return figure


def _visits(axes: Axes, visits: Visits, motion: int) -> None:
    side = np.sign(np.diff(visits.chamber_degC, prepend=visits.chamber_degC[0]))
    colour = _COLOURS[motion]
    axes.plot(visits.air_degC, visits.moved[:, motion], color=colour, linewidth=0.6, alpha=0.5)
    for rows, face in ((side >= 0, colour), (side < 0, "white")):
        places, moved = visits.air_degC[rows], visits.moved[rows, motion]
        axes.plot(places, moved, "o", color=colour, markerfacecolor=face, markersize=4)


def warm_up(warming: Warming, settled_s: float) -> Figure:
    """Shift since the first frame, and the camera's own temperature."""
    minutes = warming.since_s / 60
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 2.8, 1, 2, share=False)
        for axis, (name, colour) in enumerate((("I", I_COLOUR), ("J", J_COLOUR))):
            panels[0].plot(minutes, warming.moved[:, axis], color=colour, linewidth=1.2, label=f"shift {name}")
        if np.isfinite(settled_s):
            panels[0].axvline(settled_s / 60, color=GREY, linewidth=0.8, linestyle=":", label="90 % of it")
        panels[0].set_ylabel("since the first frame (px)")
        panels[1].plot(minutes, warming.camera_degC, color="#CC79A7", linewidth=1.2, label="camera's sensor")
        panels[1].plot(minutes, warming.air_degC, color=GREY, linewidth=1.2, label="air near it")
        panels[1].set_ylabel("temperature (°C)")
        for axes in panels:
            axes.set_xlabel("time since switching on (min)" if warming.known else "time of the recording (min)")
            legend_above(axes)
    return figure
