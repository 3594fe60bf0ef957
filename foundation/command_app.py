"""The commands of a module, each with the options that all of them have."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from typing import Annotated, Any, TypeVar, cast, get_type_hints

import typer

from thermostand.foundation.exit_codes import exit_on_error
from thermostand.foundation.output import Output, set_output
from thermostand.foundation.usage import OneLineUsage, VersionOption

Function = TypeVar("Function", bound=Callable[..., Any])


_COMMON: dict[str, Any] = {
    "common_quiet": Annotated[bool, typer.Option("--quiet", "-q", help="Nothing but the result and errors.")],
    "common_verbose": Annotated[
        bool, typer.Option("--verbose", "-v", help="Events of no importance too, and where an error came from.")
    ],
    "common_json": Annotated[bool, typer.Option("--json", help="The result as JSON.")],
    "common_version": VersionOption,
}


class App(typer.Typer):
    """Every command has -q, -v, --version and --json, which `foundation.output` knows of, and ends as `exit_codes` has
    it."""

    def __init__(self, help: str | None = None, *, no_args_is_help: bool = False) -> None:  # noqa: A002 - as in typer
        own: dict[str, Any] = {} if help is None else {"help": help}  # else it is that of the callback
        super().__init__(cls=OneLineUsage, add_completion=False, no_args_is_help=no_args_is_help, **own)

    def command(self, name: str | None = None, **settings: Any) -> Callable[[Function], Function]:
        """Register a command as typer does; a parameter that is a dataclass is given by options, one for each of its
        fields."""
        register = super().command(name, **settings)

        def take(function: Function) -> Function:
            register(_add_common_options(_expand_groups(function)))
            return function

        return take


def _expand_groups(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with the options of its groups instead of them."""
    for name, parameter in inspect.signature(function, eval_str=True).parameters.items():
        if is_dataclass(parameter.annotation):
            function = _expand_group(function, name, cast("type[Any]", parameter.annotation))
    return function


def _expand_group(function: Callable[..., Any], group: str, kind: type[Any]) -> Callable[..., Any]:
    @functools.wraps(function)
    def command(*args: Any, **options: Any) -> Any:
        chosen = {field.name: options.pop(field.name) for field in fields(kind)}
        return function(*args, **options, **{group: kind(**chosen)})

    hints = get_type_hints(kind, include_extras=True)
    added = {field.name: (hints[field.name], field.default) for field in fields(kind)}
    return add_parameters(command, function, added, without=group)


def _add_common_options(function: Callable[..., Any]) -> Callable[..., Any]:
    """`function` with the common options behind its own; what it raises becomes its sentence and its exit status."""

    @functools.wraps(function)
    def command(*args: Any, **options: Any) -> Any:
        asked = {name: bool(options.pop(name, False)) for name in _COMMON}
        wanted = Output(asked["common_quiet"], asked["common_verbose"], asked["common_json"])
        with set_output(wanted), exit_on_error():
            return function(*args, **options)

    return add_parameters(command, function, {name: (kind, False) for name, kind in _COMMON.items()})


def add_parameters(
    command: Callable[..., Any],
    function: Callable[..., Any],
    added: Mapping[str, tuple[Any, object]],
    without: str = "",
) -> Callable[..., Any]:
    """`command`, which typer then sees with the parameters of `function` but for `without`, and behind them those that
    are added: an annotation and a default by name."""
    own = inspect.signature(function, eval_str=True)
    kept = [parameter for name, parameter in own.parameters.items() if name != without]
    behind = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)
        for name, (kind, default) in added.items()
    ]
    cast("Any", command).__signature__ = own.replace(parameters=[*kept, *behind])
    kinds = {parameter.name: parameter.annotation for parameter in (*kept, *behind)}
    command.__annotations__ = {**kinds, "return": own.return_annotation}
    return command
