"""Datasheets of drawn cameras: whether two nights agree within what each states, and whether the truth does."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from tests.bench.figures import Figure, absolute, at_least, progress
from tests.compensation.drawn_cameras import REPEATING, UNREPEATING, Camera, drawn_camera
from tests.compensation.drawn_nights import full_night, night
from tests.compensation.test_datasheet import COEFFICIENTS, at_rest_per_K
from thermostand.compensation.datasheet.datasheet import Datasheet, datasheet
from thermostand.compensation.drift.choosing import fit

CAMERAS = 20
_FIRST, _CHANCE = 2000, 0.4


def figures(directory: Path) -> list[Figure]:
    """% of entries."""
    agree: list[bool] = []
    true: list[bool] = []
    for number in range(CAMERAS):
        progress(f"datasheet, two nights of drawn camera {number + 1} of {CAMERAS}")
        one, other = (_sheet(_camera(number), 100 * number + k) for k in (0, 1))
        for first, second in zip(one.quantities, other.quantities, strict=True):
            if math.isfinite(first.value) and math.isfinite(second.value):
                agree.append(abs(first.value - second.value) <= math.hypot(first.expanded, second.expanded))
        plain = drawn_camera(_FIRST + number)
        known = _sheet(plain, 100 * number).by_key
        for key, truth in zip(COEFFICIENTS, at_rest_per_K(plain), strict=True):
            true.append(abs(known[key].value - truth) <= known[key].expanded)
    return [
        at_least(93, absolute("datasheet: entries of two nights that agree", "%", [100 * float(np.mean(agree))])),
        absolute("  true coefficients at rest within U; 95 is right", "%", [100 * float(np.mean(true))]),
    ]


def _camera(number: int) -> Camera:
    rng = np.random.default_rng([20, number])
    effects = [name for name in REPEATING if rng.random() < _CHANCE]
    if rng.random() < 0.5:
        effects.append(UNREPEATING[rng.integers(2)])
    return drawn_camera(_FIRST + number, *effects)


def _sheet(camera: Camera, seed: int) -> Datasheet:
    made = night(camera, full_night(), seed)
    return datasheet(made.observed, fit(made.observed))
