"""Three hundred clean sessions with at most three steps that are none, and steps of a twentieth of a pixel in every
third of them. A hundred of the simulated laboratory, two hundred of drawn cameras, half of these with frames on the
way: centres straight from physics. No threshold was chosen on sessions of these numbers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from tests.compensation import plant_sessions
from tests.compensation.drawn_cameras import REPEATING, draw_camera
from tests.compensation.drawn_sessions import make_followed_cycle, make_full_session, record_session, reference, warm_up
from thermostand.compensation.drift.bumps import find_bumps
from thermostand.compensation.drift.model_facts import Bump
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role

FIRST, SESSIONS = 70_000, 100
MOST_FALSE = 3
LEAST_FOUND = 95
SIZE_PX = 0.05
_NEAR_NS = 3_000 * 1_000_000_000
"""A dwell and some: without a frame in it nobody can say when."""


def laboratory(seed: int) -> Observations:
    return plant_sessions.record_plant_session("modified", seed, plant_sessions.warm_up_and_cycles())[0]


def at_rest(seed: int) -> Observations:
    return record_session(draw_camera(seed, *_effects(seed)), make_full_session(), seed).observed


def on_the_way(seed: int) -> Observations:
    return record_session(
        draw_camera(seed, *_effects(seed)), [*warm_up(), *reference(), *make_followed_cycle()], seed
    ).observed


def _effects(seed: int) -> list[str]:
    rng = np.random.default_rng([29, seed])
    return [name for name in REPEATING if rng.random() < 0.4]


def bumped(clean: Observations, seed: int) -> tuple[Observations, int]:
    """With a step in the cycle, and when it is: with five frames of it at least before the end."""
    rng = np.random.default_rng([31, seed])
    last_ns = clean.time_ns[np.flatnonzero(clean.of(Role.REFERENCE))[-1]]
    at_ns = int(rng.integers(last_ns, clean.time_ns[-6]))
    angle = rng.uniform(-np.pi, np.pi)
    shift = SIZE_PX * np.array([np.cos(angle), np.sin(angle)])
    later = clean.time_ns >= at_ns
    return replace(clean, centres_px=clean.centres_px + later[:, None, None] * shift), at_ns


def is_found(found: tuple[Bump, ...], at_ns: int) -> bool:
    return any(one.after_ns - _NEAR_NS < at_ns < one.before_ns + _NEAR_NS for one in found)


@pytest.mark.nightly
def test_three_hundred_clean_sessions_and_a_hundred_bumps() -> None:
    kinds: tuple[Callable[[int], Observations], ...] = (laboratory, at_rest, on_the_way)
    false: list[tuple[str, int]] = []
    missed: list[tuple[str, int]] = []
    for kind in kinds:
        for number in range(SESSIONS):
            clean = kind(FIRST + number)
            if find_bumps(clean):
                false.append((kind.__name__, FIRST + number))
            if number % len(kinds) == 0:
                made, at_ns = bumped(clean, number)
                if not is_found(find_bumps(made), at_ns):
                    missed.append((kind.__name__, FIRST + number))
    tried = len(kinds) * len(range(0, SESSIONS, len(kinds)))
    assert len(false) <= MOST_FALSE, false
    assert 100 * (1 - len(missed) / tried) >= LEAST_FOUND, missed
