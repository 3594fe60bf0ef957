"""What a command says: its result on standard output, for people or as JSON, all else on standard error."""

from __future__ import annotations

import json
from collections.abc import Generator, Iterable
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass

import typer

from thermostand.foundation.json_values import make_plain
from thermostand.foundation.usage import escape_line, get_answer


@dataclass(frozen=True, slots=True)
class Output:
    """quiet: nothing but the result and errors. verbose: events of no importance too, and where an error came from.
    as_json: the result is one JSON document."""

    quiet: bool = False
    verbose: bool = False
    as_json: bool = False


_OUTPUT: ContextVar[Output] = ContextVar("output", default=Output())  # noqa: B039 - it is immutable


def get_output() -> Output:
    """Return what the command under way was asked for. In a thread of one's own: the defaults."""
    return _OUTPUT.get()


@contextmanager
def set_output(wanted: Output) -> Generator[None]:
    """`output()` gives this inside."""
    before = _OUTPUT.set(wanted)
    get_answer().wanted = wanted.as_json
    try:
        yield
    finally:
        _OUTPUT.reset(before)


def show(data: object, lines: Iterable[object]) -> None:
    """The result of a command: `data` (values of JSON, dataclasses, arrays; what else there is as text; NaN and
    infinities as null), or the lines."""
    if get_output().as_json:
        get_answer().is_given = True
        typer.echo(json.dumps(make_plain(data), indent=2, default=str))
        return
    for line in lines:
        typer.echo(line)


def json_line(data: object) -> str:
    """Format what goes on for programs: as `show` prints it, in one line."""
    return json.dumps(make_plain(data), default=str)


def say(line: object) -> None:
    """Print what goes on, in one line on standard error; nothing when quiet."""
    if not get_output().quiet:
        typer.echo(escape_line(line), err=True)
