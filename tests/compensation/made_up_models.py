"""Drift models of either form with drawn coefficients, and a life of samples to follow them through."""

from __future__ import annotations

import numpy as np
import pytest

from thermostand.compensation.drift.model_facts import ModelFacts
from thermostand.compensation.drift.paper_model import DegreeScore, PaperModel, list_exponents
from thermostand.compensation.drift.terms import (
    AmbientLag,
    AmbientLagCubed,
    AmbientLagSquared,
    BacklashTerm,
    CameraLag,
    CameraSquaredTerm,
    CameraTerm,
    ConstantTerm,
    HiddenBacklashTerm,
)
from thermostand.compensation.drift.thermal_model import ThermalModel, ThermalRange

SIZE = (640, 480)
HULL = np.array([[50.0, 40.0], [600.0, 40.0], [600.0, 440.0], [50.0, 440.0]])
FACTS = {
    "image_size": SIZE,
    "hull_px": HULL,
    "reference_degC": 44.0,
    "reference_chamber_degC": 24.0,
    "reference_centres_px": np.array([[100.0, 90.0], [np.nan, np.nan]]),
    "target_name": "small",
    "camera_serial": "TS-0001",
    "session_ids": ("cycle",),
    "software_version": "0",
}


def paper(degree: int = 3) -> PaperModel:
    rng, count = np.random.default_rng(degree), len(list_exponents(degree))
    score = DegreeScore(
        degree=degree, terms=count, condition=9.0, rms_px=(0.1, 0.1), fold_chamber_degC=(), fold_rms_px=()
    )
    return PaperModel(
        facts=ModelFacts(camera_range_degC=(30.0, 72.0), **FACTS),
        degree=degree,
        coefficients=rng.normal(0, 0.2, (2, count)),
        coefficient_covariance=np.array([1e-6 * np.eye(count)] * 2),
        discrepancy_px=np.array([0.02, 0.03]),
        scores=(score,),
        candidates=(),
    )


def thermal(*, warmed: bool = True) -> ThermalModel:
    """With a term of every kind."""
    terms = (
        *(ConstantTerm(), CameraTerm(), CameraSquaredTerm()),
        *(AmbientLag(tau_s=tau_s) for tau_s in (600.0, 3600.0)),
        *(AmbientLagSquared(tau_s=3600.0), AmbientLagCubed(tau_s=3600.0), CameraLag(tau_s=600.0)),
        *(BacklashTerm(radius_K=6.0), BacklashTerm(radius_K=3.0)),
        HiddenBacklashTerm(radius_K=2.0, tau_s=3600.0, share=0.3),
        HiddenBacklashTerm(radius_K=1.0, tau_s=600.0, share=0.1),
    )
    rng = np.random.default_rng(7)
    return ThermalModel(
        facts=ModelFacts(camera_range_degC=(25.0, 72.0), **FACTS),
        terms=terms,
        reference_ambient_degC=24.0,
        self_heating_K=17.0,
        reference_features=rng.normal(0, 0.1, len(terms)),
        coefficients=rng.normal(0, 0.2, (8, len(terms))),
        coefficient_covariance=np.array([1e-6 * np.eye(len(terms))] * 8),
        leverage_matrix=2e-6 * np.eye(len(terms)),
        discrepancy_px=np.array([0.003, 0.004]),
        valid=ThermalRange((10.0, 52.0), 120.0 if warmed else np.inf, leverage=5e-6),
        has_warm_up=True,
        candidates=(),
    )


MODELS = [pytest.param(paper(1), id="P1"), pytest.param(paper(4), id="P4"), pytest.param(thermal(), id="thermal"),
          pytest.param(thermal(warmed=False), id="never switched on")]  # fmt: skip
POINTS = np.random.default_rng(3).uniform((0, 0), SIZE, (40, 2))
# dt_s, air, power, camera: a cold start, a ramp, a minute without power, a silent camera, a gap, a warm start; a gap,
# and a camera that is switched on cold.
LIFE = [
    *((10.0, 15.0, 1.0, 15.0 + 17 * (1 - np.exp(-k / 60))) for k in range(200)),
    *((10.0, 15.0 + 0.1 * k, 1.0, 32.0 + 0.09 * k) for k in range(300)),
    *((10.0, 45.0, 0.0, np.nan) for _ in range(6)),
    (7.0, 45.0, 0.5, 50.0),
    *((10.0, 40.0, 1.0, 55.0) for _ in range(30)),
    (5.0, np.nan, 1.0, 50.0),
    *((10.0, 24.0, 1.0, 44.0) for _ in range(1200)),
    (5.0, np.nan, 1.0, 44.0),
    *((10.0, 24.0, 0.0, np.nan) for _ in range(30)),
    *((10.0, 24.0, 1.0, 24.0 + 17 * (1 - np.exp(-k / 60))) for k in range(200)),
]
