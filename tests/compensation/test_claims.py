"""The factors of a model's claims: what set-points and sessions that were left out are off by gives them their size."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import t

from thermostand.compensation.drift.claims import BetweenSessions, Question, estimate_claims
from thermostand.compensation.drift.displacements import Displacements
from thermostand.compensation.observations import Float

SIGMA_PX, NOISE_PX = 0.004, 0.002
NONE, STILL = np.zeros(0), np.zeros(2)


def make_rows(folds: int, each: int = 400) -> Displacements:
    chamber_degC = np.repeat(np.linspace(10.0, 50.0, folds), each)
    count = len(chamber_degC)
    zero = np.zeros((count, 2))
    frame = np.arange(count)
    return Displacements(zero, zero, zero + NOISE_PX**2, chamber_degC, chamber_degC, frame, np.zeros(count, np.int64))


def leave(rows: Displacements, times: float) -> tuple[Float, Float]:
    """Residuals that are `times` as large as a posterior of 4 mpx says, with the markers' noise; and that posterior."""
    rng = np.random.default_rng(1)
    shape = rows.variance_px2.shape
    drift, noise = (rng.standard_normal(shape) for _ in range(2))
    return times * SIGMA_PX * drift + NOISE_PX * noise, np.full(shape, SIGMA_PX**2)


@pytest.mark.parametrize("times", [0.5, 1.0, 3.0])
def test_factors_grow_with_what_folds_are_off_by_noise_taken_off(times: float) -> None:
    rows = make_rows(25)
    factors = np.array(estimate_claims(rows, *leave(rows, times), STILL, NONE).factors)
    one = np.array(estimate_claims(rows, *leave(rows, 1.0), STILL, NONE).factors)
    np.testing.assert_allclose(factors / one, times, rtol=0.03)
    assert factors[Question.WITHIN] < factors[Question.ANOTHER] < factors[Question.SWITCHED_ON]


def test_few_folds_claim_more() -> None:
    found = [
        estimate_claims(make_rows(folds), *leave(make_rows(folds), 1.0), STILL, NONE).factors[0] for folds in (5, 8, 25)
    ]
    assert found == sorted(found, reverse=True)
    # Of 5 set-points 3 lie between others: Student's t of 2 degrees of freedom reaches 4.303 for 1.960.
    assert found[0] / found[2] == pytest.approx(t.ppf(0.975, 2) / t.ppf(0.975, 22), rel=0.08)


def test_folds_without_any_error_leave_a_claim() -> None:
    rows = make_rows(10)
    claims = estimate_claims(
        rows, np.zeros((len(rows.frame), 2)), np.full((len(rows.frame), 2), SIGMA_PX**2), STILL, NONE
    )
    assert min(claims.factors) > 0
    assert min(claims.least_px) > 0


def test_sessions_that_were_compared_outweigh_what_was_assumed() -> None:
    rows = make_rows(12)
    left = leave(rows, 1.0)

    def another(sessions: Float) -> float:
        return estimate_claims(rows, *left, STILL, sessions).factors[Question.ANOTHER]

    agreeing = [another(np.full(count, 0.2)) for count in (0, 2, 4, 12)]
    assert agreeing == sorted(agreeing, reverse=True)
    assert agreeing[-1] < 0.4 * agreeing[0]
    assert another(np.full(2, 25.0)) > 4 * agreeing[0]
    assert another(np.full(400, 9.0)) == pytest.approx(9.0, rel=0.05)
    assert estimate_claims(rows, *left, STILL, np.full(9, 25.0)).factors[Question.WITHIN] < 2.5


def test_how_well_sessions_repeat_is_stated_as_assumed_or_shown() -> None:
    assumed, shown = BetweenSessions((0.002, 0.003), 0), BetweenSessions((0.002, 0.003), 2)
    assert assumed.is_assumed
    assert "assumed, not measured: 2.0 mpx (I) and 3.0 mpx (J)" in assumed.text
    assert not shown.is_assumed
    assert "as 2 sessions show" in shown.text


def test_what_wanders_is_claimed_in_any_state() -> None:
    rows = make_rows(12)
    claims = estimate_claims(rows, *leave(rows, 1.0), np.array([0.003, 0.0]), NONE)
    assert claims.least_px[0] > 0.003 > claims.least_px[1]
