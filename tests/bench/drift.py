"""The drift models on nights of the simulated laboratory, against its noise-free truth: paper form and thermal form.

The nights come from the physics of drivers/sim alone, without wires and images, with the noise that the marker fit has
on its images (2.4 mpx) and a camera that tells its temperature in quarters of a degree.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from tests.bench import (
    drift_beyond,
    drift_bumps,
    drift_drawn,
    drift_few,
    drift_moving,
    drift_presets,
    drift_space,
    drift_type,
)
from tests.bench.figures import Figure, at_most, progress, side_by_side
from tests.compensation.plant_night import Dwell, Seen, WarmUp, night, warm_up_and_cycles
from thermostand.compensation.drift.choosing import FORMS, fit
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import evaluate
from thermostand.compensation.drift.training import frame_states
from thermostand.drivers.sim.physics.optics import CameraKind
from thermostand.experiments.steps import Role

SEEDS = (5, 6, 7, 8)  # the terms were chosen with nights of seeds 1 to 4 in view
CYCLES = 2
GOAL_MPX: dict[CameraKind, float] = {"modified": 5.0, "unmodified": 15.0}
WARM_UP_GOAL_MPX = 3.0
ELSEWHERE_DEGC = (15.0, 34.0)
PEER = "the paper's form"


def figures(directory: Path) -> list[Figure]:
    """mpx RMS of both coordinates at held-out temperatures and in warm-ups elsewhere, and the intervals' coverage: the
    medians of several nights."""
    found: dict[tuple[str, str, float | None], list[tuple[float, float]]] = {}
    for seed in SEEDS:
        progress(f"drift, one night of each camera, seed {seed}")
        for what, unit, goal, pair in _values(seed):
            found.setdefault((what, unit, goal), []).append(pair)
    own = [_figure(what, unit, goal, pairs) for (what, unit, goal), pairs in found.items()]
    parts = (drift_drawn, drift_presets, drift_moving, drift_beyond, drift_bumps, drift_few, drift_space, drift_type)
    return [*own, *(figure for part in parts for figure in part.figures())]


def _figure(what: str, unit: str, goal: float | None, pairs: list[tuple[float, float]]) -> Figure:
    thermal, paper = zip(*pairs, strict=True)
    figure = side_by_side(what, unit, PEER, thermal, paper)
    return figure if goal is None else at_most(goal, figure)


def _values(seed: int) -> Iterator[tuple[str, str, float | None, tuple[float, float]]]:
    """What, unit, goal, and the thermal form's value with the paper's."""
    for kind, goal_mpx in GOAL_MPX.items():
        seen = night(kind, seed, warm_up_and_cycles(CYCLES))
        models = {form: fit(seen[0], form=form) for form in FORMS}
        yield f"drift, {kind} camera, held-out temperatures", "mpx RMS", goal_mpx, _left(models, seen, Role.VALIDATION)
        for axis, name in enumerate("IJ"):
            covered, paper = (100 * evaluate(models[form], seen[0]).coverage_95[axis] for form in ("thermal", "paper"))
            yield f"  95 % interval along {name}, {kind}; 92 to 98 is right", "%", None, (covered, paper)
        for air_degC in ELSEWHERE_DEGC if kind == "modified" else ():
            elsewhere = night(kind, seed, [Dwell(24.0, "reference", 2700, 20), WarmUp(air_degC)])
            what = f"drift, warm-up at {air_degC:g} degC"
            yield what, "mpx RMS", WARM_UP_GOAL_MPX, _left(models, elsewhere, Role.WARM_UP)


def _left(models: Mapping[Any, DriftModel], seen: Seen, role: Role) -> tuple[float, float]:
    return left_mpx(models["thermal"], seen, role), left_mpx(models["paper"], seen, role)


def left_mpx(model: DriftModel, seen: Seen, role: Role) -> float:
    """RMS of both coordinates of what compensation leaves of the noise-free drift since the session's reference."""
    observed, truth_px = seen
    at_reference_px = truth_px[observed.of(Role.REFERENCE)].mean(axis=0)
    states = frame_states(observed, model.memory)
    frames = np.flatnonzero(observed.of(role)).tolist()
    left = [at_reference_px - model.correct(truth_px[k], states.where(np.array([k]))) for k in frames]
    return 1e3 * float(np.sqrt(np.mean(np.square(left))))
