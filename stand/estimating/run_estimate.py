"""What a whole run will take, learned from the stand's last sessions, and whether the disk has space for it."""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

from thermostand.experiments.steps import PlannedStep
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.estimate import PricedStep, estimate_return_s, price_plan
from thermostand.stand.estimating.learned_durations import load_learned_durations


@dataclass(frozen=True, slots=True)
class PlanEstimate:
    """steps: of the plan, each priced. after_s: what follows the last one, the way back to the laboratory's
    temperature."""

    steps: tuple[PricedStep, ...]
    after_s: float = 0.0

    @property
    def duration_s(self) -> float:
        """All of it."""
        return sum(step.duration_s for step in self.steps) + self.after_s


def estimate_plan(plan: Sequence[PlannedStep], config: StandConfig, directory: Path) -> PlanEstimate:
    """Estimate a plan whose session will lie in `directory`; ConfigError as price."""
    learned = load_learned_durations(directory)
    return PlanEstimate(price_plan(plan, config, learned), estimate_return_s(plan, config, learned))


def find_existing(directory: Path) -> Path:
    """`directory`, or the nearest folder above it that is there."""
    return next(path for path in (directory, *directory.absolute().parents) if path.exists() or path.is_symlink())


def explain_small_disk(directory: Path, steps: Iterable[PricedStep], config: StandConfig) -> str:
    """Return why the disk has too little space for a run, which would stop half-way; "" when there is enough."""
    free_bytes = shutil.disk_usage(find_existing(directory)).free
    plan_GB, least_GB = sum(step.size_bytes for step in steps) / 1e9, config.recording.stop_frames_below_GB
    if free_bytes / 1e9 >= plan_GB + least_GB:
        return ""
    return f"{free_bytes / 1e9:.1f} GB are free; the plan records {plan_GB:.1f} GB and waits below {least_GB:.1f} GB"
