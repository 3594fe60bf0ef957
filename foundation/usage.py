"""What both commands share: every error in one line, a wrong argument as well."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from typing import Any, cast

import typer
from typer.core import TyperGroup

# The base of what typer raises for wrong arguments; it exports only this descendant.
_UsageError = cast("type[typer.BadParameter]", typer.BadParameter.__bases__[0])


class OneLineUsage(TyperGroup):
    """Says what is wrong with the arguments in one line, as every other error is said; no arguments ask for help."""

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
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode()
        for character in str(sentence)
    )
