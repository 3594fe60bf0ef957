"""The drift models on sessions of cameras drawn from published numbers, against the noise-free truth."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from tests.bench.figures import Figure, compare, make_absolute, report_progress, set_upper_goal
from tests.compensation.drawn_cameras import REPEATING, UNREPEATING, draw_camera
from tests.compensation.drawn_sessions import (
    DrawnSession,
    cycle,
    make_full_session,
    make_unseen_begin,
    record_session,
    reference,
)
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.model_selection import FORMS, fit
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Float
from thermostand.experiments.steps import Role

CAMERAS = 20
GOAL_MPX = {"repeating": 5.0, "beside what does not repeat": 10.0}
_CHANCE = 0.4
_SIGMA_95 = 1.959964


@dataclass(frozen=True)
class Score:
    """rms_mpx: of both coordinates of what compensation leaves of the truth. covered, unflagged: shares of these
    deviations in the 95 % interval, and without a flag; covered_unflagged, covered_flagged: the former of the latter
    and of the others, NaN without any. claimed_mpx: RMS of the standard deviations that are claimed."""

    rms_mpx: float
    covered: float
    unflagged: float
    covered_unflagged: float
    covered_flagged: float
    claimed_mpx: float


def draw_effects(seed: int, *, unrepeating: bool) -> tuple[tuple[str, ...], str]:
    """What this camera has, and how its session begins: with a recorded warm-up, with switching it on, or after
    that."""
    rng = np.random.default_rng([18, seed])
    names = [name for name in REPEATING if rng.random() < _CHANCE]
    begin = str(rng.choice(["warm up", "switched on", "unseen"], p=[0.6, 0.2, 0.2]))
    one = UNREPEATING[rng.integers(2)]
    return (*names, one) if unrepeating else tuple(names), begin


def record_drawn_session(seed: int, *, unrepeating: bool) -> DrawnSession:
    names, begin = draw_effects(seed, unrepeating=unrepeating)
    unrecorded = make_unseen_begin() if begin == "unseen" else []
    parts = [*reference(), *cycle()] if begin == "unseen" else make_full_session(with_warm_up=begin == "warm up")
    return record_session(draw_camera(seed, *names), parts, seed, unrecorded=unrecorded)


def score(
    model: DriftModel, made: DrawnSession, role: str = Role.VALIDATION, reference_px: Float | None = None
) -> Score:
    """Of the deviations from the truth's own reference, unless another is given, without the noise of single frames."""
    observed, truth = made.observed, made.truth_px
    if reference_px is None:
        reference_px = truth[observed.of(Role.REFERENCE)].mean(axis=0)
    states = compute_frame_states(observed, model.memory)
    model = model.of_sessions(one.session_id for one in observed.sessions)
    left, claimed, flags = [], [], []
    for frame in np.flatnonzero(observed.of(role)).tolist():
        state = states.where(np.array([frame]))
        left.append(reference_px - model.correct(truth[frame], state))
        claimed.append(np.diagonal(model.covariance(truth[frame], state), axis1=1, axis2=2))
        flags.append(model.flags(truth[frame], state))
    deviations, clear = np.array(left), np.array(flags) == 0
    holds = np.abs(deviations) <= _SIGMA_95 * np.sqrt(np.array(claimed))
    of_clear, of_flagged = (float(holds[own].mean()) if own.any() else float("nan") for own in (clear, ~clear))
    rms_mpx, claimed_mpx = (1e3 * float(np.sqrt(np.mean(squares))) for squares in (deviations**2, np.array(claimed)))
    return Score(rms_mpx, float(holds.mean()), float(clear.mean()), of_clear, of_flagged, claimed_mpx)


def figures() -> Iterator[Figure]:
    """Medians and worst of 20 cameras, per form, with and without what does not repeat."""
    for group, goal_mpx in GOAL_MPX.items():
        report_progress(f"drift, {CAMERAS} drawn cameras, {group}")
        scores: dict[str, list[Score]] = {form: [] for form in (*FORMS, "chosen")}
        for seed in range(CAMERAS):
            made = record_drawn_session(seed, unrepeating=group != "repeating")
            chosen = fit(made.observed)
            for model in (chosen, chosen.other):
                if model is not None:
                    scores[model.form].append(score(model, made))
            scores["chosen"].append(scores[chosen.form][-1])
        yield from _list_scores(group, goal_mpx, scores)


def _list_scores(group: str, goal_mpx: float, scores: dict[str, list[Score]]) -> Iterator[Figure]:
    paper = [one.rms_mpx for one in scores["paper"]]
    for form in ("thermal", "chosen"):
        values = [one.rms_mpx for one in scores[form]]
        median = compare(f"drift, drawn cameras, {group}, {form} form", "mpx RMS", "paper's form", values, paper)
        yield set_upper_goal(goal_mpx, median) if form == "chosen" else median
        yield make_absolute("  the worst camera", "mpx RMS", [max(values)])
    for form in FORMS:
        share = 100 * float(np.mean([one.covered for one in scores[form]]))
        yield make_absolute(f"  95 % interval, {form} form; 92 to 98 is right", "%", [share])
