"""The figures of the drift itself: warm-ups, the whole recording, heating and cooling."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thermostand.compensation.drift.hysteresis import BranchDifference
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.reporting.drawing.figures import (
    CAMERA_COLOUR,
    COORDINATES,
    FULL_WIDTH_IN,
    GREY,
    SPOT_COLOURS,
    WARM_UP_COLOUR,
    legend_above,
    new_figure,
    style,
)
from thermostand.compensation.reporting.tracks import Rows, Visit, WarmUp, mean_over_markers, moved_px, thinned
from thermostand.experiments.steps import Role

CURVE_POINTS = 400
"""Frames of a curve that are drawn; more only make the page larger."""
_NS_PER_H, _S_PER_MIN = 3.6e12, 60.0
_BETWEEN_SESSIONS_H = 0.5
MOVED_ON_PURPOSE = tuple(str(role) for role in (Role.CALIBRATION, Role.POSE, Role.REPEATABILITY))


def warm_up_curves(observations: Observations, curves: Sequence[WarmUp], titles: Sequence[str]) -> Figure:
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


def branches(visits: Sequence[Visit], before: Sequence[BranchDifference], after: Sequence[BranchDifference]) -> Figure:
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


def _branch(axes: Axes, visits: Sequence[Visit], index: int, name: str, colour: str) -> None:
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
