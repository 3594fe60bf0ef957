"""A new unit of a camera type: two temperatures, and what other units have shown."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.drift.evaluation import compute_rms_px
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.rereference import fit_like
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

from .drawn_cameras import draw_unit
from .drawn_sessions import DrawnSession, cycle, record_session, reference, warm_up

SEED, NEW = 7801, 9
WAY_DEGC = (31, 38, 45, 52, 38, 24, 10, 17, 24)


def seen(number: int, *, fitted_degC: tuple[int, ...], asked_degC: tuple[int, ...] = (), seed: int = 0) -> DrawnSession:
    parts = [*warm_up(), *reference(), *cycle((*fitted_degC, *asked_degC), asked_degC)]
    return record_session(draw_unit(SEED, number), parts, seed)


@pytest.fixture(scope="module")
def units() -> list[ThermalModel]:
    return [fit_thermal(seen(number, fitted_degC=WAY_DEGC).observed) for number in range(4)]


@pytest.fixture(scope="module")
def few() -> DrawnSession:
    return seen(NEW, fitted_degC=(45,), seed=1)


def left_mpx(model: ThermalModel) -> tuple[float, float]:
    """RMS of both coordinates on another session of the new unit, and the share that the 95 % interval holds."""
    asked = seen(NEW, fitted_degC=(), asked_degC=(34, 48, 20, 13), seed=2)
    at_reference_px = asked.truth_px[asked.observed.of(Role.REFERENCE)].mean(axis=0)
    states = compute_frame_states(asked.observed, model.memory)
    frames = np.flatnonzero(asked.observed.of(Role.VALIDATION)).tolist()
    each = [(asked.truth_px[k], states.where(np.array([k]))) for k in frames]
    deviation = np.concatenate([model.correct(*one) - at_reference_px for one in each])
    claimed = np.concatenate([np.diagonal(model.covariance(*one), axis1=1, axis2=2) for one in each])
    held = float((np.abs(deviation) < 1.96 * np.sqrt(claimed)).mean())
    return 1e3 * float(np.hypot(*compute_rms_px(deviation))) / 2**0.5, held


def test_two_temperatures_and_the_type_come_near_to_a_whole_session(
    units: list[ThermalModel], few: DrawnSession
) -> None:
    own, of_type = fit_like(few.observed, units), units[0]
    left, held = left_mpx(own)
    assert left < 25 < 0.5 * left_mpx(of_type)[0]
    assert held > 0.85


def test_it_is_a_model_like_others(units: list[ThermalModel], few: DrawnSession, tmp_path: Path) -> None:
    own = fit_like(few.observed, units)
    save_model(own, tmp_path / "model.json")
    loaded = load_model(tmp_path / "model.json")
    assert isinstance(loaded, ThermalModel)
    np.testing.assert_array_equal(loaded.coefficients, own.coefficients)
    assert (np.linalg.eigvalsh(own.coefficient_covariance) > -1e-9).all()
    states = compute_frame_states(few.observed, own.memory)
    seen_at = np.flatnonzero(few.observed.of(Role.FIT))[-1:]
    assert own.inside(few.truth_px[seen_at[0]][20:30], states.where(seen_at)).all()


def test_units_that_are_not_alike_are_refused(units: list[ThermalModel], few: DrawnSession) -> None:
    with pytest.raises(SessionError, match="3 units or more"):
        fit_like(few.observed, units[:2])
    other = replace(units[2], terms=units[2].terms[:-1])
    with pytest.raises(SessionError, match="has other terms"):
        fit_like(few.observed, [*units[:2], other])
    with pytest.raises(SessionError, match="images of"):
        fit_like(replace(few.observed, image_size=(640, 480)), units)
