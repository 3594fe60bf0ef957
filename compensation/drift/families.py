"""Which thermal forms are tried: families of terms, each with all its time constants on a grid."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from itertools import combinations, pairwise

from compensation.drift.terms import POLYNOMIAL, Kind, Term

TAUS_S = tuple(60.0 * minutes for minutes in (4, 6, 8, 11, 15, 20, 27, 37, 50, 70, 100, 145, 210, 300, 450))
"""The slowest are for what creeps, and for a night that begins before all is warm."""

PLAYS_K = (3.0, 6.0, 10.0, 14.0)
_PLAYS = tuple(Term(Kind.PLAY, radius_K) for radius_K in PLAYS_K)
_NEIGHBOURS = 1
"""Two time constants next to each other on the grid are one."""

Terms = tuple[Term, ...]


@dataclass(frozen=True, slots=True)
class Family:
    """Terms for each choice of time constants; `plays` as well when it is of an unmodified camera."""

    forms: tuple[Terms, ...]
    plays: bool


def all_terms(*, with_power: bool) -> Terms:
    """Every term that any family may use."""
    kinds = [Kind.AMBIENT_LAG, Kind.CAMERA_LAG, Kind.CAMERA_LAG_SQUARE] + ([Kind.POWER_LAG] if with_power else [])
    return (*POLYNOMIAL, *(Term(kind, tau_s) for kind in kinds for tau_s in TAUS_S), *_PLAYS)


def families(*, with_power: bool) -> Iterator[Family]:
    """From simple to rich; each without and with plays."""
    for plays in (False, True):
        for forms in _without_plays(with_power):
            yield Family(tuple(form + (_PLAYS if plays else ()) for form in forms), plays)


def _without_plays(with_power: bool) -> Iterator[tuple[Terms, ...]]:
    """1, T, T^2; one to three lags of the ambient (and of the power); a part that follows camera and ambient and a
    base that follows the ambient slowly, optionally bending with its temperature.

    What follows the camera has its self-heating from there. Lags of the power beside it fit a warm-up no better and
    predict those at other temperatures worse (15 mpx for 4 at 15 degC).
    """
    yield (POLYNOMIAL,)
    for count in (1, 2, 3):
        yield tuple(_lags(taus, with_power) for taus in _sets(count))
    yield from (tuple(follows(*pair) for pair in _pairs()) for follows in _followers())


def _lags(taus_s: tuple[float, ...], with_power: bool) -> Terms:
    kinds = (Kind.AMBIENT_LAG, Kind.POWER_LAG) if with_power else (Kind.AMBIENT_LAG,)
    return (*POLYNOMIAL, *(Term(kind, tau_s) for kind in kinds for tau_s in taus_s))


def _followers() -> Iterator[Callable[[float, float], Terms]]:
    yield _follower((Kind.AMBIENT_LAG, Kind.CAMERA_LAG))
    yield _follower((Kind.AMBIENT_LAG, Kind.CAMERA_LAG, Kind.CAMERA_LAG_SQUARE))


def _follower(kinds: tuple[Kind, ...]) -> Callable[[float, float], Terms]:
    def terms(part_s: float, base_s: float) -> Terms:
        return (*POLYNOMIAL, *(Term(kind, part_s) for kind in kinds), Term(Kind.AMBIENT_LAG, base_s))

    return terms


def _sets(count: int) -> Iterator[tuple[float, ...]]:
    for places in combinations(range(len(TAUS_S)), count):
        if all(later - earlier > _NEIGHBOURS for earlier, later in pairwise(places)):
            yield tuple(TAUS_S[place] for place in places)


def _pairs() -> Iterator[tuple[float, float]]:
    yield from combinations(TAUS_S, 2)
