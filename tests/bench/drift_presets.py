"""The drift models on the simulated laboratory's cameras of configs/optics, against its noise-free truth: physics that
no form was chosen on. Forms are not to be changed in view of these cameras: numbers 200 to 202 of each preset.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from compensation.drift.choosing import fit
from compensation.drift.drift_model import DriftModel
from compensation.drift.training import frame_states
from drivers.camera_preset import Effect
from experiments.steps import Role
from tests.bench.figures import Figure, absolute, at_most, progress, side_by_side
from tests.compensation.plant_night import Dwell, Published, Seen, WarmUp, night, warm_up_and_cycles

PRESETS = ("nac", "navcam", "dic", "phone")
NUMBERS = range(200, 203)
GOAL_MPX = {"what repeats": 5.0, "and what does not": 10.0}
REPEATING: tuple[Effect, ...] = ("sag", "dead_zone", "creep", "coarse_sensor", "far_air")
UNREPEATING: tuple[Effect, ...] = ("stick_slip", "unrepeated")
_CHANCE = 0.4
_SIGMA_95 = 1.959964


def cameras(group: str) -> Iterator[Published]:
    """Of each preset, with the effects that are drawn for its number."""
    for preset in PRESETS:
        for number in NUMBERS:
            rng = np.random.default_rng([22, PRESETS.index(preset), number])
            effects: tuple[Effect, ...] = tuple(name for name in REPEATING if rng.random() < _CHANCE)
            one = UNREPEATING[rng.integers(2)]
            yield Published(preset, number, (*effects, one) if group != "what repeats" else effects)


def figures() -> Iterator[Figure]:
    """Medians of the cameras at held-out temperatures and when switched on at 20 degC on another night, and how often
    the 95 % intervals of the answers without a flag hold."""
    for group, goal_mpx in GOAL_MPX.items():
        found: dict[str, list[tuple[float, float, float, float]]] = {"held-out temperatures": [], "switching on": []}
        for camera in cameras(group):
            progress(f"drift, {camera.preset} {camera.drawn}, {', '.join(camera.effects)}")
            first = night(camera, camera.drawn, warm_up_and_cycles())
            model = fit(first[0])
            paper = model if model.form == "paper" or model.other is None else model.other
            second = night(camera, camera.drawn + 1000, [WarmUp(20.0), Dwell(24.0, "reference", 2700, 20)], "night-2")
            at_reference_px = first[1][first[0].of(Role.REFERENCE)].mean(axis=0)
            for what, seen, role in (
                ("held-out temperatures", first, Role.VALIDATION),
                ("switching on", second, Role.WARM_UP),
            ):
                ours, covered, unflagged = _left(model, seen, role, at_reference_px)
                found[what].append((ours, _left(paper, seen, role, at_reference_px)[0], covered, unflagged))
        for what, scores in found.items():
            yield from _lines(f"drift, presets, {group}, {what}", goal_mpx, scores)


def _lines(what: str, goal_mpx: float, scores: list[tuple[float, float, float, float]]) -> Iterator[Figure]:
    ours, paper, covered, unflagged = zip(*scores, strict=True)
    yield at_most(goal_mpx, side_by_side(what, "mpx RMS", "paper's form", ours, paper))
    yield absolute("  the worst camera", "mpx RMS", [max(ours)])
    weights = np.array(unflagged)
    share = 100 * float(np.average(np.nan_to_num(covered), weights=weights)) if weights.any() else np.nan
    yield absolute("  95 % intervals of unflagged answers; 92 to 98 is right", "%", [share])
    yield absolute("  answers without a flag", "%", [100 * float(weights.mean())])


def _left(model: DriftModel, seen: Seen, role: str, reference_px: np.ndarray) -> tuple[float, float, float]:
    """RMS of both coordinates, mpx; of the unflagged answers the share in their interval; and the share of these."""
    observed, truth_px = seen
    states = frame_states(observed, model.memory)
    left, sigma, clear = [], [], []
    for frame in np.flatnonzero(observed.of(role)).tolist():
        state = states.where(np.array([frame]))
        left.append(reference_px - model.correct(truth_px[frame], state))
        sigma.append(np.sqrt(np.diagonal(model.covariance(truth_px[frame], state), axis1=1, axis2=2)))
        clear.append(model.flags(truth_px[frame], state) == 0)
    deviations, inside = np.array(left), np.array(clear)
    holds = np.abs(deviations) <= _SIGMA_95 * np.array(sigma)
    covered = float(holds[inside].mean()) if inside.any() else float("nan")
    return 1e3 * float(np.sqrt(np.mean(deviations**2))), covered, float(inside.mean())
