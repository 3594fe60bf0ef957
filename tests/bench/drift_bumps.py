"""Bumps in nights of drawn cameras: how many are found, how many found where there are none, and what a fit leaves."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

from tests.bench.drift_drawn import drawn_night, effects_of, score
from tests.bench.figures import Figure, absolute, at_least, at_most, progress, side_by_side
from tests.compensation.drawn_cameras import drawn_camera
from tests.compensation.drawn_nights import START_NS, Bump, full_night, night
from thermostand.compensation.drift.bumps import find_bumps
from thermostand.compensation.drift.choosing import fit
from thermostand.experiments.steps import Role

CLEAN_NIGHTS, BUMPED_NIGHTS = 300, 20
SIZES_PX = (0.05, 0.1, 0.3)
_DWELL_H = 0.8
_FIRST_SEED = 500  # the least gain of a bump was chosen on nights from 1000 on


def figures() -> Iterator[Figure]:
    """Nights without slips and fixings that settle again, which are steps themselves and have a line of their own."""
    progress(f"drift, {CLEAN_NIGHTS} nights without a bump")
    nights = (drawn_night(_FIRST_SEED + seed, unrepeating=False) for seed in range(CLEAN_NIGHTS))
    false = sum(bool(find_bumps(made.observed)) for made in nights)
    yield at_most(1, absolute("drift, nights with a bump that was none", "%", [100 * false / CLEAN_NIGHTS]))
    slips = [seed for seed in range(60) if "stick_slip" in effects_of(seed, unrepeating=True)[0]][:BUMPED_NIGHTS]
    counts = [len(find_bumps(drawn_night(seed, unrepeating=True).observed)) for seed in slips]
    yield absolute("  steps found a night in cameras that slip", "", [float(np.mean(counts))])
    for size_px in SIZES_PX:
        progress(f"drift, bumps of {size_px} px")
        yield from _of_size(size_px)


@cache
def _clean_mpx(seed: int) -> float:
    """What is left in the same night without a bump."""
    made = night(drawn_camera(seed, *effects_of(seed, unrepeating=False)[0]), full_night(), seed)
    return score(fit(made.observed, form="thermal"), made, Role.VALIDATION).rms_mpx


def _of_size(size_px: float) -> Iterator[Figure]:
    found, bumped, clean = 0, [], []
    for seed in range(BUMPED_NIGHTS):
        rng = np.random.default_rng([19, seed])
        camera = drawn_camera(seed, *effects_of(seed, unrepeating=False)[0])
        at_h, angle = float(rng.uniform(6.5, 21.0)), rng.uniform(-np.pi, np.pi)
        bump = Bump(at_h, size_px * np.array([np.cos(angle), np.sin(angle)]))
        with_bump = night(camera, full_night(), seed, [bump])
        model = fit(with_bump.observed, form="thermal")
        at = [(one.after_ns - START_NS, one.before_ns - START_NS) for one in model.facts.bumps]
        found += any(after / 3.6e12 - _DWELL_H < at_h < before / 3.6e12 + _DWELL_H for after, before in at)
        bumped.append(score(model, with_bump, Role.VALIDATION).rms_mpx)
        clean.append(_clean_mpx(seed))
    share = 100 * found / BUMPED_NIGHTS
    yield at_least(100, absolute(f"drift, bumps of {size_px:g} px that are found", "%", [share]))
    left = side_by_side("  residual of the truth after it", "mpx RMS", "the same night without", bumped, clean)
    yield at_most(1.5 * float(np.median(clean)), left)
