"""A recipe: which experiments and steps, one after another, with which parameters; YAML in, steps out."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping
from dataclasses import fields
from importlib.metadata import EntryPoint, entry_points
from itertools import islice
from typing import Any, Self, cast, get_type_hints

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    ValidationError,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from thermostand.experiments.calibration import CalibrationGrid, plan_calibration
from thermostand.experiments.recipe_steps import (
    MOST_STEPS,
    Place,
    PlanError,
    RecipeStep,
    StepEntries,
    check_steps,
    describe_unknown,
    expand_entries,
)
from thermostand.experiments.steps import PlannedStep, Situation, Step, number_steps
from thermostand.experiments.thermal_cycle import ThermalCycle, plan_thermal_cycle
from thermostand.experiments.validation import Validation, plan_validation
from thermostand.experiments.warm_up import WarmUp, plan_warm_up
from thermostand.foundation.document_faults import describe_fault
from thermostand.foundation.documents import Document
from thermostand.foundation.plugins import describe, get_package

# Experiments of other packages: the entry points of the group `thermostand.experiments`.
#
# Each is a function of one parameter, which is annotated with a pydantic model, that yields steps, as those of
# `experiments` are. Its name is the entry's key in a recipe. It must be pure: the same parameters give the same steps.

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
    """Return why this is no step that a stand can do; "" when it is one."""
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


_MADE_BY: Mapping[str, Callable[..., Iterable[Step]]] = {
    "warm_up": plan_warm_up,
    "thermal_cycle": plan_thermal_cycle,
    "calibration": plan_calibration,
    "validation": plan_validation,
}
_MOST_VISITS = 10_000  # captures; more than any camera lives through, and a plan is still listed within a second


class Experiment(Document):
    """One entry of the recipe: exactly one of the keys, or the name of an experiment that another package adds."""

    model_config = ConfigDict(json_schema_extra={"additionalProperties": True})  # names of other packages' experiments

    warm_up: WarmUp | None = None
    thermal_cycle: ThermalCycle | None = None
    calibration: CalibrationGrid | None = None
    validation: Validation | None = None
    steps: StepEntries | None = Field(default=None, min_length=1)
    _added: tuple[str, tuple[Step, ...]] = PrivateAttr(("", ()))

    @model_validator(mode="wrap")
    @classmethod
    def _parse_experiment(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        entry = cast("dict[object, object]", data) if isinstance(data, dict) else {}
        others = [name for name in entry if name not in cls.model_fields]
        if not others:
            return handler(data)
        name, known = str(others[0]), [*cls.model_fields, *list_experiments()]
        if name not in known:
            raise ValueError(
                f"{describe_unknown('experiment', name, known)}; others come with the package that adds them"
            )
        if len(entry) > 1:
            raise ValueError(f"give exactly one of {', '.join(known)}")
        experiment = cls.model_construct()
        experiment._added = (name, make_steps(name, entry[name]))
        return experiment

    @model_validator(mode="after")
    def _check_one_key(self) -> Self:
        if len(self._given) + bool(self._added[0]) != 1:
            raise ValueError(f"give exactly one of {', '.join(type(self).model_fields)}")
        return self

    @property
    def visits(self) -> int:
        """How many captures the entry asks for, the reference frames of a cycle and written steps apart."""
        return sum(getattr(parameters, "visits", 0) for parameters in self._given.values())

    @property
    def package(self) -> str:
        """The package that adds the entry's experiment, and its version; "" for our own."""
        return find_package(self._added[0]) if self._added[0] else ""

    def make_sequence(self, place: Place = (), found: Situation | None = None) -> Generator[RecipeStep, None, None]:
        """The steps of this entry, which stands at `place`; found: what those before it leave."""
        if self.steps is not None:
            yield from expand_entries(self.steps, (*place, "steps"), found or Situation())
            return
        name, steps = self._added
        if not name:
            name, parameters = next(iter(self._given.items()))
            steps = _MADE_BY[name](parameters)
        yield from (RecipeStep((*place, name), step) for step in steps)

    @property
    def _given(self) -> dict[str, object]:
        """The keys that have a value."""
        values = ((name, getattr(self, name)) for name in type(self).model_fields)
        return {name: value for name, value in values if value is not None}


class Recipe(Document):
    """A whole recipe file: the experiments in their order, then the steps."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=100)
    description: str = ""
    experiments: tuple[Experiment, ...] = Field(default=(), max_length=100)
    steps: StepEntries = ()

    @model_validator(mode="before")
    @classmethod
    def _check_is_recipe(cls, data: object) -> object:
        keys = cast("dict[object, object]", data) if isinstance(data, dict) else {}
        if "bus" in keys and "experiments" not in keys and "steps" not in keys:
            raise ValueError(
                "is a stand's file, and a recipe is wanted here (one with `experiments:` or `steps:`); give a stand's "
                "file behind --config"
            )
        return data

    @model_validator(mode="after")
    def _check_plan(self) -> Self:
        if not self.experiments and not self.steps:
            raise ValueError("nothing to do; give experiments: with one entry or more, or steps:")
        visits = sum(experiment.visits for experiment in self.experiments)
        if visits > _MOST_VISITS:
            raise ValueError(f"{visits} visits of set-points and positions are more than {_MOST_VISITS}")
        try:
            for _ in check_steps(self._expand()):
                pass
        except PlanError as error:
            fault = PydanticCustomError("plan", "{text}", {"text": str(error)})
            raise ValidationError.from_exception_data(
                "recipe", [InitErrorDetails(type=fault, loc=error.place, input=None)]
            ) from error
        return self

    def plan(self) -> Iterator[PlannedStep]:
        """Every step in order, numbered and identified."""
        return number_steps(written.step for written in self._expand())

    @property
    def packages(self) -> tuple[str, ...]:
        """The packages of other people that the plan depends on, with their versions."""
        return tuple(sorted({experiment.package for experiment in self.experiments} - {""}))

    def _expand(self) -> Iterator[RecipeStep]:
        found = Situation()
        for number, experiment in enumerate(self.experiments):
            for written in experiment.make_sequence(("experiments", number), found):
                yield written
                found = written.step.situation_after(found)
        yield from expand_entries(self.steps, ("steps",), found)
