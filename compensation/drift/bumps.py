"""Steps in a night that no thermal state explains: a camera that was touched, a fixing that slipped, a marker moved.

All frames that show the target in its place are looked at: visits, warm-ups, revisited references.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from thermostand.compensation.drift.bump import MOTIONS, Bump
from thermostand.compensation.drift.displacements import anchors
from thermostand.compensation.drift.night_series import Index, NightSeries, four_motions, night_series
from thermostand.compensation.drift.step_scan import Scan, Whitened, scan, whitened
from thermostand.compensation.history.states import Float
from thermostand.compensation.observations import Observations
from thermostand.foundation.errors import SessionError

_GAIN, _GAIN_MARKER = 17.0, 25.0
"""Log likelihood that a step has to explain, chosen on nights of drawn cameras without any (numbers 2000 to 2079)."""
_LEAST_PX, _LEAST_MARKER_PX = 0.035, 0.020
"""What the forms of thermal states miss comes in steps, too, of up to 30 mpx."""
_BLURRED = 0.5
"""How small a step may look amidst an instant."""
_MOST = 6


def find_bumps(observations: Observations) -> tuple[Bump, ...]:
    """Of all sessions, in order of time; none in a session with too few instants to tell."""
    found: list[Bump] = []
    for index in range(len(observations.sessions)):
        try:
            series = night_series(observations, index)
        except SessionError:  # nothing to measure against: the fit says so
            continue
        if series is not None:
            found += sorted(_rigid(series), key=lambda bump: bump.after_ns)
            found += sorted(_markers(series), key=lambda bump: bump.after_ns)
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
    moved = four_motions(observations.centres_px[frames, markers].reshape(-1, 2), observations.image_size)
    shift = (moved @ np.array(bump.motions_px)).reshape(len(frames), -1, 2)
    variance = (moved**2 @ np.array(bump.sigma_px) ** 2).reshape(len(frames), -1, 2)
    centres[frames, markers] -= sign * shift
    covariance[frames, markers] += variance[..., None] * np.eye(2)


def _rigid(series: NightSeries) -> Iterator[Bump]:
    """Steps of the whole image, the largest first, each beside those found before it; then all estimated together.
    Where one is found the series is looked at minute by minute: a step amidst an instant looks like two halves."""
    before_ns: list[int] = []
    while len(before_ns) < _MOST:
        best, size_px = _largest(series, series.at_ns(before_ns))
        finer = series.finer(best)
        if size_px < _LEAST_PX * (1.0 if finer is series else _BLURRED):
            break
        if finer is series:
            before_ns.append(int(series.first_ns[best]))
        series = finer
    known = series.at_ns(before_ns)
    for own in known.tolist():
        found = _scans(series, np.array([own]), known[known != own])
        amounts = tuple(float(one.amount_px[0]) for one in found)
        yield _bump(series, own, amounts, tuple(float(one.sigma_px[0]) for one in found), None)


def _largest(series: NightSeries, known: Index) -> tuple[int, float]:
    """The boundary where one more step explains most, and its size, px; 0 where it explains too little."""
    scans = _scans(series, series.boundaries, known)
    gain = np.sum([own.gain for own in scans], axis=0)
    gain[np.isin(series.boundaries, known)] = -np.inf
    best = int(np.argmax(gain))
    size = max(np.hypot(scans[0].amount_px[best], scans[1].amount_px[best]), *(abs(s.amount_px[best]) for s in scans))
    return int(series.boundaries[best]), float(size) if gain[best] >= _GAIN else 0.0


def _scans(series: NightSeries, boundaries: Index, known: Index) -> list[Scan]:
    return [
        scan(
            _white(series, series.variance_px2[:, axis], boundaries, known),
            series.motions_px[:, axis],
        )
        for axis in range(MOTIONS)
    ]


def _white(series: NightSeries, variance_px2: Float, boundaries: Index, known: Index) -> Whitened:
    return whitened(series.features, series.hours, variance_px2, series.steps(boundaries), series.steps(known))


def _bump(
    series: NightSeries, before: int, amounts: tuple[float, ...], sigma: tuple[float, ...], marker: int | None
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


def _markers(series: NightSeries) -> Iterator[Bump]:
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
        if gain[best] > _GAIN_MARKER and np.hypot(*amount) > _LEAST_MARKER_PX:
            sigma = float(i.sigma_px[best]), float(j.sigma_px[best])
            yield _bump(series, int(series.boundaries[best]), (*amount, 0.0, 0.0), (*sigma, 0.0, 0.0), marker)
