"""Certificates of drawn cameras: how often U holds the true temperature coefficient at rest.

The thermometer is as wrong as the certificate claims, each end of the range by its own, and the target grows as it
does. Truth: of plain cameras the physics at rest; of those with sag, dead zone, creep or fixings that do not repeat, a
cycle without noise that stays for a day at each set-point.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from tests.bench.figures import Figure, make_absolute, report_progress, set_lower_goal, set_upper_goal
from tests.compensation.drawn_cameras import Camera, Float, draw_camera
from tests.compensation.drawn_sessions import WAY_DEGC, Stretch, make_full_session, record_session
from tests.compensation.test_datasheet import COEFFICIENTS, at_rest_per_K
from thermostand.compensation.certificate.certificate import certify
from thermostand.compensation.datasheet.datasheet import (
    collect_visits,
    compute_datasheet,
    fit_curve,
    fit_motions,
)
from thermostand.compensation.drift.paper_model import fit_paper
from thermostand.compensation.observations import Observations

SESSIONS = 48  # 200 take ten minutes; cameras on which nothing was chosen begin at 5001
KINDS = ((), ("sag",), (), ("sag", "creep"), (), ("dead_zone",), ("coarse_sensor",), ("unrepeated",))
_DAY_S = 86400
_U_AIR_K, _U_TARGET_PPM_PER_K = 0.1, 0.1  # as the datasheet assumes
_MIDDLE_PX = (1223.5, 1023.5)


def figures(directory: Path) -> list[Figure]:
    """% of coefficients."""
    inside: list[bool] = []
    kind_of: list[tuple[str, ...]] = []
    for number in range(SESSIONS):
        report_progress(f"certificate of drawn camera {number + 1} of {SESSIONS}")
        kind = KINDS[number % len(KINDS)]
        found = hold_truth(number, kind)
        inside += found
        kind_of += [kind] * len(found)
    share = 100 * float(np.mean(inside))
    quick = 100 * float(np.mean([held for held, kind in zip(inside, kind_of, strict=True) if "creep" not in kind]))
    return [
        set_lower_goal(93, make_absolute("certificate: true coefficients within U, 95 is right", "%", [share])),
        set_upper_goal(97, make_absolute("  the same", "%", [share])),
        make_absolute("  without the creep of 5.5 h", "%", [quick]),
    ]


def hold_truth(number: int, kind: tuple[str, ...]) -> list[bool]:
    """Whether each of COEFFICIENTS holds, in one session of the camera of this number."""
    camera = draw_camera(5001 + number, *kind)
    made = record_session(camera, make_full_session(), number).observed
    observed = _draw_errors(made, np.random.default_rng([6, number]))
    known = compute_datasheet(observed, fit_paper(observed)).by_key
    truth = _compute_at_rest(camera, kind) if kind else at_rest_per_K(camera)
    return [
        abs(known[key].value - true) <= certify(known[key]).expanded
        for key, true in zip(COEFFICIENTS, truth.tolist(), strict=True)
    ]


def _draw_errors(observed: Observations, rng: np.random.Generator) -> Observations:
    low_K, high_K = rng.normal(0, _U_AIR_K, 2)
    air = observed.air_degC
    grown = 1e-6 * rng.normal(0, _U_TARGET_PPM_PER_K) * (air - 24.0)
    centres = observed.centres_px + (observed.centres_px - _MIDDLE_PX) * grown[:, None, None]
    return replace(observed, air_degC=air + low_K + (high_K - low_K) * (air - 10) / 42, centres_px=centres)


def _compute_at_rest(camera: Camera, kind: tuple[str, ...]) -> Float:
    """(4,): per K."""
    plan = [Stretch(24.0, _DAY_S, "reference", 1), *(Stretch(degC, _DAY_S, "fit", 1) for degC in WAY_DEGC)]
    repeating = camera.with_effects(*(effect for effect in kind if effect != "unrepeated"))
    made = record_session(repeating, plan, 0, noise_px=0.0)
    observed = replace(made.observed, centres_px=made.truth_px)
    visits = collect_visits(observed, fit_motions(observed), 0)
    curves = [fit_curve(visits, motion) for motion in range(len(COEFFICIENTS))]
    return np.array([curve.slope for curve in curves if curve])
