"""The commands for a run that is under way: status, pause, continue, stop, clear."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated, cast

import typer

from foundation.errors import ConfigError, SessionError
from foundation.exit_codes import one_line_errors
from foundation.instants import duration, local_text
from foundation.usage import one_line
from recording.format.inventory import inventory
from stand.commands.session_text import size
from stand.config.stand_config import load_config, packaged
from stand.gate import INTERLOCK, OPERATOR
from stand.serving.control_client import ask, ask_status, running_sessions
from stand.serving.desk import RunStatus
from stand.serving.door import Answer

app = typer.Typer(add_completion=False)

DirectoryArgument = Annotated[
    Path | None,
    typer.Argument(metavar="[DIR]", help="A session, or a folder of sessions; else recording.directory of --config."),
]
ConfigOption = Annotated[str, typer.Option("--config", help="A configuration file, or the name of an installed one.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Machine-readable.")]

_LABEL = 14


@app.command()
def status(
    directory: DirectoryArgument = None, config: ConfigOption = "simulated", as_json: JsonOption = False
) -> None:
    """What the running session is doing: step, state, expected end, temperatures, frames, disk, last warning.

    Without DIR, when none runs in recording.directory: the only one on this machine. The same for `stand stop`.

    Example: stand status /data/sessions
    """
    with one_line_errors():
        session = _running(directory, config, anywhere=True)
        found = ask_status(session)
        if as_json:
            fields = found.model_dump(mode="json", exclude={"session"})
            typer.echo(json.dumps({"session": str(session), **fields}, indent=2))
            return
        for line in status_lines(session, found):
            typer.echo(line)


@app.command()
def pause(directory: DirectoryArgument = None, config: ConfigOption = "simulated") -> None:
    """Hold the run before its next action; the chamber keeps its set-point, a dwell what it has earned.

    Moves under way are completed, and the answer lists them; `stand stop` stops it. The flap is shut within a
    minute. After guard.pause_limit_h the stand is made safe and held.

    Example: stand pause && stand continue
    """
    with one_line_errors():
        session, answer = _ask(directory, config, "pause")
        moving = cast("list[str]", answer.get("moving", []))
        typer.echo(f"{session}: paused; `stand continue` ends the pause; {_moving(moving)}")


@app.command("continue")
def continue_(directory: DirectoryArgument = None, config: ConfigOption = "simulated") -> None:
    """End a pause.

    Example: stand continue sessions/20260101T180000Z-thermal-cycle
    """
    with one_line_errors():
        session, answer = _ask(directory, config, "continue")
        typer.echo(f"{session}: {_still(answer)}")


@app.command()
def clear(directory: DirectoryArgument = None, config: ConfigOption = "simulated") -> None:
    """Continue a run that an interlock holds, once you have removed the cause.

    Example: stand clear
    """
    with one_line_errors():
        session, answer = _ask(directory, config, "clear")
        typer.echo(f"{session}: cleared; {_still(answer)}")


@app.command()
def stop(directory: DirectoryArgument = None, config: ConfigOption = "simulated") -> None:
    """Make the stand safe and end the run, as Ctrl-C does.

    Example: stand stop
    """
    with one_line_errors():
        session, _ = _ask(directory, config, "stop", anywhere=True)
        typer.echo(f"{session}: stopping; the stand is made safe first, and the run says when it is")


def status_lines(session: Path, found: RunStatus) -> Iterator[str]:
    """`stand status`."""
    state = found.state if found.state != "held" else f"held: {', '.join(found.reasons)}"
    yield _row("session", str(session))
    yield _row("recipe", found.recipe)
    since = local_text(found.since_ns + found.since_utc_offset_ns)
    yield _row("state", f"{state}, since {since} ({_span(found.now_ns - found.since_ns)})")
    if found.fault:
        yield _row("fault", f"{found.fault_rule}: {found.fault}")
    yield _row("step", f"{found.step}/{found.steps} {found.doing}")
    yield _row("ends", _end(found))
    for channel, value_degC in found.temperatures_degC.items():
        yield _row("temperatures", f"{channel} {'BAD' if value_degC is None else f'{value_degC:.2f} degC'}")
    yield _row("frames", f"{found.frames_saved} saved, {found.frames_lost} lost")
    yield _row("disk", f"{size(found.disk_free_bytes)} free")
    yield _row("last warning", _warning(found))


def _row(label: str, text: str) -> str:
    return f"{label:<{_LABEL}}{one_line(text)}"


def _span(length_ns: int) -> str:
    return duration(max(0, length_ns))


def _end(found: RunStatus) -> str:
    if found.end_ns is None:
        return "not known"
    return f"{local_text(found.end_ns + found.utc_offset_ns)} (in {_span(found.end_ns - found.now_ns)})"


def _warning(found: RunStatus) -> str:
    if found.warning_ns is None:
        return found.warning or "none"
    level = "error, " if found.warning_level == "error" else ""
    return f"{level}{local_text(found.warning_ns + found.warning_utc_offset_ns)}: {found.warning}"


def _still(answer: Mapping[str, object]) -> str:
    """Whether the run continues, and if not, what may be done about it."""
    reasons = cast("list[str]", answer.get("reasons", []))
    if not reasons:
        return "the run continues"
    remedies = {OPERATOR: "`stand continue` ends the pause", INTERLOCK: "`stand clear` once the cause is gone"}
    known = [remedies[reason] for reason in reasons if reason in remedies]
    return "; ".join([f"still held: {', '.join(reasons)}", *known])


def _moving(moving: Sequence[str]) -> str:
    return f"still moving: {', '.join(map(one_line, moving))}" if moving else "nothing moves"


def _ask(directory: Path | None, config: str, do: str, *, anywhere: bool = False) -> tuple[Path, Answer]:
    session = _running(directory, config, anywhere=anywhere)
    return session, ask(session, {"do": do})


def _running(directory: Path | None, config: str, *, anywhere: bool = False) -> Path:
    """`directory` when it is a session that is run, else the only running session in it; ConfigError when there are
    several. `anywhere`: without a directory the only one on this machine will do, for what can do no harm."""
    root = directory or load_config(packaged("", config)).recording.directory
    sessions = running_sessions(root) or (running_sessions() if anywhere and directory is None else [])
    if len(sessions) > 1:
        raise ConfigError(f"{root}: several sessions are running, name one: {', '.join(map(str, sessions))}")
    if sessions:
        return sessions[0]
    if inventory(root):
        raise SessionError(f"{root}: no daemon is running this session")
    raise SessionError(f"{root}: no daemon is running a session there")
