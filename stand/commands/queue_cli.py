"""The `stand queue` commands: what is to be run, one after another, through the nights."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from thermostand.foundation.clock import WallClock
from thermostand.foundation.command_app import App, with_parameters
from thermostand.foundation.errors import ConfigError, Interrupted, InUse, SessionError, StandError, StandTripped
from thermostand.foundation.exit_codes import INTERRUPTED
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import date_time, duration
from thermostand.foundation.output import say, show
from thermostand.foundation.usage import one_line
from thermostand.stand.commands.reached import OPTIONS, ConfigOption, RecipeArgument
from thermostand.stand.commands.submitted import submit_recipe
from thermostand.stand.commissioning.answering import not_answering
from thermostand.stand.config.stand_config import StandConfig, load_config, packaged
from thermostand.stand.estimating.learned import learn
from thermostand.stand.estimating.run_estimate import price_night, small_disk
from thermostand.stand.queueing import queue
from thermostand.stand.queueing.queue_file import Entry
from thermostand.stand.queueing.queue_work import Halt, Notes, Watch, interruption_of, is_complete, work
from thermostand.stand.run import resume, run_real, run_virtual
from thermostand.stand.running.order import load_order
from thermostand.stand.running.resume import is_of_virtual_time
from thermostand.stand.running.session_report import NotReported, check_reportable, report_session
from thermostand.stand.serving.client import API, Server, server_at
from thermostand.stand.serving.desk import QueuedRun
from thermostand.stand.serving.presence import living
from thermostand.stand.watching.live import followed

# Where a queue is: with the daemon that works on it, else in the files of its folder.

OutOption = Annotated[
    Path | None, typer.Option("--out", help="Where the queue is and its sessions go; else recording.directory.")
]


class DaemonDoor:
    """Through the daemon, which checks wires, identities, the disk and its limits when it is given a run. ConfigError
    and SessionError say what is wrong."""

    def __init__(self, server: Server) -> None:
        self.name = server.name
        self._server = server

    def add(self, recipe: str) -> int:
        """Its number; checked before as far as can be."""
        return submit_recipe(self._server, recipe).id

    def runs(self) -> tuple[str, list[Entry | QueuedRun]]:
        """Why it is halted, "" when it is not, and the runs."""
        state = self._server.state()
        return state.queue_halted, list(state.queue)

    def move(self, number: int, position: int) -> None:
        """1 is the next to be run."""
        self._server.request("POST", f"{API}/queue/{number}/move", {"to": position})

    def remove(self, number: int) -> None:
        """What it has recorded stays."""
        self._server.request("DELETE", f"{API}/queue/{number}")


class FileDoor:
    """The queue of a folder that no daemon has: limits, the disk and, of a real stand, wires and identities are checked
    here. A simulated one may be run in virtual time, on a laboratory of its own, and is not asked."""

    def __init__(self, directory: Path, config: str) -> None:
        self.name = str(directory)
        self._directory, self._config = directory, config

    def add(self, recipe: str) -> int:
        """As DaemonDoor."""
        order = load_order(recipe, self._config)
        night = price_night(tuple(order.recipe.plan()), order.config, self._directory)
        if lack := small_disk(self._directory, night.steps, order.config):
            raise SessionError(f"{self._directory}: {lack}")
        if order.config.simulation is None:
            self._check_wires(order.config)
        return queue.add(self._directory, order, self._config, WallClock().now_ns()).id

    def _check_wires(self, config: StandConfig) -> None:
        """SessionError for what keeps the run from beginning; that a stand is busy is shown, and keeps it from nothing:
        what is queued has its turn later."""
        try:
            lacks = asyncio.run(not_answering(config))
        except InUse as error:
            say(f"warning: queued without asking the devices: {error}")
            return
        if lacks:
            raise SessionError(f"this stand cannot run it now, and nothing was queued: {'; '.join(lacks)}")

    def runs(self) -> tuple[str, list[Entry | QueuedRun]]:
        """As DaemonDoor."""
        found = queue.queued(self._directory)
        return found.halted, list(found.entries)

    def move(self, number: int, position: int) -> None:
        """As DaemonDoor."""
        queue.move(self._directory, number, position)

    def remove(self, number: int) -> None:
        """As DaemonDoor."""
        queue.remove(self._directory, number)


Door = DaemonDoor | FileDoor


def door(config: str, out: Path | None, url: str, token_file: Path | None) -> Door:
    """The daemon at `url`; else the one of this machine that works on the queue of that folder; else its files."""
    if url:
        if out is not None:
            raise ConfigError(f"--out {out}: the stand at {url} has its own folder")
        return DaemonDoor(server_at(url, token_file))
    directory = directory_of(config, out)
    known = {str(directory.absolute()), str(directory.resolve())}
    found = next((each for each in living() if known & {each.entry.session, each.entry.real_path}), None)
    return FileDoor(directory, config) if found is None else DaemonDoor(Server(found.entry.session, found.socket))


def directory_of(config: str, out: Path | None) -> Path:
    """Where a queue and its sessions are."""
    return out or load_config(packaged("", config)).recording.directory


def at_door(function: Callable[..., None]) -> Callable[..., None]:
    """A command whose first parameter is the Door it goes through: what finds that is taken from the command line."""

    def command(*arguments: Any, config: str, out: Path | None, url: str, token_file: Path | None, **more: Any) -> None:
        function(door(config, out, url, token_file), *arguments, **more)

    command.__name__, command.__doc__ = function.__name__, function.__doc__
    return with_parameters(command, function, {"out": (OutOption, None), **OPTIONS}, without="door")


app = App(
    no_args_is_help=True,
    help="A queue of runs: add, list, move, remove, start.\n\nExample: stand queue add thermal-cycle",
)

RunArgument = Annotated[int, typer.Argument(metavar="ID", help="The run's number in `stand queue list`.")]

_OPEN = ("waiting", "interrupted")
_COLUMNS = ("id", "next", "recipe", "state", "added (local)", "took", "session", "reason")


@app.command()
@at_door
def add(
    door: Door,
    recipe: RecipeArgument,
) -> None:
    """Check a recipe and queue it as it is now: later edits of the files do not change it. Prints its number.

    Its limits and the room on the disk are checked, and that every device of the stand answers and is the right one;
    nothing is written to any. While another program has the stand the devices are not asked, and that is said.

    Example: stand queue add thermal-cycle --config laboratory.yaml --out /data/sessions
    """
    number = door.add(recipe)
    show({"id": number}, [number])


@app.command("list")
@at_door
def list_runs(door: Door) -> None:
    """The runs in the queue: what has ended, what is running, what comes next.

    Example: stand queue list --out /data/sessions
    """
    halted, runs = door.runs()
    show(_as_json(halted, runs), queue_lines(runs) if runs else ())
    if not runs:
        say(f"{door.name}: nothing is queued there")
    if halted:
        clear = "`stand clear`" if isinstance(door, DaemonDoor) else "`stand queue start --clear`"
        say(f"halted by {halted}; remove the cause, then {clear}")


@app.command()
@at_door
def move(
    door: Door,
    number: RunArgument,
    position: Annotated[int, typer.Argument(help="1 is the next to be run.")],
) -> None:
    """Change when a run that is still to be done has its turn.

    Example: stand queue move 5 1
    """
    door.move(number, position)
    show({"id": number, "position": position}, ())


@app.command()
@at_door
def remove(door: Door, number: RunArgument) -> None:
    """Take a run out of the queue; what it has recorded stays.

    Example: stand queue remove 5
    """
    door.remove(number)
    show({"id": number}, ())


@app.command()
def start(
    config: ConfigOption = "simulated",
    out: OutOption = None,
    virtual_time: Annotated[
        bool, typer.Option("--virtual-time", help="As fast as it goes, each with a simulated laboratory of its own.")
    ] = False,
    clear: Annotated[
        bool, typer.Option("--clear", help="Clear a trip first; only when its cause has been removed.")
    ] = False,
    report: Annotated[bool, typer.Option("--report", help="As of `stand run`, after each run with a drift.")] = False,
) -> None:
    """Run what is queued, one after another, until nothing is left; what was interrupted is resumed first.

    Example: stand queue start --out /data/sessions
    """
    directory = directory_of(config, out)
    if not queue.queued(directory).entries:
        show(_as_json("", ()), ())
        say(f"{directory}: nothing is queued there")
        return
    if clear:
        queue.clear(directory)

    async def run_one(entry: Entry, notes: Notes) -> Path:
        session = await run_entry(directory, entry, notes, virtual_time=virtual_time)
        await asyncio.to_thread(conclude, entry, session, say, report=report)
        return session

    try:
        asyncio.run(work(directory, run_one, WallClock(), say))
    except Interrupted as error:
        raise typer.Exit(INTERRUPTED) from error  # its end has been reported
    finally:
        left = queue.queued(directory)
        show(_as_json(left.halted, left.entries), ())


def _as_json(halted: str, runs: Sequence[Entry | QueuedRun]) -> dict[str, object]:
    """Of `list`, and of `start` when it is over."""
    texts = {"config_text", "recipe_text", "target_text"}
    return {"halted": halted, "runs": [run.model_dump(mode="json", exclude=texts) for run in runs]}


def queue_lines(runs: Sequence[Entry | QueuedRun]) -> list[str]:
    """`stand queue list`: a line for each run, under their headings."""
    turns = {run.id: turn for turn, run in enumerate((each for each in runs if each.state in _OPEN), 1)}
    rows = [_COLUMNS, *(_cells(run, turns.get(run.id)) for run in runs)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _cells(entry: Entry | QueuedRun, turn: int | None) -> tuple[str, ...]:
    took = "" if entry.began_ns is None or entry.ended_ns is None else duration(entry.ended_ns - entry.began_ns)
    return (
        str(entry.id),
        "" if turn is None else str(turn),
        one_line(entry.recipe),
        entry.state,
        date_time(entry.added_ns),
        took,
        one_line(entry.session),
        one_line(entry.reason),
    )


async def run_entry(directory: Path, entry: Entry, notes: Notes, *, virtual_time: bool) -> Path:
    """Run `entry` into a session below `directory`, or resume the one it has; it is shown while it runs.

    Returns the session's folder. Halt when an interrupted run cannot be resumed, or one that failed has left the stand
    not confirmed safe; else raises as a run does.
    """
    session = directory / entry.session if entry.session else None
    if session is not None and await asyncio.to_thread(is_complete, session):
        return session  # killed between its end and the note of it
    order = queue.order_of(entry)
    before = None if session is None else await asyncio.to_thread(interruption_of, session, order.config)
    night = price_night(tuple(order.recipe.plan()) if before is None else before.state.plan, order.config, directory)
    watch = Watch(frozenset() if before is None else before.kept.done, notes.step_done)
    try:
        is_virtual = virtual_time or is_of_virtual_time(before)
        with followed(order, night, directory, is_virtual=is_virtual, before=before) as show:

            def subscribe(hub: Hub) -> None:
                show(hub)
                hub.subscribe(watch)

            if before is not None:
                return await resume(before, subscribe)
            if virtual_time:
                return await run_virtual(order, directory, None, subscribe, notes.begun)
            return await run_real(order, directory, subscribe, notes.begun)
    except (Interrupted, StandTripped):
        raise
    except StandError as error:
        if watch.unsafe:
            raise Halt(f"{error}; NOT SAFE: {'; '.join(watch.unsafe)}") from error
        raise


def conclude(entry: Entry, session: Path, tell: Callable[[str], None], *, report: bool) -> None:
    """What follows a complete run, which none of it makes fail: what it teaches about durations is kept for the next,
    and with `report` the drift is fitted and reported in the session's folder, when the recipe has any. Takes a minute.
    """
    order = queue.order_of(entry)
    try:
        learn(session.parent, order.config)
    except (SessionError, OSError) as error:
        tell(f"warning: {error}")
    if not report:
        return
    try:
        check_reportable(order.recipe.plan())
        for line in report_session(session, session).lines:
            tell(line)
    except (ConfigError, NotReported) as error:
        tell(f"{session.name}: {error}")
    except Exception as error:  # noqa: BLE001 - a fit that fails must not end the queue
        tell(f"{session.name}: is recorded, but not reported: {type(error).__name__}: {error}")
