"""The `stand queue` commands: what is to be run, one after another, through the nights."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import typer

from foundation.clock import WallClock
from foundation.command_app import App
from foundation.exit_codes import INTERRUPTED, one_line_errors
from foundation.instants import date_time, duration
from foundation.output import say, show
from foundation.usage import one_line
from stand.config.stand_config import load_config, packaged
from stand.queueing import queue
from stand.queueing.queue_file import Entry, Queue
from stand.queueing.queue_run import conclude, run_entry
from stand.queueing.queue_work import Notes, work
from stand.running.order import load_order
from stand.running.stop import Interrupted

app = App(
    no_args_is_help=True,
    help="A queue of runs: add, list, move, remove, start.\n\nExample: stand queue add thermal-cycle",
)

ConfigOption = Annotated[str, typer.Option("--config", help="A configuration file, or the name of an installed one.")]
OutOption = Annotated[
    Path | None, typer.Option("--out", help="Where the queue is and its sessions go; else recording.directory.")
]
RunArgument = Annotated[int, typer.Argument(metavar="ID", help="The run's number in `stand queue list`.")]

_COLUMNS = ("id", "next", "recipe", "state", "added (local)", "took", "session", "reason")


@app.command()
def add(
    recipe: Annotated[str, typer.Argument(help="A recipe file, or the name of an installed one.")],
    config: ConfigOption = "simulated",
    out: OutOption = None,
) -> None:
    """Check a recipe and queue it as it is now: later edits of the files do not change it. Prints its number.

    Example: stand queue add thermal-cycle --config laboratory.yaml --out /data/sessions
    """
    with one_line_errors():
        order = load_order(recipe, config)
        directory = out or order.config.recording.directory
        number = queue.add(directory, order, config, WallClock().now_ns()).id
        show({"id": number}, [number])


@app.command("list")
def list_runs(config: ConfigOption = "simulated", out: OutOption = None) -> None:
    """The runs in the queue: what has ended, what is running, what comes next.

    Example: stand queue list --out /data/sessions
    """
    with one_line_errors():
        directory = _directory(config, out)
        found = queue.queued(directory)
        texts = {"config_text", "recipe_text", "target_text"}
        entries = [entry.model_dump(mode="json", exclude=texts) for entry in found.entries]
        show({"halted": found.halted, "runs": entries}, queue_lines(found) if found.entries else ())
        if not found.entries:
            say(f"{directory}: nothing is queued there")
        if found.halted:
            say(f"halted by {found.halted}; remove the cause, then `stand queue start --clear`")


@app.command()
def move(
    number: RunArgument,
    position: Annotated[int, typer.Argument(help="1 is the next to be run.")],
    config: ConfigOption = "simulated",
    out: OutOption = None,
) -> None:
    """Change when a run that is still to be done has its turn.

    Example: stand queue move 5 1
    """
    with one_line_errors():
        queue.move(_directory(config, out), number, position)
        show({"id": number, "position": position}, ())


@app.command()
def remove(number: RunArgument, config: ConfigOption = "simulated", out: OutOption = None) -> None:
    """Take a run out of the queue; what it has recorded stays.

    Example: stand queue remove 5
    """
    with one_line_errors():
        queue.remove(_directory(config, out), number)
        show({"id": number}, ())


@app.command(has_json=False)
def start(
    config: ConfigOption = "simulated",
    out: OutOption = None,
    virtual_time: Annotated[
        bool, typer.Option("--virtual-time", help="As fast as it goes, each with a simulated laboratory of its own.")
    ] = False,
    clear: Annotated[bool, typer.Option("--clear", help="After a trip whose cause has been removed.")] = False,
    report: Annotated[bool, typer.Option("--report", help="As of `stand run`, after each run with a drift.")] = False,
) -> None:
    """Run what is queued, one after another, until nothing is left; what was interrupted is resumed first.

    Example: stand queue start --out /data/sessions
    """
    with one_line_errors():
        directory = _directory(config, out)
        if not queue.queued(directory).entries:
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


def queue_lines(found: Queue) -> list[str]:
    """`stand queue list`: a line for each run, under their headings."""
    turns = {entry.id: turn for turn, entry in enumerate((e for e in found.entries if e.is_open), 1)}
    rows = [_COLUMNS, *(_cells(entry, turns.get(entry.id)) for entry in found.entries)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _cells(entry: Entry, turn: int | None) -> tuple[str, ...]:
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


def _directory(config: str, out: Path | None) -> Path:
    return out or load_config(packaged("", config)).recording.directory
