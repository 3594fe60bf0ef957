"""Drawn cameras asked beyond what was fitted: 17..45 degC fitted, 10..52 degC asked, in another night."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tests.bench.drift_drawn import effects_of, score
from tests.bench.figures import Figure, absolute, at_least, progress
from tests.compensation.drawn_cameras import drawn_camera
from tests.compensation.drawn_nights import cycle, night, reference, warm_up
from thermostand.compensation.drift.choosing import fit
from thermostand.experiments.steps import Role

CAMERAS = 12
FITTED_DEGC = (27, 31, 34, 38, 41, 45, 41, 38, 34, 31, 27, 24, 20, 17, 20, 24)
HELD_OUT_DEGC = (20, 27, 34, 41)
ASKED_DEGC = (10, 14, 17, 20, 31, 48, 52, 48, 41)
LEAST_COVERED = 92


def figures() -> Iterator[Figure]:
    """Coverage of the 95 % interval, and how much of it carries a flag."""
    progress(f"drift, {CAMERAS} drawn cameras asked beyond what was fitted")
    scores = []
    for seed in range(CAMERAS):
        camera = drawn_camera(seed, *effects_of(seed, unrepeating=False)[0])
        begin = [*warm_up(), *reference()]
        model = fit(night(camera, [*begin, *cycle(FITTED_DEGC, HELD_OUT_DEGC)], seed).observed)
        asked = night(camera, [*begin, *cycle(ASKED_DEGC, ASKED_DEGC)], seed + 50, session_id="night-2")
        scores.append(score(model, asked, Role.VALIDATION))
    covered = 100 * float(np.mean([one.covered for one in scores]))
    what = "drift, 95 % interval beyond what was fitted"
    yield at_least(LEAST_COVERED, absolute(what, "%", [covered]))
    flagged = 100 * (1 - float(np.mean([one.unflagged for one in scores])))
    yield absolute("  of these, flagged", "%", [flagged])
