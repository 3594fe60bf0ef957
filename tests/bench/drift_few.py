"""Drawn cameras with few set-points: which form is chosen, and what each leaves at others on another night. And two
nights fitted together, asked about a third, beside fixings that settle again."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tests.bench.drift_drawn import effects_of, score
from tests.bench.figures import Figure, absolute, at_least, progress, side_by_side
from tests.compensation.drawn_cameras import drawn_camera
from tests.compensation.drawn_nights import cycle, full_night, night, reference, warm_up
from thermostand.compensation.drift.choosing import fit
from thermostand.compensation.drift.thermal_learning import fit_thermal
from thermostand.compensation.observations import concatenate
from thermostand.experiments.steps import Role

CAMERAS, FIRST_FEW, FIRST_SEVERAL = 6, 2800, 2900
WAYS_DEGC = ((38, 52, 38, 24, 10, 24), (34, 44, 52, 44, 34, 24, 17, 10, 17, 24))
ASKED_DEGC = (31, 41, 48, 41, 31, 20, 14, 20)
LEAST_COVERED = 92


def figures() -> Iterator[Figure]:
    """What is left, how often the better form is chosen, and how often intervals of several nights hold."""
    for way_degC in WAYS_DEGC:
        yield from _few(way_degC)
    yield _several()


def _few(way_degC: tuple[int, ...]) -> Iterator[Figure]:
    progress(f"drift, {CAMERAS} drawn cameras with {len(way_degC)} visits")
    thermal, paper, right = [], [], 0
    for seed in range(FIRST_FEW, FIRST_FEW + CAMERAS):
        camera = drawn_camera(seed, *effects_of(seed, unrepeating=False)[0])
        begin = [*warm_up(), *reference()]
        chosen = fit(night(camera, [*begin, *cycle(way_degC, ())], seed).observed)
        asked = night(camera, [*begin, *cycle(ASKED_DEGC, ASKED_DEGC)], seed + 50, session_id="night-2")
        models = {model.form: model for model in (chosen, chosen.other) if model is not None}
        left = {form: score(model, asked, Role.VALIDATION).rms_mpx for form, model in models.items()}
        thermal.append(left["thermal"])
        paper.append(left["paper"])
        right += left[chosen.form] == min(left.values())
    what = f"drift, {len(way_degC)} visits of few set-points, thermal form"
    yield side_by_side(what, "mpx RMS", "paper's form", thermal, paper)
    yield at_least(100, absolute("  the better form is chosen", "%", [100 * right / CAMERAS]))


def _several() -> Figure:
    progress(f"drift, {CAMERAS} drawn cameras with two nights")
    covered = []
    for seed in range(FIRST_SEVERAL, FIRST_SEVERAL + CAMERAS):
        camera = drawn_camera(seed, *effects_of(seed, unrepeating=False)[0], "unrepeated")
        nights = [night(camera, full_night(), 10 * seed + k, session_id=f"night-{k}") for k in range(3)]
        model = fit_thermal(concatenate([one.observed for one in nights[:2]]))
        covered.append(100 * score(model, nights[2], Role.VALIDATION).covered)
    what = "drift, 95 % interval of two nights in a third, fixings settle again"
    return at_least(LEAST_COVERED, absolute(what, "%", [float(np.mean(covered))]))
