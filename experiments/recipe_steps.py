"""Steps as a recipe writes them: any step by its name, `repeat:` of steps, and `ramp:` of the set-point.

An entry has exactly one key. A capture takes the set-point it is made at from the steps before it.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Annotated, Any, Self, cast

from pydantic import (
    BeforeValidator,
    Field,
    GetJsonSchemaHandler,
    ModelWrapValidatorHandler,
    PrivateAttr,
    TypeAdapter,
    ValidationError,
    create_model,
    model_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from thermostand.experiments.parameters import Chamber_degC
from thermostand.experiments.steps import STEPS, Capture, SetTemperature, Situation, Soak, Step, find_step_kind
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError

Place = tuple[str | int, ...]  # of an entry within the recipe, as in ("experiments", 0, "steps", 3)


class PlanError(ValueError):
    """A step cannot be where it is in the plan; `place` is that of its entry, the text says what to do."""

    def __init__(self, place: Place, text: str) -> None:
        super().__init__(text)
        self.place = place


@dataclass(frozen=True, slots=True)
class RecipeStep:
    """A step, and the place of the entry that it comes from."""

    place: Place
    step: Step


class NoParameters(Document):
    """A step without parameters."""


class RepeatEntry(Document):
    """The same steps `times` times."""

    times: int = Field(ge=1, le=10_000, description="How often.")
    steps: StepEntries = Field(min_length=1, description="What is repeated.")


class RampEntry(Document):
    """The set-point goes from where it is to `to_degC`, by `rate_K_per_min`: a new set-point every `every_K`, a soak
    that keeps the rate, then `steps`."""

    to_degC: Chamber_degC = Field(description="Where the ramp ends.")
    rate_K_per_min: float = Field(gt=0, le=20, description="How fast the set-point goes.")
    every_K: float = Field(default=1.0, ge=0.1, le=80, description="From one set-point of the ramp to the next.")
    steps: StepEntries = Field(default=(), description="What is done at each of them.")

    def set_points(self, from_degC: float) -> Iterator[tuple[float, float]]:
        """Each set-point, degC, and the soak after it, s."""
        way_K, before_degC = self.to_degC - from_degC, from_degC
        count = math.ceil(abs(way_K) / self.every_K - 1e-9)
        for number in range(1, count + 1):
            part = math.copysign(self.every_K * number, way_K)
            degC = self.to_degC if number == count else round(from_degC + part, 6)
            yield degC, round(abs(degC - before_degC) / self.rate_K_per_min * 60.0, 6)
            before_degC = degC


def _normalize_entry(value: object) -> object:
    """A name alone is a step without parameters, and so is a name without a value."""
    if isinstance(value, str):
        value = {value: None}
    if not isinstance(value, Mapping):
        raise ValueError("give the step's name, with its parameters behind a colon if it has any")
    entry = dict(cast("Mapping[object, object]", value))
    names = [str(name) for name in entry]
    if len(names) != 1:
        raise ValueError(f"an entry is one step, this one has {' and '.join(names) or 'none'}; begin each with a dash")
    return {names[0]: next(iter(entry.values()))}


def describe_unknown(what: str, name: str, known: Iterable[str]) -> str:
    """The sentence about a name that is none of these."""
    near = difflib.get_close_matches(name, known, 1, 0.5)
    advice = f"did you mean {near[0]}? There are" if near else "there are"
    return f"there is no {what} {name[:100]!r}; {advice} {', '.join(known)}"


@cache
def _make_entry_model(step: type[Step]) -> type[Document]:
    """Return what an entry of that kind is: one field, by the kind's name. A kind without a value, or whose values all
    have defaults, needs none behind its colon."""
    return create_model(step.kind, __base__=Document, **cast("Any", {step.kind: (_get_form(step), ...)}))


def _get_form(step: type[Step]) -> Any:
    return NoParameters if step.form is None else step.form


def _needs_value(step: type[Step]) -> bool:
    try:
        TypeAdapter(_get_form(step)).validate_python({})
    except ValidationError:
        return True
    return False


def _list_recipe_steps() -> dict[str, type[Step]]:
    return {kind: step for kind, step in STEPS.items() if step.in_recipes}


class StepEntry(Document):
    """One step, repeat or ramp."""

    ramp: RampEntry | None = None
    repeat: RepeatEntry | None = None
    _step: tuple[type[Step], object] | None = PrivateAttr(None)

    @model_validator(mode="wrap")
    @classmethod
    def _parse_step(cls, data: object, handler: ModelWrapValidatorHandler[Self]) -> Self:
        if isinstance(data, cls):
            return data
        ((name, value),) = cast("dict[str, object]", data).items()
        if name in cls.model_fields:
            if value is None:
                raise ValueError(f"{name} needs a value behind its colon")
            return handler(data)
        try:
            step = find_step_kind(name)
        except ConfigError as error:
            raise ValueError(str(error)) from error
        if step is None or not step.in_recipes:
            raise ValueError(describe_unknown("step", name, [*_list_recipe_steps(), *cls.model_fields]))
        if value is None:
            if _needs_value(step):
                raise ValueError(f"{name} needs a value behind its colon")
            value = {}
        entry = cls.model_construct()
        entry._step = (step, getattr(_make_entry_model(step).model_validate({name: value}), name))
        return entry

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        schema = handler(core)
        whole = handler.resolve_ref_schema(schema)
        fields = {kind: (_get_form(step) | None, None) for kind, step in _list_recipe_steps().items()}
        forms = create_model("Forms", **cast("Any", fields))
        kinds = handler.resolve_ref_schema(handler(forms.__pydantic_core_schema__))
        whole["properties"] = kinds["properties"] | whole["properties"]
        return schema

    @property
    def name(self) -> str:
        """The entry's one key."""
        if self._step is not None:
            return self._step[0].kind
        (name,) = self.model_fields_set
        return name

    def steps(self, place: Place, at_degC: float | None) -> Iterator[Step]:
        """The steps of an entry that is neither repeat nor ramp. Raises PlanError."""
        if self._step is not None:
            step, value = self._step
            try:
                yield from step.of_form(value, at_degC)
            except ValueError as error:
                raise PlanError(place, str(error)) from error


StepEntries = tuple[
    Annotated[StepEntry, BeforeValidator(_normalize_entry, json_schema_input_type=str | StepEntry)], ...
]
RepeatEntry.model_rebuild()
RampEntry.model_rebuild()
StepEntry.model_rebuild()


def expand_entries(
    entries: Sequence[StepEntry], place: Place, found: Situation
) -> Generator[RecipeStep, None, Situation]:
    """The steps of `entries`, which stand at `place`. found: what the steps before them leave; what these leave is
    returned. Raises PlanError."""
    for number, entry in enumerate(entries):
        here = (*place, number, entry.name)
        if entry.repeat is not None:
            for _ in range(entry.repeat.times):
                found = yield from expand_entries(entry.repeat.steps, (*here, "steps"), found)
        elif entry.ramp is not None:
            if found.set_point_degC is None:
                raise PlanError(here, "a ramp begins at a set-point; give start_chamber before it")
            for degC, soak_s in entry.ramp.set_points(found.set_point_degC):
                for step in (SetTemperature(degC), Soak(soak_s, band_K=0.0)):
                    yield RecipeStep(here, step)
                    found = step.situation_after(found)
                found = yield from expand_entries(entry.ramp.steps, (*here, "steps"), found)
        else:
            for step in entry.steps(here, found.set_point_degC):
                yield RecipeStep(here, step)
                found = step.situation_after(found)
    return found


# Whether a sequence of steps makes sense: what each step needs of those before it.

MOST_STEPS = 100_000  # of a plan: weeks; it is still listed within seconds
MOST_CAPTURES = 20_000  # more than any camera lives through


def check_steps(steps: Iterable[RecipeStep]) -> Iterator[RecipeStep]:
    """The steps as they are; PlanError at the first that cannot be where it is, or is one too many."""
    for written, fault in find_faults(steps):
        if fault:
            raise PlanError(written.place, fault)
        yield written


def find_faults(steps: Iterable[RecipeStep]) -> Iterator[tuple[RecipeStep, str]]:
    """Each step, and why it cannot be where it is or that it is one too many; "" when it can."""
    found, captures = Situation(), 0
    for count, written in enumerate(steps):
        captures += isinstance(written.step, Capture)
        fault = written.step.placement_fault(found)
        if count >= MOST_STEPS or captures > MOST_CAPTURES:
            fault = f"the plan has more than {MOST_STEPS} steps or {MOST_CAPTURES} captures here; repeat less often"
        found = written.step.situation_after(found)
        yield written, fault
