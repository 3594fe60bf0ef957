"""Every number of the report, as report.json has them: the page is written from these, so that both say the same.

Pairs are along I and J. What is not known is NaN here and null there. compensation/reporting/gather.py fills them.
"""

from __future__ import annotations

import json
import math
import re
from dataclasses import dataclass

from thermostand.compensation.budget.budget import Budget
from thermostand.compensation.drift.candidates import Candidate
from thermostand.compensation.drift.evaluation import TemperatureRms
from thermostand.compensation.drift.hysteresis import Hysteresis
from thermostand.compensation.drift.unrepeated import Unrepeated
from thermostand.compensation.observations import Float
from thermostand.compensation.reporting.table_positions import TablePositions
from thermostand.foundation.json_values import plain

FORMAT = "thermostand report 1"
Pair = tuple[float, float]


@dataclass(frozen=True, slots=True)
class SessionNumbers:
    """frames_by_role, flags: how many of each. centres: in usable frames; set_aside: of them, with a flag.
    doubtful: frames that the noise model does not describe."""

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
    set_aside: int
    flags: dict[str, int]
    doubtful: int


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
    """RMS deviations before and after. marker_sigma_px: RMS standard uncertainty of a measured deviation without a
    model. claimed_sigma_px: of a compensated one, as model and markers claim it. coverage_95: part of the deviations in
    the 95 % interval. outside: part of the centres beyond the model's valid range."""

    method: str
    frames: int
    centres: int
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
    session's own instants after_ns and before_ns. motions_px, sigma_px (4,): as in compensation/drift/bump.py. marker:
    the one that moved alone, from 0."""

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
    """candidates: every form tried, with its errors at temperatures left out. between_nights_px: what a night that was
    not fitted adds, None where that is not known; with nights_compared 0 it was assumed, not measured."""

    form: str
    title: str
    reference_degC: float
    reference_chamber_degC: float
    camera_range_degC: Pair
    hull_px: tuple[Pair, ...]
    discrepancy_px: Pair
    between_nights_px: Pair | None
    nights_compared: int
    session_ids: tuple[str, ...]
    software_version: str
    formula: FormulaNumbers
    candidates: tuple[Candidate, ...]


@dataclass(frozen=True, slots=True)
class Numbers:
    """The whole of it; model, score: None without one. hysteresis: before compensation and, with a model, after.
    measured_with: as recorded and as stated. budgets: the stand's, by session id. positions: of the table. validation:
    as `compensate validate` writes it, None without one. paper: its figures, px."""

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
    unrepeated: tuple[Unrepeated, ...]
    validation: object
    paper: dict[str, Pair]


def percent(value: float, digits: int = 1) -> str:
    """A share as a text that never says all, or none, of what is not."""
    step = 10.0**-digits
    if 100 - step / 2 <= value < 100:
        return f"> {100 - step:.{digits}f} %"
    if 0 < value < step / 2:
        return f"< {step:.{digits}f} %"
    return f"{value:z.{digits}f} %"


def measured(value: float, expanded: float) -> tuple[str, str]:
    """Value and U as texts, U with two significant digits and the value with as many decimals."""
    if not expanded > 0:
        return f"{value:.4g}", "–"
    digits = 1 - math.floor(math.log10(expanded))
    if round(expanded, digits) >= 10 ** (2 - digits):  # 0.0996 becomes 0.10
        digits -= 1
    places = max(digits, 0)
    return f"{round(value, digits):z.{places}f}".replace("-", "−"), f"{round(expanded, digits):.{places}f}"


def significant(value: float, digits: int) -> str:
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


def compact(value: float, u: float) -> str:
    """As 0.0611(81): the digits in brackets are the standard uncertainty of the last ones."""
    if not u > 0 or not math.isfinite(value):
        return f"{value:.4g}"
    text, uncertain = measured(value, u)
    return f"{text}({uncertain.lstrip('0.') or '0'})" if u < 1 else f"{text}({uncertain})"


def as_json(numbers: Numbers) -> str:
    """The text of report.json: keys are the names of the fields."""
    return json.dumps(plain(numbers), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
