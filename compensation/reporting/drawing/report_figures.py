"""The figures of a report: the drift itself, the markers' paths enlarged on the picture they were seen in, what the
model says against what was measured, and where the table held the target."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from thermostand.compensation.drift.evaluation import Evaluation, improvement_percent
from thermostand.compensation.drift.hysteresis import BranchDifference
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.reporting.drawing.figures import (
    CAMERA_COLOUR,
    COORDINATES,
    FULL_WIDTH_IN,
    GREY,
    J_COLOUR,
    ON_PALE,
    PALE,
    SPOT_COLOURS,
    WARM_UP_COLOUR,
    arrows,
    image_axes,
    legend_above,
    new_figure,
    style,
)
from thermostand.compensation.reporting.numbers import TablePositions, percent
from thermostand.compensation.reporting.tracks import (
    CycleVisit,
    Rows,
    WarmUpTrack,
    mean_over_markers,
    moved_px,
    thinned,
)
from thermostand.experiments.steps import Role
from thermostand.markers.target import Target

EXAGGERATION = 100
_PATH_POINTS = 600
_SAME_VIEW_PX = 5.0
_BOX = {"boxstyle": "square,pad=0.15", "facecolor": PALE, "edgecolor": "none", "alpha": 0.8}
_GREY_STEP = 8
"""A coarser picture has no noise to store."""


@dataclass(frozen=True, slots=True, eq=False)
class Paths:
    """One panel of paths: start_px (N, 2), moved_px (F, N, 2) from there, camera_degC (F,)."""

    title: str
    start_px: Float
    moved_px: Float
    camera_degC: Float


def trajectories(observations: Observations, panels: Sequence[Paths]) -> Figure:
    """Each marker's path x100, two panels in a row, coloured by the camera's temperature.

    The ground is the first frame, or the outlines of the discs where the camera stood differently.
    """
    columns = min(2, len(panels))
    rows = -(-len(panels) // columns)
    height_in = (5.5 if columns == 1 else 3.3) * rows
    known = np.concatenate([panel.camera_degC for panel in panels])
    norm = Normalize(float(np.nanmin(known)), float(np.nanmax(known)))
    with style():
        figure, axes = new_figure(FULL_WIDTH_IN, height_in, rows, columns)
        for panel, place in zip(panels, axes, strict=False):
            _ground(place, observations, panel.start_px)
            _paths(place, panel, norm)
        for spare in axes[len(panels) :]:
            spare.remove()
        label = "camera temperature (°C)"
        figure.colorbar(
            ScalarMappable(norm, temperature_colours()), ax=axes[: len(panels)], label=label, shrink=0.85, pad=0.02
        )
    return figure


def _paths(axes: Axes, panel: Paths, norm: Normalize) -> None:
    drawn = thinned(len(panel.moved_px), _PATH_POINTS)
    path = panel.start_px + EXAGGERATION * panel.moved_px[drawn]
    colour = np.broadcast_to(panel.camera_degC[drawn][:, None], path.shape[:2])
    good = np.isfinite(path).all(axis=2)
    if panel.title:
        axes.set_title(panel.title, fontsize=9, loc="left")
    axes.scatter(
        *path[good].T, c=colour[good], s=5, cmap=temperature_colours(), norm=norm, linewidths=0, rasterized=True
    )


def temperature_colours() -> Colormap:
    """Plasma without its yellow, which does not show on white."""
    return ListedColormap(mpl.colormaps["plasma"](np.linspace(0, 0.88, 256)))


def _ground(axes: Axes, observations: Observations, start_px: Float) -> None:
    width, height = observations.image_size
    first = observations.centres_px[int(np.argmax(observations.usable))]
    away_px = np.linalg.norm(first - start_px, axis=1)
    if np.isfinite(away_px).any() and np.nanmedian(away_px) < _SAME_VIEW_PX:
        axes.imshow(
            observations.preview // _GREY_STEP * _GREY_STEP,
            cmap="gray",
            vmin=-200,  # darks become mid-grey: the dots must stand out from the discs
            vmax=290,  # and lights pale grey
            extent=(-0.5, width - 0.5, height - 0.5, -0.5),
            interpolation="none",
        )
    else:
        _outlines(axes, observations, start_px)
    image_axes(axes, observations.image_size)
    axes.label_outer()
    _scale_bar(axes, width, height)


def _outlines(axes: Axes, observations: Observations, start_px: Float) -> None:
    """Discs whose size follows from the distance of their neighbours."""
    axes.set_facecolor(PALE)
    seen = np.isfinite(start_px).all(axis=1)
    apart_px = np.linalg.norm(start_px[seen][:, None] - start_px[seen], axis=2)
    np.fill_diagonal(apart_px, np.inf)
    px_per_mm = float(np.median(apart_px.min(axis=1))) / observations.target.spacing_mm
    diameters = observations.target.diameters_mm()[seen] * px_per_mm
    axes.add_collection(
        EllipseCollection(
            diameters,
            diameters,
            np.zeros_like(diameters),
            units="xy",
            offsets=start_px[seen],
            offset_transform=axes.transData,
            facecolors="#969696",
            edgecolors="none",
        )
    )


def _scale_bar(axes: Axes, width: int, height: int) -> None:
    """What half a pixel of drift looks like."""
    x, y = 0.03 * width, 0.97 * height
    axes.plot([x, x + 0.5 * EXAGGERATION], [y, y], color=ON_PALE, linewidth=2, solid_capstyle="butt")
    at_px = x + 0.5 * EXAGGERATION + 0.01 * width
    axes.text(at_px, y, "0.5 px of drift", va="center", fontsize=8, color=ON_PALE, bbox=_BOX)


CURVE_POINTS = 400
"""Frames of a curve that are drawn; more only make the page larger."""
_NS_PER_H, _S_PER_MIN = 3.6e12, 60.0
_BETWEEN_SESSIONS_H = 0.5
MOVED_ON_PURPOSE = tuple(str(role) for role in (Role.CALIBRATION, Role.POSE, Role.REPEATABILITY))


def warm_up_curves(observations: Observations, curves: Sequence[WarmUpTrack], titles: Sequence[str]) -> Figure:
    """Mean drift since the first frame, and the camera's temperature, against the time since it was switched on."""
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 4.0, 2, len(curves))
        for number, (curve, title) in enumerate(zip(curves, titles, strict=True)):
            above, below = panels[number], panels[len(curves) + number]
            drawn = thinned(len(curve.since_on_s), CURVE_POINTS)
            minutes = curve.since_on_s[drawn] / _S_PER_MIN
            for (name, colour), values in zip(COORDINATES, curve.track.mean_px[drawn].T, strict=True):
                _curve(above, minutes, values, colour, f"mean drift, {name}" if len(curves) == 1 else name)
            camera_degC = observations.camera_degC[curve.track.frames[drawn]]
            _curve(below, minutes, camera_degC, CAMERA_COLOUR, "camera")
            since = "it was switched on" if curve.power_on_known else "the first frame"
            below.set_xlabel(f"time since {since} (min)")
            if title:
                above.set_title(title, fontsize=9, loc="left", pad=20)
            legend_above(above)
        panels[0].set_ylabel("drift (px)")
        panels[len(curves)].set_ylabel("camera (°C)")
    return figure


def _curve(axes: Axes, x: Float, y: Float, colour: str, label: str | None) -> None:
    few = len(x) <= 100
    axes.plot(x, y, color=colour, linewidth=0.9, marker="o" if few else None, markersize=2.4, label=label)


def against_time(observations: Observations) -> Figure:
    """Mean drift along I and J, and below it the temperatures, against the hours since the first frame; at the foot
    those that a thermal imager saw, where there was one.

    Time between sessions is left out; a session begins at a dashed line. Frames of a target that was moved on purpose
    are not drift: they are a grey band.
    """
    hours, starts = _recorded_hours(observations)
    mean = mean_over_markers(moved_px(observations))
    has_spots = any(session.spots for session in observations.sessions)
    with style():
        figure, (above, below, *foot) = new_figure(FULL_WIDTH_IN, 6.4 if has_spots else 4.6, 3 if has_spots else 2, 1)
        runs = _runs(observations)
        for (name, colour), values in zip(COORDINATES, mean.T, strict=True):
            _broken_curve(above, hours, values, runs, colour, f"mean drift, {name}")
        _broken_curve(below, hours, observations.camera_degC, runs, CAMERA_COLOUR, "camera")
        _broken_curve(below, hours, observations.air_degC, runs, GREY, "air near the camera")
        for axes in foot:
            _spots(axes, observations, starts)
        for axes in (above, below, *foot):
            _bands(axes, hours, observations, (str(Role.WARM_UP),), WARM_UP_COLOUR, "warm-up")
            _bands(axes, hours, observations, MOVED_ON_PURPOSE, "#bbbbbb", "target moved")
            for start in starts[1:]:
                axes.axvline(start, color=GREY, linewidth=0.8, linestyle="--")
        above.set_ylabel("drift (px)")
        below.set_ylabel("temperature (°C)")
        (foot or [below])[-1].set_xlabel("time since the first frame (h)")
        for axes in (above, below, *foot):
            legend_above(axes, columns=4)
    return figure


def _spots(axes: Axes, observations: Observations, starts: Sequence[float]) -> None:
    """What the thermal imager saw, from the first to the last frame of each session."""
    names = list(dict.fromkeys(name for session in observations.sessions for name in session.spots))
    for index, (session, start) in enumerate(zip(observations.sessions, starts, strict=True)):
        own = observations.time_ns[observations.session == index]
        for number, name in enumerate(names):
            if name not in session.spots:
                continue
            times_ns, degC = session.spots[name]
            within = (times_ns >= own[0]) & (times_ns <= own[-1])
            hours = start + (times_ns[within] - own[0]) / _NS_PER_H
            drawn = thinned(len(hours), CURVE_POINTS)
            colour = SPOT_COLOURS[number % len(SPOT_COLOURS)]
            axes.plot(hours[drawn], degC[within][drawn], color=colour, linewidth=0.9, label=None if index else name)
    axes.set_ylabel("thermal imager (°C)")


def _recorded_hours(observations: Observations) -> tuple[Float, list[float]]:
    """Hours of each frame (F,), and of the begin of each session, sessions put end to end."""
    hours = np.zeros(len(observations.time_ns))
    starts, offset = list[float](), 0.0
    for index in range(len(observations.sessions)):
        own = observations.session == index
        times_ns = observations.time_ns[own]
        hours[own] = offset + (times_ns - times_ns[0]) / _NS_PER_H
        starts.append(offset)
        offset = float(hours[own].max()) + _BETWEEN_SESSIONS_H
    return hours, starts


def _runs(observations: Observations) -> list[Rows]:
    """Frames that a line may join: of one session, all drift or all of a moved target; thinned."""
    moved = np.isin(observations.role, MOVED_ON_PURPOSE).astype(int)
    label = 2 * observations.session + moved
    frames = np.split(np.arange(len(label)), np.flatnonzero(np.diff(label)) + 1)
    return [run[thinned(len(run), CURVE_POINTS)] for run in frames]


def _broken_curve(axes: Axes, hours: Float, values: Float, runs: Sequence[Rows], colour: str, label: str) -> None:
    shown: str | None = label
    for run in runs:
        good = run[np.isfinite(values[run])]
        if len(good):
            axes.plot(hours[good], values[good], color=colour, linewidth=0.8, marker="o", markersize=2.2, label=shown)
            shown = None


def _bands(
    axes: Axes, hours: Float, observations: Observations, roles: tuple[str, ...], colour: str, label: str
) -> None:
    """Behind each run of frames with these roles in a session."""
    shown: str | None = label
    run = np.where(np.isin(observations.role, roles), observations.session, -1)
    for frames in np.split(np.arange(len(run)), np.flatnonzero(np.diff(run)) + 1):
        if run[frames[0]] >= 0:
            ends = float(hours[frames[0]]), float(hours[frames[-1]])
            axes.axvspan(*ends, color=colour, alpha=0.25, linewidth=0, label=shown)
            shown = None


def branches(
    visits: Sequence[CycleVisit], before: Sequence[BranchDifference], after: Sequence[BranchDifference]
) -> Figure:
    """Mean drift at each set-point on the way up and down, and below it the gap between the two, before and after."""
    has_gaps = len(before) > 0
    with style():
        figure, panels = new_figure(FULL_WIDTH_IN, 4.8 if has_gaps else 2.9, 2 if has_gaps else 1, 2)
        for index, (name, colour) in enumerate(COORDINATES):
            _branch(panels[index], visits, index, name, colour)
            if has_gaps:
                _gaps(panels[2 + index], before, index, colour, after=False)
                if len(after) > 0:
                    _gaps(panels[2 + index], after, index, colour, after=True)
                legend_above(panels[2 + index])
            panels[-2 + index].set_xlabel("chamber temperature (°C)")
        panels[0].set_ylabel("mean drift (px)")
        if has_gaps:
            panels[2].set_ylabel("heating − cooling (mpx)")
    return figure


def _branch(axes: Axes, visits: Sequence[CycleVisit], index: int, name: str, colour: str) -> None:
    for one, two in pairwise(visits):
        line = "-" if two.direction > 0 else ":"
        ends = [one.chamber_degC, two.chamber_degC], [one.mean_px[index], two.mean_px[index]]
        axes.plot(*ends, line, color=colour, linewidth=1.0)
    for direction, marker, face, label in ((1, "^", colour, "heating"), (-1, "v", "white", "cooling")):
        own = [visit for visit in visits if visit.direction == direction]
        places = [visit.chamber_degC for visit in own], [visit.mean_px[index] for visit in own]
        axes.plot(*places, marker, color=colour, markerfacecolor=face, markersize=5, label=f"{name}, {label}")
    legend_above(axes)


def _gaps(axes: Axes, gaps: Sequence[BranchDifference], index: int, colour: str, *, after: bool) -> None:
    axes.errorbar(
        [gap.chamber_degC for gap in gaps],
        [1e3 * float(gap.difference_px[index]) for gap in gaps],
        yerr=[2e3 * float(gap.uncertainty_px[index]) for gap in gaps],
        color=colour,
        linestyle="-" if after else "--",
        marker="o",
        markerfacecolor=colour if after else "white",
        markersize=4,
        linewidth=1.0,
        label="after" if after else "before",
    )
    axes.axhline(0, color=GREY, linewidth=0.8)


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


_LABEL_MM = 12.0


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
