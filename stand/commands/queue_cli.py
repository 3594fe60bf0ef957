"""The `stand queue` commands: what `stand serve` is to run, one after another."""

from __future__ import annotations

from collections.abc import Sequence

from thermostand.foundation.instants import format_date_time, format_duration
from thermostand.foundation.output import say, show
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.endpoint import on_stand
from thermostand.stand.commands.verbs import make_app
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api_models import QueuedRun
from thermostand.stand.serving.client import Server

app = make_app(
    StandService,
    "queue",
    "The queue of a stand: add, list, move, remove. `stand serve` works it.\n\nExample: stand queue add thermal-cycle",
)

_OPEN = ("waiting", "interrupted")
_COLUMNS = ("id", "next", "recipe", "state", "added (local)", "took", "session", "reason")


@app.command("list")
@on_stand()
def list_runs(server: Server) -> None:
    """The runs in the queue: what has ended, what is running, what comes next.

    Example: stand queue list /data/sessions
    """
    state = server.state()
    data = {"halted": state.queue_halted, "runs": [run.model_dump(mode="json") for run in state.queue]}
    show(data, format_queue(state.queue) if state.queue else ())
    if not state.queue:
        say(f"{server.name}: nothing is queued there")
    if state.queue_halted:
        say(f"halted by {state.queue_halted}; remove the cause, then `stand reset`")


def format_queue(runs: Sequence[QueuedRun]) -> list[str]:
    """A line for each run, under their headings."""
    turns = {run.id: turn for turn, run in enumerate((each for each in runs if each.state in _OPEN), 1)}
    rows = [_COLUMNS, *(_format_cells(run, turns.get(run.id)) for run in runs)]
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def _format_cells(run: QueuedRun, turn: int | None) -> tuple[str, ...]:
    took = "" if run.began_ns is None or run.ended_ns is None else format_duration(run.ended_ns - run.began_ns)
    return (
        str(run.id),
        "" if turn is None else str(turn),
        escape_line(run.recipe),
        run.state,
        format_date_time(run.added_ns),
        took,
        escape_line(run.session),
        escape_line(run.reason),
    )
