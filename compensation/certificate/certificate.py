"""What a certificate says: values with their expanded uncertainty, by the GUM and by Monte Carlo, and conformity.

U is that of JCGM 100: k u, k the quantile of Student's t for the effective degrees of freedom, 95.45 %. Each is held
against a Monte Carlo propagation of the inputs' distributions through the measurement equation (JCGM 101). Where the
two differ by more than 5 %, the law of propagation does not hold, and the Monte Carlo result is the one certified.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from typing import Literal

import numpy as np
from scipy import stats

from thermostand.compensation.budget.geometry import Geometry
from thermostand.compensation.certificate.order import Order
from thermostand.compensation.certificate.stand_correction import add_stand_uncertainty, correct_for_stand
from thermostand.compensation.datasheet.datasheet import Datasheet, MeasuredQuantity, compute_datasheet
from thermostand.compensation.drift.model_selection import fit as fit_model
from thermostand.compensation.observations import Observations
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.recording.format.manifest import MANIFEST_NAME
from thermostand.recording.reading.session import Session

PROBABILITY = 0.9545
"""Of coverage: k = 2 of a normal distribution (EA-4/02)."""
AGREEMENT = 0.05
"""Between both U, of the Monte Carlo's."""
_DRAWS, _SEED = 200_000, 101  # the quantiles of 200,000 draws scatter by 0.4 %
_CONFORMANCE = 0.95
"""Probability of ISO 14253-1:2017, one-sided: the guard band is 1.645 standard uncertainties, more for few degrees of
freedom."""
_OF_MODEL = "left_"
"""Begins the keys of what a model leaves: that is no property of the item."""


@dataclass(frozen=True, slots=True)
class CertifiedValue:
    """k, expanded: as certified, with the method. analytic, simulated: expanded uncertainty by the GUM and by Monte
    Carlo, in the quantity's unit."""

    quantity: MeasuredQuantity
    k: float
    expanded: float
    method: Literal["GUM", "Monte Carlo"]
    analytic: float
    simulated: float


Verdict = Literal["conforms", "does not conform", "neither is proven"]


@dataclass(frozen=True, slots=True)
class Conformity:
    """Of a value with limits lower and upper (None: no limit), all in its unit. guard: the band at each limit in which
    nothing is proven. within: whether the value itself is within the limits."""

    value: CertifiedValue
    lower: float | None
    upper: float | None
    guard: float
    within: bool
    verdict: Verdict


@dataclass(frozen=True, slots=True)
class RecordedSession:
    """digest: SHA-256 of its manifest, which has that of each segment."""

    session_id: str
    uid: str
    digest: str


@dataclass(frozen=True, slots=True, eq=False)
class Certificate:
    """order: as stated; everything else is measured. performed: first and last day, UTC. laboratory_degC: range over
    the sessions, None where it was not recorded. is_corrected: the stand's own motion is taken out."""

    order: Order
    sheet: Datasheet
    values: tuple[CertifiedValue, ...]
    conformities: tuple[Conformity, ...]
    sessions: tuple[RecordedSession, ...]
    performed: tuple[date, date]
    laboratory_degC: tuple[float, float] | None
    is_corrected: bool


def issue_certificate(
    sessions: Sequence[Session], observations: Observations, order: Order, geometry: Geometry | None
) -> Certificate:
    """ConfigError where order and sessions contradict each other; SessionError when nothing can be certified."""
    performed = _compute_performed(observations)
    _check_order(order, observations, performed)
    if geometry is None:
        sheet = compute_datasheet(observations, fit_model(observations), order.details)
    else:
        correction = correct_for_stand(sessions, observations, geometry)
        corrected = correction.observations
        sheet = add_stand_uncertainty(compute_datasheet(corrected, fit_model(corrected), order.details), correction)
    if any(visits.by_camera for visits in sheet.visits):
        raise SessionError("no air temperature near the camera was recorded; a drift per K of the air is not certified")
    certified = [one for one in sheet.quantities if not one.key.startswith(_OF_MODEL)]
    values = tuple(certify(one) for one in certified if math.isfinite(one.value) and one.u > 0)
    if not values:
        raise SessionError("no quantity could be measured, so there is nothing to certify")
    return Certificate(
        order=order,
        sheet=sheet,
        values=values,
        conformities=_judge_all(values, order),
        sessions=tuple(_identify(session) for session in sessions),
        performed=performed,
        laboratory_degC=_read_laboratory_range(sessions),
        is_corrected=geometry is not None,
    )


def certify(quantity: MeasuredQuantity) -> CertifiedValue:
    """The quantity, which was measured, with the expanded uncertainty that holds."""
    k = float(stats.t.ppf(0.5 + PROBABILITY / 2, quantity.dof))
    analytic, simulated = k * quantity.u, simulate_expanded(quantity)
    agree = abs(analytic - simulated) <= AGREEMENT * simulated
    expanded = analytic if agree else simulated
    return CertifiedValue(
        quantity, expanded / quantity.u, expanded, "GUM" if agree else "Monte Carlo", analytic, simulated
    )


def simulate_expanded(quantity: MeasuredQuantity, draws: int = _DRAWS) -> float:
    """Half the length of the probabilistically symmetric interval of PROBABILITY (JCGM 101, 7.7)."""
    rng = np.random.default_rng(_SEED)
    lines = quantity.contributions
    root = np.linalg.cholesky(quantity.correlation + 1e-9 * np.eye(len(lines)))
    away = rng.standard_normal((draws, len(lines))) @ root.T
    for column, line in enumerate(lines):
        if line.is_rectangular:
            away[:, column] = math.sqrt(3) * (2 * stats.norm.cdf(away[:, column]) - 1)
        elif math.isfinite(line.dof):
            away[:, column] *= np.sqrt(line.dof / rng.chisquare(line.dof, draws))
    away *= [line.u for line in lines]
    linear = np.array([line.sensitivity for line in lines])
    if quantity.equation is None:
        drawn = away @ linear
    else:  # what was added to its budget, as the scatter between sessions, is linear
        own = quantity.inputs
        drawn = quantity.equation(away[:, :own]) + away[:, own:] @ linear[own:]
    low, high = np.quantile(drawn, [0.5 - PROBABILITY / 2, 0.5 + PROBABILITY / 2])
    return float(high - low) / 2


def judge(value: CertifiedValue, lower: float | None, upper: float | None) -> Conformity:
    """By ISO 14253-1: conformity is proven within the limits less the guard band, the opposite beyond them with it."""
    measured = value.quantity.value
    guard = float(stats.t.ppf(_CONFORMANCE, value.quantity.dof)) * value.quantity.u
    inside = min(math.inf if lower is None else measured - lower, math.inf if upper is None else upper - measured)
    verdict: Verdict = "neither is proven"
    if inside >= guard:
        verdict = "conforms"
    elif inside <= -guard:
        verdict = "does not conform"
    return Conformity(value, lower, upper, guard, inside >= 0, verdict)


def _compute_performed(observations: Observations) -> tuple[date, date]:
    utc = [observations.sessions[index].utc for index in observations.session.tolist()]
    days = [
        datetime.fromtimestamp(one.utc_ns(time_ns) // 1_000_000_000, UTC).date()
        for one, time_ns in zip(utc, observations.time_ns.tolist(), strict=True)
    ]
    return min(days), max(days)


def _check_order(order: Order, observations: Observations, performed: tuple[date, date]) -> None:
    serial = observations.sessions[0].camera_serial
    if order.item.serial_number != serial:
        raise ConfigError(f"the order is for the camera {order.item.serial_number}, and the sessions are of {serial}")
    if order.received > performed[0]:
        raise ConfigError(f"the item was received on {order.received}, after it was measured ({performed[0]})")
    if order.issued < performed[1]:
        raise ConfigError(f"the certificate is issued on {order.issued}, before the last measurement ({performed[1]})")
    for name, reference in (("target", order.target), ("thermometers", order.thermometers)):
        if reference.issued > performed[0]:
            raise ConfigError(f"{name}: the certificate of {reference.issued} is later than the measurement")


def _judge_all(values: Sequence[CertifiedValue], order: Order) -> tuple[Conformity, ...]:
    known = {one.quantity.key: one for one in values}
    unknown = [key for key in order.specification if key not in known]
    if unknown:
        raise ConfigError(f"specification: {', '.join(unknown)} cannot be judged; certified are {', '.join(known)}")
    return tuple(judge(known[key], limits.lower, limits.upper) for key, limits in order.specification.items())


def _identify(session: Session) -> RecordedSession:
    manifest = session.path / MANIFEST_NAME
    digest = hashlib.sha256(manifest.read_bytes()).hexdigest() if manifest.is_file() else ""
    return RecordedSession(session.metadata.get("session_id", ""), session.metadata.get("uid", ""), digest)


def _read_laboratory_range(sessions: Sequence[Session]) -> tuple[float, float] | None:
    try:
        columns = [session.believed("thermometers.laboratory")[1] for session in sessions]
    except SessionError:  # a stand without such a thermometer
        return None
    values = np.concatenate([*columns, np.empty(0)])
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if len(values) else None
