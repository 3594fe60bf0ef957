"""A measured quantity with its uncertainty budget, after the GUM (JCGM 100:2008): contributions of type A (statistics
of this measurement) and type B (anything else), each an input's standard uncertainty times a sensitivity coefficient.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

COVERAGE = 2.0
"""Expanded uncertainties are this many standard ones: about 95 % of a normal distribution."""
NIGHTS = "night to night"


@dataclass(frozen=True, slots=True)
class Contribution:
    """One line of a budget. u: standard uncertainty of the input, in its own unit. sensitivity: unit of the quantity
    per unit of the input. basis: how u is known."""

    source: str
    kind: Literal["A", "B"]
    u: float
    unit: str
    sensitivity: float
    basis: str

    @property
    def amount(self) -> float:
        """In the quantity's unit."""
        return abs(self.sensitivity) * self.u


@dataclass(frozen=True, slots=True)
class MeasuredQuantity:
    """key: its name in the JSON file. model: the measurement equation, in words and symbols. group: the heading it
    stands under. value: NaN when it could not be measured, and `why` says so."""

    key: str
    group: str
    name: str
    unit: str
    value: float
    model: str
    contributions: tuple[Contribution, ...] = ()
    why: str = ""

    @property
    def u(self) -> float:
        """Combined standard uncertainty."""
        if math.isnan(self.value):
            return math.nan
        return math.sqrt(sum(one.amount**2 for one in self.contributions))

    @property
    def expanded(self) -> float:
        """U, k = 2."""
        return COVERAGE * self.u


def direct(source: str, kind: Literal["A", "B"], u: float, unit: str, basis: str) -> Contribution:
    """Of an input in the quantity's own unit."""
    return Contribution(source, kind, u, unit, 1.0, basis)


def pooled(nights: Sequence[MeasuredQuantity]) -> MeasuredQuantity:
    """The mean of the same quantity over nights. What each night's statistics say shrinks with their number, what is of
    type B is common to all; how they differ is a contribution of its own."""
    known = [one for one in nights if not math.isnan(one.value)]
    if len(known) < 2:
        return known[0] if known else nights[0]
    values = [one.value for one in known]
    count = len(known)
    lines: list[Contribution] = []
    for same in zip(*(one.contributions for one in known), strict=True):
        amounts = np.array([line.amount for line in same])
        a_night = math.sqrt(float((amounts**2).mean()))
        amount = a_night / math.sqrt(count) if same[0].kind == "A" else a_night
        sensitivity = same[0].sensitivity or 1.0
        lines.append(replace(same[0], u=amount / abs(sensitivity), sensitivity=sensitivity))
    spread = float(np.std(values, ddof=1)) / math.sqrt(count)
    lines.append(direct(NIGHTS, "A", spread, known[0].unit, f"standard deviation of the mean of {count} nights"))
    return replace(known[0], value=float(np.mean(values)), contributions=tuple(lines))
