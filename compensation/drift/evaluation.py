"""How much the compensation gains, on frames at temperatures the fit has never seen (the paper's section 6.2)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.drift.bumps import correct_bumps
from thermostand.compensation.drift.candidates import Pair, compute_rms_px, make_pair
from thermostand.compensation.drift.displacements import Displacements, compute_displacements
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.paper_model import (
    PaperModel,
    compute_left_out_residuals,
    list_degrees,
    make_scaling,
)
from thermostand.compensation.drift.thermal_fit import cross_validate_thermal
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Float, Mask, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

PAPER_BEFORE_PX = (0.191, 0.576)
PAPER_AFTER_PX = (0.100, 0.090)
"""RMS along I and J of the paper's camera, fourth degree (section 6.2)."""

_SIGMA_95 = 1.959964  # of a normal distribution


@dataclass(frozen=True, slots=True)
class TemperatureRms:
    """RMS deviations (I, J), px, of the held-out frames at one chamber set-point; camera_degC is their mean."""

    chamber_degC: float
    camera_degC: float
    frames: int
    before_px: Pair
    after_px: Pair


@dataclass(frozen=True, slots=True, eq=False)
class Evaluation:
    """Deviations of held-out centres from their reference positions, before and after compensation.

    Attributes
    ----------
    question
        Whether the frames are of a session that was fitted.
    method
        What was held out, in words.
    frames
        How many frames.
    before_px, after_px
        (M, 2), px: reference minus measured, and reference minus corrected.
    rows
        The M centres.
    claimed_px2
        (M, 2), px^2: variance of the deviations after, as model and markers claim it.
    outside
        (M,): beyond the model's valid range.
    coverage_95
        Along I and J, the part of the deviations after that lie in the 95 % interval which model and markers claim;
        0.95
        is right.
    temperatures
        One score for each set-point.
    simulated
        Whether the frames are known to be of a simulated laboratory.
    """

    question: Literal["same session, interpolated", "another session"]
    method: str
    held_out: bool
    frames: int
    rows: Displacements
    before_px: Float
    after_px: Float
    claimed_px2: Float
    outside: NDArray[np.bool_]
    coverage_95: Pair
    temperatures: tuple[TemperatureRms, ...]
    simulated: bool

    @property
    def rms_before_px(self) -> Pair:
        """RMS along I and J before compensation, px."""
        return compute_rms_px(self.before_px)

    @property
    def rms_after_px(self) -> Pair:
        """RMS along I and J after compensation, px."""
        return compute_rms_px(self.after_px)


def evaluate(model: DriftModel, observations: Observations) -> Evaluation:
    """Score the model on the VALIDATION frames.

    Sessions without any are scored by leaving out one temperature at a time, each time with a new fit of the same
    terms.

    Parameters
    ----------
    model
        What `fit` or `load_model` gave.
    observations
        Frames of the same camera and target.

    Returns
    -------
    Evaluation
        Deviations before and after compensation.

    Raises
    ------
    SessionError
        When the frames are of another camera or target.
    """
    check_same(model, observations)
    observations = correct_bumps(observations, model.facts.bumps)
    frames = observations.of(Role.VALIDATION)
    states = compute_frame_states(observations, model.memory)
    if frames.any():
        rows = compute_displacements(observations, frames)
        after = rows.displacement_px - model.shift(rows.measured_px, states.where(rows.frame))
        method = "held-out temperatures"
    else:
        rows, after = _cross_validate(model, observations)
        method = "no held-out frames: one temperature left out at a time"
    rows, after = _select_answered(rows, after)
    at_rows = states.where(rows.frame)
    own = model.of_sessions(session.session_id for session in observations.sessions)
    claimed = np.diagonal(own.covariance(rows.measured_px, at_rows), axis1=1, axis2=2) + rows.variance_px2
    is_fitted = {one.session_id for one in observations.sessions} <= set(model.facts.session_ids)
    return Evaluation(
        question="same session, interpolated" if is_fitted else "another session",
        method=method,
        held_out=bool(frames.any()),
        frames=len(np.unique(rows.frame)),
        rows=rows,
        before_px=rows.displacement_px,
        after_px=after,
        claimed_px2=claimed,
        outside=~model.inside(rows.measured_px, at_rows),
        coverage_95=_compute_coverage(after, claimed),
        temperatures=_group_by_temperature(rows, after),
        simulated=observations.simulated,
    )


def check_same(model: DriftModel, observations: Observations) -> None:
    """SessionError when the observations are of another camera, or of images of another size."""
    facts, serial = model.facts, observations.sessions[0].camera_serial
    if serial != facts.camera_serial:
        raise SessionError(f"the model is of camera {facts.camera_serial}, the session of camera {serial}")
    if observations.image_size != facts.image_size:
        raise SessionError(f"the model is of images of {facts.image_size} px, the session of {observations.image_size}")


def _cross_validate(model: DriftModel, observations: Observations) -> tuple[Displacements, Float]:
    """The rows at set-points, and their residuals (M, 2) of new fits of the same form."""
    if isinstance(model, ThermalModel):
        return cross_validate_thermal(model, observations)
    rows = compute_displacements(observations, observations.of(Role.REFERENCE, Role.FIT))
    degree = model.degree if isinstance(model, PaperModel) else 1
    list_degrees(rows, degree)
    try:
        return rows, compute_left_out_residuals(rows, degree, make_scaling(observations, rows))
    except np.linalg.LinAlgError as error:
        raise SessionError(f"the markers do not determine a polynomial of degree {degree}") from error


def _select_answered(rows: Displacements, after: Float) -> tuple[Displacements, Float]:
    """Return what the model had an answer for; it has none where the thermal state is unknown."""
    known: Mask = np.isfinite(after[:, 0])
    if not known.any():
        raise SessionError("no markers are left to score the model with")
    return rows.where(known), after[known]


def _compute_coverage(after: Float, claimed: Float) -> Pair:
    return make_pair((np.abs(after) <= _SIGMA_95 * np.sqrt(claimed)).mean(axis=0))


def _group_by_temperature(rows: Displacements, after: Float) -> tuple[TemperatureRms, ...]:
    found: list[TemperatureRms] = []
    for chamber_degC in np.unique(rows.chamber_degC):
        here = rows.chamber_degC == chamber_degC
        frames, first = np.unique(rows.frame[here], return_index=True)
        found.append(
            TemperatureRms(
                chamber_degC=float(chamber_degC),
                camera_degC=float(rows.camera_degC[here][first].mean()),
                frames=len(frames),
                before_px=compute_rms_px(rows.displacement_px[here]),
                after_px=compute_rms_px(after[here]),
            )
        )
    return tuple(found)


def compute_improvement_percent(before_px: float, after_px: float) -> float:
    """Return by how much the RMS has shrunk, %; negative when it has grown, NaN when it was 0 before."""
    return 100 * (1 - after_px / before_px) if before_px > 0 else float("nan")


def format_table(evaluation: Evaluation) -> str:
    """The paper's result and ours side by side, as text."""
    name = "this session (simulated)" if evaluation.simulated else "this session"
    width = len(name) + 2
    lines = [
        "RMS deviation from the reference position, px",
        f"{'':<{width}}{'along I':>26}{'along J':>30}",
        f"{'':<{width}}" + 2 * f"{'before':>10}{'after':>10}{'gain':>8}  ",
        f"{'paper':<{width}}" + _format_cells(PAPER_BEFORE_PX, PAPER_AFTER_PX),
        f"{name:<{width}}" + _format_cells(evaluation.rms_before_px, evaluation.rms_after_px),
        f"{evaluation.frames} frames; {evaluation.question}; {evaluation.method}",
    ]
    return "\n".join(line.rstrip() for line in lines)


def _format_cells(before: Pair, after: Pair) -> str:
    pairs = zip(before, after, strict=True)
    return "".join(f"{b:10.3f}{a:10.3f}{compute_improvement_percent(b, a):6.0f} %  " for b, a in pairs)
