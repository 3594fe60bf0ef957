"""Progress of long work: a bar with the time left on a terminal, plain lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Generator
from contextlib import ExitStack, contextmanager
from datetime import timedelta
from typing import Protocol

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TextColumn, TimeElapsedColumn
from rich.text import Text

from thermostand.foundation.clock import NS_PER_S, WallClock
from thermostand.foundation.output import get_output

# Plain output: a line each time this share of the work is done, so that a log stays readable.
_PLAIN_STEP = 0.1
_LATE_NS = 3 * NS_PER_S  # work that is done sooner needs no bar; round number, nothing was measured


class Report(Protocol):
    """Called with the work done so far (same unit as the total) and what is being done now."""

    def __call__(self, done: float, text: str) -> None:
        """Show it."""
        ...


@contextmanager
def progress(title: str, total: float) -> Generator[Report]:
    """Show progress on standard error while inside.

    Parameters
    ----------
    title
        What goes on.
    total
        How much there is to do, in any unit.

    Yields
    ------
    Report
        Is called with how much is done, in that unit, and a text.
    """
    if get_output().quiet:
        yield lambda done, text: None
    elif sys.stderr.isatty():
        with _show_bar(title, total) as report:
            yield report
    else:
        yield _PlainLines(title, total)


@contextmanager
def hide_progress(title: str, total: float) -> Generator[Report]:
    """Take progress as `progress` does, but show nothing."""
    yield lambda done, text: None


@contextmanager
def show_late_progress(title: str, total: float) -> Generator[Report]:
    """Show progress as `progress` does, but only once the work has taken a while."""
    if get_output().quiet:
        yield lambda done, text: None
        return
    with ExitStack() as stack:
        yield _LateProgress(title, total, stack)


class _LateProgress:
    def __init__(self, title: str, total: float, stack: ExitStack) -> None:
        self._title = title
        self._total = total
        self._stack = stack
        self._plain = _PlainLines(title, total, first=0.0)
        self._clock = WallClock()
        self._start_ns = self._clock.now_ns()
        self._report: Report | None = None

    def __call__(self, done: float, text: str) -> None:
        if self._report is None:
            if self._clock.now_ns() - self._start_ns < _LATE_NS:
                return
            is_seen = sys.stderr.isatty()
            self._report = self._stack.enter_context(_show_bar(self._title, self._total)) if is_seen else self._plain
        self._report(done, text)


@contextmanager
def _show_bar(title: str, total: float) -> Generator[Report]:
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        _WallTimeLeft(),
        TextColumn("{task.fields[now]}"),
    )
    with Progress(*columns, console=Console(stderr=True), transient=False) as bar:
        task = bar.add_task(title, total=max(total, 1e-9), now="")

        def report(done: float, text: str) -> None:
            bar.update(task, completed=done, now=text)

        yield report
        bar.update(task, completed=max(total, 1e-9), now="")


class _WallTimeLeft(ProgressColumn):
    """The time left as the plain lines have it, from the pace of the whole; Rich's own looks back 30 s and is blank in
    a soak."""

    def render(self, task: Task) -> Text:
        return Text(_format_time_left(task.elapsed or 0.0, task.percentage / 100.0), style="progress.remaining")


def _format_time_left(elapsed_s: float, share: float) -> str:
    """Wall time left at the pace so far; unknown before anything is done."""
    if share <= 0.0:
        return "-:--:--"
    return str(timedelta(seconds=round(max(0.0, elapsed_s * (1.0 / share - 1.0)))))


class _PlainLines:
    """A line at the share `first`, and each time another tenth is done."""

    def __init__(self, title: str, total: float, first: float = _PLAIN_STEP) -> None:
        self._title = title
        self._total = max(total, 1e-9)
        self._next = first
        self._clock = WallClock()
        self._start_ns = self._clock.now_ns()

    def __call__(self, done: float, text: str) -> None:
        share = done / self._total
        if share + 1e-9 < self._next:
            return
        while self._next <= share + 1e-9:
            self._next += _PLAIN_STEP
        elapsed_s = (self._clock.now_ns() - self._start_ns) / NS_PER_S
        left = _format_time_left(elapsed_s, share)
        print(f"{self._title}: {min(share, 1.0):4.0%}  {left} left  {text}", file=sys.stderr, flush=True)  # noqa: T201
