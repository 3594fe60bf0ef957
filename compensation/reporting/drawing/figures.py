"""The look of all figures, and figures as SVG text: the same data give the same bytes.

Blue is I and orange J (Okabe and Ito, safe for the colour-blind); pale and open is before, full is after compensation.
"""

from __future__ import annotations

import io
import math
import pickle
import re
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.quiver import Quiver

from thermostand.compensation.finding.workers import pool
from thermostand.compensation.observations import Float

I_COLOUR, J_COLOUR = "#0072B2", "#D55E00"
CAMERA_COLOUR, GREY, WARM_UP_COLOUR = "#CC79A7", "#6b6b6b", "#F0E442"
SPOT_COLOURS = ("#009E73", "#E69F00", "#56B4E9")
COORDINATES = (("I", I_COLOUR), ("J", J_COLOUR))
PALE, ON_PALE = "#ececec", "#111111"
"""The ground of pictures, and ink on it: both stay as they are where a page is dark."""
FULL_WIDTH_IN = 7.4
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


def style() -> AbstractContextManager[None]:
    """The look of all figures."""
    return mpl.rc_context(_STYLE)  # pyright: ignore[reportArgumentType] - the keys are checked at run time


def as_svg(figure: Figure, name: str) -> str:
    """The figure as an <svg> element for a page; every id begins with `name`, so that several fit in one page."""
    text = io.StringIO()
    with style():
        figure.savefig(text, format="svg", dpi=_RASTER_DPI, metadata=_NO_METADATA)
    svg = re.sub(
        r' id="image[0-9a-f]+"', "", text.getvalue()
    )  # the same for the same picture, which may be there twice
    svg = re.sub(r'(\bid="|href="#|url\(#)', rf"\g<1>{name}-", svg)
    return svg[svg.index("<svg") :]


def new_figure(
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
        if share:
            panels[-1].label_outer()
    return figure, panels


def legend_above(axes: Axes, columns: int = 3) -> None:
    """A legend over the axes, where no data are."""
    shown = axes.legend(loc="lower left", bbox_to_anchor=(0, 1), ncols=columns, borderaxespad=0.2, handlelength=1.6)
    for handle in shown.legend_handles:
        if isinstance(handle, Line2D):
            handle.set(markersize=max(handle.get_markersize(), _LEGEND_MARKER), alpha=1)


def image_axes(axes: Axes, image_size: tuple[int, int]) -> None:
    """Those of an image (width, height), px."""
    width, height = image_size
    axes.set(xlabel="column I (px)", ylabel="row J (px)", xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))
    axes.set_aspect("equal")
    axes.grid(visible=False)


def arrows(
    axes: Axes, at_px: Float, moved_px: Float, image_size: tuple[int, int], *colours: Float, **look: Any
) -> Quiver:
    """Motions (M, 2) of places (M, 2) over the image, enlarged until the larger ones show; a bar says how much. colours
    (M,): a value of each. look: of the arrows."""
    width, height = image_size
    scale, bar_px = enlarged(float(np.quantile(np.linalg.norm(moved_px, axis=1), 0.95)), width)
    lengths = {"angles": "xy", "scale_units": "xy", "scale": 1}
    drawn = axes.quiver(*at_px.T, *(scale * moved_px).T, *colours, **lengths, **look)
    drawn.set_rasterized(True)
    image_axes(axes, image_size)
    x, y = 0.03 * width, 0.965 * height
    axes.plot([x, x + scale * bar_px], [y, y], color=ON_PALE, linewidth=2, solid_capstyle="butt")
    text = f"{1e3 * bar_px:g} mpx, {scale:,.0f} times"
    axes.text(x + scale * bar_px + 0.01 * width, y, text, va="center", fontsize=8, color=ON_PALE)
    return drawn


def enlarged(long_px: float, width: int) -> tuple[float, float]:
    """By how much an arrow of this length is drawn longer, a round number, and a round length for the bar beside it."""
    wanted = _LONGEST_ARROW * width / max(long_px, 1e-9)
    power = 10 ** math.floor(math.log10(wanted))
    scale = next(step * power for step in (5, 2, 1) if step * power <= wanted)
    return scale, 10 ** math.floor(math.log10(0.1 * width / scale))


# Figures as SVG text for a page, one after the other or by two processes; the same bytes.
#
# Drawing is most of what a report takes once the markers are found, and the processes that found them have nothing to
# do any more.

Named = tuple[Figure, str]
Draw = Callable[[Sequence[Named]], list[str]]
"""Figures with the names that their ids begin with -> the SVG of each."""


def one_by_one(figures: Sequence[Named]) -> list[str]:
    """In this process."""
    return [as_svg(figure, name) for figure, name in figures]


@contextmanager
def drawing(workers: int) -> Generator[Draw]:
    """With two or more workers one process more, which loads what it needs from now on."""
    if workers < 2:
        yield one_by_one
        return
    with TemporaryDirectory(prefix="thermostand-drawn-") as folder, pool(1) as other:
        other.submit(_loaded)
        yield partial(_by_two, other, folder)


def _by_two(other: ProcessPoolExecutor, folder: str, figures: Sequence[Named]) -> list[str]:
    """This process from the first figure on, the other one from the last, until they meet."""
    given: dict[int, Future[str]] = {}
    with suppress(BrokenProcessPool):
        for number in range(len(figures) - 1, len(figures) // 3, -1):  # it never comes to the first third
            path = Path(folder) / str(number)
            path.write_bytes(pickle.dumps(figures[number]))
            given[number] = other.submit(_drawn_file, str(path))
    svgs = [as_svg(*figure) if n not in given or given[n].cancel() else "" for n, figure in enumerate(figures)]
    return [svg or _answer(given[n], figures[n]) for n, svg in enumerate(svgs)]


def _answer(given: Future[str], figure: Named) -> str:
    try:
        return Path(given.result()).read_text(encoding="utf-8")
    except BrokenProcessPool:  # the other process was killed
        return as_svg(*figure)


def _loaded() -> None:
    """This module is: to be called, it was imported."""


def _drawn_file(path: str) -> str:
    """The path of a file with the SVG of the figure in another one. Neither goes through the pool's pipes: of a process
    that is killed in the middle of either the pool would wait for the rest for ever."""
    done = Path(f"{path}.svg")
    done.write_text(as_svg(*pickle.loads(Path(path).read_bytes())), encoding="utf-8")
    return str(done)
