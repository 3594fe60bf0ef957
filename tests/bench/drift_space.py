"""How far a target at V0..V3 seems to move in space, after compensation, while only the temperature did: drawn cameras,
on another night, without the noise of the markers, with the camera's true calibration at the reference."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from tests.bench.drift_drawn import effects_of
from tests.bench.figures import Figure, at_most, progress, side_by_side
from tests.compensation.drawn_cameras import FOCAL_PX, RADIAL, drawn_camera, target_mm
from tests.compensation.drawn_nights import Night, cycle, full_night, night, reference, warm_up
from thermostand.compensation.drift.choosing import FORMS, fit
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.training import frame_states
from thermostand.compensation.observations import Float
from thermostand.experiments.steps import Role

CAMERAS, FIRST = 10, 3300
POSITIONS = ((0.0, 0.0), (25.0, 8.0), (-60.0, -20.0), (70.0, 22.0))
"""V0..V3: linear mm, rotary deg."""
ASKED_DEGC = (31, 41, 48, 41, 31, 20, 14, 20)
GOALS_UM = (1.0, 2.0, 5.0)
_STEP = 1e-4


def figures() -> Iterator[Figure]:
    """RMS along the image's axes and along the line of sight, um, of the target's middle; and of the markers, mpx."""
    progress(f"drift, V0..V3 in space, {CAMERAS} drawn cameras")
    found: dict[str, list[Float]] = {form: [] for form in FORMS}
    for seed in range(FIRST, FIRST + CAMERAS):
        camera = drawn_camera(seed, *effects_of(seed, unrepeating=False)[0])
        first = night(camera, full_night(), seed)
        chosen = fit(first.observed)
        parts = [*warm_up(), *reference(), *cycle(ASKED_DEGC, ASKED_DEGC)]
        seen = [night(camera, parts, seed + 50_000, place_mm=target_mm(*place)) for place in POSITIONS]
        for model in (chosen, chosen.other):
            if model is not None:
                each = [_left(model, made, target_mm(*place)) for made, place in zip(seen, POSITIONS, strict=True)]
                found[model.form].append(np.sqrt(np.mean(np.concatenate(each) ** 2, axis=0)))
    thermal, paper = (np.array(found[form]) for form in ("thermal", "paper"))
    for axis, (name, goal_um) in enumerate(zip("xyz", GOALS_UM, strict=True)):
        what = f"drift, V0..V3 on another night, along {name}"
        figure = side_by_side(what, "um RMS", "paper's form", thermal[:, axis].tolist(), paper[:, axis].tolist())
        yield at_most(goal_um, figure)
    yield side_by_side("  in the image", "mpx RMS", "paper's form", thermal[:, 3].tolist(), paper[:, 3].tolist())


def _left(model: DriftModel, made: Night, place_mm: Float) -> Float:
    """(F, 4): of each held-out frame how far the target's middle seems to be from where it is at the night's own
    reference, um, and RMS of the markers, mpx."""
    observed, truth = made.observed, made.truth_px
    states = frame_states(observed, model.memory)

    def corrected(role: str) -> Float:
        frames = np.flatnonzero(observed.of(role)).tolist()
        return np.array([model.correct(truth[k], states.where(np.array([k]))) for k in frames])

    away = corrected(Role.VALIDATION) - corrected(Role.REFERENCE).mean(axis=0)
    motions = np.linalg.lstsq(_pose_derivatives(place_mm), away.reshape(len(away), -1).T, rcond=None)[0]
    return np.column_stack([1e3 * motions[:3].T, 1e3 * np.sqrt((away**2).mean(axis=(1, 2)))])


def _pose_derivatives(place_mm: Float) -> Float:
    """(108, 6), px per mm along the axes and per rad about them, through the target's middle."""
    middle = place_mm.mean(axis=0)
    columns: list[Float] = []
    for axis in range(6):
        step = np.zeros(3)
        step[axis % 3] = _STEP
        more = np.asarray(np.cross(step, place_mm - middle), np.float64) if axis > 2 else step
        columns.append(((_seen_px(place_mm + more) - _seen_px(place_mm - more)) / (2 * _STEP)).ravel())
    return np.stack(columns, axis=1)


def _seen_px(place_mm: Float) -> Float:
    """(N, 2): by the calibration of all drawn cameras at the reference."""
    ray = place_mm[:, :2] / place_mm[:, 2:]
    return FOCAL_PX * ray * (1 + RADIAL * (ray**2).sum(axis=1, keepdims=True))
