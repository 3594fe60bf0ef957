"""The look of all figures, and figures as SVG text: the same data give the same bytes.

Blue is I and orange J (Okabe and Ito, safe for the colour-blind); pale and open is before, full is after compensation.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable, Generator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import EllipseCollection
from matplotlib.colors import Colormap, ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle
from numpy.typing import ArrayLike

from thermostand.compensation.finding.workers import open_pool
from thermostand.compensation.observations import Float, Observations
from thermostand.compensation.reporting.tracks import choose_evenly

I_COLOUR, J_COLOUR = "#0072B2", "#D55E00"
CAMERA_COLOUR, GREY, WARM_UP_COLOUR = "#CC79A7", "#6b6b6b", "#F0E442"
SPOT_COLOURS = ("#009E73", "#E69F00", "#56B4E9")
COORDINATES = (("I", I_COLOUR), ("J", J_COLOUR))
PALE, ON_PALE = "#ececec", "#111111"
"""The ground of pictures, and ink on it: both stay as they are where a page is dark."""
FULL_WIDTH_IN = 7.4  # of a printed page between its margins
_LONGEST_ARROW = 0.06
"""Of the image's width: a typical large one."""
LAYOUT: Literal["constrained"] | None = "constrained"
"""How the panels of a figure find their places; None: they keep the first."""
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
_LEGEND_MARKER = 3.5
EXAGGERATION = 100  # so that 0.1 px is seen as 10 px
_PATH_POINTS = 600  # more only make the page larger
_SAME_VIEW_PX = 5.0  # closer, the picture and the path are of one view; round number, nothing was measured
_BOX = {"boxstyle": "square,pad=0.15", "facecolor": PALE, "edgecolor": "none", "alpha": 0.8}
_GREY_STEP = 8
"""A coarser picture has no noise to store."""


def apply_style() -> AbstractContextManager[None]:
    """The look of all figures."""
    return mpl.rc_context(_STYLE)  # pyright: ignore[reportArgumentType] - the keys are checked at run time


def render_svg(figure: Figure, name: str) -> str:
    """The figure as an <svg> element for a page; every id begins with `name`, so that several fit in one page."""
    text = io.StringIO()
    with apply_style():
        figure.savefig(text, format="svg", dpi=_RASTER_DPI, metadata=_NO_METADATA)
    svg = re.sub(
        r' id="image[0-9a-f]+"', "", text.getvalue()
    )  # the same for the same picture, which may be there twice
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    return svg[svg.index("<svg") :]


def create_figure(
    width_in: float, height_in: float, rows: int, columns: int, *, share: bool = True
) -> tuple[Figure, list[Axes]]:
    """A figure of panels; with `share` those in a column share their x, those in a row their y axis."""
    figure = Figure(figsize=(width_in, height_in), layout=LAYOUT)
    FigureCanvasAgg(figure)
    panels: list[Axes] = []
    for number in range(rows * columns):
        row, column = divmod(number, columns)
        across = panels[row * columns] if share and column else None
        down = panels[column] if share and row else None
        panels.append(figure.add_subplot(rows, columns, number + 1, sharex=down, sharey=across))
    return figure, panels


def add_legend_above(axes: Axes, columns: int = 3) -> None:
    """A legend over the axes, where no data are."""
    shown = axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, borderaxespad=0.2, handlelength=1.6)
    for handle in shown.legend_handles:
        if isinstance(handle, Line2D):
            handle.set(markersize=max(handle.get_markersize(), _LEGEND_MARKER), alpha=1)


Mark = Callable[[Axes], object]
"""Something that is drawn in a panel."""


@dataclass(frozen=True, slots=True, eq=False)
class Panel:
    """marks: drawn one after the other. title: above, at the left. legend: its columns, 0: without one. look: of the
    axes, as matplotlib's `Axes.set` takes it: labels, limits, scales."""

    marks: Sequence[Mark]
    title: str = ""
    legend: int = 3
    look: Mapping[str, Any] = field(default_factory=dict[str, Any])


def draw_panels(
    columns: int, height_in: float, shown: Sequence[Panel], *, share: bool = True, one_legend: bool = False
) -> Figure:
    """Panels in rows. share: those in a column have one x axis, those in a row one y axis, labelled at the outer ones
    only. one_legend: that of the first panel, for all."""
    with apply_style():
        figure, places = create_figure(FULL_WIDTH_IN, height_in, -(-len(shown) // columns), columns, share=share)
        for axes, panel in zip(places, shown, strict=True):
            for mark in panel.marks:
                mark(axes)
        for axes, panel in zip(places, shown, strict=True):  # once all is drawn: limits of one are those of its row
            axes.set(**panel.look)
            if panel.title:
                axes.set_title(panel.title, fontsize=9, loc="left", pad=20 if panel.legend and not one_legend else None)
            if share:
                axes.label_outer()
            if panel.legend and not one_legend:
                add_legend_above(axes, panel.legend)
        if one_legend:
            handles, labels = places[0].get_legend_handles_labels()
            figure.legend(handles, labels, loc="outside upper left", ncols=4, handlelength=1.6)
    return figure


def make_curve(
    x: ArrayLike, y: ArrayLike, colour: str, label: str | None = None, *, error: ArrayLike | None = None, **look: Any
) -> Mark:
    """Points (M,) and what joins them; error (M,): half of each one's bar along y. look: as matplotlib's lines have
    it."""
    usual: dict[str, Any] = {"linewidth": 1.0, "markersize": 4, "color": colour, "label": label}
    if error is None:
        return lambda axes: axes.plot(x, y, **usual | look)
    return lambda axes: axes.errorbar(x, y, error, **usual | look)


def make_dots(x: ArrayLike, y: ArrayLike, colour: str, label: str) -> Mark:
    """Draw many single points as a picture, so that the page does not grow with their number."""
    small = {"marker": "o", "linestyle": "", "markersize": 2, "markeredgewidth": 0}
    return make_curve(x, y, colour, label, alpha=0.5, rasterized=True, **small)


def make_rule(
    at: float, label: str | None = None, *, upright: bool = False, colour: str = GREY, style: str = "--"
) -> Mark:
    """A line through the whole panel."""
    look: dict[str, Any] = {"color": colour, "linewidth": 0.8, "linestyle": style, "label": label}
    return lambda axes: axes.axvline(at, **look) if upright else axes.axhline(at, **look)


def make_span(begin: float, end: float, colour: str, label: str | None) -> Mark:
    """A band behind the panel from left to right of it."""
    return lambda axes: axes.axvspan(begin, end, color=colour, alpha=0.25, linewidth=0, label=label)


def make_band(x: Float, reach: Float, label: str) -> Mark:
    """Return a band from -reach to reach (M,) about 0."""
    return lambda axes: axes.fill_between(x, -reach, reach, color="#dddddd", linewidth=0, label=label)


def make_histogram(values: Float, bins: Any, colour: str, label: str, **look: Any) -> Mark:
    """Draw how often values (M,) occur."""
    return lambda axes: axes.hist(values, bins, color=colour, label=label, **look)


def make_bars(places: ArrayLike, height: Float, error: Float, colour: str, label: str) -> Mark:
    """Upright bars (M,) with their uncertainties."""
    return lambda axes: axes.bar(places, height, 0.4, yerr=error, color=colour, error_kw={"lw": 0.8}, label=label)


def make_text(x: float, y: float, text: str, colour: str) -> Mark:
    """Written at a place."""
    return lambda axes: axes.text(x, y, text, color=colour, ha="center", va="center", fontweight="bold")


def make_sequential_colormap() -> Colormap:
    """Make the colours of values from low to high: plasma without its yellow, which does not show on white."""
    return ListedColormap(mpl.colormaps["plasma"](np.linspace(0, 0.88, 256)))


def set_image_axes(axes: Axes, image_size: tuple[int, int]) -> None:
    """Set axes to those of an image (width, height), px."""
    width, height = image_size
    axes.set(xlabel="column I (px)", ylabel="row J (px)", xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_aspect("equal")
    axes.grid(visible=False)


def draw_arrows(
    at_px: Float, moved_px: Float, image_size: tuple[int, int], values: Float | None = None, label: str = ""
) -> Figure:
    """Motions (M, 2) of places (M, 2) over the image, enlarged until the larger ones show; a bar says how much. values
    (M,): their colours, which a scale with the label explains."""
    scale, bar_px = choose_enlargement(float(np.quantile(np.linalg.norm(moved_px, axis=1), 0.95)), image_size[0])
    with apply_style():
        figure, (axes,) = create_figure(FULL_WIDTH_IN, 5.4, 1, 1)
        look: dict[str, Any] = {"color": I_COLOUR} if values is None else {"cmap": make_sequential_colormap()}
        look |= {"angles": "xy", "scale_units": "xy", "scale": 1, "width": 0.0016, "rasterized": True}
        drawn = axes.quiver(*at_px.T, *(scale * moved_px).T, *(() if values is None else (values,)), **look)
        set_image_axes(axes, image_size)
        axes.set_facecolor(PALE)
        _draw_scale_bar(axes, image_size, scale * bar_px, f"{1e3 * bar_px:g} mpx, {scale:,.0f} times")
        if values is not None:
            figure.colorbar(drawn, ax=axes, label=label, shrink=0.85, pad=0.02)
    return figure


def _draw_scale_bar(axes: Axes, image_size: tuple[int, int], length_px: float, text: str) -> None:
    """Draw at the lower left of an image how long a motion of this size is drawn."""
    width, height = image_size
    x, y = 0.03 * width, 0.965 * height
    axes.plot([x, x + length_px], [y, y], color=ON_PALE, linewidth=2, solid_capstyle="butt")
    axes.text(x + length_px + 0.01 * width, y, text, va="center", fontsize=8, color=ON_PALE, bbox=_BOX)


def choose_enlargement(long_px: float, width: int) -> tuple[float, float]:
    """Choose by how much an arrow of this length is drawn longer, a round number, and a round length, px, for the bar
    next to it."""
    wanted = _LONGEST_ARROW * width / max(long_px, 1e-9)
    power = 10 ** math.floor(math.log10(wanted))
    scale = next(step * power for step in (5, 2, 1) if step * power <= wanted)
    return scale, 10 ** math.floor(math.log10(0.1 * width / scale))


@dataclass(frozen=True, slots=True, eq=False)
class PathPanel:
    """One panel of paths: start_px (N, 2), moved_px (F, N, 2) from there, camera_degC (F,)."""

    title: str
    start_px: Float
    moved_px: Float
    camera_degC: Float


def draw_trajectories(observations: Observations, shown: Sequence[PathPanel]) -> Figure:
    """Each marker's path x100, two panels in a row, coloured by the camera's temperature.

    The ground is the first frame, or the outlines of the discs where the camera stood differently.
    """
    columns = min(2, len(shown))
    rows = -(-len(shown) // columns)
    known = np.concatenate([panel.camera_degC for panel in shown])
    norm = Normalize(float(np.nanmin(known)), float(np.nanmax(known)))
    with apply_style():
        figure, places = create_figure(FULL_WIDTH_IN, (5.5 if columns == 1 else 3.3) * rows, rows, columns)
        for panel, axes in zip(shown, places, strict=False):
            _draw_background(axes, observations, panel.start_px)
            axes.set_title(panel.title, fontsize=9, loc="left")
            drawn = choose_evenly(len(panel.moved_px), _PATH_POINTS)
            path = panel.start_px + EXAGGERATION * panel.moved_px[drawn]
            colour = np.broadcast_to(panel.camera_degC[drawn][:, None], path.shape[:2])
            good = np.isfinite(path).all(axis=2)
            look: dict[str, Any] = {"s": 5, "cmap": make_sequential_colormap(), "norm": norm, "linewidths": 0}
            axes.scatter(*path[good].T, c=colour[good], rasterized=True, **look)
            axes.label_outer()
        for spare in places[len(shown) :]:
            spare.remove()
        scale = ScalarMappable(norm, make_sequential_colormap())
        figure.colorbar(scale, ax=places[: len(shown)], label="camera temperature (°C)", shrink=0.85, pad=0.02)
    return figure


def _draw_background(axes: Axes, observations: Observations, start_px: Float) -> None:
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
        _draw_outlines(axes, observations, start_px)
    set_image_axes(axes, observations.image_size)
    _draw_scale_bar(axes, observations.image_size, 0.5 * EXAGGERATION, "0.5 px of drift")


def _draw_outlines(axes: Axes, observations: Observations, start_px: Float) -> None:
    """Discs whose size follows from the distance of their neighbours."""
    axes.set_facecolor(PALE)
    seen = np.isfinite(start_px).all(axis=1)
    apart_px = np.linalg.norm(start_px[seen][:, None] - start_px[seen], axis=2)
    np.fill_diagonal(apart_px, np.inf)
    px_per_mm = float(np.median(apart_px.min(axis=1))) / observations.target.spacing_mm
    diameters = observations.target.diameters_mm()[seen] * px_per_mm
    look: dict[str, Any] = {"facecolors": "#969696", "edgecolors": "none"}
    places = {"units": "xy", "offsets": start_px[seen], "offset_transform": axes.transData}
    axes.add_collection(EllipseCollection(diameters, diameters, np.zeros_like(diameters), **places, **look))


@dataclass(frozen=True, slots=True, eq=False)
class ContourPanel:
    """Values (H, W) at pixels (H, W, 2); NaN where nothing is known."""

    pixels: Float
    values: Float
    label: str


def draw_contours(shown: Sequence[ContourPanel], image_size: tuple[int, int], seen_px: Float) -> Figure:
    """Values over the image side by side, hatched grey where they are not known; white dots (M, 2): seen markers."""
    with apply_style():
        figure, places = create_figure(FULL_WIDTH_IN, 3.4, 1, len(shown))
        for axes, one in zip(places, shown, strict=True):
            columns, rows, known = one.pixels[..., 0], one.pixels[..., 1], np.isfinite(one.values)
            if known.any():
                drawn = axes.contourf(columns, rows, np.ma.masked_invalid(one.values), levels=12, cmap="viridis")
                figure.colorbar(drawn, ax=axes, label=one.label, orientation="horizontal", pad=0.02, shrink=0.9)
            axes.plot(*seen_px.T, ",", color="white", alpha=0.5, rasterized=True)
            set_image_axes(axes, image_size)
            axes.label_outer()
            if not known.all():
                hatched: dict[str, Any] = {"facecolor": "#d9d9d9", "edgecolor": GREY, "hatch": "///", "zorder": -1}
                axes.add_patch(Rectangle((0, 0), 1, 1, label="not seen here", transform=axes.transAxes, **hatched))
                add_legend_above(axes)
    return figure


# Figures as SVG text for a page, one after the other or by two processes; the same bytes.
#
# Drawing is most of what a report takes once the markers are found, and the processes that found them have nothing to
# do any more.

Named = tuple[Figure, str]
Draw = Callable[[Sequence[Named]], list[str]]
"""Figures with the names that their ids begin with -> the SVG of each."""


def render_in_turn(figures: Sequence[Named]) -> list[str]:
    """Render the figures one after the other in this process."""
    return [render_svg(figure, name) for figure, name in figures]


# Figures go through files: a pool whose process is killed while a long message is in its pipe waits for ever.
@contextmanager
def open_renderer(workers: int) -> Generator[Draw]:
    """Open a renderer: with two or more workers one more process, which loads what it needs from now on."""
    if workers < 2:
        yield render_in_turn
        return
    with TemporaryDirectory(prefix="thermostand-drawn-") as folder, open_pool(1) as other:
        other.submit(_import_module)
        yield partial(_render_in_two_processes, other, folder)


def _render_in_two_processes(other: ProcessPoolExecutor, folder: str, figures: Sequence[Named]) -> list[str]:
    """This process from the first figure on, the other one from the last, until they meet."""
    given: dict[int, Future[str]] = {}
    with suppress(BrokenProcessPool):
        for number in range(len(figures) - 1, len(figures) // 3, -1):  # it never comes to the first third
            path = Path(folder) / str(number)
            path.write_bytes(pickle.dumps(figures[number]))
            given[number] = other.submit(_render_file, str(path))
    svgs = [render_svg(*figure) if n not in given or given[n].cancel() else "" for n, figure in enumerate(figures)]
    return [svg or _collect_answer(given[n], figures[n]) for n, svg in enumerate(svgs)]


def _collect_answer(given: Future[str], figure: Named) -> str:
    try:
        return Path(given.result()).read_text(encoding="utf-8")
    except BrokenProcessPool:  # the other process was killed
        return render_svg(*figure)


def _import_module() -> None:
    """This module is: to be called, it was imported."""


def _render_file(path: str) -> str:
    """The path of a file with the SVG of the figure in another one. Neither goes through the pool's pipes: of a process
    that is killed in the middle of either the pool would wait for the rest for ever."""
    done = Path(f"{path}.svg")
    done.write_text(render_svg(*pickle.loads(Path(path).read_bytes())), encoding="utf-8")
    return str(done)
