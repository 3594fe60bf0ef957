"""Experiments of other packages: the entry points of the group `thermostand.experiments`.

Each is a function of one parameter, which is annotated with a pydantic model, that yields steps, as those of
`experiments` are. Its name is the entry's key in a recipe. It must be pure: the same parameters give the same steps.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Iterable
from dataclasses import fields
from importlib.metadata import EntryPoint, entry_points
from itertools import islice
from typing import Any, cast, get_type_hints

from pydantic import BaseModel, ValidationError
from pydantic_core import InitErrorDetails, PydanticCustomError

from thermostand.experiments.recipe_steps import MOST_STEPS
from thermostand.experiments.steps import Step
from thermostand.foundation.document_faults import describe_fault
from thermostand.foundation.plugins import describe, get_package

GROUP = "thermostand.experiments"
_AT_LEAST = {"frames": 1, "interval_s": 1e-6, "exposure_s": 1e-6}


def list_experiments() -> list[str]:
    """List the experiments that other packages add."""
    return sorted({point.name for point in entry_points(group=GROUP)})


def find_package(name: str) -> str:
    """The package that adds the experiment `name`, and its version, as in `acme-experiments 1.2`."""
    return get_package(_find_point(name))


def make_steps(name: str, parameters: object) -> tuple[Step, ...]:
    """The steps of the experiment `name` of another package; ValueError, or ValidationError with the parameter's place,
    when it is not there, refuses its parameters, or makes what is no plan."""
    point = _find_point(name)
    make, model = _load(point)
    try:
        checked = model.model_validate({} if parameters is None else parameters)
    except ValidationError as error:
        raise _prefix_faults(name, error) from error
    try:
        steps = tuple(islice(cast("Iterable[object]", make(checked)), MOST_STEPS + 1))
    except Exception as error:  # another package's code may raise anything
        raise ValueError(f"{name}: {get_package(point)} makes no steps of these ({describe(error)})") from error
    faults = (f"step {number} {fault}" for number, step in enumerate(steps, 1) if (fault := _find_fault(step)))
    if fault := next(faults, ""):
        raise ValueError(f"{name}: {get_package(point)} makes a step that cannot be done: {fault}; correct the package")
    return cast("tuple[Step, ...]", steps)


def _find_point(name: str) -> EntryPoint:
    found = {point.value: point for point in entry_points(group=GROUP, name=name)}
    if len(found) != 1:
        packages = " and ".join(sorted(get_package(point) for point in found.values()))
        raise ValueError(f"{name}: {packages} have an experiment of that name; keep one of them installed")
    return next(iter(found.values()))


def _load(point: EntryPoint) -> tuple[Callable[[BaseModel], object], type[BaseModel]]:
    """The function, and the model that its parameter is annotated with."""
    try:
        make = point.load()
        (parameter,) = inspect.signature(make).parameters
        model = get_type_hints(make)[parameter]
    except Exception as error:  # importing a stranger's module may raise anything
        text = (
            f"{point.name}: {get_package(point)} cannot be loaded ({describe(error)}); reinstall it, or leave this out"
        )
        raise ValueError(text) from error
    if not (inspect.isclass(model) and issubclass(model, BaseModel)):
        raise ValueError(f"{point.name}: {point.value} takes no pydantic model; annotate its parameter with one")
    return make, model


def _find_fault(step: object) -> str:
    """Why this is no step that a stand can do; "" when it is one."""
    if not isinstance(step, Step):
        return f"is no step of thermostand.experiments.steps but {type(step).__name__}"
    for name in [field.name for field in fields(cast("Any", step))]:
        value = getattr(step, name)
        if name in ("axis", "text", "role", "on", "unsettled"):
            continue
        if name == "cameras":
            is_right = isinstance(value, tuple) and all(
                isinstance(each, str) for each in cast("Iterable[object]", value)
            )
        else:
            least = _AT_LEAST.get(name, 0.0 if name.endswith("_s") else -math.inf)
            numbers = cast("tuple[object, ...]", value) if isinstance(value, tuple) else (value,)
            is_right = all(
                isinstance(each, float | int) and least <= each < math.inf for each in numbers if each is not None
            )
        if not is_right:
            return f"({step.kind}) has {name} {value!r}"
    return ""


def _prefix_faults(name: str, error: ValidationError) -> ValidationError:
    """The faults of an entry's parameters, with the entry's key in front of their places."""
    faults = [
        InitErrorDetails(
            type=PydanticCustomError("parameter", "{text}", {"text": describe_fault(fault)}),
            loc=(name, *fault["loc"]),
            input=fault["input"],
        )
        for fault in error.errors()
    ]
    return ValidationError.from_exception_data(name, faults)
