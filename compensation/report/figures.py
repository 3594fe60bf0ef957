"""The figures of the report as SVG text: the same data give the same bytes.

Blue is I and orange J (Okabe and Ito, told apart by any eye); pale and open is before, full is after compensation.
"""

from __future__ import annotations

import io
import re
from contextlib import AbstractContextManager

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from compensation.drift.displacements import reference_centres
from compensation.drift.validation import Evaluation, improvement_percent
from compensation.observations import Float, Mask, Observations, Role

I_COLOUR, J_COLOUR = "#0072B2", "#D55E00"
_GREY = "#6b6b6b"
_AXES = (("I", I_COLOUR), ("J", J_COLOUR))
_EXAGGERATION = 100
_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#e6e6e6",
    "grid.linewidth": 0.7,
    "legend.frameon": False,
    "svg.fonttype": "path",
    "svg.hashsalt": "thermostand",
}
_NO_METADATA = {"Date": None, "Creator": None, "Type": None, "Format": None}
_RASTER_DPI = 150
_NS_PER_H = 3.6e12


def style() -> AbstractContextManager[None]:
    """The look of all figures."""
    return mpl.rc_context(_STYLE)  # pyright: ignore[reportArgumentType] - the keys are checked at run time


def as_svg(figure: Figure, name: str) -> str:
    """The figure as an <svg> element for a page; every id begins with `name`, so that several fit in one page."""
    text = io.StringIO()
    with style():
        figure.savefig(text, format="svg", dpi=_RASTER_DPI, metadata=_NO_METADATA)
    svg = text.getvalue()
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    return svg[svg.index("<svg") :]


def drift(observations: Observations) -> Float:
    """(F, N, 2): where each marker is, minus where it was at its session's reference, px.

    A session without reference frames is compared with its first frame that has the marker.
    """
    origin = reference_centres(observations)[0]
    for index in range(len(observations.sessions)):
        own = observations.centres_px[observations.session == index]
        first = np.argmax(np.isfinite(own).all(axis=2), axis=0)
        missing = ~np.isfinite(origin[index])
        origin[index][missing] = own[first, np.arange(own.shape[1])][missing]
    return observations.centres_px - origin[observations.session]


def trajectories(observations: Observations, frames: Mask) -> Figure:
    """Each marker's path over `frames` (F,), x100, on the first frame; coloured by the camera's temperature."""
    moved = drift(observations)[frames]
    start = observations.centres_px[frames] - moved
    with style():
        figure, (axes,) = new_figure(7.4, 5.5, 1, 1)
        width, height = observations.image_size
        axes.imshow(
            observations.preview,
            cmap="gray",
            vmin=-200,  # darks become mid-grey: the dots must be told from the discs
            vmax=290,  # and lights pale grey, for the yellow ones
            extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            interpolation="none",
        )
        path = start + _EXAGGERATION * moved
        colour = np.broadcast_to(observations.camera_degC[frames][:, None], path.shape[:2])
        good = np.isfinite(path).all(axis=2)
        dots = axes.scatter(*path[good].T, c=colour[good], s=5, cmap="plasma", linewidths=0, rasterized=True)
        axes.set(xlabel="column I (px)", ylabel="row J (px)", xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
        axes.grid(visible=False)
        _scale_bar(axes, width, height)
        figure.colorbar(dots, ax=axes, label="camera temperature (°C)", shrink=0.85, pad=0.02)
    return figure


def _scale_bar(axes: Axes, width: int, height: int) -> None:
    """What half a pixel of drift looks like."""
    x, y = 0.03 * width, 0.97 * height
    axes.plot([x, x + 0.5 * _EXAGGERATION], [y, y], color="black", linewidth=2, solid_capstyle="butt")
    axes.text(x + 0.5 * _EXAGGERATION + 0.01 * width, y, "0.5 px of drift", va="center", fontsize=8)


def against_time(observations: Observations) -> Figure:
    """Mean drift along I and J, and below it the temperatures, against the hours since the first frame.

    Time between sessions is left out; a session begins at a dashed line.
    """
    hours, starts = _recorded_hours(observations)
    mean = _mean_over_markers(drift(observations))
    warm_up = observations.role == str(Role.WARM_UP)
    with style():
        figure, (above, below) = new_figure(7.4, 4.6, 2, 1)
        for (name, colour), values in zip(_AXES, mean.T, strict=True):
            _sparse(above, hours, values, observations, colour, f"mean over markers, {name}")
        _sparse(below, hours, observations.camera_degC, observations, "#CC79A7", "camera")
        _sparse(below, hours, observations.air_degC, observations, _GREY, "air near the camera")
        for axes in (above, below):
            _shade(axes, hours, warm_up)
            for start in starts[1:]:
                axes.axvline(start, color=_GREY, linewidth=0.8, linestyle="--")
        above.set_ylabel("drift (px)")
        below.set(ylabel="temperature (°C)", xlabel="time since the first frame (h)")
        legend_above(above)
        legend_above(below)
    return figure


def _recorded_hours(observations: Observations) -> tuple[Float, list[float]]:
    """Hours of each frame (F,), and of the begin of each session, sessions put end to end."""
    hours = np.zeros(len(observations.time_ns))
    starts, offset = list[float](), 0.0
    for index in range(len(observations.sessions)):
        own = observations.session == index
        times_ns = observations.time_ns[own]
        hours[own] = offset + (times_ns - times_ns[0]) / _NS_PER_H
        starts.append(offset)
        offset = float(hours[own].max()) + 0.5
    return hours, starts


def _mean_over_markers(values: Float) -> Float:
    """(F, 2) from (F, N, 2); NaN where a frame has no marker."""
    count = np.isfinite(values[:, :, 0]).sum(axis=1)
    return np.where(count[:, None] > 0, np.nansum(values, axis=1) / np.maximum(count, 1)[:, None], np.nan)


def _sparse(axes: Axes, hours: Float, values: Float, observations: Observations, colour: str, label: str) -> None:
    """Frames as dots, joined within a session."""
    good = np.isfinite(values)
    for index in range(len(observations.sessions)):
        own = good & (observations.session == index)
        shown = label if index == 0 else None
        axes.plot(hours[own], values[own], color=colour, linewidth=0.8, marker="o", markersize=2.4, label=shown)


def _shade(axes: Axes, hours: Float, warm_up: Mask) -> None:
    """A band behind each warm-up."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], warm_up, [False]]).astype(int)))
    for number, (begin, end) in enumerate(zip(edges[::2], edges[1::2], strict=True)):
        label = "warm-up" if number == 0 else None
        axes.axvspan(float(hours[begin]), float(hours[end - 1]), color="#F0E442", alpha=0.25, linewidth=0, label=label)


def histogram(evaluation: Evaluation) -> Figure:
    """Deviations of the held-out centres before and after compensation, along each axis."""
    with style():
        figure, panels = new_figure(7.4, 2.9, 1, 2)
        for index, (axes, (name, colour)) in enumerate(zip(panels, _AXES, strict=True)):
            before, after = evaluation.before_px[:, index], evaluation.after_px[:, index]
            bins = np.histogram_bin_edges(np.concatenate([before, after]), 80)
            rms = evaluation.rms_before_px[index], evaluation.rms_after_px[index]
            axes.hist(
                before, bins.tolist(), color=colour, alpha=0.35, linewidth=0, label=f"before, RMS {rms[0]:.3f} px"
            )
            axes.hist(
                after, bins.tolist(), histtype="step", color=colour, linewidth=1.4, label=f"after, RMS {rms[1]:.3f} px"
            )
            axes.set_xlabel(f"deviation along {name} (px)")
            legend_above(axes, columns=1)
        panels[0].set_ylabel("marker centres")
    return figure


def against_temperature(evaluation: Evaluation) -> Figure:
    """RMS deviation at each held-out chamber temperature, before and after compensation."""
    chamber_degC = [row.chamber_degC for row in evaluation.temperatures]
    with style():
        figure, panels = new_figure(7.4, 3.0, 1, 2)
        for index, (axes, (name, colour)) in enumerate(zip(panels, _AXES, strict=True)):
            before = [row.before_px[index] for row in evaluation.temperatures]
            after = [row.after_px[index] for row in evaluation.temperatures]
            axes.plot(chamber_degC, before, "o--", color=colour, mfc="white", linewidth=0.9, label=f"{name}, before")
            gain = improvement_percent(evaluation.rms_before_px[index], evaluation.rms_after_px[index])
            axes.plot(
                chamber_degC, after, "o-", color=colour, linewidth=1.3, label=f"{name}, after ({gain:.0f} % better)"
            )
            axes.set_xlabel("chamber temperature (°C)")
            legend_above(axes)
        panels[0].set_ylabel("RMS deviation (px)")
        panels[0].set_ylim(bottom=0)
    return figure


def new_figure(width_in: float, height_in: float, rows: int, columns: int) -> tuple[Figure, list[Axes]]:
    """A figure of panels; those in a column share their x, those in a row their y axis."""
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    FigureCanvasAgg(figure)
    panels: list[Axes] = []
    for number in range(1, rows * columns + 1):
        first = panels[0] if panels else None
        shared = {"sharex": first} if rows > 1 else {"sharey": first}
        panels.append(figure.add_subplot(rows, columns, number, **shared))
        panels[-1].label_outer()
    return figure, panels


def legend_above(axes: Axes, columns: int = 3) -> None:
    """A legend over the axes, where no data are."""
    axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, borderaxespad=0.2, handlelength=1.6)
