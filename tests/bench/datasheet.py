"""Datasheets of drawn cameras: whether two sessions agree within what each states, and whether the truth does."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np

from tests.bench.figures import Figure, make_absolute, report_progress, set_lower_goal
from tests.compensation.drawn_cameras import REPEATING, UNREPEATING, Camera, draw_camera
from tests.compensation.drawn_sessions import make_full_session, record_session
from tests.compensation.test_datasheet import COEFFICIENTS, at_rest_per_K
from thermostand.compensation.datasheet.datasheet import Datasheet, compute_datasheet
from thermostand.compensation.drift.model_selection import fit

CAMERAS = 20
_FIRST, _CHANCE = 2000, 0.4


def figures(directory: Path) -> list[Figure]:
    """% of entries."""
    agree: list[bool] = []
    true: list[bool] = []
    for number in range(CAMERAS):
        report_progress(f"datasheet, two sessions of drawn camera {number + 1} of {CAMERAS}")
        one, other = (_make_sheet(_draw_camera(number), 100 * number + k) for k in (0, 1))
        for first, second in zip(one.quantities, other.quantities, strict=True):
            if math.isfinite(first.value) and math.isfinite(second.value):
                agree.append(abs(first.value - second.value) <= math.hypot(first.expanded, second.expanded))
        plain = draw_camera(_FIRST + number)
        known = _make_sheet(plain, 100 * number).by_key
        for key, truth in zip(COEFFICIENTS, at_rest_per_K(plain), strict=True):
            true.append(abs(known[key].value - truth) <= known[key].expanded)
    return [
        set_lower_goal(
            93, make_absolute("datasheet: entries of two sessions that agree", "%", [100 * float(np.mean(agree))])
        ),
        make_absolute("  true coefficients at rest within U; 95 is right", "%", [100 * float(np.mean(true))]),
    ]


def _draw_camera(number: int) -> Camera:
    rng = np.random.default_rng([20, number])
    effects = [name for name in REPEATING if rng.random() < _CHANCE]
    if rng.random() < 0.5:
        effects.append(UNREPEATING[rng.integers(2)])
    return draw_camera(_FIRST + number, *effects)


def _make_sheet(camera: Camera, seed: int) -> Datasheet:
    made = record_session(camera, make_full_session(), seed)
    return compute_datasheet(made.observed, fit(made.observed))
