"""A night that decides against the fixed thermal cycle, on drawn cameras straight from physics: how long it takes, and
what compensation leaves of the truth.

Wanted is the residual that is predicted after the fixed cycle of 18 h; the time to be compared is that of the cycle,
the visits of held-out temperatures included. Each model is asked about held-out temperatures on a way that neither
night has gone, and on that of the fixed cycle.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from compensation.design.next_visit import Wanted, decide
from compensation.drift.choosing import fit
from experiments.known import Enough, Frames, Visit, after_decision, first_decision, fixed_visits
from experiments.parameters import Known
from experiments.steps import Capture, Decide, SetTemperature, Soak, Step, estimate_s
from tests.bench.drift_drawn import effects_of, score
from tests.bench.figures import Figure, absolute, at_most, progress
from tests.compensation.drawn_cameras import Camera, drawn_camera
from tests.compensation.drawn_nights import (
    DWELL_S,
    HELD_OUT_DEGC,
    WAY_DEGC,
    Night,
    Stretch,
    full_night,
    night,
    reference,
    warm_up,
)

CAMERAS = 10
GOAL, LIMIT, SETTLED_GOAL = 60.0, 110.0, 65.0
OTHER_WAY_DEGC = (15, 36, 22, 47, 29, 18, 42, 26, 50, 33, 12, 43)
_RANGE_DEGC = (float(min(WAY_DEGC)), float(max(WAY_DEGC)))
_LOOKED_AT_EVERY = 3  # visits
_WORKERS = min(2, os.cpu_count() or 1)


@dataclass(frozen=True, slots=True)
class Outcome:
    """share: of the fixed cycle's time, %. as_good_after: by then the deciding night is as good as the fixed one, %; it
    is looked at every third visit. other_way, same_way: residuals, mpx, of the fixed night and of the deciding one."""

    share: float
    as_good_after: float
    other_way: tuple[float, float]
    same_way: tuple[float, float]


def figures(directory: Path) -> Iterator[Figure]:
    """Medians and worst of the drawn cameras."""
    found: list[Outcome] = []
    with ProcessPoolExecutor(_WORKERS, get_context("spawn")) as pool:
        for number, outcome in enumerate(pool.map(outcome_of, range(CAMERAS))):
            progress(f"known, camera {number}: {outcome}")
            found.append(outcome)
    shares = [one.share for one in found]
    median = at_most(GOAL, absolute("a night that decides, of the fixed cycle's time, median", "%", shares))
    yield median
    yield at_most(LIMIT, absolute("  the slowest of the cameras", "%", [max(shares)]))
    as_good = [one.as_good_after for one in found]
    yield at_most(SETTLED_GOAL, absolute("  as good as the fixed cycle after, median", "%", as_good))
    for way in ("other_way", "same_way"):
        fixed, deciding = (np.array([getattr(one, way)[k] for one in found]) for k in (0, 1))
        where = "on another way" if way == "other_way" else "on the fixed cycle's own way"
        yield absolute(f"  held-out residual {where}, fixed cycle, median", "mpx RMS", fixed.tolist())
        yield absolute("    the night that decides", "mpx RMS", deciding.tolist())
        worse = 100 * float(np.mean(deciding > fixed))
        yield absolute("    share of the cameras for which it is worse", "%", [worse])


def outcome_of(seed: int) -> Outcome:
    """Of one camera, without what does not repeat."""
    camera = drawn_camera(seed, *effects_of(seed, unrepeating=False)[0])
    validation = [Stretch(float(degC), DWELL_S, "validation", 5) for degC in OTHER_WAY_DEGC]
    other, same = night(camera, [*warm_up(), *reference(), *validation], seed + 600), night(camera, full_night(), seed)
    wanted = decide(same.observed, Wanted(_RANGE_DEGC, 1e-9, HELD_OUT_DEGC)).predicted_px
    fixed_mpx = tuple(left_mpx(same, asked) for asked in (other, same))
    gone_s, as_good_s, made = deciding_night(camera, seed, wanted, other, fixed_mpx[0])
    whole_s = first_decision(Known(), WAY_DEGC, HELD_OUT_DEGC, DWELL_S, Frames(5, 0.5, 0.1)).left_s
    own_mpx = tuple(left_mpx(made, asked) for asked in (other, same))
    return Outcome(
        100 * gone_s / whole_s,
        100 * as_good_s / whole_s,
        (fixed_mpx[0], own_mpx[0]),
        (fixed_mpx[1], own_mpx[1]),
    )


def left_mpx(learned_from: Night, asked: Night) -> float:
    return score(fit(learned_from.observed), asked).rms_mpx


def deciding_night(
    camera: Camera, seed: int, residual_px: float, other: Night, fixed_mpx: float
) -> tuple[float, float, Night]:
    """How long the cycle took, s, when it was as good as the fixed one, s, and the night."""
    known = Known(residual_px=residual_px)
    steps: list[Step] = [first_decision(known, WAY_DEGC, HELD_OUT_DEGC, DWELL_S, Frames(5, 0.5, 0.1))]
    parts, gone_s, as_good_s, degC, dwell_s = [*warm_up(), *reference()], 0.0, np.inf, 24.0, 0.0
    begin = len(parts)
    steps += fixed_visits(steps[0]) if isinstance(steps[0], Decide) else ()
    while steps:
        match step := steps.pop(0):
            case SetTemperature(degC):
                pass
            case Soak(dwell_s):
                pass
            case Capture(frames, _, _, role):
                parts.append(Stretch(degC, round(dwell_s), str(role), frames))
            case Decide():
                made = night(camera, parts, seed)
                visits = len(parts) - begin
                if as_good_s == np.inf and visits > 5 and visits % _LOOKED_AT_EVERY == 0:
                    as_good_s = gone_s if left_mpx(made, other) <= fixed_mpx else np.inf
                wanted = Wanted(_RANGE_DEGC, residual_px, HELD_OUT_DEGC, step.dwells_s, step.ramp_K_per_min)
                found = decide(made.observed, wanted)
                answer = Enough() if found.kind == "enough" else Visit(found.chamber_degC, found.dwell_s)
                steps = list(after_decision(step, answer))
                continue
            case _:
                pass
        gone_s += estimate_s(step, 0.0)
    made = night(camera, parts, seed)
    if as_good_s == np.inf and left_mpx(made, other) <= fixed_mpx:
        as_good_s = gone_s
    return gone_s, as_good_s, made
