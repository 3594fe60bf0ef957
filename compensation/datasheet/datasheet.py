"""The numbers of a camera's thermal datasheet, from sessions that were recorded and a model fitted to them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from thermostand.compensation.datasheet.coefficients import coefficients, curve
from thermostand.compensation.datasheet.details import Details
from thermostand.compensation.datasheet.left_over import hysteresis_quantities, residual_quantities
from thermostand.compensation.datasheet.motions import MOTIONS, Visits, Warming, motions, visits_of, warming_of
from thermostand.compensation.datasheet.quantity import Quantity, pooled
from thermostand.compensation.datasheet.warming import warming_quantities
from thermostand.compensation.drift.bumps import around_bumps
from thermostand.compensation.drift.choosing import FORMS
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import Evaluation, evaluate
from thermostand.compensation.drift.hysteresis import hysteresis
from thermostand.compensation.observations import Observations
from thermostand.foundation.errors import SessionError


@dataclass(frozen=True, slots=True, eq=False)
class Datasheet:
    """quantities: in the order of the page. nights: the same of each session by itself. warming: the first warm-up.
    air_degC, camera_degC: range of the visits. model: in use."""

    observations: Observations
    details: Details
    model: DriftModel
    quantities: tuple[Quantity, ...]
    nights: tuple[tuple[Quantity, ...], ...]
    visits: tuple[Visits, ...]
    warming: Warming | None
    air_degC: tuple[float, float]
    camera_degC: tuple[float, float]

    @property
    def by_key(self) -> Mapping[str, Quantity]:
        """The quantities by their names."""
        return {one.key: one for one in self.quantities}


def datasheet(observations: Observations, model: DriftModel, details: Details | None = None) -> Datasheet:
    """SessionError when no session has a reference and set-points."""
    details = details or Details()
    steady = around_bumps(observations, model.facts.bumps)
    moved = motions(steady)
    of_session = {one.session_id: one for one in hysteresis(steady)}
    evaluations = _evaluations(model, observations)
    nights: list[tuple[Quantity, ...]] = []
    visits: list[Visits] = []
    warmings: list[Warming | None] = []
    for index, facts in enumerate(observations.sessions):
        own = visits_of(steady, moved, index)
        if not len(own.air_degC):
            continue
        scatter = _unrepeated(own, model)
        visits.append(own)
        warmings.append(warming_of(steady, moved, index))
        nights.append(
            (
                *coefficients(own, details.u_air_K, details.u_target_ppm_per_K),
                *warming_quantities(warmings[-1], own, scatter, details.u_air_K),
                *hysteresis_quantities(of_session.get(facts.session_id), scatter),
            )
        )
    if not nights:
        raise SessionError("no session has frames at set-points with a known air temperature; there is no datasheet")
    of_nights = [pooled(same) for same in zip(*nights, strict=True)]
    scatter = _unrepeated(visits[0], model)
    left = [one for form in FORMS for one in residual_quantities(form, evaluations.get(form), scatter)]
    whole = _joined(visits)
    return Datasheet(
        observations=observations,
        details=details,
        model=model,
        quantities=(*of_nights, *left),
        nights=tuple(nights),
        visits=tuple(visits),
        warming=next((one for one in warmings if one is not None), None),
        air_degC=(float(whole.air_degC.min()), float(whole.air_degC.max())),
        camera_degC=(float(whole.camera_degC.min()), float(whole.camera_degC.max())),
    )


def _joined(visits: list[Visits]) -> Visits:
    names = ("air_degC", "camera_degC", "chamber_degC", "moved")
    return replace(visits[0], **{name: np.concatenate([getattr(one, name) for one in visits]) for name in names})


def _unrepeated(visits: Visits, model: DriftModel) -> tuple[float, ...]:
    """One standard deviation of each of MOTIONS that temperature and its history do not explain: what the chosen form
    leaves, and no more than the visits scatter about a curve."""
    i, j = model.discrepancy_px.tolist()
    angle = 1e6 * max(i, j) / (model.facts.image_size[0] / 2)
    scatters = [fitted.scatter if (fitted := curve(visits, motion)) else np.inf for motion in range(len(MOTIONS))]
    return tuple(min(pair) for pair in zip((i, j, angle, angle), scatters, strict=True))


def _evaluations(model: DriftModel, observations: Observations) -> dict[str, Evaluation]:
    found: dict[str, Evaluation] = {}
    for one in (model, model.other):
        if one is None:
            continue
        try:
            found[one.form] = evaluate(one, observations)
        except SessionError:  # said on the page: this form cannot be scored
            continue
    return found
