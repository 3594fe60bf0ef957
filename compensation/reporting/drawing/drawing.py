"""Figures as SVG text for a page, one after the other or by two processes; the same bytes.

Drawing is most of what a report takes once the markers are found, and the processes that found them have nothing to do
any more.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

from matplotlib.figure import Figure

from thermostand.compensation.finding.workers import pool
from thermostand.compensation.reporting.drawing.figures import as_svg

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
