"""Readings at other instants: linear between the readings before and after, unknown across a gap."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermostand.foundation.clock import NS_PER_S

Instants = NDArray[np.int64]
Float = NDArray[np.float64]

# Four polls of the slowest device that is read each 30 s. Round number; nothing was measured.
GAP_NS = 120 * NS_PER_S
"""Readings further apart than this say nothing of the time between them."""


def interpolate(times_ns: Instants, values: Float, at_ns: Instants, beyond_ns: int = 0) -> Float:
    """The values (n,) of ascending instants at the instants `at_ns` (m,): shape (m,).

    NaN across gaps, their ends included, and more than `beyond_ns` before the first and behind the last, up to which
    these hold. NaN among the values is no reading.
    """
    good = np.isfinite(values)
    times_ns, values = times_ns[good], values[good]
    if len(times_ns) == 0:
        return np.full(len(at_ns), np.nan)
    after = np.clip(np.searchsorted(times_ns, at_ns), 1, max(len(times_ns) - 1, 1))
    near = (times_ns[np.minimum(after, len(times_ns) - 1)] - times_ns[after - 1]) <= GAP_NS
    inside = (at_ns >= times_ns[0] - beyond_ns) & (at_ns <= times_ns[-1] + beyond_ns)
    origin_ns = int(times_ns[0])  # float64 holds ns since the epoch to 256 ns only
    return np.where(near & inside, np.interp(at_ns - origin_ns, times_ns - origin_ns, values), np.nan)
