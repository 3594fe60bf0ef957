"""What other packages add: entry points of this program's groups, each loaded when its name is first asked for."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import EntryPoint, entry_points
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticCustomError

from thermostand.foundation.document_faults import describe_fault, format_path
from thermostand.foundation.errors import ConfigError

Row = TypeVar("Row")


def get_package(point: EntryPoint) -> str:
    """The package that adds it, and its version, as in `acme-lamp 1.0`."""
    return point.value if point.dist is None else f"{point.dist.name} {point.dist.version}"


def load_point(point: EntryPoint) -> Any:
    """Return what the entry point leads to; ConfigError when it cannot be imported."""
    try:
        return point.load()
    except Exception as error:  # importing a stranger's module may raise anything
        raise ConfigError(
            f"{point.name}: {get_package(point)} cannot be loaded ({describe(error)}); reinstall it"
        ) from error


def describe(error: Exception) -> str:
    """An error of another package's code, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def load_row(group: str, name: str, row: type[Row], what: str) -> Row:
    """The `row` of that name, which has it as its own `name`; ConfigError when no package adds one, or it is another.
    what: how a message calls such a thing, before its name."""
    for point in entry_points(group=group, name=name):
        found = load_point(point)
        if not isinstance(found, row) or getattr(found, "name", "") != name:
            raise ConfigError(
                f"{name}: {get_package(point)} has no {row.__name__} of that name there; correct the package"
            )
        return found
    known = ", ".join(sorted({point.name for point in entry_points(group=group)})) or "none installed"
    raise ConfigError(f"no package adds {what} {name!r}; there are {known}")


def check_settings(settings: type[BaseModel], given: Mapping[str, object]) -> BaseModel:
    """The settings of what another package adds, inside the check of a document; ValueError with each fault's place."""
    try:
        return settings.model_validate(given)
    except ValidationError as error:
        faults = (f"{format_path(each['loc'])}: {describe_fault(each)}" for each in error.errors())
        raise PydanticCustomError("added", "{text}", {"text": "; ".join(faults)}) from error
