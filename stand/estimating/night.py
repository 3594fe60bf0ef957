"""What a whole run will take on this stand, by what its last nights have taught."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from experiments.steps import PlannedStep
from stand.config.stand_config import StandConfig
from stand.estimating.estimate import PricedStep, price, way_back_s
from stand.estimating.learned import load_learned


@dataclass(frozen=True, slots=True)
class Night:
    """steps: of the plan, each priced. after_s: what follows the last one, the way back to the laboratory's
    temperature."""

    steps: tuple[PricedStep, ...]
    after_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """All of it."""
        return sum(step.duration_s for step in self.steps) + self.after_s


def price_night(plan: Sequence[PlannedStep], config: StandConfig, directory: Path) -> Night:
    """Of a plan whose session will lie in `directory`; ConfigError as price."""
    learned = load_learned(directory)
    return Night(price(plan, config, learned), way_back_s(plan, config, learned))
