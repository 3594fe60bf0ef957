"""The terms of the thermal model: how a homography moves points, times what the camera's thermal state makes of it.

A displacement field is a sum over the eight infinitesimal motions of a homography (shift, affine, perspective), each
with an amount that is linear in the features of the thermal state.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from compensation.history.states import Float, Memory, States

MOTIONS = 8
_QUICK_S = 240.0
_SPAN_K = 20.0
"""Temperatures are scaled by this, so that all features are about 1."""


class Kind(StrEnum):
    """What a term is made of. CAMERA_LAG: what follows the camera's own temperature, as a lens does."""

    CONSTANT = "constant"
    CAMERA = "camera"
    CAMERA_SQUARE = "camera squared"
    AMBIENT_LAG = "ambient lag"
    POWER_LAG = "power lag"
    CAMERA_LAG = "camera lag"
    CAMERA_LAG_SQUARE = "camera lag squared"
    PLAY = "play"


@dataclass(frozen=True, slots=True)
class Term:
    """One feature. parameter: time constant of a lag, s, or radius of a play, K; 0 for the others."""

    kind: Kind
    parameter: float = 0.0


POLYNOMIAL = (Term(Kind.CONSTANT), Term(Kind.CAMERA), Term(Kind.CAMERA_SQUARE))
"""1, T, T^2: what the camera's own temperature explains."""

TAUS_S = tuple(60.0 * minutes for minutes in (4, 8, 15, 27, 50, 100, 210, 450))
"""The slowest are for what creeps, and for a night that begins before all is warm; lags between two of these are sums
of them."""

PLAYS_K = (3.0, 6.0, 10.0, 14.0)


TERMS = (
    *POLYNOMIAL,
    *(Term(kind, tau_s) for kind in (Kind.AMBIENT_LAG, Kind.CAMERA_LAG) for tau_s in TAUS_S),
    *(Term(Kind.PLAY, radius_K) for radius_K in PLAYS_K),
)
"""What a camera may be moved by. Its own temperature brings its self-heating with it: with lags of the supply, or of
the square of its temperature, a warm-up in other air is predicted worse. Older models have them."""


@dataclass(frozen=True, slots=True)
class Origin:
    """Temperatures at the reference: of the camera and of the air near it."""

    camera_degC: float
    ambient_degC: float


def memory_of(terms: tuple[Term, ...], self_heating_K: float) -> Memory:
    """What the terms need remembered, and one lag of the ambient in any case: its range is part of where a model holds,
    also where a warm-up has shown the camera at every temperature."""
    plays = {term.parameter for term in terms if term.kind is Kind.PLAY}
    taus = {term.parameter for term in terms if term.kind is not Kind.PLAY and term.parameter > 0} or {_QUICK_S}
    return Memory(tuple(sorted(taus)), tuple(sorted(plays)), self_heating_K)


def features(states: States, terms: tuple[Term, ...], origin: Origin) -> Float:
    """(F, H) of F instants and H terms; all but the constant are near 0 in equilibrium at the reference."""
    return np.stack([_feature(states, term, origin) for term in terms], axis=1)


def _feature(states: States, term: Term, origin: Origin) -> Float:
    memory = states.memory
    own = (states.camera_degC - origin.camera_degC) / _SPAN_K
    match term.kind:
        case Kind.CONSTANT:
            return np.ones_like(own)
        case Kind.CAMERA:
            return own
        case Kind.CAMERA_SQUARE:
            return own**2
        case Kind.AMBIENT_LAG:
            lag = states.ambient_lag_degC[:, memory.taus_s.index(term.parameter)]
            return (lag - origin.ambient_degC) / _SPAN_K
        case Kind.POWER_LAG:
            return states.power_lag[:, memory.taus_s.index(term.parameter)] - 1
        case Kind.CAMERA_LAG | Kind.CAMERA_LAG_SQUARE:
            lag = states.camera_lag_degC[:, memory.taus_s.index(term.parameter)]
            return ((lag - origin.camera_degC) / _SPAN_K) ** (1 if term.kind is Kind.CAMERA_LAG else 2)
        case Kind.PLAY:
            play = states.play_degC[:, memory.plays_K.index(term.parameter)]
            return (play - origin.camera_degC) / _SPAN_K


def motions(xy_px: Float, image_size: tuple[int, int]) -> Float:
    """(N, 2, 8): what each motion does to points (N, 2), per unit of amount, px."""
    width, height = image_size
    x = (xy_px[:, 0] - (width - 1) / 2) / (width / 2)
    y = (xy_px[:, 1] - (height - 1) / 2) / (width / 2)
    one, zero = np.ones_like(x), np.zeros_like(x)
    along_i = [one, zero, x, y, zero, zero, x * x, x * y]
    along_j = [zero, one, zero, zero, x, y, x * y, y * y]
    return np.stack([np.stack(along_i, axis=-1), np.stack(along_j, axis=-1)], axis=1)
