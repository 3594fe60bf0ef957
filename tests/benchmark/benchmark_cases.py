"""The sessions of the public benchmark: cameras drawn from published numbers, one session to learn from and others to
be asked about, with the noise-free truth.

Numbers of cameras begin at 1000: no method of this project was made with these cameras in view. Everything is computed
on the spot, the same on every run.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from tests.compensation.drawn_cameras import REPEATING, UNREPEATING, draw_camera
from tests.compensation.drawn_sessions import (
    DrawnSession,
    Stretch,
    make_followed_cycle,
    make_full_session,
    record_session,
    reference,
    warm_up,
)
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role

Float = NDArray[np.float64]

TRAININGS = ("frames at rest", "frames on the way as well")
"""What is learned from: a warm-up, and frames at the end of each dwell; or one every two minutes on the way, too."""
GROUPS = ("what repeats", "and what does not")
TASKS = ("held-out temperatures", "switching on, another session", "small steps, never at rest", "air that jumps")
FIRST, CAMERAS = 1000, 20
HELD_OUT = "held out"
_CHANCE = 0.4
_STEPS_DEGC = (21, 25, 29, 33, 30, 34, 38, 42, 46, 43, 39, 35, 31, 27, 23, 19, 15, 12, 16, 20, 24)
_JUMPS_DEGC = (33, 19, 42, 30, 12, 36, 50, 26, 45, 16, 24)
_STEP_S, _JUMP_S = 960, 1500


@dataclass(frozen=True, slots=True, eq=False)
class Question:
    """One task of one camera: which frames (K,) of a session, what is seen in them (K, N, 2), px, without noise, and
    where it was at the reference of the session to learn from (N, 2): camera and target have not been touched in
    between. session: what is known about it; the centres of these frames are not."""

    task: str
    session: Observations
    frames: NDArray[np.int64]
    seen_px: Float
    reference_px: Float


@dataclass(frozen=True, slots=True, eq=False)
class Case:
    """One camera. learned_from: of TRAININGS. training: the session to learn from, without the centres of the frames
    that are asked for."""

    group: str
    learned_from: str
    camera: int
    training: Observations
    questions: tuple[Question, ...]


def make_case(group: str, number: int, learned_from: str = TRAININGS[0]) -> Case:
    """The camera of this number, with the effects that were drawn for it."""
    seed = FIRST + number
    rng = np.random.default_rng([19, seed])
    effects = [name for name in REPEATING if rng.random() < _CHANCE]
    if group != GROUPS[0]:
        effects.append(UNREPEATING[rng.integers(2)])
    camera = draw_camera(seed, *effects)
    parts = make_full_session() if learned_from == TRAININGS[0] else [*warm_up(), *reference(), *make_followed_cycle()]
    first = record_session(camera, parts, seed, session_id="session-1")
    begin = [*warm_up(20.0), *reference()]
    second = record_session(camera, [*begin, *_make_drive(_STEPS_DEGC, _STEP_S)], seed + 10_000, session_id="session-2")
    third = record_session(camera, [*begin, *_make_drive(_JUMPS_DEGC, _JUMP_S)], seed + 20_000, session_id="session-3")
    at_reference = first.truth_px[first.observed.of(Role.REFERENCE)].mean(axis=0)
    held_out, steps, jumps = (_hide_role(made, Role.VALIDATION) for made in (first, second, third))
    switched_on = _hide_role(second, Role.WARM_UP)
    return Case(
        group,
        learned_from,
        number,
        held_out,
        (
            _make_question(TASKS[0], first, held_out, Role.VALIDATION, at_reference),
            _make_question(TASKS[1], second, switched_on, Role.WARM_UP, at_reference),
            _make_question(TASKS[2], second, steps, Role.VALIDATION, at_reference),
            _make_question(TASKS[3], third, jumps, Role.VALIDATION, at_reference),
        ),
    )


def _make_drive(way_degC: tuple[int, ...], soak_s: int) -> list[Stretch]:
    """Set-points that are left before the camera has settled; a frame every two minutes."""
    return [Stretch(float(degC), 60, "validation", soak_s // 120, 120.0) for degC in way_degC]


def _make_question(task: str, made: DrawnSession, known: Observations, role: str, at_reference: Float) -> Question:
    frames = np.flatnonzero(made.observed.of(role))
    return Question(task, known, frames, made.truth_px[frames], at_reference)


def _hide_role(made: DrawnSession, role: str) -> Observations:
    """Without the centres of the frames of this role, which are reported to be unusable."""
    observed = made.observed
    asked = observed.of(role)
    centres, covariance = observed.centres_px.copy(), observed.covariance_px2.copy()
    centres[asked], covariance[asked] = np.nan, np.nan
    reasons = tuple(HELD_OUT if hide else why for hide, why in zip(asked, observed.reasons, strict=True))
    return replace(observed, centres_px=centres, covariance_px2=covariance, reasons=reasons)
