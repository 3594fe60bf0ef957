"""Where a run is shown: a panel that stays at the foot of a terminal, with messages above it; elsewhere, lines."""

from __future__ import annotations

import queue
import sys
import threading
from collections.abc import AsyncGenerator, Callable, Generator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import ParamSpec

import typer
from rich.console import Console
from rich.live import Live
from rich.panel import Panel
from rich.text import Text

from thermostand.foundation.clock import NS_PER_S, Now, WallClock, to_ns, utc_offset_ns
from thermostand.foundation.events import RUN_BEGINS
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import format_duration, format_local
from thermostand.foundation.items import Batch, Event, Item, StepMark
from thermostand.foundation.output import get_output
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.status_snapshot import StatusSnapshot, format_event, make_snapshot
from thermostand.stand.estimating.run_estimate import PlanEstimate
from thermostand.stand.safety.gate import HELD, RELEASED
from thermostand.stand.service.run import Front, serve_by_socket
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api.listeners import Interface
from thermostand.stand.serving.commands import Served
from thermostand.stand.serving.interface import serve_interface

# Output for people, written by a thread of its own: a terminal or a log that blocks delays nothing else.

_MOST_WAITING = 1000  # what comes while so much waits is not shown; it is recorded all the same
_FAREWELL_S = 2.0  # real seconds for what still waits at the end

CallArgs = ParamSpec("CallArgs")


class BackgroundOutput:
    """Makes calls in their order, in a thread that never keeps the process from ending."""

    def __init__(self) -> None:
        self._waiting: queue.Queue[Callable[[], object] | None] = queue.Queue(_MOST_WAITING)
        self._thread = threading.Thread(target=self._show, name="output", daemon=True)
        self._thread.start()

    def __call__(self, show: Callable[CallArgs, object]) -> Callable[CallArgs, None]:
        """`show`, made later: its caller never waits."""

        def later(*args: CallArgs.args, **options: CallArgs.kwargs) -> None:
            with suppress(queue.Full):
                self._waiting.put_nowait(partial(show, *args, **options))

        return later

    def close(self) -> None:
        """Show what still waits, as far as that goes."""
        with suppress(queue.Full):
            self._waiting.put_nowait(None)
            self._thread.join(_FAREWELL_S)

    def _show(self) -> None:
        while (show := self._waiting.get()) is not None:
            with suppress(OSError):  # a terminal that is gone
                show()


@contextmanager
def open_background_output() -> Generator[BackgroundOutput]:
    """Run the block with a thread that prints; what is printed in it never waits for the terminal."""
    shown = BackgroundOutput()
    try:
        yield shown
    finally:
        shown.close()


# A moment of a run as text: a panel of a few lines on a terminal, one line elsewhere.

_BAR = 24


def format_panel(moment: StatusSnapshot) -> list[str]:
    """Return what stands in the panel, a line for each question: what, how warm, what has been seen, how long."""
    lines = [
        _format_step(moment),
        "   ".join(_format_temperatures(moment)),
        "   ".join(_format_recorded(moment)),
        _format_progress(moment),
    ]
    return [escape_line(line) for line in lines if line]


def format_line(moment: StatusSnapshot) -> str:
    """The same in one line, for a log."""
    parts = [
        _format_step(moment),
        ", ".join(_format_temperatures(moment)),
        ", ".join(_format_recorded(moment)),
        _format_end_time(moment),
    ]
    share = "" if moment.share is None else f"{moment.share:4.0%}  "
    return escape_line(f"run: {share}{format_local(moment.now_ns)[:16]}  {'; '.join(part for part in parts if part)}")


def _format_step(moment: StatusSnapshot) -> str:
    number = f"step {moment.step} of {moment.steps}: " if moment.steps else ""
    return f"{number}{moment.doing}" + (f" ({moment.held})" if moment.held else "")


def _format_temperatures(moment: StatusSnapshot) -> list[str]:
    named = (("set", moment.setpoint_degC), ("air", moment.air_degC), ("camera", moment.camera_degC))
    return [f"{name} {'–' if value is None else f'{value:.2f} °C'}" for name, value in named]


def _format_recorded(moment: StatusSnapshot) -> list[str]:
    planned = moment.frames_planned
    of = f" of {planned}" if planned is not None and planned >= moment.frames else ""
    parts = [f"frames {moment.frames}{of}"] if moment.steps else []
    if moment.frames_lost:
        parts.append(f"{moment.frames_lost} LOST")
    if moment.drift_px is not None:
        parts.append(f"drift {moment.drift_px:.3f} px")
    if moment.disk_free_bytes is not None:
        parts.append(f"disk {moment.disk_free_bytes / 1e9:.1f} GB free")
    return parts


def _format_end_time(moment: StatusSnapshot) -> str:
    if moment.end_ns is None:
        return ""
    within = "" if moment.end_within_s is None else f" ± {_format_minutes(moment.end_within_s)}"
    left = format_duration(max(0, moment.end_ns - moment.now_ns))
    zone = format_local(moment.end_ns)[19:]
    return f"ends {format_local(moment.end_ns)[:16]}{zone}{within} (in {left})"


def _format_progress(moment: StatusSnapshot) -> str:
    if moment.share is None:
        return _format_end_time(moment)
    done = round(_BAR * moment.share)
    return f"{'━' * done}{'╌' * (_BAR - done)} {moment.share:.0%}   {_format_end_time(moment)}"


def _format_minutes(duration_s: float) -> str:
    minutes = round(duration_s / 60.0)
    return f"{minutes} min" if minutes < 120 else f"{minutes / 60.0:.1f} h"


_BETWEEN_PANELS_NS = NS_PER_S // 4  # what an eye follows
_BETWEEN_LINES_NS = 60 * NS_PER_S  # of a log that somebody reads later
_TENTH = 0.1  # of a run in virtual time, whose minutes are none
_LEAST_S = 1.0  # of stand time between two reports, or a thousandth of the run: terminals are slow
_SHARE = 1e-3  # as stated for _LEAST_S


@contextmanager
def open_view(*, is_virtual: bool = False) -> Generator[View]:
    """Show the run on standard error while inside. Of a run in virtual time a line comes at each tenth instead of each
    minute."""
    if get_output().quiet:
        yield Silent()
    elif not sys.stderr.isatty():
        yield PlainLines(WallClock(), is_virtual=is_virtual)
    else:
        with _open_panel(WallClock()) as foot:
            yield foot


class RunFollower:
    """Shows a run of this process, as its service reports: messages from its hub, from the first on, and how it stands
    from the moment on at which it answers. show, tell: make a View's calls, and keep nobody waiting."""

    def __init__(
        self,
        show: Callable[[StatusSnapshot], None],
        tell: Callable[[str], None],
        sessions: Path,
        run_s: float = 0.0,
        *,
        tells_all: bool = False,
    ) -> None:
        self._show, self._tell, self._tells_all, self._sessions = show, tell, tells_all, sessions
        self._least_ns = to_ns(max(_LEAST_S, _SHARE * run_s))
        self._service: Served | None = None
        self._drift_px: Callable[[], float | None] = lambda: None
        self._session = ""
        self._next_ns = 0

    def watch(self, hub: Hub) -> None:
        """Watch from before the run begins."""
        hub.subscribe(self._follow)

    @asynccontextmanager
    async def follow_service(self, service: StandService, session: Path) -> AsyncGenerator[None]:
        """Follow the service of a run in virtual time. No frame is looked at for its drift: that would take longer than
        the run."""
        async with serve_by_socket(service, session):
            self._service = service
            yield

    def make_front(self, interface: Interface, target_text: str) -> Front:
        """Make the interface of a run on the host's clock: all that the stand's file asks for."""

        @asynccontextmanager
        async def answering(service: StandService, session: Path) -> AsyncGenerator[None]:
            async with serve_interface(
                service, session, service.stand, interface, target_text, service.shutdown_deadline
            ) as viewing:
                self._drift_px = viewing.drift_px
                self._service = service
                yield

        return answering

    def _follow(self, item: Item) -> None:
        match item:
            case Event():
                self._show_event(item)
            case StepMark():
                self._next_ns = item.time_ns
            case Batch() if self._service is not None and item.time_ns >= self._next_ns:
                self._next_ns = item.time_ns + self._least_ns
                self._show(make_snapshot(self._service.state(), self._drift_px()))
            case _:
                pass

    def _show_event(self, event: Event) -> None:
        if event.kind in RUN_BEGINS:
            self._session = str(self._sessions / str(event.data.get("session")))
        if event.kind in (HELD, RELEASED):
            self._next_ns = event.time_ns
        if event.level != "info" or self._tells_all:
            offset_ns = 0 if self._service is None else utc_offset_ns(self._service.clock)
            self._tell(format_event({**asdict(event), "utc_offset_ns": offset_ns}, self._session))


@contextmanager
def follow_run(estimate: PlanEstimate, sessions: Path, *, is_virtual: bool) -> Generator[RunFollower]:
    """What shows a run of this process while inside, by a thread of its own, for which the run never waits. sessions:
    the folder of its session's."""
    with open_view(is_virtual=is_virtual) as shown, open_background_output() as later:
        yield RunFollower(
            later(shown.show), later(shown.tell), sessions, estimate.duration_s, tells_all=get_output().verbose
        )


class Silent:
    """Errors only."""

    def show(self, moment: StatusSnapshot) -> None:
        """Show nothing."""

    def tell(self, line: str) -> None:
        """An error at once."""
        if line.startswith("error"):
            typer.echo(escape_line(line), err=True)


class PlainLines:
    """The view for a file or a pipe: a line when the run begins, and then each minute, or at each tenth in virtual
    time."""

    def __init__(self, clock: Now, *, is_virtual: bool) -> None:
        self._clock = clock
        self._is_virtual = is_virtual
        self._next_ns = 0
        self._next_share = _TENTH

    def show(self, moment: StatusSnapshot) -> None:
        """Print a line of the state when one is due."""
        if self._is_virtual:
            share = moment.share or 0.0
            if share + 1e-9 < self._next_share:
                return
            while self._next_share <= share + 1e-9:
                self._next_share += _TENTH
        else:
            now_ns = self._clock.now_ns()
            if now_ns < self._next_ns:
                return
            self._next_ns = now_ns + _BETWEEN_LINES_NS
        typer.echo(format_line(moment), err=True)

    def tell(self, line: str) -> None:
        """Print the text at once."""
        typer.echo(escape_line(line), err=True)


class TerminalPanel:
    """The panel at the foot of a terminal; its last moment stays there when it ends."""

    def __init__(self, live: Live, clock: Now) -> None:
        self._live = live
        self._clock = clock
        self._next_ns = 0
        self._last: StatusSnapshot | None = None

    def show(self, moment: StatusSnapshot) -> None:
        """Draw the panel, four times a second at the most."""
        self._last = moment
        if (now_ns := self._clock.now_ns()) >= self._next_ns:
            self._next_ns = now_ns + _BETWEEN_PANELS_NS
            self.draw()

    def draw(self) -> None:
        """Draw the view now."""
        if self._last is None:
            return
        text = Text("\n".join(format_panel(self._last)), no_wrap=True, overflow="ellipsis")
        title, style = Text(escape_line(self._last.title)), "yellow" if self._last.held else "none"
        self._live.update(Panel(text, title=title, title_align="left", border_style=style), refresh=True)

    def tell(self, line: str) -> None:
        """Print a line above the panel."""
        style = "red" if line.startswith("error") else "yellow" if line.startswith("warning") else ""
        self._live.console.print(Text(escape_line(line), style=style), soft_wrap=True)


View = Silent | PlainLines | TerminalPanel  # each shows moments as often as it likes, and every message at once


@contextmanager
def _open_panel(clock: Now) -> Generator[TerminalPanel]:
    console = Console(stderr=True, highlight=False)
    with Live(console=console, auto_refresh=False, redirect_stdout=False) as live:
        foot = TerminalPanel(live, clock)
        yield foot
        foot.draw()
