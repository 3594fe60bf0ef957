"""The figures of a calibration: what the fit leaves, how well the camera is known, and what board and table turned
out to be. Same style as compensation/reporting/drawing/figures.py; blue is x (I), orange is y (J).
"""

from __future__ import annotations

import math

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from thermostand.compensation.calibration.adjustment import Adjustment
from thermostand.compensation.calibration.calibrate import CameraCalibration
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.uncertainty import grid_pixels
from thermostand.compensation.reporting.drawing.figures import (
    GREY,
    I_COLOUR,
    J_COLOUR,
    arrows,
    image_axes,
    legend_above,
    new_figure,
    style,
)


def residual_vectors(calibration: CameraCalibration) -> Figure:
    """Every residual as an arrow from its marker's image; one colour per table position of equal linear position."""
    adjustment = calibration.adjustment
    used, positions = adjustment.used, adjustment.positions
    places, moved = positions.centres_px[used], adjustment.residuals_px[used]
    linear = np.broadcast_to(positions.linear_mm[:, None], used.shape)[used].astype(np.float64)
    with style():
        figure, (axes,) = new_figure(7.4, 5.6, 1, 1)
        drawn = arrows(axes, places, moved, positions.image_size, linear, width=0.0012, cmap="viridis")
        figure.colorbar(drawn, ax=axes, label="linear position (mm)", shrink=0.85, pad=0.02)
    return figure


def residual_sizes(calibration: CameraCalibration) -> Figure:
    """RMS residual per coordinate of each position and of each marker, against the detection sigma."""
    adjustment = calibration.adjustment
    squares = np.where(adjustment.used[:, :, None], adjustment.residuals_px**2, np.nan)
    with style():
        figure, panels = new_figure(7.4, 2.9, 1, 2)
        for axes, over, name in zip(panels, (1, 0), ("table position, in order of visit", "marker"), strict=True):
            rms_mpx = 1e3 * np.sqrt(np.nanmean(squares, axis=over))
            number = np.arange(1, len(rms_mpx) + 1)
            for values, colour, label in zip(rms_mpx.T, (I_COLOUR, J_COLOUR), ("x", "y"), strict=True):
                axes.plot(number, values, "o-", color=colour, markersize=2.6, linewidth=0.8, label=label)
            sigma_mpx = 1e3 * adjustment.positions.sigma_px
            axes.axhline(sigma_mpx, color=GREY, linewidth=0.8, linestyle="--", label="detection sigma")
            axes.set_xlabel(name)
            legend_above(axes)
        panels[0].set_ylabel("RMS residual (mpx)")
        panels[0].set_ylim(bottom=0)
    return figure


def normalised_histogram(calibration: CameraCalibration) -> Figure:
    """Residuals over their detection sigma, beside the normal distribution they would have if that were all."""
    adjustment = calibration.adjustment
    values = adjustment.normalised[adjustment.used]
    reach = max(4.0, float(np.abs(values).max()))
    bins = np.linspace(-reach, reach, 61)
    with style():
        figure, panels = new_figure(7.4, 2.7, 1, 2)
        normal = np.exp(-(bins**2) / 2) / math.sqrt(2 * math.pi)
        for axes, own, colour, name in zip(panels, values.T, (I_COLOUR, J_COLOUR), ("x", "y"), strict=True):
            rms = float(np.sqrt(np.mean(own**2)))
            axes.hist(
                own, bins.tolist(), density=True, color=colour, alpha=0.4, linewidth=0, label=f"{name}, RMS {rms:z.3f}"
            )
            axes.plot(bins, normal, color="black", linewidth=0.9, label="normal")
            axes.set_xlabel("residual over detection sigma")
            legend_above(axes)
        panels[0].set_ylabel("density")
    return figure


def uncertainty_map(calibration: CameraCalibration) -> Figure:
    """Standard uncertainty of the projection over the image, and the shift between the halves' calibrations."""
    found = calibration.uncertainty
    with style():
        shift = calibration.halves
        figure, panels = new_figure(7.4, 3.4, 1, 1 if shift is None else 2)
        _contours(figure, panels[0], found.pixels, 1e3 * found.sigma_px, "uncertainty of the projection (mpx)")
        if shift is not None:
            length = 1e3 * np.linalg.norm(shift.shift_px, axis=-1) / math.sqrt(2)
            _contours(figure, panels[1], shift.pixels, length, "difference of the halves (mpx)")
        used = calibration.adjustment.used
        for axes in panels:
            places = calibration.adjustment.positions.centres_px[used]
            axes.plot(*places.T, ",", color="white", alpha=0.5, rasterized=True)
            image_axes(axes, calibration.adjustment.positions.image_size)
    return figure


def rays_against_pinhole(calibration: CameraCalibration) -> Figure:
    """Where the ray model sees what the pinhole sees at a pixel, at the mean distance; blank outside its markers."""
    lens, rays = calibration.adjustment.scene.lens, calibration.rays
    pixels = grid_pixels(lens.image_size, 31)
    inside = rays.inside(pixels)
    slopes = lens.slopes(pixels[inside])
    points = np.column_stack([slopes, np.ones(len(slopes))]) * calibration.uncertainty.distance_mm
    moved = -rays.misfit(points, pixels[inside])
    with style():
        figure, (axes,) = new_figure(7.4, 5.2, 1, 1)
        arrows(axes, pixels[inside], moved, lens.image_size, width=0.0018, color=I_COLOUR)
    return figure


def corrections(calibration: CameraCalibration) -> Figure:
    """What the adjustment changed: the board in its plane, and the recorded table positions, with uncertainties."""
    adjustment = calibration.adjustment
    with style():
        figure, (above,) = new_figure(7.4, 5.0, 1, 1)
        above.set_subplotspec(figure.add_gridspec(2, 1)[0])
        _board_corrections(above, adjustment)
        _table_corrections(figure.add_subplot(2, 1, 2), adjustment)
    return figure


def model_scores(calibration: CameraCalibration) -> Figure:
    """Hold-out RMS of every model with its standard error; the detection sigma is what no model can beat."""
    scores = calibration.scores
    with style():
        figure, (axes,) = new_figure(7.4, 2.6, 1, 1)
        places = np.arange(len(scores))
        axes.errorbar(
            [1e3 * score.rms_px for score in scores],
            places,
            xerr=[1e3 * score.sigma_px for score in scores],
            fmt="o",
            color=I_COLOUR,
            capsize=3,
        )
        sigma_mpx = 1e3 * calibration.adjustment.positions.sigma_px
        axes.axvline(sigma_mpx, color=GREY, linewidth=0.8, linestyle="--", label="detection sigma")
        axes.set_yticks(places, [score.model for score in scores])
        axes.set_ylim(len(scores) - 0.5, -0.5)
        axes.set_xlabel("RMS at held-out positions, per coordinate (mpx)")
        axes.set_xlim(left=0)
        legend_above(axes)
    return figure


def _board_corrections(axes: Axes, adjustment: Adjustment) -> None:
    moved_um = 1e3 * (adjustment.scene.points_mm - adjustment.board.points_mm)
    sigma_um = 1e3 * adjustment.points_sigma_mm
    number = np.arange(1, len(moved_um) + 1)
    for index, (name, colour) in enumerate((("X", I_COLOUR), ("Y", J_COLOUR), ("Z", GREY))):
        axes.errorbar(
            number,
            moved_um[:, index],
            sigma_um[:, index],
            fmt="o",
            markersize=2.2,
            linewidth=0.6,
            color=colour,
            label=name,
        )
    axes.set(xlabel="marker", ylabel="correction of the board (um)")
    legend_above(axes)


def _table_corrections(axes: Axes, adjustment: Adjustment) -> None:
    errors = adjustment.scene.errors
    number = np.arange(1, len(errors) + 1)
    axes.plot(number, 1e3 * errors[:, 0], "o-", markersize=2.6, linewidth=0.8, color=I_COLOUR, label="linear (um)")
    seconds = 3600 * np.degrees(errors[:, 3])
    axes.plot(number, seconds, "s-", markersize=2.6, linewidth=0.8, color=J_COLOUR, label="rotary (arcsec)")
    axes.set(xlabel="table position, in order of visit", ylabel="error of the table")
    legend_above(axes)


def _contours(figure: Figure, axes: Axes, pixels: Float, values: Float, label: str) -> None:
    """Hatched grey where values are NaN."""
    columns, rows = pixels[..., 0], pixels[..., 1]
    if np.isfinite(values).any():
        drawn = axes.contourf(columns, rows, np.ma.masked_invalid(values), levels=12, cmap="viridis")
        figure.colorbar(drawn, ax=axes, label=label, orientation="horizontal", pad=0.02, shrink=0.9)
    if np.isnan(values).any():
        patch = Rectangle(
            (0, 0), 1, 1, label="not seen here", facecolor="#d9d9d9", edgecolor=GREY, hatch="///", zorder=-1
        )
        patch.set_transform(axes.transAxes)
        axes.add_patch(patch)
        legend_above(axes)
