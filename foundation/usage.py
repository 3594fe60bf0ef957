"""What both command lines share: every error in one line, and commands that are imported when they are given."""

from __future__ import annotations

import importlib
import json
import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Annotated, Any, NamedTuple, cast

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from thermostand.foundation.version import read_version

_BAD_INPUT, _INTERRUPTED = 2, 130  # of exit_codes, which imports this module

# The base of what typer raises for wrong arguments; it exports only this descendant.
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__bases__[0])


@dataclass(slots=True)
class Answer:
    """What is printed for a program: wanted is whether --json was given, also where no argument could be read yet.
    is_given: the one document of the result is printed."""

    wanted: bool = False
    is_given: bool = False


_ANSWER: ContextVar[Answer | None] = ContextVar("answer", default=None)


def get_answer() -> Answer:
    """Get the answer of the command under way."""
    found = _ANSWER.get()
    if found is None:
        _ANSWER.set(found := Answer())
    return found


class OneLineUsage(TyperGroup):
    """Says what is wrong with the arguments in one line, like all other errors; without arguments it shows the help."""

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **extra: Any) -> Any:
        """Parse the arguments."""
        if not rest and extra.get("parent") is None:
            options = args[: args.index("--")] if "--" in args else args
            _ANSWER.set(Answer("--json" in options))
        if not args:
            return super().make_context(info_name, args, *rest, **extra)
        with _report_usage_errors():
            return super().make_context(info_name, args, *rest, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Parse and run the subcommand."""
        with _report_usage_errors():
            return super().invoke(ctx)


class LazyCommand(NamedTuple):
    """Where a command is: the module whose `app` holds it, or is it, and its line in the list of commands."""

    module: str
    help: str


def make_lazy_app(help_text: str, commands: Mapping[str, LazyCommand], *, has_completion: bool = False) -> typer.Typer:
    """A command line whose commands are listed without being imported: their libraries take seconds. has_completion:
    of a program, whose shell may complete its commands and their options."""

    class Commands(OneLineUsage):
        """Imports the command that is given."""

        def __init__(self, **attrs: Any) -> None:
            super().__init__(**attrs)
            self.commands.update({name: TyperCommand(name, help=lazy.help) for name, lazy in commands.items()})

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            if args and args[0] in commands:
                self.commands[args[0]] = _import_command(commands[args[0]].module, args[0])
            return super().resolve_command(ctx, args)

    app = typer.Typer(cls=Commands, no_args_is_help=True, add_completion=has_completion, help=help_text)
    app.callback()(_root)  # typer refuses an application with neither commands nor a callback
    return app


def show_version(asked: bool) -> None:
    """The callback of --version."""
    if asked:
        typer.echo(f"thermostand {read_version()}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", help="Show the version and end.", is_eager=True, callback=show_version)
]


def _root(version: VersionOption = False) -> None:
    """What both command lines take before a command."""


def _import_command(module: str, name: str) -> Any:
    """The command of that name; the whole group when the module has none of that name.

    NumPy and SciPy, which it may import, compute with one thread unless the environment says otherwise: their matrices
    are small here, and two threads, which wait for each other, took twice as long for a calibration (five times
    under other load).
    """
    # A calibration of 34 positions takes 5.9 to 6.9 s with two threads and 3.4 to 4.1 with one on two idle cores,
    # with two busy programs running 17 to 22 and 3.2 to 3.7. Set before NumPy is imported; a program's own setting
    # stays.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        # Imported when given: all of it took 1.5 to 1.9 s, which `stand stop` should not take.
        group = get_group(importlib.import_module(module).app)
    except KeyboardInterrupt as error:
        raise report_end("interrupted; nothing was started", _INTERRUPTED) from error
    return group.commands.get(name, group)


@contextmanager
def _report_usage_errors() -> Generator[None]:
    try:
        yield
    except _UsageError as error:
        if not error.format_message():  # it has shown its help
            raise typer.Exit(_BAD_INPUT) from error
        raise report_failure(error.format_message(), _BAD_INPUT) from error


def report_failure(sentence: object, status: int) -> typer.Exit:
    """Make the exception to be raised: the program ends with this status. `error: sentence` is on standard error by
    then, and with --json a document with both on standard output, unless that has the result already."""
    print_error(sentence)
    return _report_status(sentence, status)


def report_end(sentence: object, status: int) -> typer.Exit:
    """Report an end as `report_failure` does, when it is nobody's error."""
    typer.echo(escape_line(sentence), err=True)
    return _report_status(sentence, status)


def print_error(sentence: object) -> None:
    """`error: sentence` on standard error."""
    typer.echo(f"error: {escape_line(sentence)}", err=True)


def _report_status(sentence: object, status: int) -> typer.Exit:
    asked = get_answer()
    if asked.wanted and not asked.is_given:
        asked.is_given = True
        typer.echo(json.dumps({"error": str(sentence), "exit_status": status}))
    return typer.Exit(status)


def escape_line(sentence: object) -> str:
    """The text with line ends, and what else cannot be printed, as escapes: a file's name may hold anything."""
    text = str(sentence)
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode() for character in text
    )
