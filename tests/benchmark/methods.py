"""The methods that are compared: nothing, temperature bins as a depth camera has them, the paper's polynomial, the form
that is chosen (of all these cameras the thermal one), and Gaussian processes on what that leaves."""

from __future__ import annotations

from functools import lru_cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from thermostand.compensation.drift.displacements import compute_displacements
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.expression import AIR
from thermostand.compensation.history.thermal_history import States
from thermostand.compensation.observations import Observations
from thermostand.experiments.steps import Role

from .scoring import Correction, Corrector, Float, Method


def nothing(training: Observations) -> Corrector:
    """What the camera does when nobody compensates."""
    return lambda session, frames, seen_px: Correction(seen_px)


def paper(training: Observations) -> Corrector:
    """The paper's polynomial."""
    return corrector(fit(training, form="paper"))


BINS, BINS_DEGC = 29, (0.0, 75.0)
"""As in the table of a depth camera that ships in millions: bins of its own temperature."""


def temperature_bins(training: Observations) -> Corrector:
    """In each bin of the camera's temperature the median corners against those at the reference, and the similarity
    (scale times cosine and sine, two shifts) between them; in an empty bin that of the nearest one that is not. A
    depth camera sold in millions corrects its colour image so; it is made on the line from one warm-up."""
    frames = np.flatnonzero(training.of(Role.REFERENCE, Role.FIT, Role.WARM_UP))
    reference_px = np.nanmedian(training.centres_px[training.of(Role.REFERENCE)], axis=0)
    bins = _find_bins(training.camera_degC[frames])
    found = np.full((BINS, 4), np.nan)
    for number in np.unique(bins):
        seen_px = np.nanmedian(training.centres_px[frames[bins == number]], axis=0)
        known = np.isfinite(seen_px + reference_px).all(axis=1)
        terms = _similarity_terms(seen_px[known])
        found[number] = np.linalg.lstsq(terms, (reference_px - seen_px)[known].ravel(), rcond=None)[0]
    filled = np.flatnonzero(np.isfinite(found[:, 0]))

    def corrected(session: Observations, asked: NDArray[np.int64], seen_px: Float) -> Correction:
        wanted = _find_bins(session.camera_degC[asked])
        nearest = filled[np.abs(wanted[:, None] - filled).argmin(axis=1)]
        moved = [
            (_similarity_terms(seen) @ found[one]).reshape(-1, 2) for seen, one in zip(seen_px, nearest, strict=True)
        ]
        return Correction(seen_px + np.array(moved))

    return corrected


def _find_bins(camera_degC: Float) -> NDArray[np.int64]:
    low, high = BINS_DEGC
    return np.clip((camera_degC - low) / (high - low) * BINS, 0, BINS - 1).astype(np.int64)


def _similarity_terms(xy_px: Float) -> Float:
    """(2 N, 4): dx = a + s x - r y, dy = b + s y + r x, for points (N, 2)."""
    (x, y), one = xy_px.T / 1000, np.ones(len(xy_px))
    return np.stack([one, 0 * one, x, -y, 0 * one, one, y, x], axis=1).reshape(-1, 4)


@lru_cache(maxsize=1)
def _model(training: Observations) -> DriftModel:
    """Of the form that the program chooses; once for the methods of a camera that follow each other."""
    return fit(training)


def chosen(training: Observations) -> Corrector:
    """The form that the program chooses."""
    return corrector(_model(training))


def corrector(model: DriftModel) -> Corrector:
    """Of a fitted model."""

    def corrected(session: Observations, frames: NDArray[np.int64], seen_px: Float) -> Correction:
        states = compute_frame_states(session, model.memory)
        asked = model.of_sessions(one.session_id for one in session.sessions)
        places, sigma = np.empty_like(seen_px), np.empty_like(seen_px)
        inside = np.empty(seen_px.shape[:2], bool)
        for row, frame in enumerate(frames.tolist()):
            state = states.where(np.array([frame]))
            places[row] = model.correct(seen_px[row], state)
            sigma[row] = np.sqrt(np.diagonal(asked.covariance(seen_px[row], state), axis1=1, axis2=2))
            inside[row] = model.inside(seen_px[row], state)
        return Correction(places, sigma, inside)

    return corrected


def gp_on_residual(training: Observations) -> Corrector:
    """The chosen form, and a Gaussian process for the shift of the whole image that it leaves in the frames it was
    fitted to: over camera, air, their rate of change and the slowest lag, squared-exponential, with hyperparameters of
    largest marginal likelihood."""
    model = _model(training)
    states = compute_frame_states(training, model.memory)
    rows = compute_displacements(training, training.of(Role.REFERENCE, Role.FIT, Role.WARM_UP))
    left = rows.displacement_px - model.shift(rows.measured_px, states.where(rows.frame))
    frames, index, count = np.unique(rows.frame, return_inverse=True, return_counts=True)
    shift = np.stack([np.bincount(index, axis) / count for axis in left.T], axis=1)
    known = np.isfinite(shift).all(axis=1)
    at = _inputs(states)[frames[known]]
    middle, spread = at.mean(axis=0), np.maximum(at.std(axis=0), 1e-3)
    gp = _Gp((at - middle) / spread, shift[known])
    plain = corrector(model)

    def corrected(session: Observations, asked: NDArray[np.int64], seen_px: Float) -> Correction:
        answer = plain(session, asked, seen_px)
        wanted = (_inputs(compute_frame_states(session, model.memory))[asked] - middle) / spread
        more, variance = gp.predicted(wanted)
        assert answer.sigma_px is not None
        sigma = np.sqrt(answer.sigma_px**2 + variance[:, None, None])
        return Correction(answer.corrected_px + more[:, None], sigma, answer.inside)

    return corrected


def _inputs(states: States) -> Float:
    lags = sorted((part for part in states.memory.parts if part[:2] == ("lag", AIR)), key=lambda part: part[2])
    air, quick, slow = states.of([AIR, *(lags[:: max(len(lags) - 1, 1)] or (AIR, AIR))]).T
    return np.column_stack([states.camera_degC, np.nan_to_num(slow), np.nan_to_num(air - quick)])


class _Gp:
    def __init__(self, at: Float, values: Float) -> None:
        """at (M, D), scaled; values (M, 2) px."""
        total = float(values.std()) + 1e-6
        grid = product((0.5, 1.0, 2.0, 4.0), (0.3 * total, total), (0.1 * total, 0.3 * total, total))
        self._at, self._values = at, values
        best = max(grid, key=self._likelihood)
        self._length, self._amplitude, noise = best
        self._factor = cho_factor(self._kernel(at) + noise**2 * np.eye(len(at)))
        self._weights = cho_solve(self._factor, values)

    def predicted(self, at: Float) -> tuple[Float, Float]:
        """Mean (K, 2) and variance (K,)."""
        kernel = self._kernel(at)
        variance = self._amplitude**2 - (kernel * cho_solve(self._factor, kernel.T).T).sum(axis=1)
        return kernel @ self._weights, np.maximum(variance, 0.0)

    def _kernel(self, at: Float) -> Float:
        squares = ((at[:, None] - self._at[None]) ** 2).sum(axis=2)
        return self._amplitude**2 * np.exp(-squares / (2 * self._length**2))

    def _likelihood(self, parameters: tuple[float, float, float]) -> float:
        self._length, self._amplitude, noise = parameters
        factor = cho_factor(self._kernel(self._at) + noise**2 * np.eye(len(self._at)))
        fits = float((self._values * cho_solve(factor, self._values)).sum())
        return -0.5 * fits - self._values.shape[1] * float(np.log(np.diag(factor[0])).sum())


METHODS: dict[str, Method] = {
    "nothing": nothing,
    "29 temperature bins of a similarity": temperature_bins,
    "the paper's polynomial": paper,
    "the form that is chosen": chosen,
    "and a GP on its residual": gp_on_residual,
}
