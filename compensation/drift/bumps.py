"""Steps in a night that no thermal state explains: a camera that was touched, a fixing that slipped, a marker moved.

All frames that show the target in its place are looked at: visits, warm-ups, revisited references.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from compensation.drift.bump import MOTIONS, Bump
from compensation.drift.displacements import Displacements, anchors, displacements
from compensation.drift.step_scan import Scan, Whitened, scan, whitened
from compensation.drift.terms import POLYNOMIAL, Kind, Origin, Term, features, motions
from compensation.drift.training import frame_states
from compensation.history.states import Float, Memory
from compensation.observations import Mask, Observations
from experiments.steps import Role
from foundation.clock import NS_PER_S
from foundation.errors import SessionError

Index = NDArray[np.int64]

_ROLES = (Role.WARM_UP, Role.REFERENCE, Role.FIT, Role.VALIDATION)
_TAUS_S = (480.0, 1620.0, 6000.0, 18000.0)
_PLAYS_K = (1.5, 3.0, 6.0, 10.0, 14.0)
_TERMS = (
    *POLYNOMIAL[1:],
    *(Term(Kind.AMBIENT_LAG, tau_s) for tau_s in _TAUS_S),
    *(Term(Kind.POWER_LAG, tau_s) for tau_s in _TAUS_S),
    Term(Kind.CAMERA_LAG, _TAUS_S[1]),
    Term(Kind.CAMERA_LAG_SQUARE, _TAUS_S[1]),
    *(Term(Kind.PLAY, radius_K) for radius_K in _PLAYS_K),
)
_FORGOTTEN_S = (900.0, 3600.0, 14400.0)
"""How what was before the record fades, when nobody knows it."""
_GAIN, _GAIN_MARKER = 22.0, 25.0
"""Log likelihood that a step has to explain, chosen on nights of drawn cameras without any: see the tests."""
_LEAST_PX = 0.020
_MOST = 6
_MOST_INSTANTS = 160
_SAME_PLACE_PX = 10.0
_INSTANT_NS = 60 * NS_PER_S
_FEWEST = 8
_QUICK_S = 1200.0
"""So soon after switching on the image moves faster than any lag of these tells."""


def find_bumps(observations: Observations) -> tuple[Bump, ...]:
    """Of all sessions, in order of time; none in a session with too few instants to tell."""
    found: list[Bump] = []
    for index in range(len(observations.sessions)):
        try:
            series = _series(observations, index)
        except SessionError:  # nothing to measure against: the fit says so
            continue
        if series is not None:
            found += sorted(_rigid(series), key=lambda bump: bump.after_ns)
            found += sorted(_markers(series, found), key=lambda bump: bump.after_ns)
    return tuple(found)


def around_bumps(observations: Observations, bumps: tuple[Bump, ...]) -> Observations:
    """With the centres where they would be had the camera stayed as it was when its reference was taken; each centre
    that was moved back has the step's variance, too."""
    centres, covariance = observations.centres_px.copy(), observations.covariance_px2.copy()
    for bump in bumps:
        for index, facts in enumerate(observations.sessions):
            if facts.session_id == bump.session_id:
                _move_back(observations, index, bump, centres, covariance)
    return replace(observations, centres_px=centres, covariance_px2=covariance) if bumps else observations


def _move_back(observations: Observations, index: int, bump: Bump, centres: Float, covariance: Float) -> None:
    own = observations.session == index
    later = observations.time_ns >= bump.before_ns
    reference = own & anchors(observations)
    side = later if (reference & ~later).any() else ~later
    sign = 1.0 if side is later else -1.0
    frames = np.flatnonzero(own & side)
    markers = slice(None) if bump.marker is None else slice(bump.marker, bump.marker + 1)
    moved = _four(observations.centres_px[frames, markers].reshape(-1, 2), observations.image_size)
    shift = (moved @ np.array(bump.motions_px)).reshape(len(frames), -1, 2)
    variance = (moved**2 @ np.array(bump.sigma_px) ** 2).reshape(len(frames), -1, 2)
    centres[frames, markers] -= sign * shift
    covariance[frames, markers] += variance[..., None] * np.eye(2)


def _four(xy_px: Float, image_size: tuple[int, int]) -> Float:
    """(N, 2, 4): shift along I, along J, turn and scale."""
    eight = motions(xy_px, image_size)
    return np.stack([eight[..., 0], eight[..., 1], eight[..., 4] - eight[..., 3], eight[..., 2] + eight[..., 5]], -1)


@dataclass(frozen=True, slots=True, eq=False)
class _Series:
    """One session's K instants. first_ns, last_ns, hours (K,). features (K, H). motions_px, variance_px2 (K, 4).
    left_px (K, N, 2): of each marker after all eight motions, NaN where it is missing; noise_px2 (K, N)."""

    session_id: str
    first_ns: Index
    last_ns: Index
    hours: Float
    features: Float
    motions_px: Float
    variance_px2: Float
    left_px: Float
    noise_px2: Float

    @property
    def boundaries(self) -> Index:
        """(B,): instants that a step may lie before."""
        return np.arange(1, len(self.hours))

    def steps(self, before: Index) -> Float:
        """(K, B): 1 from each of these instants on."""
        return (np.arange(len(self.hours))[:, None] >= before).astype(float)


def _series(observations: Observations, index: int) -> _Series | None:
    frames = observations.of(*_ROLES) & (observations.session == index)
    if not frames.any():
        return None
    of_frames, known = _features(observations)
    frames &= known
    if not frames.any():
        return None
    rows = _in_place(displacements(observations, frames, anchors(observations)))
    if not len(rows.frame):
        return None
    label, frame_of = _labels(observations, rows)
    if len(frame_of) < _FEWEST:
        return None
    count = observations.target.count
    moved, variance, left, noise = _of_instants(observations, rows, label, len(frame_of), count)
    found = of_frames[frame_of]
    times_ns = observations.time_ns[rows.frame]
    first, last = np.full(len(frame_of), np.iinfo(np.int64).max), np.zeros(len(frame_of), np.int64)
    np.minimum.at(first, label, times_ns)
    np.maximum.at(last, label, times_ns)
    hours = (first - first[0]) / NS_PER_S / 3600
    name = observations.sessions[index].session_id
    return _Series(name, first, last, hours, found, moved, variance, left, noise)


def _features(observations: Observations) -> tuple[Float, Mask]:
    """(F, H) of all frames, and which are known (F,): none without a history of the air, where lag looks like steps."""
    states = frame_states(observations, Memory(_TAUS_S, _PLAYS_K))
    if not np.isfinite(observations.air_degC).any():
        return np.empty((len(observations.frame), 0)), np.zeros(len(observations.frame), bool)
    origin = Origin(float(np.nanmean(states.camera_degC)), float(np.nanmean(observations.air_degC)))
    found = features(states, _TERMS, origin)
    fading = np.exp(-states.settled_s[:, None] / np.array(_FORGOTTEN_S))
    return np.hstack([found, fading]), np.isfinite(found).all(axis=1) & ~(states.on_s < _QUICK_S)


def _in_place(rows: Displacements) -> Displacements:
    """Without frames of a camera or a target that was moved on purpose."""
    return rows.where(np.linalg.norm(rows.displacement_px, axis=1) < _SAME_PLACE_PX)


def _labels(observations: Observations, rows: Displacements) -> tuple[Index, Index]:
    """(M,): each row's instant, in order of time, and each instant's first frame (K,). A minute of a step is one, or
    more in a long session."""
    frames, frame_of_row = np.unique(rows.frame, return_inverse=True)
    _, step = np.unique(np.array(observations.step_id)[frames], return_inverse=True)
    minute = (observations.time_ns[frames] - observations.time_ns[frames[0]]) // _INSTANT_NS
    width = 1
    while True:
        changed = (np.diff(minute // width) != 0) | (np.diff(step) != 0)
        label = np.concatenate([[0], np.cumsum(changed)])
        if label[-1] < _MOST_INSTANTS or width > minute[-1]:
            break
        width *= 2
    first = np.flatnonzero(np.concatenate([[True], changed]))
    return label[frame_of_row.ravel()], frames[first]


def _of_instants(
    observations: Observations, rows: Displacements, label: Index, instants: int, count: int
) -> tuple[Float, Float, Float, Float]:
    """motions (K, 4), their variance (K, 4), what eight motions leave of each marker (K, N, 2), its variance (K, N)."""
    place, weight = np.zeros((instants, count, 2)), np.zeros((instants, count))
    at, precision = np.zeros((instants, count, 2)), 2 / rows.variance_px2.sum(axis=1)
    np.add.at(weight, (label, rows.marker), precision)
    np.add.at(place, (label, rows.marker), -rows.displacement_px * precision[:, None])
    np.add.at(at, (label, rows.marker), rows.measured_px * precision[:, None])
    seen = weight > 0
    safe = np.where(seen, weight, 1.0)[..., None]
    place, at = place / safe, at / safe
    moved, variance = np.zeros((instants, MOTIONS)), np.zeros((instants, MOTIONS))
    left = np.full((instants, count, 2), np.nan)
    for k in range(instants):
        own = seen[k]
        scale = np.sqrt(weight[k, own])
        four = _four(at[k, own], observations.image_size)
        design = (four * scale[:, None, None]).reshape(-1, MOTIONS)
        inverse = np.linalg.pinv(design.T @ design)
        moved[k] = inverse @ design.T @ (place[k, own] * scale[:, None]).ravel()
        variance[k] = np.diagonal(inverse)
        eight = motions(at[k, own], observations.image_size)
        amounts = np.linalg.lstsq(eight.reshape(-1, 8), place[k, own].ravel(), rcond=None)[0]
        left[k, own] = place[k, own] - eight @ amounts
    return moved, variance, left, np.where(seen, 1 / np.where(seen, weight, 1.0), np.nan)


def _rigid(series: _Series) -> Iterator[Bump]:
    """Steps of the whole image, the largest first, each beside those found before it; then all estimated together."""
    before: list[int] = []
    while len(before) < _MOST:
        scans = _scans(series, series.boundaries, np.array(before, np.int64))
        gain = np.sum([own.gain for own in scans], axis=0)
        gain[np.isin(series.boundaries, before)] = -np.inf
        best = int(np.argmax(gain))
        size = max(
            np.hypot(scans[0].amount_px[best], scans[1].amount_px[best]), *(abs(s.amount_px[best]) for s in scans)
        )
        if gain[best] < _GAIN or size < _LEAST_PX:
            break
        before.append(int(series.boundaries[best]))
    for own in before:
        others = np.array([one for one in before if one != own], np.int64)
        found = _scans(series, np.array([own]), others)
        amounts = tuple(float(one.amount_px[0]) for one in found)
        yield _bump(series, own, amounts, tuple(float(one.sigma_px[0]) for one in found), None)


def _scans(series: _Series, boundaries: Index, known: Index) -> list[Scan]:
    return [
        scan(
            _white(series, series.variance_px2[:, axis], boundaries, known),
            series.motions_px[:, axis],
        )
        for axis in range(MOTIONS)
    ]


def _white(series: _Series, variance_px2: Float, boundaries: Index, known: Index) -> Whitened:
    return whitened(series.features, series.hours, variance_px2, series.steps(boundaries), series.steps(known))


def _bump(
    series: _Series, before: int, amounts: tuple[float, ...], sigma: tuple[float, ...], marker: int | None
) -> Bump:
    after_ns, before_ns = int(series.last_ns[before - 1]), int(series.first_ns[before])
    return Bump(
        session_id=series.session_id,
        after_ns=after_ns,
        before_ns=before_ns,
        motions_px=amounts,
        sigma_px=sigma,
        marker=marker,
    )


def _markers(series: _Series, rigid: list[Bump]) -> Iterator[Bump]:
    """Steps of single markers, which the eight motions of all cannot follow."""
    complete = np.asarray(np.isfinite(series.left_px).all(axis=(0, 2)))
    if not complete.any():
        return
    white = _white(series, np.nanmedian(series.noise_px2, axis=1), series.boundaries, np.empty(0, np.int64))
    for marker in np.flatnonzero(complete).tolist():
        i, j = (scan(white, series.left_px[:, marker, axis]) for axis in (0, 1))
        gain = i.gain + j.gain
        best = int(np.argmax(gain))
        amount = float(i.amount_px[best]), float(j.amount_px[best])
        if gain[best] > _GAIN_MARKER and np.hypot(*amount) > _LEAST_PX:
            sigma = float(i.sigma_px[best]), float(j.sigma_px[best])
            yield _bump(series, int(series.boundaries[best]), (*amount, 0.0, 0.0), (*sigma, 0.0, 0.0), marker)
