"""The figures of a report: the drift itself, the markers' paths enlarged on the picture they were seen in, what the
model says against what was measured, and where the table held the target."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, StrMethodFormatter

from thermostand.compensation.drift.evaluation import Evaluation, compute_improvement_percent
from thermostand.compensation.drift.hysteresis import BranchDifference
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.reporting.drawing.figures import (
    CAMERA_COLOUR,
    COORDINATES,
    GREY,
    J_COLOUR,
    SPOT_COLOURS,
    WARM_UP_COLOUR,
    Mark,
    Panel,
    PathPanel,
    draw_arrows,
    draw_panels,
    draw_trajectories,
    make_band,
    make_curve,
    make_dots,
    make_histogram,
    make_rule,
    make_span,
    make_text,
)
from thermostand.compensation.reporting.report_numbers import TablePositions, format_percent
from thermostand.compensation.reporting.tracks import (
    CycleVisit,
    Rows,
    WarmUpTrack,
    average_over_markers,
    choose_evenly,
    compute_displacement_px,
)
from thermostand.experiments.steps import Role
from thermostand.markers.target import Target

CURVE_POINTS = 400
"""Frames of a curve that are drawn; more only make the page larger."""
_NS_PER_H, _S_PER_MIN = 3.6e12, 60.0
_BETWEEN_SESSIONS_H = 0.5  # for the eye
TARGET_MOVED_ROLES = tuple(str(role) for role in (Role.CALIBRATION, Role.POSE, Role.REPEATABILITY))


def draw_warm_up_curves(observations: Observations, curves: Sequence[WarmUpTrack], titles: Sequence[str]) -> Figure:
    """Draw the mean drift since the first frame, and the camera's temperature, against the time since it was switched
    on."""
    above, below = list[Panel](), list[Panel]()
    mean = "mean drift, " if len(curves) == 1 else ""
    for one, title in zip(curves, titles, strict=True):
        drawn = choose_evenly(len(one.since_on_s), CURVE_POINTS)
        minutes = one.since_on_s[drawn] / _S_PER_MIN
        look: dict[str, Any] = {"linewidth": 0.9, "marker": "o" if len(drawn) <= 100 else None, "markersize": 2.4}
        drift = zip(COORDINATES, one.track.mean_px[drawn].T, strict=True)
        marks = [make_curve(minutes, values, colour, f"{mean}{name}", **look) for (name, colour), values in drift]
        above.append(Panel(marks, title, look={"ylabel": "drift (px)"}))
        camera_degC = observations.camera_degC[one.track.frames[drawn]]
        since = "it was switched on" if one.power_on_known else "the first frame"
        labels = {"xlabel": f"time since {since} (min)", "ylabel": "camera (°C)"}
        below.append(Panel([make_curve(minutes, camera_degC, CAMERA_COLOUR, **look)], legend=0, look=labels))
    return draw_panels(len(curves), 4.0, [*above, *below])


def draw_against_time(observations: Observations) -> Figure:
    """Draw the mean drift along I and J, and below it the temperatures, against the hours since the first frame; at the
    foot those that a thermal imager saw, if it saw any.

    Time between sessions is left out; a session begins at a dashed line. Frames of a target that was moved on purpose
    are not drift: they are a grey band.
    """
    hours, starts = _compute_hours(observations)
    mean, runs = average_over_markers(compute_displacement_px(observations)), _split_runs(observations)

    def broken(values: Float, colour: str, label: str) -> Iterator[Mark]:
        kept = [good for run in runs if len(good := run[np.isfinite(values[run])])]
        for number, good in enumerate(kept):
            look = {"linewidth": 0.8, "marker": "o", "markersize": 2.2}
            yield make_curve(hours[good], values[good], colour, None if number else label, **look)

    (i, i_colour), (j, j_colour) = COORDINATES
    rows = {
        "drift (px)": [
            *broken(mean[:, 0], i_colour, f"mean drift, {i}"),
            *broken(mean[:, 1], j_colour, f"mean drift, {j}"),
        ],
        "temperature (°C)": [
            *broken(observations.camera_degC, CAMERA_COLOUR, "camera"),
            *broken(observations.air_degC, GREY, "air near the camera"),
        ],
    }
    if any(session.spots for session in observations.sessions):
        rows["thermal imager (°C)"] = [*_mark_spots(observations, starts)]
    behind = [
        *_mark_role_bands(hours, observations, (str(Role.WARM_UP),), WARM_UP_COLOUR, "warm-up"),
        *_mark_role_bands(hours, observations, TARGET_MOVED_ROLES, "#bbbbbb", "target moved"),
        *(make_rule(start, upright=True) for start in starts[1:]),
    ]
    time = "time since the first frame (h)"
    shown = [Panel([*marks, *behind], legend=4, look={"xlabel": time, "ylabel": name}) for name, marks in rows.items()]
    return draw_panels(1, 6.4 if len(rows) > 2 else 4.6, shown)


def _mark_spots(observations: Observations, starts: Sequence[float]) -> Iterator[Mark]:
    """Return what the thermal imager saw, from the first to the last frame of each session."""
    names = list(dict.fromkeys(name for session in observations.sessions for name in session.spots))
    for index, (session, start) in enumerate(zip(observations.sessions, starts, strict=True)):
        own = observations.time_ns[observations.session == index]
        for number, name in enumerate(names):
            if name not in session.spots:
                continue
            times_ns, degC = session.spots[name]
            within = (times_ns >= own[0]) & (times_ns <= own[-1])
            hours = start + (times_ns[within] - own[0]) / _NS_PER_H
            drawn = choose_evenly(len(hours), CURVE_POINTS)
            colour = SPOT_COLOURS[number % len(SPOT_COLOURS)]
            yield make_curve(hours[drawn], degC[within][drawn], colour, None if index else name, linewidth=0.9)


def _compute_hours(observations: Observations) -> tuple[Float, list[float]]:
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


def _split_runs(observations: Observations) -> list[Rows]:
    """Frames that a line may join: of one session, all drift or all of a moved target; thinned."""
    moved = np.isin(observations.role, TARGET_MOVED_ROLES).astype(int)
    return [run[choose_evenly(len(run), CURVE_POINTS)] for run in _group_equal(2 * observations.session + moved)]


def _group_equal(label: Rows) -> list[Rows]:
    """The places of neighbours with one label."""
    return np.split(np.arange(len(label)), np.flatnonzero(np.diff(label)) + 1)


def _mark_role_bands(
    hours: Float, observations: Observations, roles: tuple[str, ...], colour: str, label: str
) -> Iterator[Mark]:
    """Shade the background behind each run of frames with these roles in a session."""
    label_of_first: str | None = label
    run = np.where(np.isin(observations.role, roles), observations.session, -1)
    for frames in _group_equal(run):
        if run[frames[0]] >= 0:
            yield make_span(float(hours[frames[0]]), float(hours[frames[-1]]), colour, label_of_first)
            label_of_first = None


def draw_branches(
    visits: Sequence[CycleVisit], before: Sequence[BranchDifference], after: Sequence[BranchDifference]
) -> Figure:
    """Draw the mean drift at each set-point on the way up and down, and below it the gap between the two, before and
    after."""
    labels = {"xlabel": "chamber temperature (°C)"}
    drift = {**labels, "ylabel": "mean drift (px)"}
    shown = [Panel([*_mark_branch(visits, index)], look=drift) for index in range(2)]
    if before:
        gap = {**labels, "ylabel": "heating − cooling (mpx)"}
        shown += [
            Panel([*_mark_gaps(before, index), *_mark_gaps(after, index, after=True)], look=gap) for index in range(2)
        ]
    return draw_panels(2, 4.8 if before else 2.9, shown)


def _mark_branch(visits: Sequence[CycleVisit], index: int) -> Iterator[Mark]:
    name, colour = COORDINATES[index]
    for one, two in pairwise(visits):
        ends = [one.chamber_degC, two.chamber_degC], [one.mean_px[index], two.mean_px[index]]
        yield make_curve(*ends, colour, linestyle="-" if two.direction > 0 else ":")
    for direction, marker, face, label in ((1, "^", colour, "heating"), (-1, "v", "white", "cooling")):
        own = [visit for visit in visits if visit.direction == direction]
        places = [visit.chamber_degC for visit in own], [visit.mean_px[index] for visit in own]
        look = {"marker": marker, "linestyle": "", "markerfacecolor": face, "markersize": 5}
        yield make_curve(*places, colour, f"{name}, {label}", **look)


def _mark_gaps(gaps: Sequence[BranchDifference], index: int, *, after: bool = False) -> Iterator[Mark]:
    if gaps:
        colour = COORDINATES[index][1]
        yield make_curve(
            [gap.chamber_degC for gap in gaps],
            [1e3 * float(gap.difference_px[index]) for gap in gaps],
            colour,
            "after" if after else "before",
            error=[2e3 * float(gap.uncertainty_px[index]) for gap in gaps],
            linestyle="-" if after else "--",
            marker="o",
            markerfacecolor=colour if after else "white",
        )
        yield make_rule(0, style="-")


_SIGMA_95 = 1.959964
_MOST_DOTS = 20_000  # more only make the page larger
_BINS = 60


def draw_compensated_paths(observations: Observations, evaluation: Evaluation) -> Figure:
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
    shown = [PathPanel("before", reference, before, degC), PathPanel("after compensation", reference, after, degC)]
    return draw_trajectories(observations, shown)


def draw_measured_against_model(evaluation: Evaluation) -> Figure:
    """Each scored centre: the drift that was measured against the drift that the model says."""
    measured, predicted = -evaluation.before_px, evaluation.after_px - evaluation.before_px
    drawn = choose_evenly(len(measured), _MOST_DOTS)
    shown: list[Panel] = []
    for index, (name, colour) in enumerate(COORDINATES):
        both = np.concatenate([predicted[:, index], measured[:, index]])
        ends = [float(both.min()), float(both.max())]
        marks: list[Mark] = [
            make_curve(ends, ends, "black", "measured = model", linewidth=0.8),
            make_dots(predicted[drawn, index], measured[drawn, index], colour, "marker centres"),
            lambda axes: [scale.set_major_locator(MaxNLocator(5)) for scale in (axes.xaxis, axes.yaxis)],
        ]
        labels = {"xlabel": f"drift along {name}, model (px)", "ylabel": "" if index else "drift, measured (px)"}
        shown.append(Panel(marks, look={**labels, "aspect": "equal", "adjustable": "box"}))
    return draw_panels(2, 3.9, shown, share=False)


def draw_residual_map(observations: Observations, evaluation: Evaluation) -> Figure:
    """Draw what is left at each marker of each scored set-point, as arrows over the image."""
    rows = evaluation.rows
    keys = np.stack([rows.chamber_degC, rows.marker], axis=1)
    groups, index, count = np.unique(keys, axis=0, return_inverse=True, return_counts=True)
    columns = (*rows.measured_px.T, *(-evaluation.after_px).T)
    mean = np.stack([np.bincount(index.ravel(), column) / count for column in columns], axis=1)
    chamber_degC = groups[:, 0].astype(np.float64)
    return draw_arrows(mean[:, :2], mean[:, 2:], observations.image_size, chamber_degC, "chamber temperature (°C)")


def draw_residuals(evaluation: Evaluation) -> Figure:
    """Draw what is left of each scored centre's deviation, against the camera's temperature, and the claimed
    interval."""
    camera_degC = evaluation.rows.camera_degC
    left_mpx = -1e3 * evaluation.after_px
    drawn = choose_evenly(len(left_mpx), _MOST_DOTS)
    places = np.unique(camera_degC)
    claimed = np.array([evaluation.claimed_px2[camera_degC == degC].mean(axis=0) for degC in places])
    reach_mpx = 1e3 * _SIGMA_95 * np.sqrt(claimed)
    labels = {"xlabel": "camera temperature (°C)", "ylabel": "measured − model (mpx)"}
    shown: list[Panel] = []
    for index, (name, colour) in enumerate(COORDINATES):
        left = make_dots(camera_degC[drawn], left_mpx[drawn, index], colour, f"along {name}")
        shown.append(Panel([make_band(places, reach_mpx[:, index], "95 % interval"), left], look=labels))
    return draw_panels(2, 3.0, shown)


def draw_deviation_histograms(evaluation: Evaluation) -> Figure:
    """Deviations of the scored centres, along each axis: before compensation, and after it on a scale of its own."""
    shown: list[Panel] = []
    scales = (
        ("before", evaluation.before_px, evaluation.rms_before_px, 1.0, ("px", 3), {"alpha": 0.4}),
        ("after", evaluation.after_px, evaluation.rms_after_px, 1e3, ("mpx", 1), dict[str, float]()),
    )
    for when, values, rms_px, factor, (unit, digits), look in scales:
        for index, (name, colour) in enumerate(COORDINATES):
            label = f"{when}, RMS {factor * rms_px[index]:z.{digits}f} {unit}"
            labels = {"xlabel": f"deviation along {name} ({unit})", "ylabel": "" if index else "marker centres"}
            shown.append(Panel([make_histogram(factor * values[:, index], _BINS, colour, label, **look)], look=labels))
    return draw_panels(2, 4.4, shown, share=False)


def draw_against_temperature(evaluation: Evaluation) -> Figure:
    """RMS deviation at each scored chamber temperature, before and after compensation."""
    rows = evaluation.temperatures
    chamber_degC = [row.chamber_degC for row in rows]
    labels = {"xlabel": "chamber temperature (°C)", "ylabel": "RMS deviation (px)"}
    shown: list[Panel] = []
    for index, (name, colour) in enumerate(COORDINATES):
        before, after = ([getattr(row, when)[index] for row in rows] for when in ("before_px", "after_px"))
        gain = format_percent(
            compute_improvement_percent(evaluation.rms_before_px[index], evaluation.rms_after_px[index])
        )
        open_look = {"marker": "o", "linestyle": "--", "markerfacecolor": "white", "markersize": 6}
        marks: list[Mark] = [
            make_curve(chamber_degC, before, colour, f"{name}, before", **open_look),
            make_curve(
                chamber_degC, after, colour, f"{name}, after ({gain} less)", marker="o", linewidth=1.3, markersize=6
            ),
            lambda axes: (axes.set_yscale("log"), axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))),
        ]
        shown.append(Panel(marks, look=labels))
    return draw_panels(2, 3.0, shown)


_LABEL_MM = 12.0


def draw_positions(positions: TablePositions, target: Target) -> Figure:
    """The target at each position, seen from above: the camera looks from the left."""
    half_mm = float(np.ptp(target.coordinates_mm()[:, 0])) / 2
    marks = [*_mark_targets(positions.calibration, half_mm, GREY, 0.9, "calibration")]
    marks += _mark_targets(positions.poses, half_mm, J_COLOUR, 2.2, "validation")
    for number, place in enumerate(positions.poses):
        marks.append(make_text(*_locate_end(*place, half_mm + _LABEL_MM), f"V{number}", J_COLOUR))
    labels = {"xlabel": "linear table, away from the camera (mm)", "ylabel": "across (mm)"}
    marks.append(lambda axes: axes.margins(0.08))
    return draw_panels(1, 3.6, [Panel(marks, look={**labels, "aspect": "equal"})])


def _mark_targets(
    places: Sequence[tuple[float, float]], half_mm: float, colour: str, width: float, name: str
) -> Iterator[Mark]:
    for number, place in enumerate(places):
        ends = np.array([_locate_end(*place, side * half_mm) for side in (-1, 1)])
        label = None if number else f"{name}, {len(places)} positions"
        yield make_curve(ends[:, 0], ends[:, 1], colour, label, linewidth=width, solid_capstyle="round")


def _locate_end(linear_mm: float, rotary_deg: float, away_mm: float) -> tuple[float, float]:
    """A point of the target this far from its middle."""
    angle_rad = np.deg2rad(rotary_deg)
    return linear_mm + away_mm * float(np.sin(angle_rad)), away_mm * float(np.cos(angle_rad))
