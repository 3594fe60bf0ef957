"""Temperature coefficients of one night: a quadratic of each motion over the air's temperature with a heating and a
cooling branch, its mean slope at the reference, and what the visits scatter about it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from thermostand.compensation.datasheet.motions import MOTIONS, UNITS, Visits
from thermostand.compensation.datasheet.quantity import Contribution, Quantity

NAMES = ("Shift of the image, I (right)", "Shift of the image, J (down)", "Scale of the image", "Turn of the image")
_GROUP = "Temperature coefficients"
_FEWEST_VISITS = 8
_MOST_CORRELATION = 0.9
_MODEL = (
    "c of y = a + c (T − T0) + b (T − T0)² ± [d + f (T − T0)], + heating, − cooling, by least squares over all visits; "
    "T: air near the camera, T0: at the reference"
)
_TOO_FEW = "fewer than eight visits of four set-points with a known air temperature"


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """slope: at the reference, the mean of both branches. u_slope: of what the visits scatter about the curve, with the
    correlation of neighbours. branches: how much the heating branch's slope is above it, 0 when there is one branch
    only. scatter: standard deviation of a visit about the curve. span_K: of the air."""

    slope: float
    u_slope: float
    branches: float
    scatter: float
    span_K: float


def curve(visits: Visits, motion: int) -> Curve | None:
    """None when there are too few visits to say how they scatter."""
    count = len(visits.air_degC)
    if count < _FEWEST_VISITS or len(np.unique(visits.chamber_degC)) < 4:
        return None
    away_K = visits.air_degC - visits.air_degC[0]
    side = np.sign(np.diff(visits.chamber_degC, prepend=visits.chamber_degC[0]))
    terms = np.stack([np.ones(count), away_K, away_K**2], axis=1)
    both = (side > 0).sum() > 1 and (side < 0).sum() > 1
    if both:
        terms = np.column_stack([terms, side, side * away_K])
    found, _, rank, _ = np.linalg.lstsq(terms, visits.moved[:, motion], rcond=None)
    if rank < terms.shape[1]:
        return None
    left = visits.moved[:, motion] - terms @ found
    scatter = math.sqrt(float(left @ left) / (count - rank))
    # What comes slowly makes neighbours alike: fewer visits are independent than there are.
    alike = float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-30)
    alike = min(max(alike, 0.0), _MOST_CORRELATION)
    u_slope = scatter * math.sqrt(float(np.linalg.inv(terms.T @ terms)[1, 1]) * (1 + alike) / (1 - alike))
    return Curve(float(found[1]), u_slope, float(found[4]) if both else 0.0, scatter, float(np.ptp(visits.air_degC)))


def coefficients(visits: Visits, u_air_K: float, target_ppm_per_K: float) -> list[Quantity]:
    """Of the four motions."""
    found: list[Quantity] = []
    for motion, (key, name, unit) in enumerate(zip(MOTIONS, NAMES, UNITS, strict=True)):
        fitted = curve(visits, motion)
        one = Quantity(f"{key}_per_K", _GROUP, name, f"{unit}/K", math.nan, _MODEL, why=_TOO_FEW)
        if fitted is None:
            found.append(one)
            continue
        lines = [
            Contribution("scatter of the visits about the curve", "A", fitted.u_slope, f"{unit}/K", 1.0,
                         "least squares, with the correlation of neighbouring visits"),
            Contribution("slope of heating against cooling", "B", abs(fitted.branches) / math.sqrt(3), f"{unit}/K", 1.0,
                         "rectangular, between the slopes of the two branches"),
            Contribution("span of the air's temperature", "B", math.sqrt(2) * u_air_K, "K",
                         fitted.slope / fitted.span_K, "thermometer and its place, both ends of the range"),
        ]  # fmt: skip
        if key == "scale":
            lines.append(
                Contribution("expansion of the target", "B", target_ppm_per_K, "ppm/K", 1.0,
                             "the part of the air's change that may reach the target")
            )  # fmt: skip
        found.append(replace(one, value=fitted.slope, contributions=tuple(lines), why=""))
    return found
