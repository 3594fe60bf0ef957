"""The drift models on nights of the simulated laboratory, against its noise-free truth: paper form and thermal form.

The nights come from the physics of drivers/sim alone, without wires and images, with the noise that the marker fit has
on its images (2.4 mpx) and a camera that tells its temperature in quarters of a degree.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from compensation.drift.choosing import FORMS, Form, fit
from compensation.drift.drift_model import DriftModel
from compensation.drift.training import frame_states
from compensation.drift.validation import evaluate
from compensation.observations import Role
from drivers.sim.optics import CameraKind
from tests.bench.figures import Figure, at_most, progress
from tests.compensation.plant_night import Dwell, Seen, WarmUp, night, warm_up_and_cycles

SEED = 1
CYCLES = 2
GOAL_MPX: dict[CameraKind, float] = {"modified": 5.0, "unmodified": 15.0}
WARM_UP_GOAL_MPX = 3.0
ELSEWHERE_DEGC = (15.0, 34.0)


def figures(directory: Path) -> list[Figure]:
    """mpx RMS of both coordinates at held-out temperatures and in warm-ups elsewhere, and the intervals' coverage."""
    progress("drift, one night of each camera")
    elsewhere = {
        air_degC: night("modified", SEED, [Dwell(24.0, "reference", 2700, 20), WarmUp(air_degC)])
        for air_degC in ELSEWHERE_DEGC
    }
    found: list[Figure] = []
    for kind, goal_mpx in GOAL_MPX.items():
        seen = night(kind, SEED, warm_up_and_cycles(CYCLES))
        models = {form: fit(seen[0], form=form) for form in FORMS}
        what = f"drift, {kind} camera, held-out temperatures"
        found.append(at_most(goal_mpx, _figure(what, seen, Role.VALIDATION, models)))
        found += _coverage(kind, seen, models)
        if kind == "modified":
            for air_degC, other in elsewhere.items():
                what = f"drift, warm-up at {air_degC:g} degC"
                found.append(at_most(WARM_UP_GOAL_MPX, _figure(what, other, Role.WARM_UP, models)))
    return found


def _figure(what: str, seen: Seen, role: Role, models: dict[Form, DriftModel]) -> Figure:
    thermal, paper = (left_mpx(models[form], seen, role) for form in ("thermal", "paper"))
    return Figure(what, "mpx RMS", thermal, "the paper's form", paper, (thermal / paper,) * 3)


def _coverage(kind: str, seen: Seen, models: dict[Form, DriftModel]) -> Iterator[Figure]:
    for axis, name in enumerate("IJ"):
        covered, paper = (100 * evaluate(models[form], seen[0]).coverage_95[axis] for form in ("thermal", "paper"))
        what = f"  95 % interval along {name}, {kind}; 92 to 98 is right"
        yield Figure(what, "%", covered, "the paper's form", paper, (covered / paper,) * 3)


def left_mpx(model: DriftModel, seen: Seen, role: Role) -> float:
    """RMS of both coordinates of what compensation leaves of the noise-free drift since the session's reference."""
    observed, truth_px = seen
    at_reference_px = truth_px[observed.of(Role.REFERENCE)].mean(axis=0)
    states = frame_states(observed, model.memory)
    frames = np.flatnonzero(observed.of(role)).tolist()
    left = [at_reference_px - model.correct(truth_px[k], states.where(np.array([k]))) for k in frames]
    return 1e3 * float(np.sqrt(np.mean(np.square(left))))
