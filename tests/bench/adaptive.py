"""A session that decides against the fixed thermal cycle, on drawn cameras straight from physics: how long it takes,
and what compensation leaves of the truth.

Wanted is the residual that is predicted after the fixed cycle of 18 h; the time to be compared is that of the cycle,
the visits of held-out temperatures included. Both models are asked about the same held-out temperatures: at rest, 4 h
at each; on a way that neither session has gone, 45 min at each; and on that of the fixed cycle, which its own model has
seen and no other.
"""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from tests.bench.drift_drawn import Score, draw_effects, score
from tests.bench.figures import Figure, make_absolute, report_progress, set_upper_goal
from tests.compensation.drawn_cameras import Camera, draw_camera
from tests.compensation.drawn_sessions import (
    DWELL_S,
    HELD_OUT_DEGC,
    WAY_DEGC,
    DrawnSession,
    Stretch,
    make_full_session,
    record_session,
    reference,
    warm_up,
)
from thermostand.compensation.design.next_visit import DesignGoal, decide
from thermostand.compensation.drift.model_selection import fit
from thermostand.experiments.adaptive import CycleComplete, Visit, apply_decision, begin_cycle, plan_fixed_visits
from thermostand.experiments.parameters import CaptureParameters, Known
from thermostand.experiments.steps import Capture, Decide, SetTemperature, Soak, Step, estimate_duration_s
from thermostand.foundation.errors import SessionError

CAMERAS = 10
GOAL, LIMIT, SETTLED_GOAL = 60.0, 110.0, 65.0
AT_REST_DEGC, AT_REST_S = (34, 48, 20, 41, 14, 27), 4 * 3600
OTHER_WAY_DEGC = (15, 36, 22, 47, 29, 18, 42, 26, 50, 33, 12, 43)
_RANGE_DEGC = (float(min(WAY_DEGC)), float(max(WAY_DEGC)))
_LOOKED_AT_EVERY = 6  # visits
_WORKERS = min(2, os.cpu_count() or 1)


WAYS = {
    "at_rest": "at rest",
    "other_way": "on another way",
    "same_way": "on the fixed cycle's own way",
}


@dataclass(frozen=True, slots=True)
class Outcome:
    """share: of the fixed cycle's time, %. as_good_after: by then the deciding session is as good as the fixed one at
    rest, %; it is looked at every sixth visit. fixed, deciding: what each leaves, by WAYS."""

    share: float
    as_good_after: float
    fixed: dict[str, Score]
    deciding: dict[str, Score]


def figures(directory: Path) -> Iterator[Figure]:
    """Medians and worst of the drawn cameras."""
    found: list[Outcome] = []
    with ProcessPoolExecutor(_WORKERS, get_context("spawn")) as pool:
        for number, outcome in enumerate(pool.map(compare_cycles, range(CAMERAS))):
            report_progress(f"known, camera {number}: {outcome}")
            found.append(outcome)
    shares = [one.share for one in found]
    yield set_upper_goal(GOAL, make_absolute("a session that decides, of the fixed cycle's time, median", "%", shares))
    yield set_upper_goal(LIMIT, make_absolute("  the slowest of the cameras", "%", [max(shares)]))
    as_good = [one.as_good_after for one in found if np.isfinite(one.as_good_after)]
    yield make_absolute(
        "  share of the cameras as good at rest as the fixed cycle", "%", [100 * len(as_good) / len(found)]
    )
    if as_good:
        yield set_upper_goal(SETTLED_GOAL, make_absolute("    these after, median", "%", as_good))
    for way, where in WAYS.items():
        yield from _list_residuals(where, [one.fixed[way] for one in found], [one.deciding[way] for one in found])


def _list_residuals(where: str, fixed: list[Score], deciding: list[Score]) -> Iterator[Figure]:
    yield make_absolute(f"  held-out residual {where}, fixed cycle, median", "mpx RMS", [one.rms_mpx for one in fixed])
    own = [one.rms_mpx for one in deciding]
    yield make_absolute("    the session that decides", "mpx RMS", own)
    ratios = [one / other.rms_mpx for one, other in zip(own, fixed, strict=True)]
    yield make_absolute("    over that of the fixed cycle, median of the cameras", "", ratios)
    yield make_absolute(
        "    share of the cameras for which it is worse", "%", [100 * float(np.mean(np.array(ratios) > 1))]
    )
    covered = 100 * float(np.mean([one.covered for one in deciding]))
    yield make_absolute("    within its 95 % interval; 92 to 98 is right", "%", [covered])
    yield make_absolute("    without a flag", "%", [100 * float(np.mean([one.unflagged for one in deciding]))])


def compare_cycles(seed: int) -> Outcome:
    """Of one camera, without what does not repeat."""
    camera = draw_camera(seed, *draw_effects(seed, unrepeating=False)[0])
    same = record_session(camera, make_full_session(), seed)
    asked = {
        "at_rest": _record_asked_session(camera, AT_REST_DEGC, AT_REST_S, seed + 800),
        "other_way": _record_asked_session(camera, OTHER_WAY_DEGC, DWELL_S, seed + 600),
        "same_way": same,
    }
    wanted = decide(same.observed, DesignGoal(_RANGE_DEGC, 1e-9, HELD_OUT_DEGC)).predicted_px
    fixed = _score_left(same, asked)
    gone_s, as_good_s, made = record_adaptive_session(camera, seed, wanted, asked["at_rest"], fixed["at_rest"].rms_mpx)
    whole_s = begin_cycle(Known(), WAY_DEGC, HELD_OUT_DEGC, DWELL_S, 5, CaptureParameters()).left_s
    return Outcome(100 * gone_s / whole_s, 100 * as_good_s / whole_s, fixed, _score_left(made, asked))


def _record_asked_session(camera: Camera, way_degC: Sequence[int], soak_s: int, seed: int) -> DrawnSession:
    visits = [Stretch(float(degC), soak_s, "validation", 5) for degC in way_degC]
    return record_session(camera, [*warm_up(), *reference(), *visits], seed)


def _score_left(learned_from: DrawnSession, asked: dict[str, DrawnSession]) -> dict[str, Score]:
    model = fit(learned_from.observed)
    return {way: score(model, one) for way, one in asked.items()}


def compute_left_mpx(learned_from: DrawnSession, asked: DrawnSession) -> float:
    """inf while the set-points so far allow no model."""
    try:
        return score(fit(learned_from.observed), asked).rms_mpx
    except SessionError:
        return np.inf


def record_adaptive_session(
    camera: Camera, seed: int, residual_px: float, asked: DrawnSession, fixed_mpx: float
) -> tuple[float, float, DrawnSession]:
    """How long the cycle took, s, when it was as good as the fixed one, s, and the session."""
    known = Known(residual_px=residual_px)
    steps: list[Step] = [begin_cycle(known, WAY_DEGC, HELD_OUT_DEGC, DWELL_S, 5, CaptureParameters())]
    parts, gone_s, as_good_s, degC, soak_s = [*warm_up(), *reference()], 0.0, np.inf, 24.0, 0.0
    begin = len(parts)
    steps += plan_fixed_visits(steps[0]) if isinstance(steps[0], Decide) else ()
    while steps:
        match step := steps.pop(0):
            case SetTemperature(degC):
                pass
            case Soak(soak_s):
                pass
            case Capture(frames, _, _, role):
                parts.append(Stretch(degC, round(soak_s), str(role), frames))
            case Decide():
                made = record_session(camera, parts, seed)
                visits = len(parts) - begin
                if as_good_s == np.inf and visits > 5 and visits % _LOOKED_AT_EVERY == 0:
                    as_good_s = gone_s if compute_left_mpx(made, asked) <= fixed_mpx else np.inf
                wanted = DesignGoal(_RANGE_DEGC, residual_px, HELD_OUT_DEGC, step.soaks_s, step.ramp_K_per_min)
                found = decide(made.observed, wanted)
                answer = CycleComplete() if found.kind == "enough" else Visit(found.chamber_degC, found.soak_s)
                steps = list(apply_decision(step, answer))
                continue
            case _:
                pass
        gone_s += estimate_duration_s([step])
    made = record_session(camera, parts, seed)
    if as_good_s == np.inf and compute_left_mpx(made, asked) <= fixed_mpx:
        as_good_s = gone_s
    return gone_s, as_good_s, made
