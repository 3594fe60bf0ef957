"""The `stand session` commands: recorded sessions listed, shown, verified, repaired, replayed, exported and trimmed."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Literal

import typer

from thermostand.foundation.clock import NS_PER_S, VirtualClock
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.exit_codes import FAILED
from thermostand.foundation.files import accept_unsynced_folders
from thermostand.foundation.hub import Hub
from thermostand.foundation.instants import parse_instant
from thermostand.foundation.items import Event, Item, StepMark
from thermostand.foundation.output import get_output, json_line, say, show
from thermostand.foundation.progress import Report, progress, show_late_progress
from thermostand.foundation.usage import escape_line
from thermostand.recording.exporting.export import export
from thermostand.recording.exporting.mcap_export import export_mcap
from thermostand.recording.exporting.mcap_import import import_mcap
from thermostand.recording.exporting.nexus import export_nexus
from thermostand.recording.exporting.replay import ReplayClock, replay, replay_and_record
from thermostand.recording.exporting.ro_crate import write_crate
from thermostand.recording.exporting.state import describe_state
from thermostand.recording.exporting.trim import trim
from thermostand.recording.format.damage import FileDamaged
from thermostand.recording.format.inventory import SegmentState, explain_changed_names, list_segments
from thermostand.recording.reading.overview import summarise_session
from thermostand.recording.reading.scan import Scan, scan, verify
from thermostand.recording.reading.session import Session, check_whole
from thermostand.recording.repair.salvage import Salvaged, format_salvaged, salvage_session
from thermostand.stand.commands.sessions.session_args import (
    IncompleteOption,
    OutOption,
    SessionArgument,
    check_folder,
    check_session,
)
from thermostand.stand.commands.sessions.session_text import (
    format_info,
    format_verification,
    make_info_json,
    make_verification_json,
)

app = App(
    no_args_is_help=True,
    help="Recorded sessions: list, look at, verify, repair, replay, export, import, trim.\n\n"
    "Example: stand session info sessions/20260101T180000Z-thermal-cycle",
)


@app.command()
def info(directory: SessionArgument) -> None:
    """Show what a session holds: when, steps, frames, gaps, temperatures, events, versions.

    Example: stand session info sessions/20260101T180000Z-thermal-cycle
    """
    found = summarise_session(check_session(directory))
    if get_output().as_json:
        show(make_info_json(found), ())
    else:
        show(None, format_info(found))


def _find_sessions(directory: Path) -> list[Path]:
    """`directory` itself when it is a session, else those in it; ConfigError when there is no such folder."""
    check_folder(directory)
    if list_segments(directory) or explain_changed_names(directory):
        return [check_session(directory)]
    return [path for path in sorted(directory.iterdir()) if path.is_dir() and list_segments(path)]


@contextmanager
def _open_session(directory: Path, incomplete: bool) -> Generator[Session]:
    """The session in `directory` for a command that takes all of it. SessionError when something of it is missing or
    not finished, and not `incomplete`; what is being recorded is left out with a warning. Damage that the command meets
    becomes a sentence that says what helps."""
    files = list_segments(check_session(directory))
    help_text = f"`stand session repair {directory}`"
    growing = [file.name for file in files if file.state is SegmentState.RECORDING]
    if growing:
        _warn(f"{directory}: is being recorded; left out because they are not finished yet: {', '.join(growing)}")
    try:
        session = Session.open(directory)
        check_whole(session, _warn if incomplete else None)
        with accept_unsynced_folders(_warn):
            yield session
    except FileDamaged as error:
        raise SessionError(f"{error}; {help_text} recovers what is sound") from error


def _warn(text: str) -> None:
    say(f"warning: {text}")


@app.command("verify")
def verify_session(directory: SessionArgument) -> None:
    """Read every byte of a session and say what is damaged or missing; status 1 when anything is,
    however the run ended.

    Example: stand session verify sessions/20260101T180000Z-thermal-cycle
    """
    files = list_segments(check_session(directory))
    total_bytes = sum(file.size_bytes for file in files if file.state is SegmentState.FINISHED)
    with show_late_progress("verify", total_bytes) as report:
        found = verify(directory, report)
    show(make_verification_json(found), format_verification(found))
    if not found.is_sound:
        raise typer.Exit(FAILED)


def _make_part_report(report: Report, done_bytes: int, size_bytes: int) -> Callable[[float, str], None]:
    """Takes the share that is done of one session of that size, behind those before it."""
    return lambda share, text: report(done_bytes + share * size_bytes, escape_line(text))


@app.command()
def repair(
    directory: Annotated[Path, typer.Argument(metavar="DIR", help="A recorded session, or a folder of sessions.")],
) -> None:
    """Finish unfinished segments and repair damaged ones; nothing valid is lost. Status 1 when something was not
    recovered: its original is then kept as .damaged.

    Example: stand session repair sessions
    """
    sizes = {path: sum(file.size_bytes for file in list_segments(path)) for path in _find_sessions(directory)}
    done: list[Salvaged] = []
    done_bytes = 0
    with accept_unsynced_folders(_warn), show_late_progress("repair", sum(sizes.values())) as report:
        for path, size_bytes in sizes.items():
            for salvaged in salvage_session(path, _make_part_report(report, done_bytes, size_bytes)):
                done.append(salvaged)
            done_bytes += size_bytes
    data = [{**asdict(each), "text": format_salvaged(each)} for each in done]
    show(data, [escape_line(format_salvaged(each)) for each in done] or ["nothing to repair"])
    if any(salvaged.kept for salvaged in done):
        raise typer.Exit(FAILED)


@app.command("replay")
def replay_session(
    directory: SessionArgument,
    speed: Annotated[str, typer.Option(metavar="N|max", help="Times as fast as it was, or max.")] = "1",
    record: Annotated[Path | None, typer.Option(help="Record the replay as this new session.")] = None,
    incomplete: IncompleteOption = False,
) -> None:
    """Publish a session again, at its own pace or faster; its steps and events are printed as they come, with --json
    one a line, but for a replay that is recorded.

    Example: stand session replay sessions/20260101T180000Z-thermal-cycle --speed 60
    """
    times = _parse_speed(speed)
    if record is not None:
        _check_new(record, directory)
    seen = scan(check_session(directory))
    with _open_session(directory, incomplete) as session, _show_replay(seen, session, record) as watch:
        if record is None:
            asyncio.run(_replay(session, seen.begin_ns or 0, times, watch))
        else:
            recorded = asyncio.run(replay_and_record(session, record, times, watch))
            show({"session": recorded}, [recorded])


def _parse_speed(text: str) -> float | None:
    """Times as fast as it was; None is as fast as possible."""
    if text == "max":
        return None
    if re.fullmatch(r"\d+(\.\d*)?|\.\d+", text) and 0.001 <= float(text) <= 1e6:
        return float(text)
    raise ConfigError(f"--speed {text}: expected max or a number from 0.001 to 1000000")


def _check_new(out: Path, session: Path) -> None:
    """ConfigError when `out` cannot become a folder outside `session`."""
    if out.resolve().is_relative_to(session.resolve()) and out.resolve() != session.resolve():
        raise ConfigError(f"{out}: is inside the session; choose a place outside of it")
    if out.exists():
        raise ConfigError(f"{out}: exists already; choose another name or move it away")


@contextmanager
def _show_replay(seen: Scan, session: Session, record: Path | None) -> Generator[Callable[[Hub], None]]:
    """Progress in seconds of the session; its steps and events as lines, in local time or as JSON."""
    begin_ns, end_ns, utc = seen.begin_ns or 0, seen.end_ns or 0, session.utc
    with progress("replay", (end_ns - begin_ns) / NS_PER_S) as report:

        def follow(item: Item) -> None:
            at = utc.date_time(item.time_ns)
            report((item.time_ns - begin_ns) / NS_PER_S, at)
            if get_output().as_json:
                if record is None and isinstance(item, StepMark | Event):
                    typer.echo(json_line(item))
                return
            if get_output().quiet:
                return
            if isinstance(item, StepMark):
                typer.echo(f"{at}  step {item.index + 1} {escape_line(item.kind)} {item.state}")
            elif isinstance(item, Event):
                typer.echo(f"{at}  {escape_line(f'{item.level} {item.kind}: {item.text}')}")

        yield lambda hub: hub.subscribe(follow)


async def _replay(session: Session, begin_ns: int, speed: float | None, watch: Callable[[Hub], None]) -> None:
    hub = Hub()
    watch(hub)
    if speed is not None:
        await replay(session, hub, ReplayClock(begin_ns, speed))
        return
    clock = VirtualClock(begin_ns)
    running = asyncio.create_task(clock.run())
    try:
        await replay(session, hub, clock)
    finally:
        running.cancel()


@app.command("export")
def export_session(
    directory: SessionArgument,
    out: OutOption,
    table_format: Annotated[
        Literal["csv", "parquet", "mcap", "nexus"],
        typer.Option("--format", help="Of the tables; mcap, nexus: all of it in one file, OUT."),
    ] = "csv",
    frames: Annotated[bool, typer.Option("--frames/--no-frames", help="Images with their temperatures.")] = True,
    telemetry: Annotated[bool, typer.Option("--telemetry/--no-telemetry", help="Tables of every topic.")] = True,
    incomplete: IncompleteOption = False,
) -> None:
    """A session as PNG files with their temperatures, and its telemetry as tables; or as one MCAP or NeXus (HDF5) file.

    Example: stand session export sessions/20260101T180000Z-thermal-cycle --out data --format parquet
    """
    _check_new(out, directory)
    with _open_session(directory, incomplete) as session, show_late_progress("export", 1.0) as report:
        if table_format == "mcap":
            export_mcap(session, out, frames=frames, telemetry=telemetry, report=report)
        elif table_format == "nexus":
            export_nexus(session, out, frames=frames, telemetry=telemetry, report=report)
        else:
            tables = table_format if telemetry else None
            export(session, out, frames=frames, telemetry=tables, report=report)
        if table_format in ("mcap", "nexus"):
            write_crate(session, out)
        state = describe_state(session)
    for line in state.findings:
        say(escape_line(line))
    show({"out": out, **state._asdict()}, [out])


@app.command("import")
def import_session(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="An MCAP file that an export has written.")],
    out: OutOption,
) -> None:
    """A session of one MCAP file, as `stand session export --format mcap` writes it; also when another program has
    rewritten it.

    Example: stand session import session.mcap --out sessions/20260101T180000Z-thermal-cycle
    """
    if not file.is_file():
        raise ConfigError(f"{file}: {'is no file' if file.exists() else 'no such file'}")
    if out.exists():
        raise ConfigError(f"{out}: exists already; choose another name or move it away")
    with accept_unsynced_folders(_warn), show_late_progress("import", 1.0) as report:
        import_mcap(file, out, report)
    show({"session": out}, [out])


@app.command("trim")
def trim_session(
    directory: SessionArgument,
    out: OutOption,
    begin: Annotated[
        str, typer.Option("--from", metavar="T", help="2026-01-01T18:30:00 (local), +1h30m or step:12.")
    ] = ("+0s"),
    end: Annotated[str | None, typer.Option("--to", metavar="T", help="Not included; else the session's end.")] = None,
    incomplete: IncompleteOption = False,
) -> None:
    """A part of a session as a new one. +1h30m counts from the session's start; step:12 is when step 12 began (from 1).

    Example: stand session trim sessions/20260101T180000Z-thermal-cycle --out part --from step:12 --to +5h
    """
    _check_new(out, directory)
    seen = scan(check_session(directory))
    with _open_session(directory, incomplete) as session:
        part = trim(session, out, *_parse_range(begin, end, session, seen))
        show({"session": part}, [part])


def _parse_range(begin: str, end: str | None, session: Session, seen: Scan) -> tuple[int, int]:
    """Parse from when up to when; ConfigError when that is not a time, or none."""
    begin_ns = _parse_instant(begin, session, seen)
    if seen.end_ns is not None and begin_ns > seen.end_ns:
        raise ConfigError(f"--from {begin} is after the session's end ({session.utc.local_text(seen.end_ns)})")
    end_ns = (seen.end_ns or 0) + 1 if end is None else _parse_instant(end, session, seen)
    if end_ns <= begin_ns:
        raise ConfigError(f"--to {end} is not after --from {begin}")
    return begin_ns, end_ns


def _parse_instant(text: str, session: Session, seen: Scan) -> int:
    """ns since the epoch; ConfigError when the text is no time, or names no step of the session."""
    step = re.fullmatch(r"step:(\d+)", text)
    if step is None:
        return parse_instant(text, seen.begin_ns or 0, session.utc.stand_ns)
    begun = (mark.time_ns for mark in session.steps() if mark.index + 1 == int(step[1]))
    time_ns = next(begun, None)
    if time_ns is None:
        raise ConfigError(f"{text}: the session has no step {step[1]}")
    return time_ns
