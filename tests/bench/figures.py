"""A figure, the peer or limit it is held against, and how the two are measured side by side.

The machine may be busy, so no figure is a pass or a fail on seconds: ours and the peer take turns (A B, B A, A B ...),
and what counts is the median of the ratios of neighbours, with the quartiles that show how steady it was.
"""

from __future__ import annotations

import math
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from thermostand.drivers.framing.aravis_library import load_library
from thermostand.foundation.errors import StandError

Measurement = Callable[[], float]


@dataclass(frozen=True, slots=True)
class Figure:
    """One line of the table: `value` in `unit`, the same of `peer`, and value over peer value (quartiles).

    Without a peer it is an absolute figure of this machine, for information only; a skipped one has no value either.
    """

    what: str
    unit: str
    value: float = math.nan
    peer: str = ""
    peer_value: float = math.nan
    ratios: tuple[float, float, float] | None = None
    goal: str = ""


def set_upper_goal(limit: float, figure: Figure) -> Figure:
    """The figure with its goal: its value is not above `limit`."""
    return replace(figure, goal=f"<= {limit:g} {_format_verdict(figure.value <= limit)}")


def set_lower_goal(limit: float, figure: Figure) -> Figure:
    """The figure with its goal: its value is not below `limit`."""
    return replace(figure, goal=f">= {limit:g} {_format_verdict(figure.value >= limit)}")


def set_lower_ratio_goal(limit: float, figure: Figure) -> Figure:
    """The figure with its goal: the median of its ratios is not below `limit`."""
    ratio = math.nan if figure.ratios is None else figure.ratios[1]
    return replace(figure, goal=f"ratio >= {limit:g} {_format_verdict(ratio >= limit)}")


def set_upper_ratio_goal(limit: float, figure: Figure) -> Figure:
    """The figure with its goal: the median of its ratios is not above `limit`."""
    ratio = math.nan if figure.ratios is None else figure.ratios[1]
    return replace(figure, goal=f"ratio <= {limit:g} {_format_verdict(ratio <= limit)}")


def _format_verdict(is_met: bool) -> str:
    return "met" if is_met else "MISSED"


def make_absolute(what: str, unit: str, values: Sequence[float]) -> Figure:
    """The median of `values`, with nothing to hold it against."""
    return Figure(what, unit, statistics.median(values), "absolute, this machine now")


def make_skipped(what: str, reason: object) -> Figure:
    """A line for what could not be measured here."""
    return Figure(what, "", peer=f"skipped: {' '.join(str(reason).split())[:60]}")


def compare(what: str, unit: str, peer: str, ours: Sequence[float], others: Sequence[float]) -> Figure:
    """Medians, and quartiles of the ratios, of measurements made in pairs."""
    ratios = [own / other for own, other in zip(ours, others, strict=True)]
    low, middle, high = statistics.quantiles(ratios, n=4, method="inclusive") if len(ratios) > 1 else ratios * 3
    return Figure(what, unit, statistics.median(ours), peer, statistics.median(others), (low, middle, high))


def measure_in_turns(ours: Measurement, other: Measurement, rounds: int) -> tuple[list[float], list[float]]:
    """`rounds` measurements of each, after one of each that does not count; the order changes every round."""
    ours()
    other()
    own_values: list[float] = []
    other_values: list[float] = []
    for number in range(rounds):
        if number % 2:
            other_values.append(other())
            own_values.append(ours())
        else:
            own_values.append(ours())
            other_values.append(other())
    return own_values, other_values


def measure_per_second(work: Callable[[], object], count: int) -> float:
    """How often a second `work` is done, over `count` times."""
    begin_s = time.perf_counter()
    for _ in range(count):
        work()
    return count / (time.perf_counter() - begin_s)


def measure_milliseconds(work: Callable[[], object]) -> float:
    """How long `work` takes once, ms."""
    return 1e3 / measure_per_second(work, 1)


def measure_processor_ms(work: Callable[[], object]) -> float:
    """What `work` takes of one core once, ms; other programs on the machine do not count."""
    begin_s = time.thread_time()
    work()
    return 1e3 * (time.thread_time() - begin_s)


def measure_process_ms(*words: str | Path) -> float:
    """How long a process of Python's takes, from its start to its end, ms."""
    command = [sys.executable, *map(str, words)]
    return measure_milliseconds(lambda: subprocess.run(command, stdout=subprocess.DEVNULL, check=True))


class Missing(Exception):
    """What a benchmark needs is not here; the table says so."""


def require_aravis() -> None:
    """Missing without the library that drives cameras."""
    try:
        load_library()
    except StandError as error:
        raise Missing(str(error)) from error


def report_progress(text: str) -> None:
    """A line on stderr, so that somebody who waits knows for what."""
    sys.stderr.write(f"  {text}\n")
    sys.stderr.flush()


def format_table(figures: Sequence[Figure]) -> str:
    """All figures, aligned; ratio is ours over the peer's, with the quartiles behind it."""
    rows = [
        ("measured", "ours", "peer's", "unit", "ratio", "quartiles", "goal", "peer or limit"),
        *map(_format_row, figures),
    ]
    widths = [max(len(row[column]) for row in rows) for column in range(len(rows[0]))]
    aligned = (str.ljust, str.rjust, str.rjust, str.ljust, str.rjust, str.rjust, str.ljust, str.ljust)
    lines = [
        "  ".join(align(cell, width) for align, cell, width in zip(aligned, row, widths, strict=True)) for row in rows
    ]
    lines.insert(1, "  ".join("-" * width for width in widths))
    return "\n".join(line.rstrip() for line in lines) + "\n"


def _format_row(figure: Figure) -> tuple[str, ...]:
    if figure.ratios is None:
        return (figure.what, _format_number(figure.value), "", figure.unit, "", "", figure.goal, figure.peer)
    low, middle, high = figure.ratios
    quartiles = f"{low:.2g}..{high:.2g}"
    return (
        figure.what,
        _format_number(figure.value),
        _format_number(figure.peer_value),
        figure.unit,
        f"{middle:.3g}",
        quartiles,
        figure.goal,
        figure.peer,
    )


def _format_number(value: float) -> str:
    """Three significant digits, no exponent."""
    if math.isnan(value):
        return ""
    digits = max(0, 2 - math.floor(math.log10(abs(value)))) if value else 0
    return f"{value:.{digits}f}"
