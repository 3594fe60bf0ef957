"""A step that sets the lamp next to the target to a level."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field

from thermostand.experiments.steps import KnownStand, PerformingStand, Price, Situation, Step

PERFORMED: list[float] = []
"""Levels that were set; a test reads them."""


@dataclass(frozen=True, slots=True)
class LampOn(Step):
    """The lamp next to the target, at `percent` of its light."""

    kind = "lamp_on"
    is_setup = True  # a state, which is set again after an interruption
    says = "lamp at {percent:g} %"
    form = Annotated[float, Field(ge=0, le=100)]  # what a recipe writes: `- lamp_on: 40`
    percent: float

    def stand_fault(self, stand: KnownStand) -> str:
        """A plan with it is refused with this sentence; "" when the stand can do it."""
        return "the lamp stands too near the camera" if self.percent > 90 else ""

    def price(self, found: Situation, stand: KnownStand) -> Price:
        """Return how long it takes, s."""
        return Price(self.kind, 4.0)

    async def perform(self, stand: PerformingStand) -> None:
        """Do it."""
        PERFORMED.append(self.percent)
        await stand.table.check_home("lamp")
