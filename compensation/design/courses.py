"""Courses of visits compared by what a linear model would know after them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from thermostand.compensation.design.forecast import Situation, Surroundings, after
from thermostand.compensation.history.states import Float

_HORIZON_S = 8 * 3600.0
_DRAWN = 40
"""Courses of each kind, drawn from the whole grid and from each of its thirds."""
_THIRDS, _EVERY = 3, 3


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """covariance (H, H), px^2: of the coefficients. noise_px2: of one more instant. wanted (W, H): features of the
    states in which the model is wanted. features: of situations (S,), (S, H)."""

    covariance: Float
    noise_px2: float
    wanted: Float
    features: Callable[[Situation], Float]


@dataclass(frozen=True, slots=True)
class Course:
    """The first visit of a course. variance_px2: of the model after all of it, mean over the wanted states."""

    chamber_degC: float
    dwell_s: float
    variance_px2: float


def best_course(
    known: Known, here: Situation, around: Surroundings, grid_degC: Float, dwells_s: Sequence[float], seed: int
) -> Course:
    """Of courses of each dwell, about as long together: the one after which the mean variance over the wanted states is
    least. The same for a seed."""
    rng = np.random.default_rng([20, seed])
    moment = known.wanted.T @ known.wanted / len(known.wanted)
    best: Course | None = None
    for dwell_s in dwells_s:
        set_points = _drawn(grid_degC, max(1, round(_HORIZON_S / dwell_s)), rng)
        variance_px2 = _after_courses(known, here, around, set_points, dwell_s, moment)
        first = int(np.argmin(variance_px2))
        found = Course(float(set_points[first, 0]), dwell_s, float(variance_px2[first]))
        best = found if best is None or found.variance_px2 < best.variance_px2 else best
    if best is None:
        raise ValueError("there is no dwell to choose from")
    return best


def _after_courses(
    known: Known, here: Situation, around: Surroundings, set_points: Float, dwell_s: float, moment: Float
) -> Float:
    """(S,), px^2: the variance after each course (S, visits); the covariance of each is updated visit by visit (the
    Sherman-Morrison formula)."""
    count = len(set_points)
    at = here.where(np.zeros(count, np.int64))
    covariance = np.repeat(known.covariance[None], count, axis=0)
    for visit in set_points.T:
        at = after(around, at, visit, np.full(count, dwell_s))
        own = known.features(at)
        gain = np.einsum("skl,sl->sk", covariance, own)
        total = known.noise_px2 + (gain * own).sum(axis=1)
        covariance -= gain[:, :, None] * gain[:, None, :] / total[:, None, None]
    return np.einsum("skl,lk->s", covariance, moment)


def _drawn(grid_degC: Float, visits: int, rng: np.random.Generator) -> Float:
    """(S, visits): to and fro, steadily up or down, staying at one temperature, and at one after the other. What creeps
    for hours shows in those that stay or go one way, which are hardly ever drawn by chance."""
    parts = [grid_degC, *(third for third in np.array_split(grid_degC, _THIRDS) if len(third))]
    to_and_fro = [rng.choice(part, (_DRAWN, visits)) for part in parts]
    up = [np.sort(rng.choice(part, (_DRAWN // 2, visits)), axis=1) for part in parts]
    down = [np.sort(rng.choice(part, (_DRAWN // 2, visits)), axis=1)[:, ::-1] for part in parts]
    staying = np.repeat(grid_degC[:, None], visits, axis=1)
    pairs = np.array(list(product(grid_degC[::_EVERY], repeat=2)))
    first = visits // 2
    both = np.hstack([np.repeat(pairs[:, :1], first, axis=1), np.repeat(pairs[:, 1:], visits - first, axis=1)])
    return np.concatenate([*to_and_fro, *up, *down, staying, both])
