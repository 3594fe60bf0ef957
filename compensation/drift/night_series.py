"""A session as a series of instants: where the image was, and the thermal state that should explain it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.bump import MOTIONS
from thermostand.compensation.drift.displacements import Displacements, anchors, displacements
from thermostand.compensation.drift.terms import features, motions
from thermostand.compensation.drift.training import frame_states
from thermostand.compensation.drift_runtime import remembered
from thermostand.compensation.expression import AIR, CAMERA, POWER, Origin, away, lag, play
from thermostand.compensation.history.states import Float, ThermalMemory
from thermostand.compensation.observations import Mask, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S

Index = NDArray[np.int64]

_ROLES = (Role.WARM_UP, Role.REFERENCE, Role.FIT, Role.VALIDATION)
_TAUS_S = (480.0, 1620.0, 6000.0, 18000.0)
_PLAYS_K = (1.5, 3.0, 6.0, 10.0, 14.0)
_FEATURES = (
    away(CAMERA),
    away(CAMERA) ** 2,
    *(away(lag(AIR, tau_s)) for tau_s in _TAUS_S),
    *(lag(POWER, tau_s) - 1 for tau_s in _TAUS_S),
    away(lag(CAMERA, _TAUS_S[1])),
    away(lag(CAMERA, _TAUS_S[1])) ** 2,
    *(away(play(CAMERA, radius_K)) for radius_K in _PLAYS_K),
)
_FORGOTTEN_S = (900.0, 3600.0, 14400.0)
"""How what was before the record fades, when nobody knows it."""
_MOST_INSTANTS = 160
_SAME_PLACE_PX = 10.0
_INSTANT_NS = 60 * NS_PER_S
_FEWEST = 8
_QUICK_S = 1200.0
"""So soon after switching on the image moves faster than any lag of these tells."""


@dataclass(frozen=True, slots=True, eq=False)
class _Frames:
    """What a series is condensed from. rows: of the frames that show the target in its place. label (M,): the instant
    of each, in order of time. features (F, H): of all frames."""

    observations: Observations
    rows: Displacements
    label: Index
    features: Float


@dataclass(frozen=True, slots=True, eq=False)
class NightSeries:
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
    _frames: _Frames

    @property
    def boundaries(self) -> Index:
        """(B,): instants that a step may lie before."""
        return np.arange(1, len(self.hours))

    def steps(self, before: Index) -> Float:
        """(K, B): 1 from each of these instants on."""
        return (np.arange(len(self.hours))[:, None] >= before).astype(float)

    def at_ns(self, before_ns: list[int]) -> Index:
        """The instants that begin at these times."""
        return np.searchsorted(self.first_ns, np.array(before_ns, np.int64))

    def finer(self, before: int) -> NightSeries:
        """With each minute an instant of its own on both sides of the boundary before this instant; the same series
        where that is so already."""
        frames = self._frames
        near = (frames.label == before - 1) | (frames.label == before)
        minute = frames.observations.time_ns[frames.rows.frame] // _INSTANT_NS
        parts = np.where(near, minute - minute[0] + 1, 0)
        label = np.unique(np.column_stack([frames.label, parts]), axis=0, return_inverse=True)[1].ravel()
        if label[-1] == frames.label[-1]:
            return self
        return _condensed(self.session_id, _Frames(frames.observations, frames.rows, label, frames.features))


def night_series(observations: Observations, index: int) -> NightSeries | None:
    """Of session `index`; None with too few instants to tell. SessionError without anything to measure against."""
    frames = observations.of(*_ROLES) & (observations.session == index)
    if not frames.any():
        return None
    of_frames, known = _features(observations)
    frames &= known
    if not frames.any():
        return None
    rows = displacements(observations, frames, anchors(observations))
    # Without frames of a camera or a target that was moved on purpose.
    rows = rows.where(np.linalg.norm(rows.displacement_px, axis=1) < _SAME_PLACE_PX)
    if not len(rows.frame):
        return None
    label = _labels(observations, rows)
    if label[-1] + 1 < _FEWEST:
        return None
    return _condensed(observations.sessions[index].session_id, _Frames(observations, rows, label, of_frames))


def four_motions(xy_px: Float, image_size: tuple[int, int]) -> Float:
    """(N, 2, 4): shift along I, along J, turn and scale."""
    eight = motions(xy_px, image_size)
    return np.stack([eight[..., 0], eight[..., 1], eight[..., 4] - eight[..., 3], eight[..., 2] + eight[..., 5]], -1)


def _condensed(session_id: str, frames: _Frames) -> NightSeries:
    moved, variance, left, noise = _of_instants(frames)
    count, times_ns = len(moved), frames.observations.time_ns[frames.rows.frame]
    first, last = np.full(count, np.iinfo(np.int64).max), np.zeros(count, np.int64)
    np.minimum.at(first, frames.label, times_ns)
    np.maximum.at(last, frames.label, times_ns)
    hours = (first - first[0]) / NS_PER_S / 3600
    return NightSeries(session_id, first, last, hours, _mean_features(frames), moved, variance, left, noise, frames)


def _features(observations: Observations) -> tuple[Float, Mask]:
    """(F, H) of all frames, and which are known (F,): none without a history of the air, where lag looks like steps."""
    states = frame_states(observations, ThermalMemory(remembered(_FEATURES)))
    if not np.isfinite(observations.air_degC).any():
        return np.empty((len(observations.frame), 0)), np.zeros(len(observations.frame), bool)
    origin = Origin(float(np.nanmean(states.camera_degC)), float(np.nanmean(observations.air_degC)))
    found = features(states, _FEATURES, origin)
    fading = np.exp(-states.settled_s[:, None] / np.array(_FORGOTTEN_S))
    return np.hstack([found, fading]), np.isfinite(found).all(axis=1) & ~(states.on_s < _QUICK_S)


def _labels(observations: Observations, rows: Displacements) -> Index:
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


def _mean_features(frames: _Frames) -> Float:
    """(K, H): of the frames of an instant, which may be minutes apart and of a camera on its way, weighted as their
    mean places are."""
    rows, label = frames.rows, frames.label
    precision = 2 / rows.variance_px2.sum(axis=1)
    total = np.bincount(label, precision)
    found = [np.bincount(label, precision * column[rows.frame]) / total for column in frames.features.T]
    return np.stack(found, axis=1)


def _of_instants(frames: _Frames) -> tuple[Float, Float, Float, Float]:
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
        four = four_motions(at[k, own], observations.image_size)
        design = (four * scale[:, None, None]).reshape(-1, MOTIONS)
        inverse = np.linalg.pinv(design.T @ design)
        moved[k] = inverse @ design.T @ (place[k, own] * scale[:, None]).ravel()
        variance[k] = np.diagonal(inverse)
        eight = motions(at[k, own], observations.image_size)
        amounts = np.linalg.lstsq(eight.reshape(-1, 8), place[k, own].ravel(), rcond=None)[0]
        left[k, own] = place[k, own] - eight @ amounts
    return moved, variance, left, np.where(seen, 1 / np.where(seen, weight, 1.0), np.nan)
