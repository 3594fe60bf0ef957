"""`stand session archive`: finished sessions copied to another disk, read back, and deleted by a rule when asked."""

from __future__ import annotations

import os
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated

import typer

from thermostand.foundation.clock import WallClock
from thermostand.foundation.command_app import App
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.exit_codes import FAILED
from thermostand.foundation.files import accept_unsynced_folders
from thermostand.foundation.output import get_output, say, show
from thermostand.foundation.progress import show_late_progress
from thermostand.foundation.usage import escape_line, print_error
from thermostand.recording.exporting.archive import DeletionRule, archive, delete, explain_unfit
from thermostand.recording.reading.catalogue import ListedSession
from thermostand.stand.commands.endpoint import ConfigOption
from thermostand.stand.commands.sessions.session_args import check_folder
from thermostand.stand.commands.sessions.session_list_cli import get_user_name, list_sessions_at
from thermostand.stand.commands.sessions.session_table import format_size
from thermostand.stand.config.stand_config import find_packaged, load_config

app = App(no_args_is_help=True)
_NICENESS = 15  # whatever a stand does on this computer goes first


@app.callback()
def archiving() -> None:
    """Copies of sessions."""


@app.command("archive")
def archive_sessions(
    directory: Annotated[
        Path | None, typer.Argument(metavar="[DIR]", help="A session, or where the sessions are.")
    ] = None,
    to: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Where the copies go; else recording.archive_directory.")
    ] = None,
    config: ConfigOption = "simulated",
    again: Annotated[bool, typer.Option("--again", help="Copy those once more whose copy is gone.")] = False,
    delete_after: Annotated[
        float | None,
        typer.Option("--delete-after", metavar="DAYS", min=0, help="Then delete those that ended so long ago."),
    ] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Delete; without it what would be deleted is only shown.")] = False,
) -> None:
    """Copy finished sessions to another disk and read the copies back. An interrupted copy continues where it was;
    a session that is being recorded is not touched.

    Example: stand session archive /data/sessions --to /mnt/nas/sessions --delete-after 30
    """
    recording = load_config(find_packaged("", config)).recording
    place, out = directory or recording.directory, to or recording.archive_directory
    if out is None:
        raise ConfigError("where to? give --to DIR, or recording.archive_directory in the stand's file")
    if out.resolve().is_relative_to(check_folder(place).resolve()):
        raise ConfigError(f"{out}: lies inside of {place}; the copies belong on another disk")
    with suppress(OSError):
        os.nice(_NICENESS)
    done = _ArchiveResult()
    _copy(list_sessions_at(place), out, done, again=again)
    if delete_after is not None:
        _delete(list_sessions_at(place), DeletionRule(delete_after), done, yes=yes)
    show(done.data(), ())
    if done.failed:
        raise typer.Exit(FAILED)


@dataclass
class _ArchiveResult:
    """What became of the sessions, by name. gone: whose copy is gone; due: those that the rule would delete."""

    copied: dict[str, Path] = field(default_factory=dict[str, Path])
    waiting: dict[str, str] = field(default_factory=dict[str, str])
    gone: list[str] = field(default_factory=list[str])
    failed: list[str] = field(default_factory=list[str])
    due: list[str] = field(default_factory=list[str])
    deleted: list[str] = field(default_factory=list[str])

    def data(self) -> dict[str, object]:
        return asdict(self)


def _print_line(text: str) -> None:
    """Print a line for people, as it happens."""
    if not get_output().as_json:
        typer.echo(escape_line(text))


def _select_to_copy(
    entries: Sequence[ListedSession], out: Path, found: _ArchiveResult, *, again: bool
) -> list[ListedSession]:
    """Select the sessions without a copy in `out`. Those that must wait are listed, and those whose copy is gone: a
    disk that is not mounted must not fill the one that its place is on."""
    due: list[ListedSession] = []
    for entry in entries:
        copy = (out / entry.name).resolve()
        if not entry.archived and (reason := explain_unfit(entry)):
            found.waiting[entry.name] = reason
            say(f"{entry.name}: not yet: {reason}")
        elif not entry.archived or Path(entry.archived) != copy or (again and not copy.exists()):
            due.append(entry)
        elif not copy.exists():
            found.gone.append(entry.name)
            found.failed.append(entry.name)
            print_error(SessionError(f"{copy}: the copy is gone; is its disk connected? `--again` makes another"))
    return due


def _copy(entries: Sequence[ListedSession], out: Path, found: _ArchiveResult, *, again: bool) -> None:
    due = _select_to_copy(entries, out, found, again=again)
    if out.exists() and any(entry.path.stat().st_dev == out.stat().st_dev for entry in due):
        say(f"warning: {out}: is on the disk that the sessions are on")
    done = 0
    with show_late_progress("archive", 2 * sum(entry.size_bytes for entry in due)) as report:
        for entry in due:

            def count(size_bytes: int, name: str = entry.name) -> None:
                nonlocal done
                done += size_bytes
                report(done, escape_line(name))

            try:
                with accept_unsynced_folders(lambda text: say(f"warning: {text}")):
                    copy = archive(entry, out, get_user_name(), WallClock().now_ns(), count)
                found.copied[entry.name] = copy
                _print_line(f"{entry.name}: copied to {copy} and read back ({format_size(entry.size_bytes)})")
            except SessionError as error:
                print_error(error)
                found.failed.append(entry.name)
    if not due:
        have = sum(bool(entry.archived) for entry in entries) - len(found.gone)
        _print_line(f"nothing to copy: {have} of {len(entries)} have a copy in {out}")


def _delete(entries: Sequence[ListedSession], rule: DeletionRule, found: _ArchiveResult, *, yes: bool) -> None:
    """The rule and what it applies to; deleted only with `yes`."""
    _print_line(f"{rule}:")
    due = [entry for entry in entries if rule.applies(entry, WallClock().now_ns())]
    for entry in due:
        found.due.append(entry.name)
        if not yes:
            _print_line(f"  {entry.path} ({format_size(entry.size_bytes)}), copy in {entry.archived}")
            continue
        try:
            delete(entry)
            found.deleted.append(entry.name)
            _print_line(f"  {entry.path}: deleted ({format_size(entry.size_bytes)}); its copy is {entry.archived}")
        except SessionError as error:
            print_error(error)
            found.failed.append(entry.name)
    total = format_size(sum(entry.size_bytes for entry in due))
    _print_line("  none" if not due else f"{len(due)} sessions, {total}" + ("" if yes else "; --yes deletes them"))
