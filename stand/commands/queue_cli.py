"""The `stand queue` commands: what is to be run, one after another, through the nights."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer

from thermostand.foundation.clock import WallClock
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import Interrupted
from thermostand.foundation.exit_codes import INTERRUPTED
from thermostand.foundation.instants import date_time, duration
from thermostand.foundation.output import say, show
from thermostand.foundation.usage import one_line
from thermostand.stand.commands.queue_door import DaemonDoor, Door, OutOption, at_door, directory_of
from thermostand.stand.commands.reached import ConfigOption, RecipeArgument
from thermostand.stand.queueing import queue
from thermostand.stand.queueing.queue_file import Entry
from thermostand.stand.queueing.queue_run import conclude, run_entry
from thermostand.stand.queueing.queue_work import Notes, work
from thermostand.stand.serving.desk import QueuedRun

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
