"""A recipe: which experiments run, one after another, with which parameters; YAML in, steps out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from experiments.calibration import Calibration, calibration
from experiments.steps import PlannedStep, Step, number_steps
from experiments.thermal_cycle import ThermalCycle, thermal_cycle
from experiments.validation import Validation, validation
from experiments.warm_up import WarmUp, warm_up
from foundation.documents import Document, load_document

_MOST_VISITS = 10_000  # captures; more than any camera lives through, and a plan is still listed within a second


class Experiment(Document):
    """One entry of the recipe: exactly one of the keys."""

    warm_up: WarmUp | None = None
    thermal_cycle: ThermalCycle | None = None
    calibration: Calibration | None = None
    validation: Validation | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        if len(self._given) != 1:
            raise ValueError(f"give exactly one of {', '.join(type(self).model_fields)}")
        return self

    @property
    def visits(self) -> int:
        """How many captures the entry asks for, the reference frames of a cycle apart."""
        return self._given[0].visits

    def steps(self) -> Iterator[Step]:
        """The steps of this entry."""
        match self._given[0]:
            case WarmUp() as parameters:
                return warm_up(parameters)
            case ThermalCycle() as parameters:
                return thermal_cycle(parameters)
            case Calibration() as parameters:
                return calibration(parameters)
            case Validation() as parameters:
                return validation(parameters)

    @property
    def _given(self) -> tuple[WarmUp | ThermalCycle | Calibration | Validation, ...]:
        entries = (self.warm_up, self.thermal_cycle, self.calibration, self.validation)
        return tuple(entry for entry in entries if entry is not None)


class Recipe(Document):
    """A whole recipe file."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=100)
    description: str = ""
    experiments: tuple[Experiment, ...] = Field(min_length=1, max_length=100)

    @model_validator(mode="after")
    def _ends(self) -> Self:
        visits = sum(experiment.visits for experiment in self.experiments)
        if visits > _MOST_VISITS:
            raise ValueError(f"{visits} visits of set-points and positions are more than {_MOST_VISITS}")
        return self

    def plan(self) -> Iterator[PlannedStep]:
        """Every step in order, numbered and identified."""
        return number_steps(step for experiment in self.experiments for step in experiment.steps())


def load_recipe(path: Path) -> Recipe:
    """The recipe file, checked; ConfigError names file and path."""
    return load_document(path, Recipe)
