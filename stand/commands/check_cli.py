"""`stand check`: is every device of a stand there, the right one, set as it must be, and fit for a night?"""

from __future__ import annotations

import asyncio
import importlib.resources
from itertools import groupby
from pathlib import Path
from typing import Annotated

import typer

from foundation.clock import WallClock
from foundation.documents import read_document
from foundation.errors import ConfigError
from foundation.exit_codes import FAILED, INTERRUPTED, one_line_errors
from foundation.usage import OneLineUsage, one_line
from stand.commands.reached import ConfigOption
from stand.commands.session_args import JsonOption
from stand.commissioning.commissioning import commission
from stand.commissioning.finding import Finding, worst
from stand.commissioning.record import Record
from stand.config.stand_config import load_config, packaged
from stand.running.order import register_texts
from stand.running.stop import Interrupted

app = typer.Typer(cls=OneLineUsage, add_completion=False)

_NAME, _VERDICT = 16, 11  # columns


@app.command()
def check(
    config: ConfigOption = "simulated",
    moves: Annotated[
        bool, typer.Option("--moves", help="Flap, stages and cameras, too, and the timer that guards the heat.")
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Each device of a stand: its link, identity, settings and a reading; what is wrong, and what to do. Status 1 when
    something has failed.

    Without --moves nothing moves and nothing heats. The record is kept beside the stand's file, and goes with sessions.

    Example: stand check --config my-stand.yaml --moves
    """
    with one_line_errors():
        path = packaged("", config)
        stand = load_config(path)
        texts = {"config.yaml": read_document(path), **register_texts(stand)}
        clock = WallClock()
        began_ns = clock.now_ns()
        try:
            found, identities = asyncio.run(commission(stand, _nothing if as_json else _tell, has_moves=moves))
        except Interrupted as error:
            typer.echo(one_line(error), err=True)
            raise typer.Exit(INTERRUPTED) from error
        record = Record(stand, str(path), texts, began_ns, clock.now_ns(), moves, found, identities)
        kept = "not kept, since this is an installed file; copy it to have a stand of your own"
        if not _is_installed(path):
            _, page = record.write(path)
            kept = f"kept as {page}"
        typer.echo(record.json() if as_json else one_line(_summary(found, kept, moves=moves)))
        if worst(found) == "failed":
            raise typer.Exit(FAILED)


def _nothing(_: tuple[Finding, ...]) -> None:
    """Of what is told at the end."""


def _tell(findings: tuple[Finding, ...]) -> None:
    """A line for each device with what is well, and two for each thing that is not."""
    for name, group in groupby(findings, lambda finding: finding.device):
        found = tuple(group)
        lines = (
            [(worst(found), well)] if (well := "; ".join(each.text for each in found if each.verdict == "ok")) else []
        )
        for each in found:
            if each.verdict != "ok":
                lines.append((each.verdict, f"{each.what}: {each.text}"))
                lines += [("", f"-> {each.advice}")] if each.advice else []
        for number, (verdict, text) in enumerate(lines):
            typer.echo(one_line(f"{name if number == 0 else '':<{_NAME}}{verdict:<{_VERDICT}}{text}"))


def _summary(findings: tuple[Finding, ...], kept: str, *, moves: bool) -> str:
    words = {"failed": "failed", "warning": "to be looked at", "unverified": "to be verified by hand"}
    counts = [(sum(each.verdict == verdict for each in findings), word) for verdict, word in words.items()]
    text = ", ".join(f"{count} {word}" for count, word in counts if count) or "all well"
    unmoved = "" if moves else "; nothing was moved: --moves tries flap, stages, cameras and the heat's timer"
    return f"{text}{unmoved}. Record: {kept}"


def _is_installed(path: Path) -> bool:
    """Whether it belongs to the program, whose folder is no place for records."""
    try:
        return path.resolve().is_relative_to(Path(str(importlib.resources.files("configs"))).resolve())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be looked up ({error.strerror})") from error
