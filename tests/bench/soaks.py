"""Shorter dwells: a thermal cycle whose dwells last 65 % of the time, against 45 min, on drawn cameras straight from
physics. Both models are asked about the same temperatures that neither has seen, after 90 min and after 4 h at each.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from tests.bench.drift_drawn import draw_effects, score
from tests.bench.figures import Figure, make_absolute, report_progress, set_upper_goal
from tests.compensation.drawn_cameras import draw_camera
from tests.compensation.drawn_sessions import DWELL_S, Stretch, record_session, reference, warm_up
from thermostand.compensation.drift.model_selection import fit

FIRST, CAMERAS = 60, 10
SHARE, GOAL = 0.65, 1.0
CYCLE_DEGC = (31, 34, 38, 45, 48, 52, 48, 45, 38, 34, 31, 24, 20, 17, 10, 17, 20, 24)
UNSEEN_DEGC = (27, 41, 50, 36, 22, 12)
AFTER_H = (1.5, 4.0)


def figures(directory: Path) -> Iterator[Figure]:
    """Of the residuals of each camera, those of the shorter dwells over those of the longer."""
    ratios: dict[float, list[float]] = {after_h: [] for after_h in AFTER_H}
    for seed in range(FIRST, FIRST + CAMERAS):
        report_progress(f"dwells, camera {seed}")
        longer, shorter = residuals_mpx(seed, DWELL_S), residuals_mpx(seed, round(SHARE * DWELL_S))
        for after_h, found in ratios.items():
            found.append(shorter[after_h] / longer[after_h])
    for after_h, found in ratios.items():
        what = f"dwells of 65 %: residual {after_h:g} h after a change, over that of 45 min, median"
        yield set_upper_goal(GOAL, make_absolute(what, "", found))
        yield make_absolute("  the worst of the cameras", "", [max(found)])


def residuals_mpx(seed: int, dwell_s: int) -> dict[float, float]:
    """What a model of one cycle leaves, by the hours after a change."""
    camera = draw_camera(seed, *draw_effects(seed, unrepeating=False)[0])
    model = fit(record_session(camera, _parts(CYCLE_DEGC, dwell_s, "fit"), seed).observed)
    asked = {
        after_h: record_session(camera, _parts(UNSEEN_DEGC, round(3600 * after_h), "validation"), seed + 700)
        for after_h in AFTER_H
    }
    return {after_h: score(model, one).rms_mpx for after_h, one in asked.items()}


def _parts(way_degC: tuple[int, ...], dwell_s: int, role: str) -> list[Stretch]:
    return [*warm_up(), *reference(), *(Stretch(float(degC), dwell_s, role, 5) for degC in way_degC)]
