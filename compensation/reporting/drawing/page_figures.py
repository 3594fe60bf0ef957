"""The figures of the pages besides the report: of a calibration (blue is x, orange is y), of a datasheet, and of a
validation in three dimensions (blue is before, orange after compensation, as in the paper)."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from matplotlib.figure import Figure

from thermostand.compensation.calibration.calibrate import CameraCalibration
from thermostand.compensation.calibration.uncertainty import make_pixel_grid
from thermostand.compensation.datasheet.datasheet import UNITS, Datasheet, Visits, Warming
from thermostand.compensation.reporting.drawing.figures import (
    CAMERA_COLOUR,
    COORDINATES,
    GREY,
    I_COLOUR,
    J_COLOUR,
    ContourPanel,
    Mark,
    Panel,
    draw_arrows,
    draw_contours,
    draw_panels,
    make_bars,
    make_curve,
    make_histogram,
    make_rule,
)
from thermostand.compensation.validation3d.document import AFTER_mm, BEFORE_mm
from thermostand.compensation.validation3d.validate import Deviations, SpatialValidation

_XY = (("x", I_COLOUR), ("y", J_COLOUR))
_JOINED = {"linewidth": 0.8, "markersize": 2.6}


def draw_residual_vectors(calibration: CameraCalibration) -> Figure:
    """Every residual as an arrow from its marker's image; one colour per table position of equal linear position."""
    adjustment = calibration.adjustment
    used, positions = adjustment.used, adjustment.positions
    linear = np.broadcast_to(positions.linear_mm[:, None], used.shape)[used].astype(np.float64)
    places, moved = positions.centres_px[used], adjustment.residuals_px[used]
    return draw_arrows(places, moved, positions.image_size, linear, "linear position (mm)")


def draw_residual_sizes(calibration: CameraCalibration) -> Figure:
    """RMS residual per coordinate of each position and of each marker, against the detection sigma."""
    adjustment = calibration.adjustment
    squares = np.where(adjustment.used[:, :, None], adjustment.residuals_px**2, np.nan)
    sigma = make_rule(1e3 * adjustment.positions.sigma_px, "detection sigma")
    shown: list[Panel] = []
    for over, name in ((1, "table position, in order of visit"), (0, "marker")):
        rms_mpx = 1e3 * np.sqrt(np.nanmean(squares, axis=over))
        number = np.arange(1, len(rms_mpx) + 1)
        of_axes = zip(rms_mpx.T, _XY, strict=True)
        marks = [
            make_curve(number, values, colour, label, marker="o", **_JOINED) for values, (label, colour) in of_axes
        ]
        shown.append(Panel([*marks, sigma], look={"xlabel": name, "ylabel": "RMS residual (mpx)", "ylim": (0, None)}))
    return draw_panels(2, 2.9, shown)


def draw_normalised_histogram(calibration: CameraCalibration) -> Figure:
    """Draw the residuals over their detection sigma, and the normal distribution they would have if that were all."""
    adjustment = calibration.adjustment
    values = adjustment.normalised[adjustment.used]
    reach = max(4.0, float(np.abs(values).max()))
    bins = np.linspace(-reach, reach, 61)
    normal = make_curve(bins, np.exp(-(bins**2) / 2) / math.sqrt(2 * math.pi), "black", "normal", linewidth=0.9)
    labels = {"xlabel": "residual over detection sigma", "ylabel": "density"}
    look = {"density": True, "alpha": 0.4, "linewidth": 0}
    shown: list[Panel] = []
    for own, (name, colour) in zip(values.T, _XY, strict=True):
        label = f"{name}, RMS {float(np.sqrt(np.mean(own**2))):z.3f}"
        shown.append(Panel([make_histogram(own, bins.tolist(), colour, label, **look), normal], look=labels))
    return draw_panels(2, 2.7, shown)


def draw_uncertainty_map(calibration: CameraCalibration) -> Figure:
    """Standard uncertainty of the projection over the image, and the shift between the halves' calibrations."""
    found, shift, adjustment = calibration.uncertainty, calibration.halves, calibration.adjustment
    shown = [ContourPanel(found.pixels, 1e3 * found.sigma_px, "uncertainty of the projection (mpx)")]
    if shift is not None:
        length_mpx = 1e3 * np.linalg.norm(shift.shift_px, axis=-1) / math.sqrt(2)
        shown.append(ContourPanel(shift.pixels, length_mpx, "difference of the halves (mpx)"))
    positions = adjustment.positions
    return draw_contours(shown, positions.image_size, positions.centres_px[adjustment.used])


def draw_rays_against_pinhole(calibration: CameraCalibration) -> Figure:
    """Draw where the ray model sees what the pinhole sees at a pixel, at the mean distance; blank outside its
    markers."""
    lens, rays = calibration.adjustment.scene.lens, calibration.rays
    pixels = make_pixel_grid(lens.image_size, 31)
    inside = pixels[rays.inside(pixels)]
    slopes = lens.compute_slopes(inside)
    points = np.column_stack([slopes, np.ones(len(slopes))]) * calibration.uncertainty.distance_mm
    return draw_arrows(inside, -rays.compute_misfit(points, inside), lens.image_size)


def draw_corrections(calibration: CameraCalibration) -> Figure:
    """Draw what the adjustment changed: the board in its plane, and the recorded table positions, with
    uncertainties."""
    adjustment = calibration.adjustment
    moved_um = 1e3 * (adjustment.scene.points_mm - adjustment.board.points_mm)
    sigma_um, number = 1e3 * adjustment.points_sigma_mm, np.arange(1, len(moved_um) + 1)
    look = {"fmt": "o", "markersize": 2.2, "linewidth": 0.6}
    board = [
        make_curve(number, moved_um[:, axis], colour, name, error=sigma_um[:, axis], **look)
        for axis, (name, colour) in enumerate((("X", I_COLOUR), ("Y", J_COLOUR), ("Z", GREY)))
    ]
    errors = adjustment.scene.errors
    position, seconds = np.arange(1, len(errors) + 1), 3600 * np.degrees(errors[:, 3])
    table = [
        make_curve(position, 1e3 * errors[:, 0], I_COLOUR, "linear (um)", marker="o", **_JOINED),
        make_curve(position, seconds, J_COLOUR, "rotary (arcsec)", marker="s", **_JOINED),
    ]
    labels = {"xlabel": "table position, in order of visit", "ylabel": "error of the table"}
    above = Panel(board, look={"xlabel": "marker", "ylabel": "correction of the board (um)"})
    return draw_panels(1, 5.0, [above, Panel(table, look=labels)], share=False)


def draw_model_scores(calibration: CameraCalibration) -> Figure:
    """Hold-out RMS of every model with its standard error; the detection sigma is what no model can beat."""
    scores = calibration.scores
    places = np.arange(len(scores))
    rms_mpx, sigma_mpx = (1e3 * np.array([getattr(one, key) for one in scores]) for key in ("rms_px", "sigma_px"))
    marks: list[Mark] = [
        lambda axes: axes.errorbar(rms_mpx, places, xerr=sigma_mpx, fmt="o", color=I_COLOUR, capsize=3),
        make_rule(1e3 * calibration.adjustment.positions.sigma_px, "detection sigma", upright=True),
        lambda axes: axes.set_yticks(places, [score.model for score in scores]),
    ]
    labels = {"xlabel": "RMS at held-out positions, per coordinate (mpx)"}
    limits = {"xlim": (0, None), "ylim": (len(scores) - 0.5, -0.5)}
    return draw_panels(1, 2.6, [Panel(marks, look={**labels, **limits})])


_LABELS = ("shift I (px)", "shift J (px)", "change of scale (ppm)", "turn (µrad)")
_COLOURS = (I_COLOUR, J_COLOUR, "#009E73", CAMERA_COLOUR)


def draw_over_temperature(sheet: Datasheet) -> Figure:
    """Each visit: full after heating, open after cooling; the line is the stated coefficient at the reference."""
    first, shown = sheet.visits[0], list[Panel]()
    ends = np.array([first.base_degC.min(), first.base_degC.max()])
    for motion, one in enumerate(sheet.quantities[: len(UNITS)]):
        marks = [mark for visits in sheet.visits for mark in _mark_visits(visits, motion)]
        if np.isfinite(one.value):
            label = f"{one.value:.3g} {one.unit} at the reference".replace("-", "−")
            at = first.moved[0, motion] + one.value * (ends - first.base_degC[0])
            marks.append(make_curve(ends, at, GREY, label, linewidth=0.9, linestyle="--"))
        whose = "camera's own sensor" if first.by_camera else "air near the camera"
        below = f"{whose} (°C)" if motion > 1 else ""
        shown.append(Panel(marks, look={"xlabel": below, "ylabel": _LABELS[motion]}))
    return draw_panels(2, 5.2, shown, share=False)


def _mark_visits(visits: Visits, motion: int) -> Iterator[Mark]:
    side = np.sign(np.diff(visits.chamber_degC, prepend=visits.chamber_degC[0]))
    base_degC, moved, colour = visits.base_degC, visits.moved[:, motion], _COLOURS[motion]
    yield make_curve(base_degC, moved, colour, linewidth=0.6, alpha=0.5)
    for rows, face in ((side >= 0, colour), (side < 0, "white")):
        yield make_curve(base_degC[rows], moved[rows], colour, marker="o", linestyle="", markerfacecolor=face)


def draw_warm_up(warming: Warming, settled_s: float) -> Figure:
    """Shift since the first frame, and the camera's own temperature."""
    minutes, thick = warming.since_s / 60, {"linewidth": 1.2}
    shifts = zip(COORDINATES, warming.moved.T, strict=False)
    moved = [make_curve(minutes, values, colour, f"shift {name}", **thick) for (name, colour), values in shifts]
    if np.isfinite(settled_s):
        moved.append(make_rule(settled_s / 60, "90 % of it", upright=True, style=":"))
    warmed = [
        make_curve(minutes, warming.camera_degC, CAMERA_COLOUR, "camera's sensor", **thick),
        make_curve(minutes, warming.air_degC, GREY, "air near it", **thick),
    ]
    time = {"xlabel": "time since switching on (min)" if warming.known else "time of the recording (min)"}
    left = Panel(moved, look={**time, "ylabel": "since the first frame (px)"})
    return draw_panels(2, 2.8, [left, Panel(warmed, look={**time, "ylabel": "temperature (°C)"})], share=False)


AXES = ("X", "Y", "Z")
_POSITION_COLOURS = ("#000000", "#009E73", "#CC79A7", "#56B4E9")
_MARKERS = "os^D"
_SPREAD_K = 0.35
"""Between the points of two positions at one temperature, for the eye."""


def draw_deviation_bars(validation: SpatialValidation) -> Figure:
    """The form of the paper's figure 15: mean absolute deviation at each temperature, before and after; dashed: the
    paper's means over its temperatures."""
    order = _sort_by_temperature(validation)
    place, ticks = np.arange(len(order)), [f"{degC:z.1f}" for degC in validation.camera_degC[order]]
    sides = (
        (validation.before, I_COLOUR, -0.2, BEFORE_mm, "before"),
        (validation.after, J_COLOUR, 0.2, AFTER_mm, "after"),
    )
    shown: list[Panel] = []
    for axis, title in enumerate(AXES):
        marks: list[Mark] = []
        for one, colour, side, paper_mm, name in sides:
            height, u = one.per_temperature_um[order, axis], one.u_per_temperature_um[order, axis]
            marks.append(make_bars(place + side, height, u, colour, name))
            marks.append(make_rule(1e3 * paper_mm[axis], f"mean of the paper's, {name}", colour=colour))
        marks.append(lambda axes: axes.set_xticks(place, ticks, rotation=90, fontsize=7))
        marks.append(lambda axes: axes.grid(visible=False, axis="x"))
        labels = {"xlabel": "camera (°C)", "ylabel": "mean |deviation| (µm)"}
        shown.append(Panel(marks, title, look={**labels, "ylim": (0, None)}))
    return draw_panels(3, 3.3, shown, one_legend=True)


def draw_by_position(validation: SpatialValidation, deviations: Deviations) -> Figure:
    """One variant's deviations at each position, with standard uncertainties."""
    order = _sort_by_temperature(validation)
    degC, middle = validation.camera_degC[order], (len(validation.names) - 1) / 2
    shown: list[Panel] = []
    for axis, title in enumerate(AXES):
        marks: list[Mark] = []
        for index, name in enumerate(validation.names):
            colour = _POSITION_COLOURS[index % len(_POSITION_COLOURS)]
            values, u = (each[order, index, axis] for each in (deviations.translation_um, deviations.u_um))
            look = {"fmt": _MARKERS[index % len(_MARKERS)], "markersize": 3.2, "linewidth": 0.7}
            marks.append(make_curve(degC + _SPREAD_K * (index - middle), values, colour, name, error=u, **look))
        marks.append(make_rule(0, style="-"))
        shown.append(Panel(marks, title, look={"xlabel": "camera (°C)", "ylabel": "deviation (µm)"}))
    return draw_panels(3, 2.9, shown, one_legend=True)


def _sort_by_temperature(validation: SpatialValidation) -> list[int]:
    """The temperatures but the reference, the coolest camera first."""
    return [int(index) + 1 for index in np.argsort(validation.camera_degC[1:], kind="stable")]
