"""Drawn cameras in moving air, learned with frames on the way: what compensation leaves, and how often the 95 %
interval holds, flagged or not."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from tests.bench.figures import Figure, absolute, at_least, progress
from tests.benchmark.methods import corrector
from tests.benchmark.nights import GROUPS, TASKS, TRAININGS, case
from tests.benchmark.scoring import Corrector, Score, scores
from thermostand.compensation.drift.choosing import fit
from thermostand.compensation.observations import Observations

FIRST, CAMERAS = 40, 6  # beyond those of `make benchmark`
LEAST_COVERED = 92


def figures() -> Iterator[Figure]:
    """Of small steps and of jumps, without and with what does not repeat."""
    for group in GROUPS:
        progress(f"drift, {CAMERAS} drawn cameras in moving air, {group}")
        numbers = range(FIRST, FIRST + CAMERAS)
        found = [one for number in numbers for one in scores("thermal", _everywhere, case(group, number, TRAININGS[1]))]
        for task in TASKS[1:]:
            yield from _of_task(f"drift, {task}; {group}", [one for one in found if one.task == task])


def _of_task(what: str, found: list[Score]) -> Iterator[Figure]:
    yield absolute(what, "mpx RMS", [one.rms_mpx for one in found])
    covered = absolute("  95 % interval, flagged or not", "%", [100 * float(np.mean([one.covered for one in found]))])
    yield at_least(LEAST_COVERED, covered)


def _everywhere(training: Observations) -> Corrector:
    """The thermal form, which stands by all of its answers here."""
    corrected = corrector(fit(training, form="thermal"))
    return lambda night, frames, seen_px: replace(corrected(night, frames, seen_px), inside=None)
