"""What of a camera's drift does not come again on another night: assumed of one night, measured of several.

Its variance is unknown. Of one night it has a prior (a scaled inverse chi-squared distribution; Gelman et al., Bayesian
Data Analysis, 3rd edition, 2013, section 2.6), as wide as simulated cameras of published numbers made likely; each
night that the others predict takes part in it. With an unknown variance what is left follows Student's t, whose 95 %
interval is wider than that of a normal distribution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from thermostand.compensation.drift.candidates import Pair
from thermostand.compensation.history.states import Float

_LEAST_PX, _OF_DISCREPANCY = 0.002, 0.8
"""What a night leaves at set-points that were left out it leaves again, otherwise, on another one; and a little in any
case. Chosen on presets 300 to 303 and 48 drawn cameras (docs/decisions.md)."""
_PRIOR_NIGHTS = 4.0
"""The prior weighs as much as so many nights."""
_SIGMA_95, _TAIL = 1.959964, 0.975


@dataclass(frozen=True, slots=True)
class BetweenNights:
    """sigma_px: along I and J; 1.96 times it is half of the 95 % interval of what another night adds. nights: that were
    compared with others; 0: it was assumed, not measured."""

    sigma_px: Pair
    nights: int

    @property
    def is_assumed(self) -> bool:
        """Whether no two nights were compared."""
        return self.nights == 0

    @property
    def text(self) -> str:
        """In a sentence."""
        i, j = (1e3 * sigma_px for sigma_px in self.sigma_px)
        if self.is_assumed:
            return (
                f"how well nights repeat was assumed, not measured: {i:.1f} mpx (I) and {j:.1f} mpx (J) are added on "
                "nights that were not fitted; a second night over the same set-points, in another order, measures it"
            )
        shown = "one night shows" if self.nights == 1 else f"{self.nights} nights show"
        return f"nights repeat to {i:.1f} mpx (I) and {j:.1f} mpx (J), as {shown}"


def between_nights(discrepancy_px: Float, left_px2: Float) -> BetweenNights:
    """discrepancy_px (2,): what is left at set-points left out, within nights. left_px2 (N, 2): mean square that is
    left of each of N nights by a fit of the others, noise taken off; (0, 2) where none can be compared."""
    nights = len(left_px2)
    assumed_px2 = _LEAST_PX**2 + (_OF_DISCREPANCY * discrepancy_px) ** 2
    measured_px2 = np.maximum(left_px2 - discrepancy_px**2, 0.0).sum(axis=0)
    freedom = _PRIOR_NIGHTS + nights
    variance_px2 = (_PRIOR_NIGHTS * assumed_px2 + measured_px2) / freedom
    i, j = (np.sqrt(variance_px2) * float(stdtrit(freedom, _TAIL)) / _SIGMA_95).tolist()
    return BetweenNights((i, j), nights)
