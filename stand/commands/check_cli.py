"""`stand check`: is every device of a stand there, the right one, set as it must be, and fit for a run?"""

from __future__ import annotations

import asyncio
import importlib.resources
from itertools import groupby
from pathlib import Path
from typing import Annotated

import typer

from thermostand.drivers.devices.device_check import Finding, find_worst
from thermostand.foundation.clock import WallClock
from thermostand.foundation.command_app import App
from thermostand.foundation.documents import read_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.exit_codes import FAILED
from thermostand.foundation.output import get_output, show
from thermostand.foundation.usage import escape_line
from thermostand.stand.commands.endpoint import ConfigOption
from thermostand.stand.commissioning.commissioning import CommissioningRecord, commission
from thermostand.stand.commissioning.genicam_rehearsal import rehearse
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.order import read_register_texts

app = App()

_NAME, _VERDICT = 16, 11  # columns


@app.command()
def check(
    config: ConfigOption = "simulated",
    moves: Annotated[
        bool,
        typer.Option("--moves", help="Also move flap and stages, take frames, and test the timer that ends the heat."),
    ] = False,
    genicam: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="Only: which features of this camera's GenICam file the stand would use."),
    ] = None,
) -> None:
    """Each device of a stand: its link, identity, settings and a reading; what is wrong, and what to do. Status 1 when
    something has failed.

    Without --moves nothing moves and nothing heats. The record is kept next to the stand's file and copied to sessions.
    With --genicam no device is asked: the file is tried on a simulated camera; status 1 when it is refused.

    Example: stand check --config my-stand.yaml --moves
    """
    path = find_packaged("", config)
    stand = load_config(path)
    if genicam is not None:
        _rehearse(genicam, None if _is_installed(path) else stand)
        return
    texts = {"config.yaml": read_document(path), **read_register_texts(stand)}
    clock = WallClock()
    began_ns = clock.now_ns()
    found, identities = asyncio.run(
        commission(stand, _ignore_findings if get_output().as_json else _print_findings, has_moves=moves)
    )
    record = CommissioningRecord(stand, str(path), texts, began_ns, clock.now_ns(), moves, found, identities)
    kept = "not kept, since this is an installed file; copy it to have a stand of your own"
    if not _is_installed(path):
        _, page = record.write(path)
        kept = f"kept as {page}"
    show(record.data(), [escape_line(_format_summary(found, kept, moves=moves))])
    if find_worst(found) == "failed":
        raise typer.Exit(FAILED)


def _rehearse(file: Path, stand: StandConfig | None) -> None:
    """Rehearse a GenICam file: print what of it would be used."""
    found = asyncio.run(rehearse(file, stand))
    lines = [found.camera or str(file), *(f"  {purpose:<14}{name or '-'}" for purpose, name in found.features.items())]
    if found.refusal:
        lines.append(f"refused: {found.refusal}" if found.is_played else found.refusal)
    show(found, map(escape_line, lines))
    if found.refusal:
        raise typer.Exit(FAILED)


def _ignore_findings(_: tuple[Finding, ...]) -> None:
    """The summary at the end."""


def _print_findings(findings: tuple[Finding, ...]) -> None:
    """A line for each device with what is well, and two for each thing that is not."""
    for name, group in groupby(findings, lambda finding: finding.device):
        found = tuple(group)
        lines = [("ok", well)] if (well := "; ".join(each.text for each in found if each.verdict == "ok")) else []
        for each in found:
            if each.verdict != "ok":
                lines.append((each.verdict, f"{each.what}: {each.text}"))
                lines += [("", f"-> {each.advice}")] if each.advice else []
        for number, (verdict, text) in enumerate(lines):
            typer.echo(escape_line(f"{name if number == 0 else '':<{_NAME}}{verdict:<{_VERDICT}}{text}"))


def _format_summary(findings: tuple[Finding, ...], kept: str, *, moves: bool) -> str:
    words = {"failed": "failed", "warning": "to be looked at", "unverified": "to be verified by hand"}
    counts = [(sum(each.verdict == verdict for each in findings), word) for verdict, word in words.items()]
    text = ", ".join(f"{count} {word}" for count, word in counts if count) or "all well"
    unmoved = "" if moves else "; nothing was moved: --moves tries flap, stages, cameras and the heat's timer"
    return f"{text}{unmoved}. CommissioningRecord: {kept}"


def _is_installed(path: Path) -> bool:
    """Return whether it belongs to the program, whose folder is no place for records."""
    try:
        return path.resolve().is_relative_to(Path(str(importlib.resources.files("thermostand.configs"))).resolve())
    except OSError as error:
        raise ConfigError(f"{path}: cannot be looked up ({error.strerror})") from error
