"""What does not follow temperature: hysteresis, and what each form of compensation leaves at held-out set-points."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np

from thermostand.compensation.datasheet.quantity import Quantity, direct
from thermostand.compensation.datasheet.warming import UNREPEATED
from thermostand.compensation.drift.evaluation import Evaluation
from thermostand.compensation.drift.hysteresis import Hysteresis
from thermostand.compensation.observations import Float

_FEWEST = 3


def hysteresis_quantities(found: Hysteresis | None, scatter_px: Sequence[float]) -> list[Quantity]:
    """RMS of heating minus cooling over set-points reached from both sides, mpx. scatter_px: what does not repeat."""
    model = "root mean square of (heating − cooling) over set-points reached from both sides, mean over the markers"
    quantities: list[Quantity] = []
    for axis, name in enumerate("IJ"):
        key, title = f"hysteresis_{name}", f"Heating against cooling, {name}"
        gaps = [] if found is None else found.gaps
        differences = 1e3 * np.array([gap.difference_px[axis] for gap in gaps])
        one = Quantity(key, "Dependence on the way", title, "mpx", math.nan, model)
        if len(differences) < _FEWEST:
            why = "fewer than three set-points were reached from both sides"
            quantities.append(Quantity(key, one.group, title, "mpx", math.nan, model, (), why))
            continue
        noise = 1e3 * float(np.sqrt(np.mean([gap.uncertainty_px[axis] ** 2 for gap in gaps])))
        repeats = 1e3 * scatter_px[axis] * math.sqrt(2 / len(differences))
        lines = (
            direct("choice of set-points", "A", _jackknife(differences, _rms), "mpx", "each left out once"),
            direct("noise of the markers", "A", noise / math.sqrt(len(differences)), "mpx", "as the marker fit claims"),
            direct("what does not repeat", "A", repeats, "mpx", UNREPEATED),
        )
        quantities.append(Quantity(key, one.group, title, "mpx", _rms(differences), model, lines))
    return quantities


def residual_quantities(form: str, evaluation: Evaluation | None, scatter_px: Sequence[float]) -> list[Quantity]:
    """RMS along I and J at held-out set-points, mpx; the marker's noise of single frames is in it."""
    model = (
        "root mean square of (reference − corrected) over all centres at held-out set-points, with their noise in it"
    )
    group = "Left after compensation"
    quantities: list[Quantity] = []
    for axis, name in enumerate("IJ"):
        key, title = f"left_{form}_{name}", f"The {form} form, {name}: RMS at held-out set-points"
        if evaluation is None or len(evaluation.temperatures) < _FEWEST:
            why = "the sessions do not support this form, or have fewer than three set-points to score it"
            quantities.append(Quantity(key, group, title, "mpx", math.nan, model, (), why))
            continue
        each = 1e3 * np.array([row.after_px[axis] for row in evaluation.temperatures])
        value = 1e3 * evaluation.rms_after_px[axis]
        # What does not repeat adds to the residual as a square: it matters less the larger that is.
        repeats = math.sqrt(value**2 + (1e3 * scatter_px[axis]) ** 2 / len(each)) - value
        lines = (
            direct("choice of set-points", "A", _jackknife(each, _rms), "mpx", "each left out once"),
            direct("what does not repeat", "A", repeats, "mpx", UNREPEATED),
        )
        quantities.append(Quantity(key, group, title, "mpx", value, model, lines))
    return quantities


def _rms(values: Float) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _jackknife(values: Float, statistic: Callable[[Float], float]) -> float:
    """Standard uncertainty of a statistic of independent values."""
    count = len(values)
    without = np.array([statistic(np.delete(values, k)) for k in range(count)])
    return math.sqrt((count - 1) / count * float(((without - without.mean()) ** 2).sum()))
