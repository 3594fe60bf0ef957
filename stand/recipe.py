"""A recipe: which experiments run, one after another, with which parameters; YAML in, steps out."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Self

from pydantic import Field, model_validator

from drivers.documents import Document, load_document
from experiments.steps import PlannedStep, Step, number_steps
from experiments.thermal_cycle import ThermalCycle, thermal_cycle
from experiments.warm_up import WarmUp, warm_up

_MOST_VISITS = 10_000  # of set-points; more than any camera lives through, and a plan is still listed within a second


class Experiment(Document):
    """One entry of the recipe: exactly one of the keys."""

    thermal_cycle: ThermalCycle | None = None
    warm_up: WarmUp | None = None

    @model_validator(mode="after")
    def _exactly_one(self) -> Self:
        if (self.thermal_cycle is None) == (self.warm_up is None):
            raise ValueError("give exactly one of thermal_cycle, warm_up")
        return self

    def steps(self) -> Iterator[Step]:
        """The steps of this entry."""
        if self.thermal_cycle is not None:
            yield from thermal_cycle(self.thermal_cycle)
        if self.warm_up is not None:
            yield from warm_up(self.warm_up)


class Recipe(Document):
    """A whole recipe file."""

    name: str = Field(pattern=r"^[a-z0-9][a-z0-9-]*$", max_length=100)
    description: str = ""
    experiments: tuple[Experiment, ...] = Field(min_length=1, max_length=100)

    @model_validator(mode="after")
    def _ends(self) -> Self:
        cycles = (experiment.thermal_cycle for experiment in self.experiments)
        visits = sum(cycle.visits for cycle in cycles if cycle is not None)
        if visits > _MOST_VISITS:
            raise ValueError(f"{visits} visits of set-points are more than {_MOST_VISITS}")
        return self

    def plan(self) -> Iterator[PlannedStep]:
        """Every step in order, numbered and identified."""
        return number_steps(step for experiment in self.experiments for step in experiment.steps())


def load_recipe(path: Path) -> Recipe:
    """The recipe file, checked; ConfigError names file and path."""
    return load_document(path, Recipe)
