"""The drift models on the simulated laboratory's cameras of configs/optics, against its noise-free truth: physics that
no form was chosen on. Forms are not to be changed in view of these cameras: numbers 200 to 202 of each preset.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tests.bench.figures import Figure, absolute, at_least, at_most, progress, side_by_side
from tests.compensation.plant_night import Dwell, Published, Seen, WarmUp, night, warm_up_and_cycles
from thermostand.compensation.drift.choosing import fit
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.training import frame_states
from thermostand.drivers.camera_preset import Effect
from thermostand.experiments.steps import Role

PRESETS = ("nac", "navcam", "dic", "phone")
NUMBERS = range(200, 203)
HELD_OUT, SWITCHED_ON = "held-out temperatures", "switching on, another night"
GOAL_MPX = {"what repeats": {HELD_OUT: 5.0, SWITCHED_ON: 6.4}, "and what does not": {HELD_OUT: 10.0}}
LEAST_COVERED = 92
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
    for group, goals_mpx in GOAL_MPX.items():
        found: dict[str, list[_Score]] = {HELD_OUT: [], SWITCHED_ON: []}
        for camera in cameras(group):
            progress(f"drift, {camera.preset} {camera.drawn}, {', '.join(camera.effects)}")
            first = night(camera, camera.drawn, warm_up_and_cycles())
            model = fit(first[0])
            paper = model if model.form == "paper" or model.other is None else model.other
            second = night(camera, camera.drawn + 1000, [WarmUp(20.0), Dwell(24.0, "reference", 2700, 20)], "night-2")
            at_reference_px = first[1][first[0].of(Role.REFERENCE)].mean(axis=0)
            for what, seen, role in (
                (HELD_OUT, first, Role.VALIDATION),
                (SWITCHED_ON, second, Role.WARM_UP),
            ):
                ours, covered, unflagged = _left(model, seen, role, at_reference_px)
                peer = _left(paper, seen, role, at_reference_px)[0]
                found[what].append(_Score(ours, peer, covered, unflagged, "dead_zone" in camera.effects))
        for what, scores in found.items():
            yield from _lines(f"drift, presets, {group}, {what}", goals_mpx.get(what), scores)


@dataclass(frozen=True, slots=True)
class _Score:
    """Of one camera: what the model in use and the paper's form leave, mpx; of its answers without a flag the share in
    their 95 % interval, and the share of these answers."""

    left_mpx: float
    paper_mpx: float
    covered: float
    unflagged: float
    has_dead_zone: bool


def _lines(what: str, goal_mpx: float | None, scores: list[_Score]) -> Iterator[Figure]:
    ours, paper = [one.left_mpx for one in scores], [one.paper_mpx for one in scores]
    median = side_by_side(what, "mpx RMS", "paper's form", ours, paper)
    yield median if goal_mpx is None else at_most(goal_mpx, median)
    yield absolute("  the worst camera", "mpx RMS", [max(ours)])
    yield at_least(LEAST_COVERED, _holds("", scores))
    yield absolute("  answers without a flag", "%", [100 * float(np.mean([one.unflagged for one in scores]))])
    few = [one for one in scores if not one.has_dead_zone]
    yield absolute(f"  the {len(few)} cameras without a dead zone", "mpx RMS", [one.left_mpx for one in few])
    yield at_least(LEAST_COVERED, _holds(" of these", few))


def _holds(whose: str, scores: list[_Score]) -> Figure:
    weights = [one.unflagged for one in scores]
    share = float(np.average(np.nan_to_num([one.covered for one in scores]), weights=weights))
    return absolute(f"  95 % intervals of unflagged answers{whose}; 92 to 98 is right", "%", [100 * share])


def _left(model: DriftModel, seen: Seen, role: str, reference_px: np.ndarray) -> tuple[float, float, float]:
    """RMS of both coordinates, mpx; of the unflagged answers the share in their interval; and the share of these."""
    observed, truth_px = seen
    states = frame_states(observed, model.memory)
    model = model.of_sessions(one.session_id for one in observed.sessions)
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
