"""A new unit of a camera type of which several units are known: a few frames at two temperatures, and the type's prior.

The coefficients of a type's units are drawn from one Gaussian (a hierarchical model: Gelman et al., Bayesian Data
Analysis, 3rd edition, 2013, chapter 5), of the mean and the scatter of those that were fitted over whole nights; what
is seen of the new unit makes them its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thermostand.compensation.drift.candidates import Pair
from thermostand.compensation.drift.facts import facts_of
from thermostand.compensation.drift.terms import MOTIONS
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training import training
from thermostand.compensation.history.states import Float
from thermostand.compensation.observations import Observations
from thermostand.foundation.errors import SessionError

_FEWEST = 3
_APART = 0.1
"""Of the scatter: this part is taken for independent of one term to the next, for a few units show few directions.
Chosen on 8 drawn types, judged on 10 others (docs/decisions.md)."""


def fit_like(observations: Observations, units: Sequence[ThermalModel]) -> ThermalModel:
    """The model of a new unit, from its REFERENCE, FIT and WARM_UP frames, however few, and other units of its type.

    It holds where all of the units were, in states like theirs. SessionError when there are fewer than three units, or
    they are not alike: other terms, or images of another size.
    """
    _check_alike(observations, units)
    first = units[0]
    memory = replace(first.memory, self_heating_K=float(np.mean([one.self_heating_K for one in units])))
    trained = training(observations, first.terms, memory)
    seen = trained.instants()
    discrepancy_px2 = np.mean([one.discrepancy_px**2 for one in units], axis=0)
    unexplained_px2 = np.append(discrepancy_px2, np.zeros(MOTIONS - 2))
    coefficients, covariance = _of_type(units)
    for motion in range(MOTIONS):
        toward = covariance[motion] @ seen.features.T
        noise_px2 = np.diag(seen.variance_px2[:, motion] + unexplained_px2[motion])
        gain = np.linalg.solve(seen.features @ toward + noise_px2, toward.T).T
        coefficients[motion] += gain @ (seen.amounts_px[:, motion] - seen.features @ coefficients[motion])
        covariance[motion] -= gain @ toward.T
    covariance = (covariance + covariance.transpose(0, 2, 1)) / 2
    camera_degC = _common([one.facts.camera_range_degC for one in units])
    least_on_s = max(one.valid.least_on_s for one in units)
    return ThermalModel(
        facts=facts_of(observations, trained.rows, camera_degC, trained.origin.camera_degC),
        terms=first.terms,
        reference_ambient_degC=trained.origin.ambient_degC,
        self_heating_K=memory.self_heating_K,
        reference_features=trained.reference_features,
        coefficients=coefficients,
        coefficient_covariance=covariance,
        leverage_matrix=np.mean([one.leverage_matrix for one in units], axis=0),
        discrepancy_px=np.sqrt(discrepancy_px2),
        valid=replace(
            first.valid,
            ambient_degC=_common([one.valid.ambient_degC for one in units]),
            least_on_s=least_on_s,
            leverage=max(one.valid.leverage for one in units),
            history_s=max(one.history_s for one in units),
        ),
        has_warm_up=all(one.has_warm_up for one in units),
        candidates=(),
    )


def _of_type(units: Sequence[ThermalModel]) -> tuple[Float, Float]:
    """Mean (8, H) and covariance (8, H, H) of the coefficients of a unit that nothing is known of."""
    each = np.array([one.coefficients for one in units])
    mean, count = each.mean(axis=0), len(each)
    scatter = np.einsum("kmg,kmh->mgh", each - mean, each - mean) * (1 + 1 / count) / (count - 1)
    apart = np.einsum("mgg,gh->mgh", scatter, np.eye(scatter.shape[1]))
    uncertain = np.mean([one.coefficient_covariance for one in units], axis=0)
    return mean, (1 - _APART) * scatter + _APART * apart + uncertain


def _common(ranges: Sequence[Pair]) -> Pair:
    return max(low for low, _ in ranges), min(high for _, high in ranges)


def _check_alike(observations: Observations, units: Sequence[ThermalModel]) -> None:
    if len(units) < _FEWEST:
        raise SessionError(
            f"a type is known by {_FEWEST} units or more, each fitted over a night; given are {len(units)}"
        )
    for one in units[1:]:
        if one.terms != units[0].terms:
            raise SessionError(f"the model of camera {one.facts.camera_serial} has other terms; fit its sessions again")
    for one in units:
        if one.facts.image_size != observations.image_size:
            raise SessionError(
                f"camera {one.facts.camera_serial} has images of {one.facts.image_size} px, the new unit of "
                f"{observations.image_size}"
            )
