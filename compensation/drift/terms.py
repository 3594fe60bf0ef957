"""The terms of the thermal model: how a homography moves points, times what the camera's thermal state makes of it.

A displacement field is a sum over the eight infinitesimal motions of a homography (shift, affine, perspective), each
with an amount that is linear in the features of the thermal state.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from itertools import product

import numpy as np

from thermostand.compensation.history.states import Float, Memory, States

MOTIONS = 8
_QUICK_S = 240.0
_SPAN_K = 20.0
"""Temperatures are scaled by this, so that all features are about 1."""


class Kind(StrEnum):
    """What a term is made of. CAMERA_LAG: what follows the camera's own temperature, as a lens does. POWER_LAG,
    CAMERA_LAG_SQUARE: of night_series.py, in no model. PART_PLAY: of a part between air and camera that nobody
    measures, as a mount."""

    CONSTANT = "constant"
    CAMERA = "camera"
    CAMERA_SQUARE = "camera squared"
    AMBIENT_LAG = "ambient lag"
    AMBIENT_LAG_SQUARE = "ambient lag squared"
    AMBIENT_LAG_CUBE = "ambient lag cubed"
    POWER_LAG = "power lag"
    CAMERA_LAG = "camera lag"
    CAMERA_LAG_SQUARE = "camera lag squared"
    PLAY = "play"
    PART_PLAY = "part play"


@dataclass(frozen=True, slots=True)
class Term:
    """One feature. parameter: time constant of a lag, s, or radius of a play, K; 0 for the others. tau_s, share: of the
    part in a part's play, how late it follows and its share of the camera's excess over the air."""

    kind: Kind
    parameter: float = 0.0
    tau_s: float = 0.0
    share: float = 0.0


TAUS_S = tuple(60.0 * minutes for minutes in (4, 8, 15, 27, 50, 100, 210, 450))
"""The slowest are for what creeps, and for a night that begins before all is warm; lags between two of these are sums
of them."""

SLOW_S = 12600.0
"""Lags from here on are slower than a camera warms: of what creeps, which most cameras have little of."""

_BENT, _BENT_S = (Kind.AMBIENT_LAG_SQUARE, Kind.AMBIENT_LAG_CUBE), (480.0, 1620.0, 6000.0)

PLAYS_K = (3.0, 6.0, 10.0, 14.0)

PART_PLAYS = tuple(product((480.0, 1620.0, 3000.0), (0.1, 0.3), (1.0, 2.0, 4.0)))
"""Time constants, shares and radii. A dead zone in a mount moves the image by where the mount came from, which is no
play of the chip's temperature: switching on heats the chip by 15 K and the mount by 3."""

TERMS = (
    Term(Kind.CONSTANT),
    Term(Kind.CAMERA),
    Term(Kind.CAMERA_SQUARE),
    *(Term(kind, tau_s) for kind in (Kind.AMBIENT_LAG, Kind.CAMERA_LAG) for tau_s in TAUS_S),
    *(Term(kind, tau_s) for kind in _BENT for tau_s in _BENT_S),
    *(Term(Kind.PLAY, radius_K) for radius_K in PLAYS_K),
    *(Term(Kind.PART_PLAY, radius_K, tau_s, share) for tau_s, share, radius_K in PART_PLAYS),
)
"""What a camera may be moved by. Its own temperature brings its self-heating with it: with lags of the supply, a
warm-up in other air is predicted worse. Higher powers follow the air: a camera that is switched on cold is at
temperatures of its own that a warm one reaches in much colder air only, and powers of these would extrapolate there."""


def width_group(term: Term) -> tuple[Kind, bool]:
    """Terms of one group have coefficients of one size: those of a kind, slow lags by themselves, and what bends."""
    slow = term.kind in (Kind.AMBIENT_LAG, Kind.CAMERA_LAG) and term.parameter >= SLOW_S
    return _BENT[0] if term.kind in _BENT else term.kind, slow


@dataclass(frozen=True, slots=True)
class Origin:
    """Temperatures at the reference: of the camera and of the air near it."""

    camera_degC: float
    ambient_degC: float


def memory_of(terms: tuple[Term, ...], self_heating_K: float) -> Memory:
    """What the terms need remembered, and one lag of the ambient in any case: its range is part of where a model holds,
    also where a warm-up has shown the camera at every temperature."""
    plays = {term.parameter for term in terms if term.kind is Kind.PLAY}
    parts = [(term.tau_s, term.share, term.parameter) for term in terms if term.kind is Kind.PART_PLAY]
    of_lags = {term.parameter for term in terms if term.kind not in (Kind.PLAY, Kind.PART_PLAY) and term.parameter > 0}
    taus = of_lags | {tau_s for tau_s, _, _ in parts} or {_QUICK_S}
    return Memory(tuple(sorted(taus)), tuple(sorted(plays)), self_heating_K, tuple(sorted(parts)))


def power_of(kind: Kind) -> int:
    """Of a lag or temperature in a term."""
    return 2 if kind.endswith(" squared") else 3 if kind.endswith(" cubed") else 1


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
        case Kind.AMBIENT_LAG | Kind.AMBIENT_LAG_SQUARE | Kind.AMBIENT_LAG_CUBE:
            lag = states.ambient_lag_degC[:, memory.taus_s.index(term.parameter)]
            return ((lag - origin.ambient_degC) / _SPAN_K) ** power_of(term.kind)
        case Kind.POWER_LAG:
            return states.power_lag[:, memory.taus_s.index(term.parameter)] - 1
        case Kind.CAMERA_LAG | Kind.CAMERA_LAG_SQUARE:
            lag = states.camera_lag_degC[:, memory.taus_s.index(term.parameter)]
            return ((lag - origin.camera_degC) / _SPAN_K) ** power_of(term.kind)
        case Kind.PLAY:
            play = states.play_degC[:, memory.plays_K.index(term.parameter)]
            return (play - origin.camera_degC) / _SPAN_K
        case Kind.PART_PLAY:
            part = memory.part_plays.index((term.tau_s, term.share, term.parameter))
            play = states.play_degC[:, len(memory.plays_K) + part]
            at_origin = origin.ambient_degC + term.share * (origin.camera_degC - origin.ambient_degC)
            return (play - at_origin) / _SPAN_K


def motions(xy_px: Float, image_size: tuple[int, int]) -> Float:
    """(N, 2, 8): what each motion does to points (N, 2), per unit of amount, px."""
    width, height = image_size
    x = (xy_px[:, 0] - (width - 1) / 2) / (width / 2)
    y = (xy_px[:, 1] - (height - 1) / 2) / (width / 2)
    one, zero = np.ones_like(x), np.zeros_like(x)
    along_i = [one, zero, x, y, zero, zero, x * x, x * y]
    along_j = [zero, one, zero, zero, x, y, x * y, y * y]
    return np.stack([np.stack(along_i, axis=-1), np.stack(along_j, axis=-1)], axis=1)
