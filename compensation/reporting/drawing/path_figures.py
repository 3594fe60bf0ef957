"""The paths of the markers, enlarged, on the picture they were seen in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure

from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.reporting.drawing.figures import (
    FULL_WIDTH_IN,
    ON_PALE,
    PALE,
    image_axes,
    new_figure,
    style,
)
from thermostand.compensation.reporting.tracks import thinned

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
