"""Sessions of one camera fitted together: what does not repeat between them is in the model's uncertainty."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from thermostand.compensation.drift.claims import Question
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Float, concatenate
from thermostand.experiments.steps import Role

from .drawn_cameras import draw_camera
from .drawn_sessions import DrawnSession, make_full_session, record_session

SEED = 2700


@cache
def made(number: int) -> DrawnSession:
    """The image of each session is larger by a part that no temperature explains, along J and towards the edges of the
    cycle: 0.5 mpx/K of the set-point in every other session. The same for all tests, who read it only."""
    one = record_session(draw_camera(SEED), make_full_session(), 10 * SEED + number, session_id=f"cycle-{number}")
    away_K = one.observed.chamber_degC - 24.0
    shift = (0.0005 if number % 2 else -0.0005) * away_K[:, None, None] * np.array([0.0, 1.0])
    return DrawnSession(replace(one.observed, centres_px=one.observed.centres_px + shift), one.truth_px + shift)


@cache
def thermal(*drawn: DrawnSession) -> ThermalModel:
    return fit_thermal(concatenate([one.observed for one in drawn]))


def ask(model: ThermalModel, asked: DrawnSession) -> tuple[Float, Float]:
    """Deviations (F, 54, 2) and variances of the validation frames."""
    observed, truth = asked.observed, asked.truth_px
    reference_px = truth[observed.of(Role.REFERENCE)].mean(axis=0)
    states = compute_frame_states(observed, model.memory)
    each = [(truth[k], states.where(np.array([k]))) for k in np.flatnonzero(observed.of(Role.VALIDATION)).tolist()]
    left = np.array([reference_px - model.correct(*one) for one in each])
    return left, np.array([np.diagonal(model.covariance(*one), axis1=1, axis2=2) for one in each])


def test_what_does_not_repeat_between_sessions_is_claimed() -> None:
    drawn = [made(number) for number in range(2)]
    alone, together = (model.between_sessions for model in (thermal(drawn[0]), thermal(*drawn)))
    assert alone is not None
    assert together is not None
    assert (alone.sessions, together.sessions) == (0, 2)
    assert together.sigma_px[1] > 1.5 * alone.sigma_px[1]
    left, variance = ask(thermal(*drawn), made(2))
    assert np.sqrt((left**2).mean(axis=(0, 1)))[1] > 0.005
    assert (np.abs(left) < 1.96 * np.sqrt(variance)).mean() > 0.9


def test_another_session_is_claimed_by_its_own_factor() -> None:
    first, other = (made(number) for number in range(2))
    model = thermal(first)
    places, state = first.truth_px[0], compute_frame_states(first.observed, model.memory)
    warm = state.where(np.flatnonzero(first.observed.of(Role.FIT))[-1:])
    own, any_session = model.of_sessions(["cycle-0"]), model.of_sessions(["cycle-0", "cycle-1"])
    least = np.diag(np.square(model.claims.least_px))
    within, another = (model.claims.factors[question] for question in (Question.WITHIN, Question.ANOTHER))
    more = (any_session.covariance(places, warm) - least) / (own.covariance(places, warm) - least)
    np.testing.assert_allclose(more[:, [0, 1], [0, 1]], another / within, rtol=1e-9)
    assert thermal(first, other).of_sessions(["cycle-1"]).between_sessions is None


def test_a_session_that_the_others_cannot_do_without_says_nothing() -> None:
    whole, few = made(0), made(1)
    far = np.abs(few.observed.chamber_degC - 24.0) > 8
    reasons = tuple("not of this session" if out else why for out, why in zip(far, few.observed.reasons, strict=True))
    short = DrawnSession(replace(few.observed, reasons=reasons), few.truth_px)
    found = thermal(whole, short).between_sessions
    assert found is not None
    assert found.sessions == 1
