"""The light that the discs and the ground between them have in common.

Twelve parameters let the light slope otherwise on a disc than on the ground round it. Where it does, because light is
scattered onto the image, fewer parameters put the centres wrong by twice the noise; where it does not, they cost 5 % of
the accuracy, 7 % when blurred. All markers of a frame together show how much the two slopes differ, beyond what noise
explains; each marker's slopes are then pulled together as far as that allows, and the centre goes with them:

    r = low / high * slope(high) - slope(low)          DN per px, expected 0 +- w; w^2 = mean(r^2 - variance of r)
    centre -= cov(centre, r) (cov(r) + w^2)^-1 r

high and low are the levels of the lighter and of the darker side.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from thermostand.markers.edge_fit import EdgeFit
from thermostand.markers.edge_model import B0, F0, PARAMETERS, EdgeState, Float

_LEAST_MARKERS = 20
"""So many determine w^2 to a quarter of the variance of r."""
_BELIEVED_CHI2, _DOUBTED_CHI2 = 2.0, 5.0
"""A marker whose slopes differ by more (chi^2 of two) is pulled less and less, and then stays as it is: faint glare
that no flag shows would gain weight."""


def under_common_light(fit: EdgeFit, clean: NDArray[np.bool_]) -> tuple[Float, Float]:
    """Centres (N, 2) px and their covariances (N, 2, 2), where the slopes of the `clean` (N,) markers are believed to
    differ no more than the frame shows; the others, and all where they are few, as they were fitted."""
    centres, covariance = fit.state.centres_px().copy(), fit.covariance_px2.copy()
    if np.count_nonzero(clean) < _LEAST_MARKERS:
        return centres, covariance
    state, whole = fit.state[np.flatnonzero(clean)], fit.covariance[clean]
    by_parameters = _by_parameters(state)
    differing = np.einsum("nij,nj->ni", by_parameters, state.parameters)
    shared = whole[:, :2] @ by_parameters.transpose(0, 2, 1)
    variance = by_parameters @ whole @ by_parameters.transpose(0, 2, 1)
    beyond = np.mean(differing**2 - np.diagonal(variance, axis1=1, axis2=2))
    inverse = np.linalg.inv(variance + max(float(beyond), 0.0) * np.eye(2))
    gain = shared @ inverse
    chi2 = np.einsum("ni,nij,nj->n", differing, inverse, differing)
    part = np.clip((_DOUBTED_CHI2 - chi2) / (_DOUBTED_CHI2 - _BELIEVED_CHI2), 0, 1)[:, None]
    centres[clean] -= part * np.einsum("nij,nj->ni", gain, differing)
    covariance[clean] -= (part * (2 - part))[:, :, None] * (gain @ shared.transpose(0, 2, 1))
    return centres, covariance


def _by_parameters(state: EdgeState) -> Float:
    """The derivatives of r by the parameters (N, 2, 12), but for those by the levels, which are known far better."""
    rows = np.arange(len(state.scale_px))
    ground, disc = state.parameters[:, B0], state.parameters[:, F0]
    high, low = np.where(ground > disc, B0, F0), np.where(ground > disc, F0, B0)
    share = np.maximum(np.minimum(ground, disc), 0) / np.maximum(ground, disc)
    derivatives = np.zeros((len(rows), 2, PARAMETERS))
    for axis in range(2):
        derivatives[rows, axis, high + 1 + axis] = share / state.scale_px
        derivatives[rows, axis, low + 1 + axis] = -1 / state.scale_px
    return derivatives
