"""How the image as a whole has moved: shift at its middle, change of scale, turn, at each visit of a set-point and
through a warm-up.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import groupby

import numpy as np

from thermostand.compensation.drift.displacements import reference_centres
from thermostand.compensation.observations import Float, Mask, Observations
from thermostand.experiments.steps import Role

SET_POINTS = (Role.REFERENCE, Role.FIT, Role.VALIDATION)
MOTIONS = ("shift_I", "shift_J", "scale", "turn")
UNITS = ("px", "px", "ppm", "µrad")
_FEWEST_MARKERS = 4


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """V visits of set-points of one session, in order of time. moved (V, 4): of MOTIONS, px, px, ppm, urad, from the
    session's reference. air_degC, camera_degC (V,)."""

    air_degC: Float
    camera_degC: Float
    chamber_degC: Float
    moved: Float


@dataclass(frozen=True, slots=True, eq=False)
class Warming:
    """F frames of a session's warm-up. since_s (F,): the supply came on; from the first frame when that is not recorded
    (`known` is False). moved (F, 4): as in Visits, from the first frame."""

    since_s: Float
    known: bool
    air_degC: Float
    camera_degC: Float
    moved: Float


def motions(observations: Observations) -> Float:
    """(F, 4): of every usable frame from its session's reference, NaN elsewhere. Least squares of a similarity about
    the image's middle: dx = a + s x - r y, dy = b + s y + r x."""
    found = np.full((len(observations.frame), 4), np.nan)
    width, height = observations.image_size
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    reference = reference_centres(observations)[0]
    for frame in np.flatnonzero(observations.usable):
        start = reference[observations.session[frame]]
        moved = observations.centres_px[frame] - start
        seen = np.isfinite(moved).all(axis=1) & np.isfinite(start).all(axis=1)
        if seen.sum() < _FEWEST_MARKERS:
            continue
        x, y = (start[seen] - middle).T
        one, zero = np.ones_like(x), np.zeros_like(x)
        terms = np.concatenate([np.stack([one, zero, x, -y], axis=1), np.stack([zero, one, y, x], axis=1)])
        fitted = np.linalg.lstsq(terms, moved[seen].T.ravel(), rcond=None)[0]
        found[frame] = fitted * (1.0, 1.0, 1e6, 1e6)
    return found


def visits_of(observations: Observations, moved: Float, session: int) -> Visits:
    """Frames of one set-point that follow each other are a visit; those without air or markers do not count."""
    own = observations.of(*SET_POINTS) & (observations.session == session) & np.isfinite(moved[:, 0])
    own &= np.isfinite(observations.air_degC)
    rows: list[Float] = []
    for _, group in groupby(np.flatnonzero(own).tolist(), key=lambda k: float(observations.chamber_degC[k])):
        at = list(group)
        columns = (observations.air_degC[at], observations.camera_degC[at], observations.chamber_degC[at])
        rows.append(np.concatenate([[column.mean() for column in columns], moved[at].mean(axis=0)]))
    table = np.array(rows).reshape(-1, 7)
    return Visits(table[:, 0], table[:, 1], table[:, 2], table[:, 3:])


def warming_of(observations: Observations, moved: Float, session: int) -> Warming | None:
    """The session's first warm-up; None without one at the reference's place."""
    own: Mask = observations.of(Role.WARM_UP) & (observations.session == session) & np.isfinite(moved[:, 0])
    frames = np.flatnonzero(own)
    if len(frames) < 5:
        return None
    first = observations.step_id[frames[0]]
    frames = np.array([frame for frame in frames.tolist() if observations.step_id[frame] == first])
    if len(frames) < 5 or np.abs(moved[frames, :2]).max() > 10:
        return None
    times_ns = observations.time_ns[frames]
    on_ns = observations.switched_on_ns(session, int(times_ns[0]))
    since_s = (times_ns - (int(times_ns[0]) if on_ns is None else on_ns)) / 1e9
    return Warming(
        since_s,
        on_ns is not None,
        observations.air_degC[frames],
        observations.camera_degC[frames],
        moved[frames] - moved[frames[0]],
    )
