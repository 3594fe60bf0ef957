"""What of a recording is drift: warm-ups and thermal cycles, without frames of a target moved on purpose."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.displacements import average_reference_centres
from thermostand.compensation.observations import Float, Observations
from thermostand.experiments.steps import Role

Rows = NDArray[np.int64]

CYCLE = (Role.REFERENCE, Role.FIT, Role.VALIDATION)
_AT_ONE_PLACE = (*CYCLE, Role.WARM_UP, Role.SETTLING, Role.OTHER)
_ELSEWHERE_PX = 10.0
"""No drift is as large: the camera was rolled, or the target moved."""
_NS_PER_S = 1e9


@dataclass(frozen=True, slots=True, eq=False)
class Track:
    """Frames that show drift from one start.

    frames (F,): rows of the observations, in order of time. start_px (N, 2): where the markers are without drift.
    moved_px (F, N, 2): from there; NaN without the marker. roll_deg: of the target in the image, positive from I
    towards J, relative to the recording's first frame. shares_reference: whether the camera stood as at its session's
    reference.
    """

    session: int
    frames: Rows
    start_px: Float
    moved_px: Float
    roll_deg: float
    shares_reference: bool

    @property
    def mean_px(self) -> Float:
        """(F, 2): mean over the markers; NaN for a frame without any."""
        return average_over_markers(self.moved_px)


@dataclass(frozen=True, slots=True, eq=False)
class WarmUpTrack:
    """A track from the first frame on. since_on_s (F,): since the camera was switched on; since the first frame when
    that is not recorded, and `power_on_known` is False."""

    track: Track
    since_on_s: Float
    power_on_known: bool


@dataclass(frozen=True, slots=True)
class CycleVisit:
    """Frames at one set-point that follow each other. mean_px (I, J): mean drift. direction: 1 when reached from below,
    -1 from above, 0 the first of all."""

    chamber_degC: float
    camera_degC: float
    mean_px: tuple[float, float]
    direction: int


def compute_displacement_px(observations: Observations) -> Float:
    """(F, N, 2): where each marker is, minus where it was at its session's reference, px.

    A session without reference frames, and a warm-up of a camera that had been rolled or moved before the reference,
    are compared with their own first frame that has the marker. NaN for frames that show the target elsewhere.
    """
    origin = average_reference_centres(observations)[0]
    moved = np.full(observations.centres_px.shape, np.nan)
    shown = observations.of(*_AT_ONE_PLACE)
    for index in range(len(observations.sessions)):
        own = shown & (observations.session == index)
        if np.isfinite(origin[index]).any():
            moved[own] = observations.centres_px[own] - origin[index]
        elif own.any():
            moved[own] = _subtract_first(observations.centres_px[own])[1]
    for frame in np.flatnonzero(observations.of(Role.OTHER)):  # which may show the target anywhere
        if not _is_near(moved[frame]):
            moved[frame] = np.nan
    for frames in _find_warm_up_frames(observations):
        if not _is_near(moved[frames[0]]):
            moved[frames] = _subtract_first(observations.centres_px[frames])[1]
    return moved


def _is_near(moved: Float) -> bool:
    """Return whether markers (N, 2) are about where they should be; not known to be elsewhere is near."""
    lengths = np.linalg.norm(moved, axis=1)
    lengths = lengths[np.isfinite(lengths)]
    return len(lengths) > 0 and float(np.median(lengths)) < _ELSEWHERE_PX


def _subtract_first(centres: Float) -> tuple[Float, Float]:
    """(N, 2): the first place of each marker in (F, N, 2); and (F, N, 2): how far it is from there."""
    first = np.argmax(np.isfinite(centres).all(axis=2), axis=0)
    start = centres[first, np.arange(centres.shape[1])]
    return start, centres - start


def find_warm_ups(observations: Observations) -> tuple[WarmUpTrack, ...]:
    """Each warm-up, from its own first frame."""
    return tuple(_make_warm_up_track(observations, frames) for frames in _find_warm_up_frames(observations))


def _find_warm_up_frames(observations: Observations) -> Iterator[Rows]:
    frames = np.flatnonzero(observations.of(Role.WARM_UP)).tolist()
    for _, group in groupby(frames, key=lambda k: (int(observations.session[k]), observations.step_id[k])):
        yield np.array(list(group), np.int64)


def _make_warm_up_track(observations: Observations, frames: Rows) -> WarmUpTrack:
    session = int(observations.session[frames[0]])
    start, moved = _subtract_first(observations.centres_px[frames])
    times_ns = observations.time_ns[frames]
    on_ns = observations.find_switch_on_ns(session, int(times_ns[0]))
    since_ns = times_ns - (int(times_ns[0]) if on_ns is None else on_ns)
    at_reference = _is_near(start - average_reference_centres(observations)[0][session])
    track = Track(session, frames, start, moved, _compute_roll_deg(observations, start), at_reference)
    return WarmUpTrack(track, since_ns / _NS_PER_S, on_ns is not None)


def _compute_roll_deg(observations: Observations, start_px: Float) -> float:
    """Compute the roll from the directions between the same markers in the first usable frame and here."""
    first = observations.centres_px[int(np.argmax(observations.usable))]
    both = np.isfinite(first).all(axis=1) & np.isfinite(start_px).all(axis=1)
    if both.sum() < 2:
        return math.nan
    before, now = (points[both] - points[both].mean(axis=0) for points in (first, start_px))
    cross = (before[:, 0] * now[:, 1] - before[:, 1] * now[:, 0]).sum()
    return math.degrees(math.atan2(cross, (before * now).sum()))


def find_cycle(observations: Observations, session: int) -> Track | None:
    """The thermal cycle of a session, from its reference; None when it has no more than that."""
    own = observations.session == session
    frames = np.flatnonzero(observations.of(*CYCLE) & own)
    if not (observations.of(Role.REFERENCE) & own).any() or not (observations.of(*CYCLE[1:]) & own).any():
        return None
    start = average_reference_centres(observations)[0][session]
    return Track(
        session, frames, start, observations.centres_px[frames] - start, _compute_roll_deg(observations, start), True
    )


def list_visits(observations: Observations, track: Track) -> tuple[CycleVisit, ...]:
    """The set-points of a cycle in order of time."""
    found: list[CycleVisit] = []
    mean = track.mean_px
    chamber = observations.chamber_degC[track.frames]
    for degC, group in groupby(range(len(track.frames)), key=lambda k: float(chamber[k])):
        rows = list(group)
        i, j = np.nanmean(mean[rows], axis=0).tolist() if np.isfinite(mean[rows]).any() else (math.nan, math.nan)
        direction = 0 if not found else (1 if degC > found[-1].chamber_degC else -1)
        camera_degC = float(observations.camera_degC[track.frames[rows]].mean())
        found.append(CycleVisit(degC, camera_degC, (i, j), direction))
    return tuple(found)


def average_over_markers(values: Float) -> Float:
    """(F, 2) from (F, N, 2); NaN where a frame has no marker."""
    count = np.isfinite(values[:, :, 0]).sum(axis=1)
    return np.where(count[:, None] > 0, np.nansum(values, axis=1) / np.maximum(count, 1)[:, None], np.nan)


def choose_evenly(count: int, limit: int) -> Rows:
    """Choose at most `limit` of `count` places, evenly, with the first and the last."""
    return np.unique(np.round(np.linspace(0, count - 1, min(count, limit))).astype(np.int64))
