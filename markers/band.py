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

import numpy as np
from numpy.typing import NDArray

from markers.edge_fit import EdgeFit
from markers.edge_model import Float

WIDE_SIGMA, NARROW_SIGMA = 9.0, 4.5
"""Half widths of the band in blurs."""
WIDE_EXCESS = (WIDE_SIGMA / NARROW_SIGMA) ** 2
_DOUBTFUL_GROWTH = 1.3
_DOUBTFUL_LEVELS = 1.3
_BEYOND_CHANCE = 1.5
"""Of a mean square over a frame's markers, 54 of them: chance reaches it once in a hundred frames."""


def is_doubtful(fit: EdgeFit, growth: Float, clean: NDArray[np.bool_]) -> bool:
    """Whether residuals hang together, round the outlines (`growth`, sandwich.py) or in the levels beside them: what is
    seen is not what the noise model describes."""
    if not clean.any():
        return False
    levels = float(np.median(fit.levels[clean] / fit.chi[clean]))
    return bool(growth.max() > _DOUBTFUL_GROWTH) or levels > _DOUBTFUL_LEVELS


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
