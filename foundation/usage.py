"""What both command lines share: every error in one line, and commands that are imported when they are given."""

from __future__ import annotations

import importlib
import os
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from typing import Annotated, Any, NamedTuple, cast

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_group

from foundation.version import installed_version

_INTERRUPTED = 130  # exit_codes.INTERRUPTED, which imports this module

# The base of what typer raises for wrong arguments; it exports only this descendant.
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__bases__[0])


class OneLineUsage(TyperGroup):
    """Says what is wrong with the arguments in one line, like all other errors; without arguments it shows the help."""

    def make_context(self, info_name: str | None, args: list[str], *rest: Any, **extra: Any) -> Any:
        """Parse the arguments."""
        if not args:
            return super().make_context(info_name, args, *rest, **extra)
        with _usage_in_one_line():
            return super().make_context(info_name, args, *rest, **extra)

    def invoke(self, ctx: Any) -> Any:
        """Parse and run the subcommand."""
        with _usage_in_one_line():
            return super().invoke(ctx)


class Lazy(NamedTuple):
    """Where a command is: the module whose `app` holds it, or is it, and its line in the list of commands."""

    module: str
    help: str


def lazy_app(help_text: str, commands: Mapping[str, Lazy], *, has_completion: bool = False) -> typer.Typer:
    """A command line whose commands are listed without being imported: their libraries take seconds. has_completion:
    of a program, whose shell may complete its commands and their options."""

    class Commands(OneLineUsage):
        """Imports the command that is given."""

        def __init__(self, **attrs: Any) -> None:
            super().__init__(**attrs)
            self.commands.update({name: TyperCommand(name, help=lazy.help) for name, lazy in commands.items()})

        def resolve_command(self, ctx: Any, args: list[str]) -> Any:
            if args and args[0] in commands:
                self.commands[args[0]] = _imported(commands[args[0]].module, args[0])
            return super().resolve_command(ctx, args)

    app = typer.Typer(cls=Commands, no_args_is_help=True, add_completion=has_completion, help=help_text)
    app.callback()(_root)  # typer refuses an application with neither commands nor a callback
    return app


def show_version(asked: bool) -> None:
    """The callback of --version."""
    if asked:
        typer.echo(f"thermostand {installed_version()}")
        raise typer.Exit


VersionOption = Annotated[
    bool, typer.Option("--version", help="Show the version and end.", is_eager=True, callback=show_version)
]


def _root(version: VersionOption = False) -> None:
    """What both command lines take before a command."""


def _imported(module: str, name: str) -> Any:
    """The command of that name; the whole group when the module has none of that name.

    NumPy and SciPy, which it may import, compute with one thread unless the environment says otherwise: their matrices
    are small here, and two threads, which wait for each other, took twice as long for a calibration (beside load five
    times).
    """
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        group = get_group(importlib.import_module(module).app)
    except KeyboardInterrupt as error:
        typer.echo("interrupted; nothing was started", err=True)
        raise typer.Exit(_INTERRUPTED) from error
    return group.commands.get(name, group)


@contextmanager
def _usage_in_one_line() -> Generator[None]:
    try:
        yield
    except _UsageError as error:
        if error.format_message():  # else it has shown its help
            tell(error.format_message())
        raise typer.Exit(2) from error


def tell(sentence: object) -> None:
    """`error: sentence` on standard error."""
    typer.echo(f"error: {one_line(sentence)}", err=True)


def one_line(sentence: object) -> str:
    """The text with line ends, and what else cannot be printed, as escapes: a file's name may hold anything."""
    text = str(sentence)
    if text.isprintable():
        return text
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode() for character in text
    )
