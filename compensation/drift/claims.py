"""How far the thermal model may be off, by the kind of question that it is asked.

The posterior of the coefficients knows in which states a session says much and in which little. How large all of it is,
it knows badly: it takes the most likely widths for the true ones, and no other session has been seen. So it gives the
shape of the uncertainty, and one factor for each kind of question gives the size:

    covariance = factor * covariance of the coefficients + least^2,  factor = c(kind) * z

z is the RMS of what set-points that were left out are off by, over what the posterior without them says. With z itself
the factor would be that of the folds alone, with z^0 that of the posterior alone. Cameras in the root of both scatter
least: the folds of one session see a part of what goes wrong elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from scipy.special import stdtrit

from thermostand.compensation.drift.candidates import (
    Pair,
    average_folds,
    compute_student_factor,
    find_interior,
    make_pair,
)
from thermostand.compensation.drift.displacements import Displacements
from thermostand.compensation.history.thermal_history import Float


class Question(IntEnum):
    """What a model can be asked. WITHIN: a state between those of the fit, in a session that was fitted. ANOTHER: in a
    session that was not. SWITCHED_ON: a camera in its first hour; UNTAUGHT: so, and no warm-up was fitted. BEYOND:
    temperatures that were not fitted."""

    WITHIN = 0
    ANOTHER = 1
    SWITCHED_ON = 2
    UNTAUGHT = 3
    BEYOND = 4


# Chosen on 37 drawn cameras (numbers 11000 on; half of them with what does not repeat, half with frames on the way) and
# 10 of the simulated presets (numbers 210 and 211), so that 92 to 98 % of the intervals hold. `python -m tests.bench
# coverage` judges them on others. Presets repeat better than drawn cameras, and less would hold for both.
_FACTORS = {
    Question.WITHIN: 1.4,
    Question.ANOTHER: 2.25,
    Question.SWITCHED_ON: 4.5,
    Question.UNTAUGHT: 13.0,
    Question.BEYOND: 1.0,
}
WARMING_S = 3600.0
"""So long a camera counts as switched on lately; the warm-ups of these cameras were of half an hour."""
_LEAST_Z = 0.15
"""What is left of five to fifteen folds may be small by chance."""
_LEAST_PX = 0.0004
"""Of the reference itself: 20 frames with the markers' noise. What wanders is added to it."""
# On 56 pairs of development sessions 92.5 to 100 % of the unflagged answers hold in most cases, for 91.3 to 100 without
# the prior.
_PRIOR_SESSIONS = 4.0
"""The factor for other sessions weighs as much as so many sessions that were compared."""
_TAIL, _SIGMA_95 = 0.975, 1.959964


@dataclass(frozen=True, slots=True)
class Claims:
    """factors: of the coefficients' covariance, for each Question. least_px: along I and J, in any state."""

    factors: tuple[float, ...] = (1.0,) * len(Question)
    least_px: Pair = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class BetweenSessions:
    """sigma_px: along I and J, what is claimed in another session beyond what is claimed within those of the fit; RMS
    over the fitted set-points. sessions: how many were compared with others; 0: it was assumed, not measured."""

    sigma_px: Pair
    sessions: int

    @property
    def is_assumed(self) -> bool:
        """Whether no two sessions were compared."""
        return self.sessions == 0

    @property
    def text(self) -> str:
        """A sentence that says how well sessions repeat."""
        i, j = (1e3 * sigma_px for sigma_px in self.sigma_px)
        if self.is_assumed:
            return (
                f"how well sessions repeat was assumed, not measured: {i:.1f} mpx (I) and {j:.1f} mpx (J) are added in "
                "sessions that were not fitted; a second one over the same set-points, in another order, measures it"
            )
        shown = "one session shows" if self.sessions == 1 else f"{self.sessions} sessions show"
        return f"sessions repeat to {i:.1f} mpx (I) and {j:.1f} mpx (J), as {shown}"


def estimate_claims(
    rows: Displacements, held_out: Float, predicted_px2: Float, wander_px: Float, left_out_sessions: Float
) -> Claims:
    """Estimate the factors from what set-points and sessions that were left out are off by.

    Parameters
    ----------
    rows : Displacements
        M rows at set-points.
    held_out, predicted_px2 : (M, 2) of float
        Residuals of each row from a fit without its set-point, px, and their variance by that fit's posterior, px^2.
    wander_px : (2,) of float
        Standard deviation of what the image wanders by, which no coefficient explains, along I and J.
    left_out_sessions : (N,) of float
        Mean square residual of each session that a fit of the others could predict, over what that fit says.
    """
    inner = find_interior(rows.chamber_degC)
    squares = average_folds(rows.where(inner), (held_out**2 - rows.variance_px2)[inner])
    predicted = average_folds(rows.where(inner), predicted_px2[inner]).mean()
    left = max(float(squares.mean()), 0.0)
    z = compute_student_factor(len(squares)) * np.sqrt(left / predicted) if predicted > 0 else 0.0
    factors = [_FACTORS[question] * max(float(z), _LEAST_Z) for question in Question]
    factors[Question.ANOTHER] = _combine_sessions(factors[Question.ANOTHER], left_out_sessions)
    return Claims(tuple(factors), make_pair(np.hypot(_LEAST_PX, wander_px)))


def _combine_sessions(assumed: float, measured: Float) -> float:
    """The assumed factor covers 95 % with Student's t of as many degrees of freedom as it weighs; so does what it
    becomes with sessions that were compared."""
    freedom = _PRIOR_SESSIONS + len(measured)
    allowance = (stdtrit(freedom, _TAIL) / stdtrit(_PRIOR_SESSIONS, _TAIL)) ** 2
    of_measured = (stdtrit(_PRIOR_SESSIONS, _TAIL) / _SIGMA_95) ** 2 * float(measured.sum())
    return float(allowance * (_PRIOR_SESSIONS * assumed + of_measured) / freedom)
