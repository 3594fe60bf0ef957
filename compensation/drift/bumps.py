"""Steps in a session that no thermal state explains: a camera that was touched, a fixing that slipped, a marker moved.

All frames that show the target in its place are looked at: visits, warm-ups, revisited references.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve, solve_triangular

from thermostand.compensation.drift.displacements import Displacements, compute_displacements, find_reference_frames
from thermostand.compensation.drift.model_facts import MOTIONS, Bump
from thermostand.compensation.drift.terms import compute_features, compute_motions
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.drift_runtime import remembered
from thermostand.compensation.expression import AIR, CAMERA, POWER, Origin, away, backlash, lag
from thermostand.compensation.history.thermal_history import Float, ThermalStateSpec
from thermostand.compensation.observations import Mask, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError

# Other kinds of wander (shorter, smoother, both) found no more and no fewer steps on drawn cameras.
_OU_TIME_CONSTANT_H = 2.0
# The likeliest of the 48 combinations is taken. They span what drawn cameras do in factors of three to five, so that a
# value which is off by two lies within one step of the grid.
_AMOUNTS_PX = (0.03, 0.15, 0.6)
_OU_NOISES_PX = (0.0, 0.002, 0.006, 0.02)
_NOISES_PX = (0.0005, 0.0015, 0.004, 0.012)
_WIDE_PX = 3.0
"""What is known of a step that was found, before it is estimated."""


@dataclass(frozen=True, slots=True, eq=False)
class StepScan:
    """gain (B,): by how much the log likelihood grows with a step at each of B boundaries. amount_px, sigma_px (B,): of
    that step, and its standard uncertainty."""

    gain: Float
    amount_px: Float
    sigma_px: Float


@dataclass(frozen=True, slots=True, eq=False)
class WhitenedSteps:
    """The grid's covariances (G, K, K) as inverse Cholesky factors, and their log determinants (G,); steps (G, K, B):
    the candidates, whitened."""

    inverse: Float
    log_determinant: Float
    steps: Float


def whiten_steps(features: Float, hours: Float, variance_px2: Float, steps: Float, known: Float) -> WhitenedSteps:
    """features (K, H), about 1. hours (K,): of the instants. variance_px2 (K,): of the values' own noise. steps (K, B):
    the candidates, 0 or 1. known (K, S): steps that were found already."""
    inverses: list[Float] = []
    for covariance, _ in _iterate_covariances(features, hours, variance_px2, known):
        lower = np.linalg.cholesky(covariance)
        inverses.append(np.asarray(solve_triangular(lower, np.eye(len(hours)), lower=True)))
    inverse = np.array(inverses)
    log_determinant = -2 * np.log(np.diagonal(inverse, axis1=1, axis2=2)).sum(axis=1)
    return WhitenedSteps(inverse, log_determinant, inverse @ steps)


def scan_steps(white: WhitenedSteps, values_px: Float) -> StepScan:
    """Scan a series of values (K,), px, for steps."""
    own = white.inverse @ values_px
    without = -0.5 * ((own**2).sum(axis=1) + white.log_determinant)
    along = np.einsum("gkb,gk->gb", white.steps, own)
    square = (white.steps**2).sum(axis=1)
    with_step = without[:, None] + 0.5 * along**2 / square
    best = with_step.argmax(axis=0)
    at = np.arange(square.shape[1])
    return StepScan(
        gain=with_step[best, at] - without.max(),
        amount_px=along[best, at] / square[best, at],
        sigma_px=1 / np.sqrt(square[best, at]),
    )


def estimate_unexplained(features: Float, hours: Float, variance_px2: Float, known: Float, values_px: Float) -> Float:
    """(K,): what neither the thermal state nor the known steps explain of values (K,), without their own noise: wander
    and scatter, as expected with the likeliest of the grid's covariances."""
    best, found = -np.inf, np.zeros(len(hours))
    for covariance, of_rest in _iterate_covariances(features, hours, variance_px2, known):
        factor = cho_factor(covariance, lower=True)
        weights = np.asarray(cho_solve(factor, values_px))
        likelihood = float(-0.5 * values_px @ weights - np.log(np.diagonal(factor[0])).sum())
        if likelihood > best:
            best, found = likelihood, of_rest @ weights
    return found


def _iterate_covariances(
    features: Float, hours: Float, variance_px2: Float, known: Float
) -> Iterator[tuple[Float, Float]]:
    """Covariances (K, K) of values, and of the part that is wander and scatter."""
    of_features = features @ features.T
    of_wander = np.exp(-np.abs(hours[:, None] - hours) / _OU_TIME_CONSTANT_H)
    fixed = _WIDE_PX**2 * (known @ known.T + 1) + np.diag(variance_px2)
    for amount, wander, noise in product(_AMOUNTS_PX, _OU_NOISES_PX, _NOISES_PX):
        of_rest = wander**2 * of_wander + noise**2 * np.eye(len(hours))
        yield fixed + amount**2 * of_features + of_rest, of_rest


# A session as a series of instants: where the image was, and the thermal state that should explain it.

Index = NDArray[np.int64]

_ROLES = (Role.WARM_UP, Role.REFERENCE, Role.FIT, Role.VALIDATION)
# A part of the lags and plays that a fit has: here they only have to tell drift from steps.
_TAUS_S = (480.0, 1620.0, 6000.0, 18000.0)
_BACKLASHES_K = (1.5, 3.0, 6.0, 10.0, 14.0)
_FEATURES = (
    away(CAMERA),
    away(CAMERA) ** 2,
    *(away(lag(AIR, tau_s)) for tau_s in _TAUS_S),
    *(lag(POWER, tau_s) - 1 for tau_s in _TAUS_S),
    away(lag(CAMERA, _TAUS_S[1])),
    away(lag(CAMERA, _TAUS_S[1])) ** 2,
    *(away(backlash(CAMERA, radius_K)) for radius_K in _BACKLASHES_K),
)
_FADING_S = (900.0, 3600.0, 14400.0)
"""How what was before the record fades, when nobody knows it."""
# A scan takes time with the cube of it. Longer sessions get coarser instants, up to 16 min; around a step that was
# found the session is looked at again minute by minute.
_MOST_INSTANTS = 160
_SAME_PLACE_PX = 10.0  # no drift is as large: the camera was moved or rolled
_INSTANT_NS = 60 * NS_PER_S  # one minute: the time to which a bump is resolved
_FEWEST = 8  # instants; fewer tell nothing of a step
_QUICK_S = 1200.0
"""So soon after switching on the image moves faster than any of these lags follows."""


@dataclass(frozen=True, slots=True, eq=False)
class _SeriesFrames:
    """What a series is condensed from. rows: of the frames that show the target in its place. label (M,): the instant
    of each, in order of time. features (F, H): of all frames."""

    observations: Observations
    rows: Displacements
    label: Index
    features: Float


@dataclass(frozen=True, slots=True, eq=False)
class SessionSeries:
    """One session's K instants: means over the frames of each. first_ns, last_ns, hours (K,). features (K, H).
    motions_px, variance_px2 (K, 4): shift along I and J, turn and scale. left_px (K, N, 2): of each marker after all
    eight motions, NaN where it is missing; noise_px2 (K, N)."""

    session_id: str
    first_ns: Index
    last_ns: Index
    hours: Float
    features: Float
    motions_px: Float
    variance_px2: Float
    left_px: Float
    noise_px2: Float
    _frames: _SeriesFrames

    @property
    def boundaries(self) -> Index:
        """(B,): instants that a step may lie before."""
        return np.arange(1, len(self.hours))

    def steps(self, before: Index) -> Float:
        """(K, B): 1 from each of these instants on."""
        return (np.arange(len(self.hours))[:, None] >= before).astype(float)

    def find_instants(self, before_ns: list[int]) -> Index:
        """The instants that begin at these times."""
        return np.searchsorted(self.first_ns, np.array(before_ns, np.int64))

    def refine(self, before: int) -> SessionSeries:
        """Return the series with each minute an instant of its own on both sides of the boundary before this instant;
        the same series where that is so already."""
        frames = self._frames
        near = (frames.label == before - 1) | (frames.label == before)
        minute = frames.observations.time_ns[frames.rows.frame] // _INSTANT_NS
        parts = np.where(near, minute - minute[0] + 1, 0)
        label = np.unique(np.column_stack([frames.label, parts]), axis=0, return_inverse=True)[1].ravel()
        if label[-1] == frames.label[-1]:
            return self
        return _condense(self.session_id, _SeriesFrames(frames.observations, frames.rows, label, frames.features))


def build_session_series(observations: Observations, index: int) -> SessionSeries | None:
    """Build the series of session `index`; None with too few instants.

    SessionError when there is nothing to measure against.
    """
    frames = observations.of(*_ROLES) & (observations.session == index)
    if not frames.any():
        return None
    of_frames, known = _compute_features(observations)
    frames &= known
    if not frames.any():
        return None
    rows = compute_displacements(observations, frames, find_reference_frames(observations))
    # Without frames of a camera or a target that was moved on purpose.
    rows = rows.where(np.linalg.norm(rows.displacement_px, axis=1) < _SAME_PLACE_PX)
    if not len(rows.frame):
        return None
    label = _label_instants(observations, rows)
    if label[-1] + 1 < _FEWEST:
        return None
    return _condense(observations.sessions[index].session_id, _SeriesFrames(observations, rows, label, of_frames))


def compute_rigid_motions(xy_px: Float, image_size: tuple[int, int]) -> Float:
    """(N, 2, 4): shift along I, along J, turn and scale."""
    eight = compute_motions(xy_px, image_size)
    return np.stack([eight[..., 0], eight[..., 1], eight[..., 4] - eight[..., 3], eight[..., 2] + eight[..., 5]], -1)


def _condense(session_id: str, frames: _SeriesFrames) -> SessionSeries:
    moved, variance, left, noise = _fit_instant_motions(frames)
    count, times_ns = len(moved), frames.observations.time_ns[frames.rows.frame]
    first, last = np.full(count, np.iinfo(np.int64).max), np.zeros(count, np.int64)
    np.minimum.at(first, frames.label, times_ns)
    np.maximum.at(last, frames.label, times_ns)
    hours = (first - first[0]) / NS_PER_S / 3600
    return SessionSeries(
        session_id=session_id,
        first_ns=first,
        last_ns=last,
        hours=hours,
        features=_average_features(frames),
        motions_px=moved,
        variance_px2=variance,
        left_px=left,
        noise_px2=noise,
        _frames=frames,
    )


def _compute_features(observations: Observations) -> tuple[Float, Mask]:
    """(F, H) of all frames, and which are known (F,): none without a history of the air, where lag looks like steps."""
    states = compute_frame_states(observations, ThermalStateSpec(remembered(_FEATURES)))
    if not np.isfinite(observations.air_degC).any():
        return np.empty((len(observations.frame), 0)), np.zeros(len(observations.frame), bool)
    origin = Origin(float(np.nanmean(states.camera_degC)), float(np.nanmean(observations.air_degC)))
    found = compute_features(states, _FEATURES, origin)
    fading = np.exp(-states.settled_s[:, None] / np.array(_FADING_S))
    return np.hstack([found, fading]), np.isfinite(found).all(axis=1) & ~(states.on_s < _QUICK_S)


def _label_instants(observations: Observations, rows: Displacements) -> Index:
    """(M,): each row's instant, in order of time. A minute of a step is one, or more in a long session."""
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
    return label[frame_of_row.ravel()]


def _average_features(frames: _SeriesFrames) -> Float:
    """(K, H): of the frames of an instant, which may be minutes apart and of a camera on its way, weighted as their
    mean places are."""
    rows, label = frames.rows, frames.label
    precision = 2 / rows.variance_px2.sum(axis=1)
    total = np.bincount(label, precision)
    found = [np.bincount(label, precision * column[rows.frame]) / total for column in frames.features.T]
    return np.stack(found, axis=1)


def _fit_instant_motions(frames: _SeriesFrames) -> tuple[Float, Float, Float, Float]:
    """motions (K, 4), their variance (K, 4), what eight motions leave of each marker (K, N, 2), its variance (K, N)."""
    observations, rows, label = frames.observations, frames.rows, frames.label
    instants, count = int(label[-1]) + 1, observations.target.count
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
        four = compute_rigid_motions(at[k, own], observations.image_size)
        design = (four * scale[:, None, None]).reshape(-1, MOTIONS)
        inverse = np.linalg.pinv(design.T @ design)
        moved[k] = inverse @ design.T @ (place[k, own] * scale[:, None]).ravel()
        variance[k] = np.diagonal(inverse)
        eight = compute_motions(at[k, own], observations.image_size)
        amounts = np.linalg.lstsq(eight.reshape(-1, 8), place[k, own].ravel(), rcond=None)[0]
        left[k, own] = place[k, own] - eight @ amounts
    return moved, variance, left, np.where(seen, 1 / np.where(seen, weight, 1.0), np.nan)


# On 160 clean sessions, and as many with one bump, what the forms miss explains up to 29, with steps of up to 30 mpx;
# bumps of 50 mpx at rest explain 16 to 100. Twice 17 would lose those of them that explain less than 34.
_GAIN, _GAIN_MARKER = 17.0, 25.0
"""Log likelihood that a step has to explain, chosen on sessions of drawn cameras without any (numbers 2000 to 2079)."""
# The limit before, 20 mpx, lies within what the forms miss; twice 35 mpx would pass over bumps of 50.
_LEAST_PX, _LEAST_MARKER_PX = 0.035, 0.020
"""What the forms of thermal states miss comes in steps, too, of up to 30 mpx."""
_BLURRED = 0.5
"""How small a step may look amidst an instant."""
# A bound of the time: each step costs a scan. Round number; nothing was measured.
MOST_STEPS = 6


def find_bumps(observations: Observations) -> tuple[Bump, ...]:
    """Find the steps of all sessions, in order of time; a session with too few instants has none."""
    found: list[Bump] = []
    for index in range(len(observations.sessions)):
        try:
            series = build_session_series(observations, index)
        except SessionError:  # nothing to measure against: the fit says so
            continue
        if series is not None:
            found += sorted(_find_rigid_bumps(series), key=lambda bump: bump.after_ns)
            found += sorted(_find_marker_bumps(series), key=lambda bump: bump.after_ns)
    return tuple(found)


def list_sessions_at_limit(bumps: Sequence[Bump]) -> tuple[str, ...]:
    """List the sessions in which as many steps of the whole image were found as are looked for: there may be more."""
    found = Counter(bump.session_id for bump in bumps if bump.marker is None)
    return tuple(session_id for session_id, count in found.items() if count >= MOST_STEPS)


def correct_bumps(observations: Observations, bumps: tuple[Bump, ...]) -> Observations:
    """Return the observations with the centres where they would be had the camera stayed as it was when its reference
    was taken; each centre that was moved back has the step's variance, too."""
    centres, covariance = observations.centres_px.copy(), observations.covariance_px2.copy()
    for bump in bumps:
        for index, facts in enumerate(observations.sessions):
            if facts.session_id == bump.session_id:
                _move_back(observations, index, bump, centres, covariance)
    return replace(observations, centres_px=centres, covariance_px2=covariance) if bumps else observations


def _move_back(observations: Observations, index: int, bump: Bump, centres: Float, covariance: Float) -> None:
    own = observations.session == index
    later = observations.time_ns >= bump.before_ns
    reference = own & find_reference_frames(observations)
    side = later if (reference & ~later).any() else ~later
    sign = 1.0 if side is later else -1.0
    frames = np.flatnonzero(own & side)
    markers = slice(None) if bump.marker is None else slice(bump.marker, bump.marker + 1)
    moved = compute_rigid_motions(observations.centres_px[frames, markers].reshape(-1, 2), observations.image_size)
    shift = (moved @ np.array(bump.motions_px)).reshape(len(frames), -1, 2)
    variance = (moved**2 @ np.array(bump.sigma_px) ** 2).reshape(len(frames), -1, 2)
    centres[frames, markers] -= sign * shift
    covariance[frames, markers] += variance[..., None] * np.eye(2)


def _find_rigid_bumps(series: SessionSeries) -> Iterator[Bump]:
    """Find steps of the whole image, the largest first, each together with those found before it; then estimate all
    together. Where one is found the series is looked at minute by minute: a step amidst an instant looks like two
    halves."""
    before_ns: list[int] = []
    while len(before_ns) < MOST_STEPS:
        best, size_px = _find_largest_step(series, series.find_instants(before_ns))
        finer = series.refine(best)
        if size_px < _LEAST_PX * (1.0 if finer is series else _BLURRED):
            break
        if finer is series:
            before_ns.append(int(series.first_ns[best]))
        series = finer
    known = series.find_instants(before_ns)
    for own in known.tolist():
        found = _scan_axes(series, np.array([own]), known[known != own])
        amounts = tuple(float(one.amount_px[0]) for one in found)
        yield _make_bump(series, own, amounts, tuple(float(one.sigma_px[0]) for one in found), None)


def _find_largest_step(series: SessionSeries, known: Index) -> tuple[int, float]:
    """The boundary where one more step explains most, and its size, px; 0 where it explains too little."""
    scans = _scan_axes(series, series.boundaries, known)
    gain = np.sum([own.gain for own in scans], axis=0)
    gain[np.isin(series.boundaries, known)] = -np.inf
    best = int(np.argmax(gain))
    size = max(np.hypot(scans[0].amount_px[best], scans[1].amount_px[best]), *(abs(s.amount_px[best]) for s in scans))
    return int(series.boundaries[best]), float(size) if gain[best] >= _GAIN else 0.0


def _scan_axes(series: SessionSeries, boundaries: Index, known: Index) -> list[StepScan]:
    return [
        scan_steps(
            _whiten(series, series.variance_px2[:, axis], boundaries, known),
            series.motions_px[:, axis],
        )
        for axis in range(MOTIONS)
    ]


def _whiten(series: SessionSeries, variance_px2: Float, boundaries: Index, known: Index) -> WhitenedSteps:
    return whiten_steps(series.features, series.hours, variance_px2, series.steps(boundaries), series.steps(known))


def _make_bump(
    series: SessionSeries, before: int, amounts: tuple[float, ...], sigma: tuple[float, ...], marker: int | None
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


def _find_marker_bumps(series: SessionSeries) -> Iterator[Bump]:
    """Steps of single markers, which the eight motions of all cannot follow."""
    complete = np.asarray(np.isfinite(series.left_px).all(axis=(0, 2)))
    if not complete.any():
        return
    white = _whiten(series, np.nanmedian(series.noise_px2, axis=1), series.boundaries, np.empty(0, np.int64))
    for marker in np.flatnonzero(complete).tolist():
        i, j = (scan_steps(white, series.left_px[:, marker, axis]) for axis in (0, 1))
        gain = i.gain + j.gain
        best = int(np.argmax(gain))
        amount = float(i.amount_px[best]), float(j.amount_px[best])
        if gain[best] > _GAIN_MARKER and np.hypot(*amount) > _LEAST_MARKER_PX:
            sigma = float(i.sigma_px[best]), float(j.sigma_px[best])
            yield _make_bump(series, int(series.boundaries[best]), (*amount, 0.0, 0.0), (*sigma, 0.0, 0.0), marker)


# What of a session's drift neither a thermal state nor a single step explains: fixings that slip again and again, or
# settle differently each time.
#
# A joint that sticks and slips moves the image along one line; fixings that settle differently after each change move
# it in any direction. In sessions of 24 drawn cameras each (numbers 2400 to 2423, by which the limits were chosen) what
# is left along its main axis is 1.6 to 29 times that across (3 below 3) with slips, 1.2 to 3.1 (1 above 2.4) with
# fixings that settle differently; in cameras that repeat it is 0.1 to 2.4 mpx.

# Cameras that repeat leave 0.1 to 2.4 mpx (see above): half of it would name a cause for many of them.
_LEAST_UNREPEATED_PX = 0.0025
# Only one of 24 cameras whose fixings settle differently is above it; at half of it all would be called slips.
_ONE_LINE = 2.4


class Cause(StrEnum):
    """What leaves such a trace. NOTHING: as small as in cameras that repeat."""

    NOTHING = "nothing"
    SLIPS = "slips"
    SETTLING = "settling"


@dataclass(frozen=True, slots=True)
class UnrepeatedMotion:
    """How far one session's drift does not repeat. cause: what it is like. along_px, across_px: RMS along the line on
    which most is left, and across it; direction_deg: of that line, from I towards J, -90..90. text: in a sentence."""

    session_id: str
    cause: Cause
    along_px: float
    across_px: float
    direction_deg: float
    text: str


def find_unrepeated(observations: Observations, bumps: Sequence[Bump]) -> tuple[UnrepeatedMotion, ...]:
    """Find them in each session with enough instants to decide, besides the steps that were found in it."""
    found: list[UnrepeatedMotion] = []
    for index in range(len(observations.sessions)):
        try:
            series = build_session_series(observations, index)
        except SessionError:  # nothing to measure against: the fit says so
            continue
        if series is None:
            continue
        own = [one.before_ns for one in bumps if one.session_id == series.session_id and one.marker is None]
        known = series.steps(series.find_instants(own))
        left = np.stack(
            [
                estimate_unexplained(
                    series.features, series.hours, series.variance_px2[:, axis], known, series.motions_px[:, axis]
                )
                for axis in (0, 1)
            ]
        )
        values, vectors = np.linalg.eigh(left @ left.T / left.shape[1])
        across_px, along_px = np.sqrt(np.maximum(values, 0.0)).tolist()
        i, j = vectors[:, 1].tolist()
        direction_deg = (math.degrees(math.atan2(j, i)) + 90) % 180 - 90
        cause = _classify_cause(along_px, across_px)
        text = _describe_cause(cause, 1e3 * along_px, 1e3 * across_px, direction_deg)
        found.append(UnrepeatedMotion(series.session_id, cause, along_px, across_px, direction_deg, text))
    return tuple(found)


def _classify_cause(along_px: float, across_px: float) -> Cause:
    if along_px < _LEAST_UNREPEATED_PX:
        return Cause.NOTHING
    return Cause.SLIPS if along_px > _ONE_LINE * across_px else Cause.SETTLING


def _describe_cause(cause: Cause, along_mpx: float, across_mpx: float, direction_deg: float) -> str:
    match cause:
        case Cause.SLIPS:
            return (
                f"{along_mpx:.1f} mpx RMS of the image's place do not repeat, along one line at {direction_deg:.0f} "
                f"deg from I towards J ({across_mpx:.1f} across it): as of a joint that sticks and slips"
            )
        case Cause.SETTLING:
            return (
                f"{along_mpx:.1f} mpx RMS of the image's place do not repeat, in no single direction ({across_mpx:.1f} "
                "across): as of fixings that settle differently after each change"
            )
        case Cause.NOTHING:
            return f"what does not repeat of the image's place is at most {along_mpx:.1f} mpx RMS"
