"""The numbers of a report, from what was recorded, fitted and scored."""

from __future__ import annotations

import importlib.metadata
import json
import math
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime

import numpy as np

from thermostand.compensation.drift.bump import Bump
from thermostand.compensation.drift.bumps import around_bumps, find_bumps
from thermostand.compensation.drift.candidates import pair_of, rms_px
from thermostand.compensation.drift.displacements import displacements
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import PAPER_AFTER_PX, PAPER_BEFORE_PX, Evaluation, improvement_percent
from thermostand.compensation.drift.hysteresis import hysteresis
from thermostand.compensation.drift.thermal_model import ThermalModel
from thermostand.compensation.drift.training import frame_states
from thermostand.compensation.drift.unrepeated import find_unrepeated
from thermostand.compensation.observations import Float, Mask, Observations
from thermostand.compensation.reporting.equipment import stated
from thermostand.compensation.reporting.extras import Extras
from thermostand.compensation.reporting.formula import formula_of
from thermostand.compensation.reporting.numbers import (
    FORMAT,
    BumpNumbers,
    ModelNumbers,
    Numbers,
    Pair,
    ScoreNumbers,
    SessionNumbers,
    UnusableFrames,
    WarmUpNumbers,
)
from thermostand.compensation.reporting.tracks import WarmUp, warm_ups
from thermostand.compensation.validation3d.document import as_json as validation_json
from thermostand.experiments.steps import Role
from thermostand.markers.detection import Flag

PAPER_WARM_UP_PX = (0.3, 1.1)
"""Mean drift of the paper's camera, not modified, while it warmed itself by 20 K at 24 degC (section 3.1)."""

_LIBRARIES = ("thermostand", "numpy", "scipy", "opencv-python-headless", "matplotlib")


def numbers_of(
    observations: Observations,
    model: DriftModel | None,
    evaluation: Evaluation | None,
    extras: Extras | None = None,
) -> Numbers:
    """Everything that the report says."""
    extras = extras or Extras()
    validation = extras.validation
    bumps = find_bumps(observations) if model is None else model.facts.bumps
    return Numbers(
        format=FORMAT,
        versions={name: importlib.metadata.version(name) for name in _LIBRARIES},
        measured_with=dict([*stated(extras.details, observations.target), *extras.equipment]),
        camera=observations.sessions[0].camera_serial,
        target=observations.target.name,
        simulated=observations.simulated,
        image_px=observations.image_size,
        sessions=tuple(_session(observations, index) for index in range(len(observations.sessions))),
        unusable=tuple(_unusable(observations)),
        warm_ups=tuple(_warm_up(observations, one, model) for one in warm_ups(observations)),
        score=None if evaluation is None else _score(evaluation),
        hysteresis_before=hysteresis(observations),
        hysteresis_after=() if model is None else hysteresis(observations, model),
        model=None if model is None else _model(model),
        budgets=dict(extras.budgets),
        positions=extras.positions,
        bumps=tuple(_bumps(observations, bumps)),
        unrepeated=find_unrepeated(observations, bumps),
        validation=None if validation is None else json.loads(validation_json(validation)),
        paper={"before_px": PAPER_BEFORE_PX, "after_px": PAPER_AFTER_PX, "warm_up_px": PAPER_WARM_UP_PX},
    )


def _bumps(observations: Observations, bumps: Sequence[Bump]) -> Iterator[BumpNumbers]:
    utc = {facts.session_id: facts.utc for facts in observations.sessions}
    for bump in bumps:
        if bump.session_id in utc:
            at_ns = bump.after_ns, bump.before_ns
            at = [_instant(utc[bump.session_id].utc_ns(ns)) for ns in at_ns]
            moved = bump.motions_px, bump.sigma_px
            yield BumpNumbers(bump.session_id, at[0], at[1], *at_ns, *moved, bump.marker, bump.text)


def _session(observations: Observations, index: int) -> SessionNumbers:
    facts, own = observations.sessions[index], observations.session == index
    used = own & observations.usable
    flags = observations.flags[used]
    by_flag = {(flag.name or "").lower().replace("_", " "): int(((flags & flag) != 0).sum()) for flag in Flag}
    by_role = {str(role): int((own & (observations.role == str(role))).sum()) for role in Role}
    return SessionNumbers(
        session_id=facts.session_id,
        recipe=facts.recipe,
        operator=facts.operator,
        software_version=facts.software_version,
        simulated=facts.simulated,
        incomplete_segments=facts.incomplete,
        begin=_instant(facts.utc.utc_ns(int(observations.time_ns[own][0]))),
        end=_instant(facts.utc.utc_ns(int(observations.time_ns[own][-1]))),
        frames=int(own.sum()),
        frames_by_role={role: count for role, count in by_role.items() if count},
        unusable=int((own & ~observations.usable).sum()),
        chamber_degC=_set_points(observations, own),
        camera_degC=_extent(observations.camera_degC[used]),
        centres=flags.size,
        set_aside=int(np.count_nonzero(flags)),
        flags={flag: count for flag, count in by_flag.items() if count},
        doubtful=facts.doubtful,
    )


def _instant(utc_ns: int) -> str:
    return datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).isoformat()


def _set_points(observations: Observations, own: Mask) -> tuple[float, ...]:
    found = observations.chamber_degC[own]
    return tuple(np.unique(found[np.isfinite(found)]).tolist())


def _extent(values: Float) -> Pair:
    return (float(values.min()), float(values.max())) if len(values) else (math.nan, math.nan)


def _unusable(observations: Observations) -> Iterator[UnusableFrames]:
    for index, facts in enumerate(observations.sessions):
        found: dict[str, list[int]] = {}
        for row in np.flatnonzero((observations.session == index) & ~observations.usable).tolist():
            found.setdefault(observations.reasons[row], []).append(int(observations.frame[row]))
        for reason, frames in sorted(found.items(), key=lambda item: (-len(item[1]), item[1][0])):
            yield UnusableFrames(facts.session_id, reason, tuple(frames))


def _warm_up(observations: Observations, one: WarmUp, model: DriftModel | None) -> WarmUpNumbers:
    track = one.track
    camera_degC = observations.camera_degC[track.frames]
    mean = track.mean_px[np.isfinite(track.mean_px).all(axis=1)]
    i, j = (mean[-1] - mean[0]).tolist() if len(mean) else (math.nan, math.nan)
    return WarmUpNumbers(
        session_id=observations.sessions[track.session].session_id,
        frames=len(track.frames),
        roll_deg=track.roll_deg,
        power_on_known=one.power_on_known,
        begin_s=float(one.since_on_s[0]),
        end_s=float(one.since_on_s[-1]),
        camera_degC=(float(camera_degC[0]), float(camera_degC[-1])),
        drift_px=(i, j),
        left_px=(math.nan, math.nan) if model is None else _left_px(observations, one, model),
    )


def _left_px(observations: Observations, one: WarmUp, model: DriftModel) -> Pair:
    """NaN for a camera that stood differently at the reference, and where the model has no answer."""
    frames = np.zeros(len(observations.frame), bool)
    frames[one.track.frames] = True
    observations = around_bumps(observations, model.facts.bumps)
    if not one.track.shares_reference:
        return math.nan, math.nan
    rows = displacements(observations, frames)
    states = frame_states(observations, model.memory).where(rows.frame)
    left = rows.displacement_px - model.shift(rows.measured_px, states)
    known = left[np.isfinite(left).all(axis=1)]
    return rms_px(known) if len(known) else (math.nan, math.nan)


def _score(evaluation: Evaluation) -> ScoreNumbers:
    before, after = evaluation.rms_before_px, evaluation.rms_after_px
    return ScoreNumbers(
        method=evaluation.method,
        frames=evaluation.frames,
        centres=len(evaluation.after_px),
        before_px=before,
        after_px=after,
        gain_percent=(improvement_percent(before[0], after[0]), improvement_percent(before[1], after[1])),
        marker_sigma_px=rms_px(np.sqrt(evaluation.rows.variance_px2)),
        claimed_sigma_px=rms_px(np.sqrt(evaluation.claimed_px2)),
        coverage_95=evaluation.coverage_95,
        outside=float(evaluation.outside.mean()),
        temperatures=evaluation.temperatures,
    )


def _model(model: DriftModel) -> ModelNumbers:
    facts = model.facts
    known = model.between_nights if isinstance(model, ThermalModel) else None
    return ModelNumbers(
        form=model.form,
        title=model.title,
        reference_degC=facts.reference_degC,
        reference_chamber_degC=facts.reference_chamber_degC,
        camera_range_degC=facts.camera_range_degC,
        hull_px=tuple((x, y) for x, y in facts.hull_px.tolist()),
        discrepancy_px=pair_of(model.discrepancy_px),
        between_nights_px=None if known is None else known.sigma_px,
        nights_compared=0 if known is None else known.nights,
        session_ids=facts.session_ids,
        software_version=facts.software_version,
        formula=formula_of(model),
        candidates=model.candidates,
    )
