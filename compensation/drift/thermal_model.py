"""The thermal drift model: a homography whose eight motions follow the camera's thermal state.

A function of the camera's temperature alone cannot distinguish a lens that is still warming from a warm one. This form
uses the history of air, supply and own temperature, kept in first-order lags and plays.
compensation/drift/thermal_fit.py makes the model.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from thermostand.compensation.drift.candidates import Pair
from thermostand.compensation.drift.claims import WARMING_S, BetweenSessions, Claims, Question
from thermostand.compensation.drift.drift_model import (
    DriftModel,
    Flags,
    Outside,
    Situation,
    broadcast_states,
    compute_place_flags,
    compute_range_flags,
)
from thermostand.compensation.drift.terms import TERMS, Term, build_state_spec, compute_features, compute_motions
from thermostand.compensation.drift_runtime import SETTLED_TAUS, remembered
from thermostand.compensation.expression import Origin
from thermostand.compensation.history.thermal_history import Float, States, ThermalStateSpec

# Three times the variance of the least known state of the fit. Plays of parts are taken as known here: with their
# openness in the leverage 34 to 81 % of answers had no flag, without it 51 to 100, and as many of their intervals hold.
_MORE_LEVERAGE = 3.0
_MARGIN = 0.02
"""Of a calibrated range: it is known to no better than the noise of its ends."""


@dataclass(frozen=True, slots=True, eq=False)
class ThermalRange:
    """What the calibration covered besides the camera's temperature: the quickest lag of the ambient, and the shortest
    time since the camera was switched on, s. leverage: the largest of a training state, inf until it is known.
    history_s: how long a state must have been followed after a guess until what is left of it does not matter; None:
    three of the longest time constants."""

    ambient_degC: Pair
    least_on_s: float
    leverage: float = math.inf
    history_s: float | None = None


@dataclass(frozen=True, slots=True)
class TermGroup:
    """Terms whose coefficients have one prior width for each motion. coefficients: how many, of all motions; effective:
    how many of them the data determine. prior_px, posterior_px: RMS standard deviation of those of the shift along I
    and J, before and after the data."""

    name: str
    coefficients: int
    effective: float
    prior_px: Pair
    posterior_px: Pair


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class ThermalModel(DriftModel):
    """terms: H features of the thermal state. coefficients (8, H) px, each motion's with a covariance (8, H, H) px^2:
    their posterior. claims: what that is multiplied by, for each kind of question. leverage_matrix (H, H), px^2: what
    features of a state are to the posterior of the shift along I and J; it says which states are like those of the fit.

    reference_ambient_degC: of the air near the camera at the reference. reference_features (H,): subtracted, so that
    the shift at the reference is about 0. discrepancy_px: at set-points that were left out. between_sessions: what is
    claimed beyond that in another session; None of sessions that were fitted, and where both are the same.
    has_warm_up: whether a warm-up was among the training frames. prior_px (8, H): standard deviations of the
    coefficients before anything was seen, as the evidence has them; None where there was no such prior.
    """

    form = "thermal"
    terms: tuple[Term, ...]
    reference_ambient_degC: float
    self_heating_K: float
    reference_features: Float
    coefficients: Float
    coefficient_covariance: Float
    leverage_matrix: Float
    valid: ThermalRange
    has_warm_up: bool
    between_sessions: BetweenSessions | None = None
    claims: Claims = field(default_factory=Claims)
    prior_px: Float | None = None

    @property
    def title(self) -> str:
        """The form in words."""
        without = "" if self.has_warm_up else "; no warm-up was recorded"
        return f"{format_form_name(self.terms)}, {self.coefficients.size} coefficients{without}"

    @property
    def groups(self) -> tuple[TermGroup, ...]:
        """What was learned of the terms of each width; empty where no prior is known."""
        if self.prior_px is None:
            return ()
        posterior_px2 = np.diagonal(self.coefficient_covariance, axis1=1, axis2=2)
        learned = np.clip(1 - posterior_px2 / self.prior_px**2, 0.0, 1.0)
        found: list[TermGroup] = []
        for width in dict.fromkeys(term.width for term in self.terms):
            own = np.array([term.width == width for term in self.terms])
            prior_px, posterior_px = (
                np.sqrt(squares[:, own].mean(axis=1)) for squares in (self.prior_px**2, posterior_px2)
            )
            shifts = [(float(each[0]), float(each[1])) for each in (prior_px, posterior_px)]
            found.append(TermGroup(width, int(own.sum()) * len(prior_px), float(learned[:, own].sum()), *shifts))
        return tuple(found)

    @property
    def effective_parameters(self) -> float:
        """How many coefficients the data determine (MacKay, Bayesian interpolation, 1992): the sum of 1 - posterior
        over prior variance; NaN where no prior is known."""
        return sum(group.effective for group in self.groups) if self.groups else math.nan

    @property
    def memory(self) -> ThermalStateSpec:
        """What has to be remembered for it."""
        return build_state_spec(self.terms, self.self_heating_K)

    @property
    def origin(self) -> Origin:
        """Temperatures at the reference."""
        return Origin(self.facts.reference_degC, self.reference_ambient_degC)

    def shift(self, xy_px: Float, state: Situation) -> Float:
        """Predict the drift, as DriftModel.shift states."""
        amounts = self._compute_features(state, len(xy_px)) @ self.coefficients.T
        return np.einsum("nak,nk->na", compute_motions(xy_px, self.facts.image_size), amounts)

    def covariance(self, xy_px: Float, state: Situation) -> Float:
        """Covariance (N, 2, 2), px^2, of `shift`, without the noise of the point itself: that of the coefficients,
        times the factor for the kind of question that a state is (compensation/drift/claims.py). It holds for sessions
        that were not fitted: of those that were, ask the model that `of_sessions` gives."""
        states = broadcast_states(state, len(xy_px), self.memory)
        found = self._compute_features(states, len(xy_px))
        moved = compute_motions(xy_px, self.facts.image_size)
        variance = np.einsum("nh,mhk,nk->nm", found, self.coefficient_covariance, found, optimize=True)
        of_coefficients = (moved * variance[:, None, :]) @ moved.transpose(0, 2, 1)
        return self._select_factors(states)[:, None, None] * of_coefficients + np.diag(np.square(self.claims.least_px))

    def _select_factors(self, states: States) -> Float:
        """(N,): in a session that was fitted it goes over from that for states between those of the fit, as the
        leverage goes from the largest of them to where states are flagged."""
        lately = Question.SWITCHED_ON if self.has_warm_up else Question.UNTAUGHT
        question = np.where(states.on_s < WARMING_S, lately, Question.ANOTHER)
        is_warm = question == Question.ANOTHER
        question[is_warm & (self._compute_temperature_flags(states) != 0)] = Question.BEYOND
        factors = np.array(self.claims.factors)
        found = factors[question]
        if self.between_sessions is not None:
            return found
        away = (self.compute_leverage(states) / self.valid.leverage - 1) / (_MORE_LEVERAGE - 1)
        return factors[Question.WITHIN] + np.clip(away, 0.0, 1.0) * (found - factors[Question.WITHIN])

    def of_sessions(self, session_ids: Iterable[str]) -> ThermalModel:
        """The model for these sessions: where it was fitted to all of them, without what other sessions add."""
        is_own = set(session_ids) <= set(self.facts.session_ids)
        return replace(self, between_sessions=None) if is_own else self

    def flags(self, xy_px: Float, state: Situation) -> Flags:
        """(N,): of Outside."""
        states = broadcast_states(state, len(xy_px), self.memory)
        return compute_place_flags(xy_px, self.facts.hull_px) | self._compute_state_flags(states)

    @property
    def history_s(self) -> float:
        """How long a camera must be followed after a guess of its state."""
        longest_s = SETTLED_TAUS * self.memory.longest_s
        return longest_s if self.valid.history_s is None else min(self.valid.history_s, longest_s)

    def compute_leverage(self, state: States) -> Float:
        """(N,), px^2: how far a state is from those of the fit, in terms of what they determine (the diagonal of the
        hat matrix, with the scale of the covariance)."""
        found = self._compute_features(state, len(state.camera_degC))
        return np.einsum("nk,kl,nl->n", found, self.leverage_matrix, found)

    def _compute_features(self, state: Situation, count: int) -> Float:
        states = broadcast_states(state, count, self.memory)
        return compute_features(states, [term.feature for term in self.terms], self.origin) - self.reference_features

    def _compute_temperature_flags(self, states: States) -> Flags:
        found = compute_range_flags(states.camera_degC, _widen(self.facts.camera_range_degC), Outside.CAMERA)
        (ambient_degC,) = states.of([self.memory.ambient_lag]).T
        return found | compute_range_flags(ambient_degC, _widen(self.valid.ambient_degC), Outside.AMBIENT)

    def _compute_state_flags(self, states: States) -> Flags:
        valid = self.valid
        found = self._compute_temperature_flags(states)
        found |= compute_range_flags(states.on_s, (valid.least_on_s - 1, np.inf), Outside.SWITCHED_ON)
        # By the leverage and not only by each range: at temperatures never fitted intervals cover 94 % where they
        # covered 79 (12 drawn cameras, 17 to 45 degC fitted, 10 to 52 asked).
        found |= compute_range_flags(
            self.compute_leverage(states), (0.0, _MORE_LEVERAGE * valid.leverage), Outside.STATE
        )
        needed_s = self.history_s
        return found | compute_range_flags(states.settled_s, (needed_s, np.inf), Outside.HISTORY)


def _widen(limits: Pair) -> Pair:
    margin = _MARGIN * (limits[1] - limits[0])
    return limits[0] - margin, limits[1] + margin


def format_form_name(terms: tuple[Term, ...]) -> str:
    """`homography x (1, T, T^2), ambient lag 4 to 450 min, plays 3 to 14 K, plays of parts 1 to 4 K`."""
    kept = [term for term in terms if remembered([term.feature])]
    still = ", ".join(term.symbol for term in terms if term not in kept)
    named = [_format_terms(own) for kind in TERMS.values() if (own := [term for term in kept if type(term) is kind])]
    named.sort(key=lambda name: name.split()[0])
    return ", ".join([f"homography x ({still})", *named])


def _format_terms(terms: Sequence[Term]) -> str:
    """Terms of one kind, with the range of its first parameter."""
    kind = type(terms[0])
    first = next(iter(kind.model_fields), "")
    unit, size = ("min", 60.0) if first.endswith("_s") else (first.rpartition("_")[2], 1.0)
    values = [getattr(term, first) / size for term in terms] if first else []
    return f"{kind.title} {_format_extent(values)} {unit}" if values else kind.title


def _format_extent(values: list[float]) -> str:
    low, high = min(values), max(values)
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
