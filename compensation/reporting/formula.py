"""A model written out: its formula in symbols, and a table of its coefficients with their uncertainties."""

from __future__ import annotations

import numpy as np

from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.paper_model import PaperModel
from thermostand.compensation.drift.polynomial import exponents
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.expression import SPAN_K
from thermostand.compensation.reporting.numbers import FormulaNumbers, typeset

_MOTIONS = ("a₁", "a₂", "a₃", "a₄", "a₅", "a₆", "a₇", "a₈")


def formula_of(model: DriftModel) -> FormulaNumbers:
    """TypeError for a form that is not known here."""
    match model:
        case PaperModel():
            return _paper(model)
        case ThermalModel():
            return _thermal(model)
        case _:
            raise TypeError(f"no formula for a model of form {model.form}")


def _paper(model: PaperModel) -> FormulaNumbers:
    width, height = model.facts.image_size
    low, high = model.facts.camera_range_degC
    lines = (
        "I at the reference = I + Σ c(I)_abc T_a(i) T_b(j) T_c(t)",
        "J at the reference = J + Σ c(J)_abc T_a(i) T_b(j) T_c(t)",
        f"i = 2 (I + 0.5) / {width} − 1,  j = 2 (J + 0.5) / {height} − 1",
        f"t = (2 T − {low + high:z.4f}) / {high - low:z.4f},  T: the camera's temperature, °C",
        "T_n: Chebyshev polynomial of degree n; I, J in px, integers are pixel centres",
    )
    sigma = np.sqrt(np.diagonal(model.coefficient_covariance, axis1=1, axis2=2))
    names = tuple(f"T{a}(i) T{b}(j) T{c}(t)" for a, b, c in exponents(model.degree))
    return FormulaNumbers(lines, ("c(I), px", "c(J), px"), names, model.coefficients.T, sigma.T)


def _thermal(model: ThermalModel) -> FormulaNumbers:
    width, height = model.facts.image_size
    origin, air = model.facts.reference_degC, model.reference_ambient_degC
    lines = (
        "I at the reference = I + a₁ + a₃ x + a₄ y + (a₇ x + a₈ y) x",
        "J at the reference = J + a₂ + a₅ x + a₆ y + (a₇ x + a₈ y) y",
        f"x = (I − {(width - 1) / 2:g}) / {width / 2:g},  y = (J − {(height - 1) / 2:g}) / {width / 2:g}",
        "a_k = Σ c_kh (f_h − r_h),  f_h: the rows of the table, r_h: the same at the reference",
        f"T = (camera − {origin:z.3f} °C) / {SPAN_K:g} K, its own temperature",
        f"air(τ) = (air near the camera, through a first-order lag τ, − {air:z.3f} °C) / {SPAN_K:g} K",
        "camera(τ) = T through such a lag",
        "play(r) = T through a dead zone of ± r",
        "play(r, τ, s): so of air(τ) + s (camera(τ) − air(τ)), a part that nobody measures",
        "at switching on a camera as cold as the air, lags and plays are at the temperatures of that instant",
        "I, J in px, integers are pixel centres",
    )
    sigma = np.sqrt(np.diagonal(model.coefficient_covariance, axis1=1, axis2=2))
    return FormulaNumbers(
        lines,
        tuple(f"{name}, px" for name in _MOTIONS),
        tuple(typeset(term.symbol) for term in model.terms),
        model.coefficients.T,
        sigma.T,
        tuple(model.reference_features.tolist()),
    )
