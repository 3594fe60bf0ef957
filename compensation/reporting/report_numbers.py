"""Every number of the report, as report.json has them: the page is written from these, so that both say the same.

Pairs are along I and J. What is not known is NaN here and null there.
"""

from __future__ import annotations

import importlib.metadata
import json
import math
import re
import shlex
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

from thermostand.compensation.budget.budget import Budget
from thermostand.compensation.calibration.session_centres import list_visits
from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.compensation.drift.bumps import UnrepeatedMotion, correct_bumps, find_bumps, find_unrepeated
from thermostand.compensation.drift.candidates import Candidate, compute_rms_px, make_pair
from thermostand.compensation.drift.displacements import average_reference_centres, compute_displacements
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import (
    PAPER_AFTER_PX,
    PAPER_BEFORE_PX,
    Evaluation,
    TemperatureRms,
    compute_improvement_percent,
    evaluate,
)
from thermostand.compensation.drift.hysteresis import Hysteresis, compute_hysteresis
from thermostand.compensation.drift.model_facts import Bump
from thermostand.compensation.drift.paper_model import PaperModel, fit_paper, list_exponents
from thermostand.compensation.drift.thermal_model import TermGroup, ThermalModel
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.expression import SPAN_K
from thermostand.compensation.observations import Float, Mask, Observations
from thermostand.compensation.reporting.equipment import Line, list_stated_details
from thermostand.compensation.reporting.tracks import WarmUpTrack, find_warm_ups
from thermostand.compensation.validation3d.document import serialise_validation as validation_json
from thermostand.compensation.validation3d.validate import SpatialValidation
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepMark
from thermostand.foundation.json_values import make_plain
from thermostand.foundation.version import read_commit
from thermostand.markers.detection import Flag

FORMAT = "thermostand report 1"
Pair = tuple[float, float]


@dataclass(frozen=True, slots=True)
class TablePositions:
    """(linear mm, rotary deg) of the captures, each place once, in order of the first visit; poses are V0, V1, ..."""

    calibration: tuple[tuple[float, float], ...] = ()
    poses: tuple[tuple[float, float], ...] = ()


@dataclass(frozen=True, slots=True)
class SessionNumbers:
    """frames_by_role, flags: how many of each. centres: in usable frames; set_aside: of them, with a flag.
    suspect: frames that the noise model does not describe. sha256: of the session's manifest."""

    session_id: str
    recipe: str
    operator: str
    software_version: str
    simulated: bool | None
    incomplete_segments: int
    begin: str
    end: str
    frames: int
    frames_by_role: dict[str, int]
    unusable: int
    chamber_degC: tuple[float, ...]
    camera_degC: Pair
    centres: int
    excluded: int
    flags: dict[str, int]
    suspect: int
    sha256: str


@dataclass(frozen=True, slots=True)
class UnusableFrames:
    """Frames of a session, numbered from 0, that were left out for the same reason."""

    session_id: str
    reason: str
    frames: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class WarmUpNumbers:
    """roll_deg: relative to the first frame of all. begin_s, end_s: of first and last frame, since the camera was
    switched on (or, when that is not known, since the first frame). drift_px: mean over the markers, last minus first.
    left_px: RMS that the model leaves of the deviations from the reference, NaN without one.
    """

    session_id: str
    frames: int
    roll_deg: float
    power_on_known: bool
    begin_s: float
    end_s: float
    camera_degC: Pair
    drift_px: Pair
    left_px: Pair


@dataclass(frozen=True, slots=True)
class ScoreNumbers:
    """RMS deviations before and after. question: what the model was asked. mm_per_px: at the target, by which the
    deviations are the paper's of figure 12, in mm. marker_sigma_px: RMS standard uncertainty of a measured deviation
    without a model. claimed_sigma_px: of a compensated one, as model and markers claim it. coverage_95: part of the
    deviations in the 95 % interval. outside: part of the centres beyond the model's valid range."""

    question: str
    method: str
    frames: int
    centres: int
    mm_per_px: float
    before_px: Pair
    after_px: Pair
    gain_percent: Pair
    marker_sigma_px: Pair
    claimed_sigma_px: Pair
    coverage_95: Pair
    outside: float
    temperatures: tuple[TemperatureRms, ...]


@dataclass(frozen=True, slots=True)
class BumpNumbers:
    """A step of the image that no thermal state explains, between the frames at `after` and `before`, the same as the
    session's own instants after_ns and before_ns. motions_px, sigma_px (4,): as in
    compensation/drift/model_facts.py. marker: the one that moved alone, from 0."""

    session_id: str
    after: str
    before: str
    after_ns: int
    before_ns: int
    motions_px: tuple[float, ...]
    sigma_px: tuple[float, ...]
    marker: int | None
    text: str


@dataclass(frozen=True, slots=True, eq=False)
class FormulaNumbers:
    """lines: the formula. coefficients_px, sigma_px (H, K): a row for each of `terms`, a column for each of `heads`.
    reference: value of each term at the reference, to be subtracted; empty where nothing is."""

    lines: tuple[str, ...]
    heads: tuple[str, ...]
    terms: tuple[str, ...]
    coefficients_px: Float
    sigma_px: Float
    reference: tuple[float, ...] = ()


@dataclass(frozen=True, slots=True)
class ModelNumbers:
    """candidates: every form tried, with its errors at temperatures left out. between_sessions_px: what a session that
    was not fitted adds, None where that is not known; with sessions_compared 0 it was assumed, not measured.
    effective_parameters: how many coefficients the data determine, groups: of each kind of term."""

    form: str
    title: str
    reference_degC: float
    reference_chamber_degC: float
    camera_range_degC: Pair
    hull_px: tuple[Pair, ...]
    discrepancy_px: Pair
    between_sessions_px: Pair | None
    sessions_compared: int
    session_ids: tuple[str, ...]
    software_version: str
    formula: FormulaNumbers
    candidates: tuple[Candidate, ...]
    effective_parameters: float
    groups: tuple[TermGroup, ...]


@dataclass(frozen=True, slots=True, eq=False)
class PaperFormNumbers:
    """The paper's polynomial of degree 4, fitted to the same frames: what it gains at the same held-out temperatures,
    and its formula."""

    degree: int
    score: ScoreNumbers
    formula: FormulaNumbers


@dataclass(frozen=True, slots=True)
class ProvenanceNumbers:
    """What made the report. commit: of the program, "" where it is not known. command: the line it was called by."""

    version: str
    commit: str
    command: str


@dataclass(frozen=True, slots=True)
class ReportNumbers:
    """The whole of it; model, score: None without one. hysteresis: before compensation and, with a model, after.
    measured_with: as recorded and as stated. budgets: the stand's, by session id. positions: of the table. validation:
    as `compensate validate` writes it, None without one. paper: its figures, px. paper_form: None where the frames do
    not support it."""

    format: str
    versions: dict[str, str]
    measured_with: dict[str, str]
    camera: str
    target: str
    simulated: bool
    image_px: tuple[int, int]
    sessions: tuple[SessionNumbers, ...]
    unusable: tuple[UnusableFrames, ...]
    warm_ups: tuple[WarmUpNumbers, ...]
    score: ScoreNumbers | None
    hysteresis_before: tuple[Hysteresis, ...]
    hysteresis_after: tuple[Hysteresis, ...]
    model: ModelNumbers | None
    budgets: dict[str, Budget]
    positions: TablePositions
    bumps: tuple[BumpNumbers, ...]
    unrepeated: tuple[UnrepeatedMotion, ...]
    validation: object
    paper: dict[str, Pair]
    paper_form: PaperFormNumbers | None
    made_by: ProvenanceNumbers


@dataclass(frozen=True, slots=True)
class Extras:
    """budgets: the stand's, by session id. positions: where the table stood. validation: in three dimensions.
    equipment: as the sessions record it. details: as an operator has stated them."""

    budgets: Mapping[str, Budget] = field(default_factory=dict[str, Budget])
    positions: TablePositions = field(default_factory=TablePositions)
    validation: SpatialValidation | None = None
    equipment: Sequence[Line] = ()
    details: MeasurementDetails = field(default_factory=MeasurementDetails)


PAPER_WARM_UP_PX = (0.3, 1.1)
"""Mean drift of the paper's camera, not modified, while it warmed itself by 20 K at 24 degC (section 3.1)."""

PAPER_DEGREE = 4
"""Of its polynomial (section 6.2)."""

_LIBRARIES = ("thermostand", "numpy", "scipy", "opencv-python-headless", "matplotlib")


def collect_numbers(
    observations: Observations,
    model: DriftModel | None,
    evaluation: Evaluation | None,
    extras: Extras | None = None,
) -> ReportNumbers:
    """Everything that the report says."""
    extras = extras or Extras()
    validation = extras.validation
    bumps = find_bumps(observations) if model is None else model.facts.bumps
    mm_per_px = _compute_mm_per_px(observations)
    return ReportNumbers(
        format=FORMAT,
        versions={name: importlib.metadata.version(name) for name in _LIBRARIES},
        measured_with=dict([*list_stated_details(extras.details, observations.target), *extras.equipment]),
        camera=observations.sessions[0].camera_serial,
        target=observations.target.name,
        simulated=observations.simulated,
        image_px=observations.image_size,
        sessions=tuple(_summarise_session(observations, index) for index in range(len(observations.sessions))),
        unusable=tuple(_list_unusable(observations)),
        warm_ups=tuple(_summarise_warm_up(observations, one, model) for one in find_warm_ups(observations)),
        score=None if evaluation is None else _summarise_score(evaluation, mm_per_px),
        hysteresis_before=compute_hysteresis(observations),
        hysteresis_after=() if model is None else compute_hysteresis(observations, model),
        model=None if model is None else _describe_model(model),
        budgets=dict(extras.budgets),
        positions=extras.positions,
        bumps=tuple(_list_bumps(observations, bumps)),
        unrepeated=find_unrepeated(observations, bumps),
        validation=None if validation is None else json.loads(validation_json(validation)),
        paper={"before_px": PAPER_BEFORE_PX, "after_px": PAPER_AFTER_PX, "warm_up_px": PAPER_WARM_UP_PX},
        paper_form=None if model is None or evaluation is None else _score_paper_form(observations, model, mm_per_px),
        made_by=ProvenanceNumbers(
            importlib.metadata.version("thermostand"),
            read_commit(),
            shlex.join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        ),
    )


def _compute_mm_per_px(observations: Observations) -> float:
    """At the target, of its markers at the reference: the root of the ratio of their scatters."""
    centres_px = average_reference_centres(observations)[0]
    places_px = centres_px[np.isfinite(centres_px).any(axis=(1, 2))]
    if not len(places_px):
        return math.nan
    seen = np.isfinite(places_px[0]).all(axis=1)
    scatter = [
        float(((places - places.mean(axis=0)) ** 2).sum())
        for places in (observations.target.coordinates_mm()[seen], places_px[0][seen])
    ]
    return math.sqrt(scatter[0] / scatter[1]) if scatter[1] > 0 else math.nan


def _score_paper_form(observations: Observations, model: DriftModel, mm_per_px: float) -> PaperFormNumbers | None:
    """None of a session that the model was not fitted to: its own frames would teach the polynomial what they ask."""
    if not {one.session_id for one in observations.sessions} <= set(model.facts.session_ids):
        return None
    try:
        paper = fit_paper(correct_bumps(observations, model.facts.bumps), PAPER_DEGREE)
        paper = replace(paper, facts=replace(paper.facts, bumps=model.facts.bumps))
        score = _summarise_score(evaluate(paper, observations), mm_per_px)
    except SessionError:
        return None
    return PaperFormNumbers(PAPER_DEGREE, score, describe_formula(paper))


def _list_bumps(observations: Observations, bumps: Sequence[Bump]) -> Iterator[BumpNumbers]:
    utc = {facts.session_id: facts.utc for facts in observations.sessions}
    for bump in bumps:
        if bump.session_id in utc:
            after, before = (_format_instant(utc[bump.session_id].utc_ns(ns)) for ns in (bump.after_ns, bump.before_ns))
            yield BumpNumbers(**bump.model_dump(), after=after, before=before, text=bump.text)


def _summarise_session(observations: Observations, index: int) -> SessionNumbers:
    facts, own = observations.sessions[index], observations.session == index
    used = own & observations.usable
    flags = observations.flags[used]
    by_flag = {(flag.name or "").lower().replace("_", " "): int(((flags & flag) != 0).sum()) for flag in Flag}
    by_role = {str(role): int((own & (observations.role == str(role))).sum()) for role in Role}
    instants = [facts.utc.utc_ns(int(time_ns)) for time_ns in observations.time_ns[own][[0, -1]]]
    begin, end = ("", "") if "times" in observations.not_known else map(_format_instant, instants)
    return SessionNumbers(
        session_id=facts.session_id,
        recipe=facts.recipe,
        operator=facts.operator,
        software_version=facts.software_version,
        simulated=facts.simulated,
        incomplete_segments=facts.incomplete,
        begin=begin,
        end=end,
        frames=int(own.sum()),
        frames_by_role={role: count for role, count in by_role.items() if count},
        unusable=int((own & ~observations.usable).sum()),
        chamber_degC=_list_set_points(observations, own),
        camera_degC=_compute_extent(observations.camera_degC[used]),
        centres=flags.size,
        excluded=int(np.count_nonzero(flags)),
        flags={flag: count for flag, count in by_flag.items() if count},
        suspect=facts.suspect,
        sha256=facts.sha256,
    )


def _format_instant(utc_ns: int) -> str:
    return datetime.fromtimestamp(utc_ns // 1_000_000_000, UTC).isoformat()


def _list_set_points(observations: Observations, own: Mask) -> tuple[float, ...]:
    found = observations.chamber_degC[own]
    return tuple(np.unique(found[np.isfinite(found)]).tolist())


def _compute_extent(values: Float) -> Pair:
    return (float(values.min()), float(values.max())) if len(values) else (math.nan, math.nan)


def _list_unusable(observations: Observations) -> Iterator[UnusableFrames]:
    for index, facts in enumerate(observations.sessions):
        found: dict[str, list[int]] = {}
        for row in np.flatnonzero((observations.session == index) & ~observations.usable).tolist():
            found.setdefault(observations.reasons[row], []).append(int(observations.frame[row]))
        for reason, frames in sorted(found.items(), key=lambda item: (-len(item[1]), item[1][0])):
            yield UnusableFrames(facts.session_id, reason, tuple(frames))


def _summarise_warm_up(observations: Observations, one: WarmUpTrack, model: DriftModel | None) -> WarmUpNumbers:
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
        left_px=(math.nan, math.nan) if model is None else _compute_warm_up_residual_px(observations, one, model),
    )


def _compute_warm_up_residual_px(observations: Observations, one: WarmUpTrack, model: DriftModel) -> Pair:
    """NaN for a camera that stood differently at the reference, and where the model has no answer."""
    frames = np.zeros(len(observations.frame), bool)
    frames[one.track.frames] = True
    observations = correct_bumps(observations, model.facts.bumps)
    if not one.track.shares_reference:
        return math.nan, math.nan
    rows = compute_displacements(observations, frames)
    states = compute_frame_states(observations, model.memory).where(rows.frame)
    left = rows.displacement_px - model.shift(rows.measured_px, states)
    known = left[np.isfinite(left).all(axis=1)]
    return compute_rms_px(known) if len(known) else (math.nan, math.nan)


def _summarise_score(evaluation: Evaluation, mm_per_px: float) -> ScoreNumbers:
    before, after = evaluation.rms_before_px, evaluation.rms_after_px
    return ScoreNumbers(
        question=evaluation.question,
        method=evaluation.method,
        frames=evaluation.frames,
        centres=len(evaluation.after_px),
        mm_per_px=mm_per_px,
        before_px=before,
        after_px=after,
        gain_percent=(
            compute_improvement_percent(before[0], after[0]),
            compute_improvement_percent(before[1], after[1]),
        ),
        marker_sigma_px=compute_rms_px(np.sqrt(evaluation.rows.variance_px2)),
        claimed_sigma_px=compute_rms_px(np.sqrt(evaluation.claimed_px2)),
        coverage_95=evaluation.coverage_95,
        outside=float(evaluation.outside.mean()),
        temperatures=evaluation.temperatures,
    )


def _describe_model(model: DriftModel) -> ModelNumbers:
    facts = model.facts
    known = model.between_sessions if isinstance(model, ThermalModel) else None
    return ModelNumbers(
        form=model.form,
        title=model.title,
        reference_degC=facts.reference_degC,
        reference_chamber_degC=facts.reference_chamber_degC,
        camera_range_degC=facts.camera_range_degC,
        hull_px=tuple((x, y) for x, y in facts.hull_px.tolist()),
        discrepancy_px=make_pair(model.discrepancy_px),
        between_sessions_px=None if known is None else known.sigma_px,
        sessions_compared=0 if known is None else known.sessions,
        session_ids=facts.session_ids,
        software_version=facts.software_version,
        formula=describe_formula(model),
        candidates=model.candidates,
        effective_parameters=model.effective_parameters
        if isinstance(model, ThermalModel)
        else float(describe_formula(model).coefficients_px.size),
        groups=model.groups if isinstance(model, ThermalModel) else (),
    )


_MOTIONS = ("a₁", "a₂", "a₃", "a₄", "a₅", "a₆", "a₇", "a₈")


def describe_formula(model: DriftModel) -> FormulaNumbers:
    """TypeError for a form that is not known here."""
    match model:
        case PaperModel():
            return _describe_paper_formula(model)
        case ThermalModel():
            return _describe_thermal_formula(model)
        case _:
            raise TypeError(f"no formula for a model of form {model.form}")


def _describe_paper_formula(model: PaperModel) -> FormulaNumbers:
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
    names = tuple(f"T{a}(i) T{b}(j) T{c}(t)" for a, b, c in list_exponents(model.degree))
    return FormulaNumbers(lines, ("c(I), px", "c(J), px"), names, model.coefficients.T, sigma.T)


def _describe_thermal_formula(model: ThermalModel) -> FormulaNumbers:
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


def format_percent(value: float, digits: int = 1) -> str:
    """A share as a text that never says all, or none, of what is not."""
    step = 10.0**-digits
    if 100 - step / 2 <= value < 100:
        return f"> {100 - step:.{digits}f} %"
    if 0 < value < step / 2:
        return f"< {step:.{digits}f} %"
    return f"{value:z.{digits}f} %"


def format_with_expanded_uncertainty(value: float, expanded: float) -> tuple[str, str]:
    """Value and U as texts, U with two significant digits and the value with as many decimals."""
    if not expanded > 0:
        return f"{value:.4g}", "–"
    digits = 1 - math.floor(math.log10(expanded))
    if round(expanded, digits) >= 10 ** (2 - digits):  # 0.0996 becomes 0.10
        digits -= 1
    places = max(digits, 0)
    return f"{round(value, digits):z.{places}f}".replace("-", "−"), f"{round(expanded, digits):.{places}f}"


def format_significant(value: float, digits: int) -> str:
    """Rounded to so many digits, in decimals: 0.000081 and 1400, where a format would say 8.1e-05 and 1.4e+03."""
    if not math.isfinite(value):
        return f"{value:g}"
    rounded, exponent = f"{value:.{digits - 1}e}".split("e")
    places = max(digits - 1 - int(exponent), 0)
    return f"{float(f'{rounded}e{exponent}'):z.{places}f}".replace("-", "−")


def typeset(text: str) -> str:
    """A form's name with signs and powers as they are printed."""
    text = text.replace("homography x ", "homography × ").replace("-", "−")
    return re.sub(r"\^(\d)", lambda found: "⁰¹²³⁴⁵⁶⁷⁸⁹"[int(found[1])], text)


def format_compact(value: float, u: float) -> str:
    """Write a value as 0.0611(81): the digits in brackets are the standard uncertainty of the last ones."""
    if not u > 0 or not math.isfinite(value):
        return f"{value:.4g}"
    text, uncertain = format_with_expanded_uncertainty(value, u)
    return f"{text}({uncertain.lstrip('0.') or '0'})" if u < 1 else f"{text}({uncertain})"


def list_table_positions(sessions: Sequence[Sequence[StepMark]]) -> TablePositions:
    """List the places in the steps of these sessions. SessionError when they do not record where the table stood."""
    return TablePositions(_list_places(sessions, Role.CALIBRATION), _list_places(sessions, Role.POSE))


def _list_places(sessions: Sequence[Sequence[StepMark]], role: Role) -> tuple[tuple[float, float], ...]:
    visits = [visit for steps in sessions for visit in list_visits(steps, {str(role)}).values()]
    return tuple(dict.fromkeys((visit.sent["linear"], visit.sent["rotary"]) for visit in visits))


def serialise_numbers(numbers: ReportNumbers) -> str:
    """The text of report.json: keys are the names of the fields."""
    return json.dumps(make_plain(numbers), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
