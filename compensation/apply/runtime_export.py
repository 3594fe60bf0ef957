"""A drift model for other people's programs: a small JSON file and a module that needs numpy and nothing else."""

from __future__ import annotations

import importlib.resources
import json
import math
from pathlib import Path

import numpy as np

from thermostand.compensation import drift_runtime
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.paper_model import PaperModel, exponents
from thermostand.compensation.drift.thermal_model import BetweenNights, ThermalModel
from thermostand.compensation.history.states import Float
from thermostand.foundation.files import make_folder, write_whole

MODEL_NAME, MODULE_NAME = "drift.json", "drift_runtime.py"


def export(model: DriftModel, folder: Path) -> tuple[Path, Path]:
    """Write drift.json and drift_runtime.py into `folder`, made when it is missing; each whole or not at all.

    SessionError when the place refuses.
    """
    make_folder(folder)
    written = folder / MODEL_NAME, folder / MODULE_NAME
    module = importlib.resources.files("thermostand.compensation") / MODULE_NAME
    write_whole(written[0], json.dumps(runtime_model(model), indent=1, allow_nan=False) + "\n")
    write_whole(written[1], module.read_text(encoding="utf-8"))
    return written


def runtime_model(model: DriftModel) -> dict[str, object]:
    """What drift_runtime.Drift takes, as JSON values: no covariance; discrepancy_px is one standard deviation of the
    correction inside the calibrated range."""
    facts = model.facts
    common: dict[str, object] = {
        "format": "thermostand drift runtime",
        "version": drift_runtime.VERSION,
        "form": model.form,
        "camera_serial": facts.camera_serial,
        "software_version": facts.software_version,
        "image_size_px": facts.image_size,
        "camera_range_degC": facts.camera_range_degC,
        "reference_degC": facts.reference_degC,
        "discrepancy_px": _left_px(model).tolist(),
        "hull_px": facts.hull_px.tolist(),
    }
    match model:
        case PaperModel():
            of_form = {"terms_abc": exponents(model.degree), "coefficients_px": model.coefficients.tolist()}
        case ThermalModel():
            of_form = _thermal(model)
        case _:
            raise TypeError(f"no runtime for a model of form {model.form}")
    return {**common, **of_form}


def _left_px(model: DriftModel) -> Float:
    """(2,): on nights that were not fitted, as those are on which a running camera asks."""
    match model:
        case ThermalModel(between_nights=BetweenNights(sigma_px=between_px)):
            return np.hypot(model.discrepancy_px, between_px)
        case _:
            return model.discrepancy_px


def _thermal(model: ThermalModel) -> dict[str, object]:
    valid = model.valid
    return {
        "terms": [model.origin.bound(term.feature) for term in model.terms],
        "ambient_tau_s": model.memory.ambient_lag[2],
        "self_heating_K": model.self_heating_K,
        "reference_ambient_degC": model.reference_ambient_degC,
        "reference_features": model.reference_features.tolist(),
        "coefficients_px": model.coefficients.tolist(),
        "ambient_range_degC": valid.ambient_degC,
        "least_on_s": None if math.isinf(valid.least_on_s) else valid.least_on_s,
        "leverage": valid.leverage,
        "leverage_matrix": model.leverage_matrix.tolist(),
        "history_s": model.history_s,
    }
