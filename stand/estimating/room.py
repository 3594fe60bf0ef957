"""Whether there is room on the disk for a plan."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from stand.config.stand_config import StandConfig
from stand.estimating.estimate import PricedStep


def existing(directory: Path) -> Path:
    """`directory`, or the nearest folder above it that is there."""
    return next(path for path in (directory, *directory.absolute().parents) if path.exists() or path.is_symlink())


def small_disk(free_bytes: int, steps: Iterable[PricedStep], config: StandConfig) -> str:
    """What is wrong with so much room for a run that would stop in the middle of the night; "" when it will do."""
    plan_GB, least_GB = sum(step.size_bytes for step in steps) / 1e9, config.recording.stop_frames_below_GB
    if free_bytes / 1e9 >= plan_GB + least_GB:
        return ""
    return f"{free_bytes / 1e9:.1f} GB are free; the plan records {plan_GB:.1f} GB and waits below {least_GB:.1f} GB"
