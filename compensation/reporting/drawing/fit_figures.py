"""The figures of a compensation: what the model says against what was measured, and what it leaves."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from thermostand.compensation.drift.evaluation import Evaluation, improvement_percent
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.reporting.drawing.figures import (
    COORDINATES,
    FULL_WIDTH_IN,
    PALE,
    arrows,
    legend_above,
    new_figure,
    style,
)
from thermostand.compensation.reporting.drawing.path_figures import Paths, temperature_colours, trajectories
from thermostand.compensation.reporting.numbers import percent
from thermostand.compensation.reporting.tracks import thinned

_SIGMA_95 = 1.959964
_MOST_DOTS = 20_000
_BINS = 60


def compensated_paths(observations: Observations, evaluation: Evaluation) -> Figure:
    """The scored centres' drift x100, before and after compensation."""
    rows = evaluation.rows
    frames, place = np.unique(rows.frame, return_inverse=True)
    shape = (len(frames), observations.target.count, 2)
    start, before, after = np.full(shape, np.nan), np.full(shape, np.nan), np.full(shape, np.nan)
    start[place, rows.marker] = rows.measured_px + evaluation.before_px
    before[place, rows.marker] = -evaluation.before_px
    after[place, rows.marker] = -evaluation.after_px
    seen = np.isfinite(start).any(axis=(0, 2))
    reference = np.full(shape[1:], np.nan)
    reference[seen] = np.nanmean(start[:, seen], axis=0)
    degC = observations.camera_degC[frames]
    panels = [Paths("before", reference, before, degC), Paths("after compensation", reference, after, degC)]
    return trajectories(observations, panels)


def measured_against_model(evaluation: Evaluation) -> Figure:
    """Each scored centre: the drift that was measured against the drift that the model says."""
    measured, said = -evaluation.before_px, evaluation.after_px - evaluation.before_px
    drawn = thinned(len(measured), _MOST_DOTS)
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 3.9, 1, 2, share=False)
        for index, (axes, (name, colour)) in enumerate(zip(panels, COORDINATES, strict=True)):
            both = np.concatenate([said[:, index], measured[:, index]])
            ends = [float(both.min()), float(both.max())]
            axes.plot(ends, ends, color="black", linewidth=0.8, label="measured = model")
            for scale in (axes.xaxis, axes.yaxis):
                scale.set_major_locator(MaxNLocator(5))
            _dots(axes, said[drawn, index], measured[drawn, index], colour, "marker centres")
            axes.set_xlabel(f"drift along {name}, model (px)")
            axes.set_aspect("equal", adjustable="box")
            legend_above(axes)
        panels[0].set_ylabel("drift, measured (px)")
    return figure


def residual_map(observations: Observations, evaluation: Evaluation) -> Figure:
    """What is left at each marker of each scored set-point, as arrows over the image, enlarged until the larger ones
    show; the bar says how much."""
    rows = evaluation.rows
    keys = np.stack([rows.chamber_degC, rows.marker], axis=1)
    groups, index, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    index = index.ravel()
    mean = [np.bincount(index, column) / count for column in (*rows.measured_px.T, *(-evaluation.after_px).T)]
    with style():
        figure, (axes,) = new_figure(FULL_WIDTH_IN, 5.4, 1, 1)
        at, moved = np.stack(mean[:2], axis=1), np.stack(mean[2:], axis=1)
        look = {"width": 0.002, "cmap": temperature_colours()}
        drawn = arrows(axes, at, moved, observations.image_size, groups[:, 0].astype(np.float64), **look)
        axes.set_facecolor(PALE)
        figure.colorbar(drawn, ax=axes, label="chamber temperature (°C)", shrink=0.85, pad=0.02)
    return figure


def residuals(evaluation: Evaluation) -> Figure:
    """What is left of each scored centre's deviation, against the camera's temperature, and the claimed interval."""
    camera_degC = evaluation.rows.camera_degC
    left_mpx = -1e3 * evaluation.after_px
    drawn = thinned(len(left_mpx), _MOST_DOTS)
    places = np.unique(camera_degC)
    claimed = np.array([evaluation.claimed_px2[camera_degC == degC].mean(axis=0) for degC in places])
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 3.0, 1, 2)
        for index, (axes, (name, colour)) in enumerate(zip(panels, COORDINATES, strict=True)):
            reach_mpx = 1e3 * _SIGMA_95 * np.sqrt(claimed[:, index])
            axes.fill_between(places, -reach_mpx, reach_mpx, color="#dddddd", linewidth=0, label="95 % interval")
            _dots(axes, camera_degC[drawn], left_mpx[drawn, index], colour, f"along {name}")
            axes.set_xlabel("camera temperature (°C)")
            legend_above(axes)
        panels[0].set_ylabel("measured − model (mpx)")
    return figure


def _dots(axes: Axes, x: Float, y: Float, colour: str, label: str) -> None:
    axes.plot(x, y, "o", color=colour, markersize=2, markeredgewidth=0, alpha=0.5, rasterized=True, label=label)


def histogram(evaluation: Evaluation) -> Figure:
    """Deviations of the scored centres, along each axis: before compensation, and after it on a scale of its own."""
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 4.4, 2, 2, share=False)
        for index, (name, colour) in enumerate(COORDINATES):
            before, after = evaluation.before_px[:, index], 1e3 * evaluation.after_px[:, index]
            rms = evaluation.rms_before_px[index], 1e3 * evaluation.rms_after_px[index]
            panels[index].hist(before, _BINS, color=colour, alpha=0.4, label=f"before, RMS {rms[0]:z.3f} px")
            panels[index].set_xlabel(f"deviation along {name} (px)")
            panels[2 + index].hist(after, _BINS, color=colour, label=f"after, RMS {rms[1]:z.1f} mpx")
            panels[2 + index].set_xlabel(f"deviation along {name} (mpx)")
        for axes in panels:
            legend_above(axes)
        for axes in panels[::2]:
            axes.set_ylabel("marker centres")
    return figure


def against_temperature(evaluation: Evaluation) -> Figure:
    """RMS deviation at each scored chamber temperature, before and after compensation."""
    chamber_degC = [row.chamber_degC for row in evaluation.temperatures]
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 3.0, 1, 2)
        for index, (axes, (name, colour)) in enumerate(zip(panels, COORDINATES, strict=True)):
            before = [row.before_px[index] for row in evaluation.temperatures]
            after = [row.after_px[index] for row in evaluation.temperatures]
            gain = improvement_percent(evaluation.rms_before_px[index], evaluation.rms_after_px[index])
            axes.plot(chamber_degC, before, "o--", color=colour, mfc="white", linewidth=0.9, label=f"{name}, before")
            axes.plot(
                chamber_degC, after, "o-", color=colour, linewidth=1.3, label=f"{name}, after ({percent(gain)} less)"
            )
            axes.set_xlabel("chamber temperature (°C)")
            legend_above(axes)
        panels[0].set_ylabel("RMS deviation (px)")
        panels[0].set_yscale("log")
        panels[0].yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    return figure
