"""How wide a band of pixels round the outlines is fitted, and what its width says about the centres' errors.

Where the model holds, the levels of ground and disc are known best from a wide band: 1.01 of the Cramer-Rao limit, and
1.09..1.16 from a narrow one. A real ground is no plane: grain, texture and shadows move the centre, the further out
they are looked at the more. Fits in both bands tell (Hausman): with independent noise their centres differ by no more
than their variances do,

    mean (c_wide - c_narrow)^2 = var_narrow - var_wide

and what is beyond that is misfit. It grows about in proportion to the width, so it is as large as what is left in the
centres of a band of half the width, and a quarter of the squared misfit of the wide one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.edge_fit import EdgeFit
from thermostand.markers.edge_model import Float
from thermostand.markers.sandwich import variance_growth, variance_ratio

WIDE_SIGMA, NARROW_SIGMA = 9.0, 4.5
"""Half widths of the band in blurs."""
WIDE_EXCESS = (WIDE_SIGMA / NARROW_SIGMA) ** 2
_DOUBTFUL_GROWTH, _SUSPECT_GROWTH = 1.4, 1.3
"""Along x or y alone, as rows that flicker have it."""
_DOUBTFUL_TOGETHER, _SUSPECT_TOGETHER = 0.35, 0.3
"""Growth along x and y and of the levels' variance: each scatters by itself where there is only noise, and they grow
together where residuals hang together: 0.05 +- 0.09 by noise alone (54 markers), 0.59 +- 0.12 by JPEG of quality 90."""
_DOUBTFUL_CHANCES = 3.0
_DOUBTFUL_LEVELS = 1.3
_BEYOND_CHANCE = 1.5
"""Of a mean square over a frame's markers, 54 of them: chance reaches it once in a hundred frames."""


@dataclass(frozen=True, slots=True, eq=False)
class Strangeness:
    """How much the residuals of a frame hang together, each 0 (levels: 1) where there is noise alone. along: growth of
    variance along x or y, the larger. together: that of x and y, their mean, and of the levels. chance: standard
    deviation of `together`'s first part. levels: root mean square of the sectors' levels. growth: (2,), of the
    variances along x and y (sandwich.py)."""

    growth: Float
    along: float
    together: float
    chance: float
    levels: float

    def is_doubtful(self) -> bool:
        """Whether what is seen is not what the noise model describes. Of 100 frames of noise alone at most one."""
        limit = max(_DOUBTFUL_TOGETHER, _DOUBTFUL_CHANCES * self.chance)
        return self.along > _DOUBTFUL_GROWTH - 1 or self.together > limit or self.levels > _DOUBTFUL_LEVELS

    def is_suspect(self) -> bool:
        """Whether it may be doubtful, if this is from a sample of the markers: then it takes all to decide."""
        return self.along > _SUSPECT_GROWTH - 1 or self.together > _SUSPECT_TOGETHER or self.levels > _DOUBTFUL_LEVELS


def strangeness(fit: EdgeFit, clean: NDArray[np.bool_]) -> Strangeness:
    """Of the `clean` (N,) markers."""
    if not clean.any():
        return Strangeness(np.ones(2), 0.0, 0.0, 0.0, 1.0)
    levels = float(np.median(fit.levels[clean] / fit.chi[clean]))
    ratio, chance = variance_ratio(fit.scatter, clean)
    growth = variance_growth(ratio, chance)
    together = float(ratio.mean()) - 1 + levels**2 - 1
    return Strangeness(growth, float(growth.max()) - 1, together, float(np.linalg.norm(chance)) / 2, levels)


def excess_px2(wide: EdgeFit, narrow: EdgeFit, growth: Float, clean: NDArray[np.bool_]) -> Float:
    """By what the mean squared difference of the centres (x, y) exceeds that of independent noise, px^2, 0 where it may
    be chance. growth: of the wide fit. clean: (N,), markers without a flag in both."""
    if not clean.any():
        return np.zeros(2)
    difference = np.mean((wide.state.centres_px() - narrow.state.centres_px())[clean] ** 2, axis=0)
    same_noise = ((wide.chi / narrow.chi) ** 2)[clean, None]
    variances = [np.diagonal(fit.covariance_px2, axis1=1, axis2=2)[clean] for fit in (wide, narrow)]
    expected = np.maximum(np.mean(same_noise * variances[1] - variances[0], axis=0), 0) * growth
    return np.where(difference > _BEYOND_CHANCE * expected, difference - expected, 0.0)
