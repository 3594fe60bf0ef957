"""`stand session list`, `note` and `tag`: what is known of many sessions, and what people say of one."""

from __future__ import annotations

import os
import pwd
import sys
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from thermostand.foundation.command_app import App
from thermostand.foundation.output import get_output, say, show
from thermostand.foundation.usage import escape_line
from thermostand.recording.format.inventory import list_segments
from thermostand.recording.reading.catalogue import ListedSession, Report, inspect_session, load_catalogue
from thermostand.recording.reading.notes import add_note, add_tags, check_tag, read_notes
from thermostand.stand.commands.sessions.session_args import SessionArgument, check_folder, check_session
from thermostand.stand.commands.sessions.session_table import (
    ON_THE_RIGHT,
    fit_columns,
    format_lines,
    make_entry_json,
    make_rows,
)

app = App(no_args_is_help=True)
_USUAL = {"run": ("complete", "running"), "files": ("sound",)}  # anything else is shown in another colour


@app.command("list")
def list_sessions(
    directory: Annotated[Path, typer.Argument(metavar="[DIR]", help="Where the sessions are.")] = Path("sessions"),
    tag: Annotated[
        list[str] | None, typer.Option("--tag", help="Only those with this tag; with each, when repeated.")
    ] = None,
    not_archived: Annotated[bool, typer.Option("--not-archived", help="Only those without a copy elsewhere.")] = False,
) -> None:
    """The sessions in a folder, the oldest first: recipe, start, duration, frames, size, how the
    run ended, whether the files are sound, and the operators' notes.

    Example: stand session list /data/sessions --tag paper
    """
    wanted = set(map(check_tag, tag or ()))
    seen = [entry for entry in list_sessions_at(check_folder(directory)) if wanted <= set(entry.tags)]
    seen = [entry for entry in seen if not (not_archived and entry.archived)]
    if get_output().as_json:
        show([make_entry_json(entry) for entry in seen], ())
    elif not seen:
        with_tag = f" with the tag {', '.join(sorted(wanted))}" if wanted else ""
        say(f"{directory}: no sessions{with_tag} there")
    elif sys.stdout.isatty():
        _show_table(seen)
    else:
        typer.echo("\n".join(format_lines(*make_rows(seen))))


def list_sessions_at(directory: Path) -> list[ListedSession]:
    """`directory` itself when it is a session, else those in it."""
    if list_segments(directory):
        return [inspect_session(directory)]
    with ExitStack() as stack:

        def progress(count: int) -> Report:
            from thermostand.foundation.progress import show_late_progress

            report = stack.enter_context(show_late_progress("look at sessions", count))
            return lambda done, text: report(done, escape_line(text))

        return load_catalogue(directory, progress)


def _show_table(seen: list[ListedSession]) -> None:
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    console = Console()
    columns, cells, left_out = fit_columns(*make_rows(seen), console.width)
    table = Table(box=None, pad_edge=False)
    for column in columns:
        is_name = column == columns[0]
        table.add_column(
            column, justify="right" if column in ON_THE_RIGHT else "left", overflow="fold", no_wrap=is_name
        )
    for row in cells:
        named = zip(columns, row, strict=True)
        table.add_row(
            *(Text(cell, style="yellow" if cell not in _USUAL.get(name, (cell,)) else "") for name, cell in named)
        )
    console.print(table)
    if left_out:
        say(f"the terminal is too narrow for: {', '.join(left_out)}; --json has them")


@app.command()
def note(
    directory: SessionArgument,
    text: Annotated[list[str], typer.Argument(metavar="TEXT...", help="What is to be remembered.")],
) -> None:
    """Add a note to a session, also while it runs; kept in it with your name and the time.

    Example: stand session note sessions/20260101T180000Z-thermal-cycle "door opened at 19:10"
    """
    _save(directory, partial(add_note, text=" ".join(text)))


@app.command()
def tag(
    directory: SessionArgument,
    tags: Annotated[list[str], typer.Argument(metavar="TAG...", help="Words to find it by.")],
    remove: Annotated[bool, typer.Option("--remove", help="Take these tags away instead.")] = False,
) -> None:
    """Give a session tags, also while it runs; `stand session list --tag TAG` finds it.

    Example: stand session tag sessions/20260101T180000Z-thermal-cycle paper lens-B
    """
    _save(directory, partial(add_tags, tags=tags, remove=remove))


def _save(directory: Path, add: Callable[..., None]) -> None:
    from thermostand.foundation.clock import WallClock
    from thermostand.foundation.files import accept_unsynced_folders

    with accept_unsynced_folders(lambda text: say(f"warning: {text}")):
        add(check_session(directory), by=get_user_name(), time_ns=WallClock().now_ns())
    text = read_notes(directory)
    count = f"{len(text.notes)} note{'' if len(text.notes) == 1 else 's'}"
    line = escape_line(f"{directory}: {count}, tags: {', '.join(text.tags) or 'none'}")
    show({"notes": [asdict(each) for each in text.notes], "tags": list(text.tags)}, [line])


def get_user_name() -> str:
    """Get the name of the user who gives the command."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())
