"""The numbers of a camera's thermal datasheet, from sessions that were recorded and a model fitted to them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.datasheet.measurement_details import MeasurementDetails
from thermostand.compensation.drift.bumps import correct_bumps
from thermostand.compensation.drift.displacements import average_reference_centres
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import Evaluation, evaluate
from thermostand.compensation.drift.hysteresis import Hysteresis, compute_hysteresis
from thermostand.compensation.drift.model_selection import FORMS
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.expression import AIR, lag
from thermostand.compensation.history.thermal_history import ThermalStateSpec
from thermostand.compensation.observations import Float, Mask, Observations
from thermostand.experiments.steps import Role
from thermostand.foundation.errors import SessionError

# A measured quantity with its uncertainty budget, after the GUM (JCGM 100:2008): contributions of type A (statistics
# of this measurement) and type B (anything else), each an input's standard uncertainty times a sensitivity coefficient.

COVERAGE = 2.0
"""Expanded uncertainties are this many standard ones: about 95 % of a normal distribution."""
BETWEEN_SESSIONS = "session to session"


@dataclass(frozen=True, slots=True)
class Contribution:
    """One line of a budget. u: standard uncertainty of the input, in its own unit. basis: how u is known. sensitivity:
    unit of the quantity per unit of the input, 1 where it is the same. dof: degrees of freedom of u, inf where it is
    not estimated. is_rectangular: the input is within +-sqrt(3) u with equal probability; else it is normal, and with
    few degrees of freedom Student's t."""

    source: str
    kind: Literal["A", "B"]
    u: float
    unit: str
    basis: str
    sensitivity: float = 1.0
    dof: float = math.inf
    is_rectangular: bool = False

    @property
    def amount(self) -> float:
        """The standard uncertainty that this contributes, in the quantity's unit."""
        return abs(self.sensitivity) * self.u


@dataclass(frozen=True, slots=True)
class MeasuredQuantity:
    """key: its name in the JSON file. model: the measurement equation, in words and symbols. group: the heading it
    stands under. value: NaN when it could not be measured, and `why` says so. correlations: pairs of sources and the
    correlation coefficient of their inputs; all others are uncorrelated. equation: the quantity for deviations
    (M, inputs) of the inputs of its first lines from their estimates, in their units; None where it is linear in
    all."""

    key: str
    group: str
    name: str
    unit: str
    model: str
    value: float = math.nan
    contributions: tuple[Contribution, ...] = ()
    why: str = ""
    correlations: tuple[tuple[str, str, float], ...] = ()
    equation: Callable[[Float], Float] | None = field(default=None, compare=False, repr=False)
    inputs: int = 0

    def found(self, value: float, *contributions: Contribution) -> MeasuredQuantity:
        """Return this quantity with that value and its budget."""
        return replace(self, value=value, contributions=contributions, why="")

    @property
    def correlation(self) -> Float:
        """(lines, lines): of the inputs of the contributions."""
        at = {line.source: place for place, line in enumerate(self.contributions)}
        matrix = np.eye(len(self.contributions))
        for one, other, coefficient in self.correlations:
            matrix[at[one], at[other]] = matrix[at[other], at[one]] = coefficient
        return matrix

    @property
    def u(self) -> float:
        """Combined standard uncertainty, with the correlations of the inputs (GUM, equation 16)."""
        if math.isnan(self.value):
            return math.nan
        amounts = np.array([one.sensitivity * one.u for one in self.contributions])
        return math.sqrt(max(float(amounts @ self.correlation @ amounts), 0.0))

    @property
    def dof(self) -> float:
        """Effective degrees of freedom (GUM, equation G.2b); NaN when it could not be measured."""
        fourths = sum(one.amount**4 / one.dof for one in self.contributions)
        return math.nan if math.isnan(self.value) else self.u**4 / fourths if fourths > 0 else math.inf

    @property
    def expanded(self) -> float:
        """U, k = 2."""
        return COVERAGE * self.u


def pool_sessions(by_session: Sequence[MeasuredQuantity]) -> MeasuredQuantity:
    """Return the mean of the same quantity over sessions.

    What the statistics of each session say shrinks with the number of sessions. What is of type B is common to all. How
    the sessions differ is a contribution of its own."""
    known = [one for one in by_session if not math.isnan(one.value)]
    if len(known) < 2:
        return known[0] if known else by_session[0]
    values = [one.value for one in known]
    count = len(known)
    lines: list[Contribution] = []
    for same in zip(*(one.contributions for one in known), strict=True):
        amounts = np.array([line.amount for line in same])
        session_rms = math.sqrt(float((amounts**2).mean()))
        amount = session_rms / math.sqrt(count) if same[0].kind == "A" else session_rms
        sensitivity = same[0].sensitivity or 1.0
        dof = sum(line.dof for line in same) if same[0].kind == "A" else same[0].dof
        lines.append(replace(same[0], u=amount / abs(sensitivity), sensitivity=sensitivity, dof=dof))
    spread = float(np.std(values, ddof=1)) / math.sqrt(count)
    basis = f"standard deviation of the mean of {count} sessions"
    lines.append(Contribution(BETWEEN_SESSIONS, "A", spread, known[0].unit, basis, dof=count - 1))
    return replace(known[0], value=float(np.mean(values)), contributions=tuple(lines))


# How the image as a whole has moved: shift at its middle, change of scale, turn, at each visit of a set-point and
# through a warm-up.

SET_POINTS = (Role.REFERENCE, Role.FIT, Role.VALIDATION)
MOTIONS = ("shift_I", "shift_J", "scale", "turn")
UNITS = ("px", "px", "ppm", "µrad")
_FEWEST_MARKERS = 4  # eight numbers for four motions
LAGS_S = (900.0, 1800.0, 3600.0, 7200.0, 14400.0, 28800.0)
"""In factors of two, from a small lens to an adhesive that creeps. Chosen on drawn cameras 2001 to 2080."""


@dataclass(frozen=True, slots=True, eq=False)
class Visits:
    """V visits of set-points of one session, in order of time. moved (V, 4): of MOTIONS, px, px, ppm, urad, from the
    session's reference. air_degC, camera_degC (V,). by_camera: the air is not known, and the camera's own temperature
    stands for it. behind_K (V, L): by what first-order followers of the air are above it, of time constants LAGS_S; L
    is 0 where the air's history is not known. time_ns (V,)."""

    air_degC: Float
    camera_degC: Float
    chamber_degC: Float
    moved: Float
    by_camera: bool = False
    behind_K: Float = field(default_factory=lambda: np.empty((0, 0)))
    time_ns: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, np.int64))

    @property
    def base_degC(self) -> Float:
        """(V,): what the image's motion is counted per K of."""
        return self.camera_degC if self.by_camera else self.air_degC


@dataclass(frozen=True, slots=True, eq=False)
class Warming:
    """F frames of a session's warm-up. since_s (F,): the supply came on; from the first frame when that is not recorded
    (`known` is False). moved (F, 4): as in Visits, from the first frame."""

    since_s: Float
    known: bool
    air_degC: Float
    camera_degC: Float
    moved: Float


def fit_motions(observations: Observations) -> Float:
    """(F, 4): of every usable frame from its session's reference, NaN elsewhere. Least squares of a similarity about
    the image's middle: dx = a + s x - r y, dy = b + s y + r x."""
    found = np.full((len(observations.frame), 4), np.nan)
    width, height = observations.image_size
    middle = np.array([(width - 1) / 2, (height - 1) / 2])
    reference = average_reference_centres(observations)[0]
    for frame in np.flatnonzero(observations.usable):
        start = reference[observations.session[frame]]
        found[frame] = fit_similarity(start, observations.centres_px[frame] - start, middle)
    return found


def fit_similarity(places: Float, moved: Float, middle: Float) -> Float:
    """(4,): of MOTIONS, by which points at places (N, 2), px, have moved (N, 2), NaN for those not seen; all NaN when
    fewer than four are."""
    seen = np.isfinite(moved).all(axis=1) & np.isfinite(places).all(axis=1)
    if seen.sum() < _FEWEST_MARKERS:
        return np.full(len(MOTIONS), np.nan)
    x, y = (places[seen] - middle).T
    one, zero = np.ones_like(x), np.zeros_like(x)
    terms = np.concatenate([np.stack([one, zero, x, -y], axis=1), np.stack([zero, one, y, x], axis=1)])
    fitted = np.linalg.lstsq(terms, moved[seen].T.ravel(), rcond=None)[0]
    return np.asarray(fitted * (1.0, 1.0, 1e6, 1e6), np.float64)


def collect_visits(observations: Observations, moved: Float, session: int) -> Visits:
    """Frames of one set-point that follow each other are a visit; those without markers, or without air in a
    session that has it, do not count."""
    own = observations.of(*SET_POINTS) & (observations.session == session) & np.isfinite(moved[:, 0])
    by_camera = not np.isfinite(observations.air_degC[own]).any()
    own &= by_camera | np.isfinite(observations.air_degC)
    behind = _follow_air(observations) - observations.air_degC[:, None]
    columns = np.column_stack(
        [observations.air_degC, observations.camera_degC, observations.chamber_degC, moved, behind]
    )
    groups = groupby(np.flatnonzero(own).tolist(), key=lambda k: float(observations.chamber_degC[k]))
    visits = [list(group) for _, group in groups]
    table = np.array([columns[at].mean(axis=0) for at in visits]).reshape(-1, columns.shape[1])
    known = table[:, 7:] if np.isfinite(table[:, 7:]).all() else np.empty((len(table), 0))
    middles = np.array([int(observations.time_ns[at[len(at) // 2]]) for at in visits], np.int64)
    return Visits(table[:, 0], table[:, 1], table[:, 2], table[:, 3:7], by_camera, known, middles)


def _follow_air(observations: Observations) -> Float:
    """(F, lags): first-order followers of the air near the camera, degC; NaN where its history is not known."""
    lags = [lag(AIR, tau_s) for tau_s in LAGS_S]
    return compute_frame_states(observations, ThermalStateSpec(tuple(lags))).of(lags)


def find_warm_up(observations: Observations, moved: Float, session: int) -> Warming | None:
    """The session's first warm-up; None without one at the reference's place."""
    own: Mask = observations.of(Role.WARM_UP) & (observations.session == session) & np.isfinite(moved[:, 0])
    frames = np.flatnonzero(own)
    if len(frames) < 5:
        return None
    first = observations.step_id[frames[0]]
    frames = np.array([frame for frame in frames.tolist() if observations.step_id[frame] == first])
    if len(frames) < 5 or np.abs(moved[frames, :2]).max() > 10:
        return None
    times_ns = observations.time_ns[frames]
    on_ns = observations.find_switch_on_ns(session, int(times_ns[0]))
    since_s = (times_ns - (int(times_ns[0]) if on_ns is None else on_ns)) / 1e9
    return Warming(
        since_s,
        on_ns is not None,
        observations.air_degC[frames],
        observations.camera_degC[frames],
        moved[frames] - moved[frames[0]],
    )


_FEWEST = 3  # a scatter of two has one degree of freedom


def compute_hysteresis_quantities(found: Hysteresis | None, scatter_px: Sequence[float]) -> list[MeasuredQuantity]:
    """RMS of heating minus cooling over set-points reached from both sides, mpx. scatter_px: what does not repeat."""
    group, title = "Dependence on the way", "Heating against cooling"
    model = "root mean square of (heating − cooling) over set-points reached from both sides, mean over the markers"
    why = "fewer than three set-points were reached from both sides"
    quantities = [
        MeasuredQuantity(f"hysteresis_{name}", group, f"{title}, {name}", "mpx", model, why=why) for name in "IJ"
    ]
    gaps = () if found is None else found.gaps
    if len(gaps) < _FEWEST:
        return quantities
    for axis, one in enumerate(quantities):
        differences = 1e3 * np.array([gap.difference_px[axis] for gap in gaps])
        noise = 1e3 * float(np.sqrt(np.mean([gap.uncertainty_px[axis] ** 2 for gap in gaps])))
        repeats = 1e3 * scatter_px[axis] * math.sqrt(2 / len(differences))
        quantities[axis] = one.found(
            _compute_rms(differences),
            Contribution(
                "choice of set-points",
                "A",
                _jackknife_uncertainty(differences, _compute_rms),
                "mpx",
                "each left out once",
            ),
            Contribution("noise of the markers", "A", noise / math.sqrt(len(gaps)), "mpx", "as the marker fit claims"),
            Contribution("what does not repeat", "A", repeats, "mpx", NOT_REPEATING),
        )
    return quantities


def compute_residual_quantities(
    form: str, evaluation: Evaluation | None, scatter_px: Sequence[float]
) -> Iterator[MeasuredQuantity]:
    """RMS along I and J at held-out set-points, mpx; the marker's noise of single frames is in it."""
    group, title = "Left after compensation", f"The {form} form"
    model = (
        "root mean square of (reference − corrected) over all centres at held-out set-points, with their noise in it"
    )
    for axis, name in enumerate("IJ"):
        key, title_here = f"left_{form}_{name}", f"{title}, {name}: RMS at held-out set-points"
        one = MeasuredQuantity(key, group, title_here, "mpx", model)
        if evaluation is None or len(evaluation.temperatures) < _FEWEST:
            why = "the sessions do not support this form, or have fewer than three set-points to score it"
            yield replace(one, why=why)
            continue
        each = 1e3 * np.array([row.after_px[axis] for row in evaluation.temperatures])
        value = 1e3 * evaluation.rms_after_px[axis]
        # What does not repeat adds to the residual as a square: it matters less the larger that is.
        repeats = math.sqrt(value**2 + (1e3 * scatter_px[axis]) ** 2 / len(each)) - value
        yield one.found(
            value,
            Contribution(
                "choice of set-points", "A", _jackknife_uncertainty(each, _compute_rms), "mpx", "each left out once"
            ),
            Contribution("what does not repeat", "A", repeats, "mpx", NOT_REPEATING),
        )


def _compute_rms(values: Float) -> float:
    return math.sqrt(float(np.mean(values**2)))


def _jackknife_uncertainty(values: Float, statistic: Callable[[Float], float]) -> float:
    """Standard uncertainty of a statistic of independent values."""
    count = len(values)
    without = np.array([statistic(np.delete(values, k)) for k in range(count)])
    return math.sqrt((count - 1) / count * float(((without - without.mean()) ** 2).sum()))


NAMES = ("Shift of the image, I (right)", "Shift of the image, J (down)", "Scale of the image", "Turn of the image")
_GROUP = "Temperature coefficients"
_FEWEST_VISITS = 8  # five coefficients are fitted to them
# At 0.9 the uncertainty grows by a factor of 4.4; at 1 it would be without bound.
_MOST_CORRELATION = 0.9
_MODEL = (
    "c of y = a + c (T − T0) + b (T − T0)² ± [d + f (T − T0)], + heating, − cooling, by least squares over all visits; "
    "T: {}, T0: at the reference"
)
_AIR_MODEL, _CAMERA_MODEL = _MODEL.format("air near the camera"), _MODEL.format("the camera's own sensor")
_BY_CAMERA = ", per K of the camera's own sensor"
_SPAN = "span of the temperature"
_TOO_FEW = "fewer than eight visits of four set-points with a known temperature"


@dataclass(frozen=True, slots=True, eq=False)
class Curve:
    """slope: at the reference, the mean of both branches. u_slope: of what the visits scatter about the curve, with the
    correlation of neighbours; dof: its degrees of freedom. branches: how much the heating branch's slope is above it,
    0 when there is one branch only. unsettled: how much the slope of a camera at rest is above it, by the follower of
    the air that explains the visits best; NaN without the air's history. scatter: standard deviation of a visit about
    the curve. span_K: of the air. left (V,): what the curve leaves."""

    slope: float
    u_slope: float
    dof: float
    branches: float
    unsettled: float
    scatter: float
    span_K: float
    left: Float


def fit_curve(visits: Visits, motion: int) -> Curve | None:
    """Fit the curve of a motion; None when the visits are too few to show how they scatter."""
    count = len(visits.base_degC)
    if count < _FEWEST_VISITS or len(np.unique(visits.chamber_degC)) < 4:
        return None
    away_K = visits.base_degC - visits.base_degC[0]
    side = np.sign(np.diff(visits.chamber_degC, prepend=visits.chamber_degC[0]))
    terms = np.stack([np.ones(count), away_K, away_K**2], axis=1)
    both = (side > 0).sum() > 1 and (side < 0).sum() > 1
    if both:
        terms = np.column_stack([terms, side, side * away_K])
    found, _, rank, _ = np.linalg.lstsq(terms, visits.moved[:, motion], rcond=None)
    if rank < terms.shape[1]:
        return None
    left = visits.moved[:, motion] - terms @ found
    scatter = math.sqrt(float(left @ left) / (count - rank))
    # What comes slowly makes neighbours alike: fewer visits are independent than there are.
    alike = float(left[1:] @ left[:-1]) / max(float(left @ left), 1e-30)
    alike = min(max(alike, 0.0), _MOST_CORRELATION)
    u_slope = scatter * math.sqrt(float(np.linalg.inv(terms.T @ terms)[1, 1]) * (1 + alike) / (1 - alike))
    return Curve(
        slope=float(found[1]),
        u_slope=u_slope,
        dof=float(count - rank),
        branches=float(found[4]) if both else 0.0,
        unsettled=_fit_slope_at_rest(visits, motion) - float(found[1]),
        scatter=scatter,
        span_K=float(np.ptp(visits.base_degC)),
        left=left,
    )


def _fit_slope_at_rest(visits: Visits, motion: int) -> float:
    """The slope of a quadratic and a follower of the air, that of LAGS_S which leaves least; NaN without followers."""
    away_K = visits.base_degC - visits.base_degC[0]
    best = math.inf, math.nan
    for behind_K in visits.behind_K.T:
        terms = np.stack([np.ones_like(away_K), away_K, away_K**2, behind_K], axis=1)
        found = np.linalg.lstsq(terms, visits.moved[:, motion], rcond=None)[0]
        best = min(best, (float(((visits.moved[:, motion] - terms @ found) ** 2).sum()), float(found[1])))
    return best[1]


def compute_coefficients(visits: Visits, u_air_K: float, target_ppm_per_K: float) -> Iterator[MeasuredQuantity]:
    """Compute the temperature coefficients of the four motions."""
    for motion, (key, name, unit) in enumerate(zip(MOTIONS, NAMES, UNITS, strict=True)):
        fitted, per_K = fit_curve(visits, motion), f"{unit}/K"
        group, model = (f"{_GROUP}{_BY_CAMERA}", _CAMERA_MODEL) if visits.by_camera else (_GROUP, _AIR_MODEL)
        one = MeasuredQuantity(f"{key}_per_K", group, name, per_K, model, why=_TOO_FEW)
        if fitted is None:
            yield one
            continue
        lines = [
            Contribution("scatter of the visits about the curve", "A", fitted.u_slope, per_K,
                         "least squares, with the correlation of neighbouring visits", dof=fitted.dof),
            _describe_rest(fitted, per_K),
            Contribution(_SPAN, "B", math.sqrt(2) * u_air_K, "K",
                         "thermometer and its place, both ends of the range", fitted.slope / fitted.span_K),
        ]  # fmt: skip
        if key == "scale":
            basis = "the part of the air's change that may reach the target"
            lines.append(Contribution("expansion of the target", "B", target_ppm_per_K, "ppm/K", basis))
        yield one.found(fitted.slope, *lines)


def _describe_rest(fitted: Curve, per_K: str) -> Contribution:
    """That a camera is not at rest when it is looked at: of 320 coefficients of drawn cameras (2001 to 2080) at rest 81
    % lay within U without it, 96 % with it, and 97 % with the difference of the branches besides."""
    if math.isnan(fitted.unsettled):
        u, basis = abs(fitted.branches) / math.sqrt(3), "rectangular, between the slopes of the two branches"
        return Contribution("slope of heating against cooling", "B", u, per_K, basis, is_rectangular=True)
    basis = "rectangular, as far as the slope by a first-order follower of the air"
    return Contribution("not at rest", "B", abs(fitted.unsettled) / math.sqrt(3), per_K, basis, is_rectangular=True)


NOT_REPEATING = "what the chosen form leaves unexplained"
_SWITCHING_ON = "Switching on"
_NAMES = ("Drift in the warm-up, I", "Drift in the warm-up, J", "Change of scale in the warm-up")
_SETTLED = 0.9  # the usual 90 % of a settling time
_LAST_S = 300.0  # round number; nothing was measured
_MOST_EXPONENTIALS = 10  # round number; not measured
_NO_WARM_UP = "no warm-up was recorded at the reference's place"
_OF_RESIDUALS = "residuals of a line and exponentials"
_NO_AIR = "no air temperature near the camera"
_NO_CURVE = "no temperature coefficient to compare with"
_OF_PLACE = "thermometer and its place"


def compute_warm_up_quantities(
    warming: Warming | None, visits: Visits, scatter: Sequence[float], u_air_K: float
) -> list[MeasuredQuantity]:
    """All of them; NaN with a reason where nothing was recorded. scatter: of MOTIONS, what does not repeat."""
    share = _compute_camera_share(warming, visits, scatter, u_air_K)
    return [
        *_compute_drifts(warming, scatter, u_air_K),
        _compute_settling(warming, scatter),
        _compute_final_rate(warming, scatter),
        _compute_self_heating(visits, u_air_K),
        share,
        _compute_surroundings_share(share),
    ]


def _make_unknown_quantity(key: str, name: str, unit: str, model: str = "", why: str = _NO_WARM_UP) -> MeasuredQuantity:
    """Make a quantity that is not known yet, with the reason."""
    return MeasuredQuantity(key, _SWITCHING_ON, name, unit, model, why=why)


def _compute_drifts(warming: Warming | None, scatter: Sequence[float], u_air_K: float) -> Iterator[MeasuredQuantity]:
    for motion, name in enumerate(_NAMES):
        key, unit = f"warm_up_{MOTIONS[motion]}", UNITS[motion]
        if warming is None:
            yield _make_unknown_quantity(key, name, unit)
            continue
        value = float(warming.moved[-1, motion])
        minutes = warming.since_s[[0, -1]] / 60
        risen_K = max(float(warming.camera_degC[-1] - warming.camera_degC[0]), 1.0)
        noise = math.sqrt(2) * estimate_frame_noise(warming.since_s, warming.moved[:, motion])
        model = f"y at {minutes[1]:z.1f} min minus y at {minutes[0]:z.1f} min"
        model += " after switching on" if warming.known else " of the recording"
        yield _make_unknown_quantity(key, name, unit, model).found(
            value,
            Contribution("what does not repeat", "A", math.sqrt(2) * scatter[motion], unit, NOT_REPEATING),
            Contribution("noise of the frames", "A", noise, unit, _OF_RESIDUALS),
            Contribution("temperature it began at", "B", u_air_K, "K", _OF_PLACE, value / risen_K),
        )


def estimate_frame_noise(since_s: Float, values: Float) -> float:
    """Standard deviation of one frame about the drift: of the residuals of a line and exponentials, by least squares.

    since_s, values (F,), F >= 5. A warm-up is a sum of exponentials, so that no drift is left in the residuals,
    whatever the interval between frames; second differences take its curvature for noise. Of noiseless drifts of 0.3 px
    with one or two time constants of 90 to 1900 s, 5 to 240 s between frames, this leaves at most 0.0002 px; of less
    than ten frames up to 0.01 px, for then there are too few for two exponentials.
    """
    at_s = since_s - since_s[0]
    count, span_s = len(at_s), float(at_s[-1])
    # Time constants from half an interval to the whole warm-up; half of the frames are left for the residuals.
    shortest_s = span_s / (count - 1) / 2
    constants_s = np.geomspace(shortest_s, span_s, min(_MOST_EXPONENTIALS, max(1, (count - 4) // 2)))
    terms = np.column_stack([np.ones(count), at_s / span_s, np.exp(-at_s[:, None] / constants_s)])
    terms /= np.linalg.norm(terms, axis=0)
    found, _, rank, _ = np.linalg.lstsq(terms, values, rcond=1e-12)
    left = values - terms @ found
    return math.sqrt(float(left @ left) / (count - int(rank)))


def _compute_settling(warming: Warming | None, scatter: Sequence[float]) -> MeasuredQuantity:
    model = f"first time after which the drift along its direction stays above {_SETTLED:.0%} of its last value"
    one = _make_unknown_quantity("settling_s", "Time to 90 % of the drift in the recorded warm-up", "s", model)
    if warming is None:
        return replace(one, model="")
    whole = warming.moved[-1, :2]
    size = float(np.linalg.norm(whole))
    along = warming.moved[:, :2] @ whole / max(size, 1e-12)
    noise = math.sqrt(2) * estimate_frame_noise(warming.since_s, along)
    if size < 10 * noise:
        return replace(one, why="the warm-up moves the image by no more than noise")
    below = int(np.flatnonzero(along < _SETTLED * size)[-1])
    after = min(below + 1, len(along) - 1)
    step_s, step_px = warming.since_s[after] - warming.since_s[below], along[after] - along[below]
    value = float(warming.since_s[below] + step_s * (_SETTLED * size - along[below]) / max(float(step_px), 1e-12))
    rate = max(_fit_slope(warming.since_s, along, value), 1e-9)
    repeats = float(np.hypot(scatter[0], scatter[1]))
    return one.found(
        value,
        Contribution("drift at that time", "A", noise, "px", _OF_RESIDUALS, 1 / rate),
        Contribution("what does not repeat", "A", repeats, "px", NOT_REPEATING, 1 / rate),
        Contribution("instant of switching on", "B", 0.5, "s", "a second between commands and readings"),
    )


def _fit_slope(at_s: Float, values: Float, middle_s: float) -> float:
    near = np.abs(at_s - middle_s) <= _LAST_S
    if near.sum() < 3:
        return 0.0
    return abs(float(np.polyfit(at_s[near] - middle_s, values[near], 1)[0]))


def _compute_final_rate(warming: Warming | None, scatter: Sequence[float]) -> MeasuredQuantity:
    unit = "mpx/min"
    one = _make_unknown_quantity("rate_at_end", "Drift still going on at the end of the warm-up", unit)
    if warming is None:
        return one
    last = warming.since_s >= warming.since_s[-1] - _LAST_S
    if last.sum() < 4:
        return replace(one, why="fewer than four frames in its last five minutes")
    minutes = (warming.since_s[last] - warming.since_s[-1]) / 60
    terms = np.stack([np.ones_like(minutes), minutes], axis=1)
    fitted = np.linalg.lstsq(terms, 1e3 * warming.moved[last, :2], rcond=None)[0]
    left = 1e3 * warming.moved[last, :2] - terms @ fitted
    variance = float((left**2).sum()) / max(2 * int(last.sum()) - 4, 1)
    u = math.sqrt(variance * float(np.linalg.inv(terms.T @ terms)[1, 1]))
    repeats, within_min = 1e3 * math.hypot(scatter[0], scatter[1]), float(np.ptp(minutes))
    basis = "a tenth of what the chosen form leaves may fall into these minutes"
    model = "length of the slope of a line through I and J over the last five minutes"
    return replace(one, model=model).found(
        float(np.linalg.norm(fitted[1])),
        Contribution("scatter of the frames about a line", "A", u, unit, "least squares"),
        Contribution("what does not repeat", "A", repeats, "mpx", basis, 0.1 / within_min),
    )


def _compute_self_heating(visits: Visits, u_air_K: float) -> MeasuredQuantity:
    model, why = "camera's own sensor minus the air near it, at the reference", _NO_AIR
    one = _make_unknown_quantity("self_heating_K", "Self-heating, by its own sensor", "K", model, why)
    excess = visits.camera_degC - visits.air_degC
    if visits.by_camera or not len(excess):
        return one
    basis = "steps of at most 0.25 K; its offset is unknown"
    return one.found(
        float(excess[0]),
        Contribution(_OF_PLACE, "B", u_air_K, "K", "stated, else assumed"),
        Contribution("the camera's sensor", "B", 0.25 / math.sqrt(12), "K", basis, is_rectangular=True),
    )


def _compute_camera_share(
    warming: Warming | None, visits: Visits, scatter: Sequence[float], u_air_K: float
) -> MeasuredQuantity:
    """Compute, of the shift per K of the air, how much the camera's own warming moves the image per K of its own
    sensor. The rest follows the surroundings: mount, fixture, and what of the camera stays at the air's temperature
    then."""
    model = (
        "(h · c) / (c · c); h: shift in the warm-up per K of the camera's sensor, c: shift per K of the air; the rest "
        "follows mount and surroundings, which are taken to stay at the air's temperature in the warm-up; above 100 % "
        "they move the image back"
    )
    one = _make_unknown_quantity("camera_share", "Part of the shift that follows the camera itself", "%", model)
    i, j = (fit_curve(visits, axis) for axis in (0, 1))
    if warming is None:
        return one
    if visits.by_camera:
        return replace(one, why=_NO_AIR)
    if i is None or j is None:
        return replace(one, why=_NO_CURVE)
    slope = np.array([i.slope, j.slope])
    risen_K = float(warming.camera_degC[-1] - warming.camera_degC[0])
    size = float(slope @ slope)
    if risen_K < 2 or size < 1e-10:
        return replace(one, why="the camera warmed by less than 2 K")
    h = warming.moved[-1, :2] / risen_K
    share = float(h @ slope) / size
    by_slope = (100 * (h - 2 * share * slope) / size).tolist()
    drift, along = math.sqrt(2) * max(scatter[:2]), slope / math.sqrt(size)

    def equation(away: Float) -> Float:
        """(M, 5), in the order of the lines below -> %."""
        shift = (warming.moved[-1, :2] + away[:, :1] * along) / (risen_K - away[:, 3:4])
        per_K = (slope + away[:, 1:3]) * (1 - away[:, 4:5] / i.span_K)
        return 100 * (shift * per_K).sum(axis=1) / (per_K**2).sum(axis=1)

    found = one.found(
        100 * share,
        Contribution("drift in the warm-up", "A", drift, "px", NOT_REPEATING, 100 / (risen_K * math.sqrt(size))),
        Contribution("coefficient along I", "A", i.u_slope, "px/K", "as above", by_slope[0], i.dof),
        Contribution("coefficient along J", "A", j.u_slope, "px/K", "as above", by_slope[1], j.dof),
        Contribution("warming of the camera", "B", u_air_K, "K", "of its own sensor", 100 * share / risen_K),
        Contribution(_SPAN, "B", math.sqrt(2) * u_air_K, "K", "in both coefficients", 100 * share / i.span_K),
    )
    both = float(i.left @ j.left) / max(math.sqrt(float(i.left @ i.left) * float(j.left @ j.left)), 1e-30)
    # The visits of both coefficients are the same, and what moves them off one curve moves them off the other.
    alike = ("coefficient along I", "coefficient along J", both)
    return replace(found, correlations=(alike,), equation=equation, inputs=len(found.contributions))


def _compute_surroundings_share(share: MeasuredQuantity) -> MeasuredQuantity:
    """Return what the camera's share leaves, as uncertain as that."""
    lines = tuple(replace(line, sensitivity=-line.sensitivity) for line in share.contributions)
    name, model = "Part of the shift that follows mount and surroundings", "100 % less the part that follows the camera"
    of_camera = share.equation

    def equation(away: Float) -> Float:
        return 100 - of_camera(away) if of_camera else np.full(len(away), math.nan)

    return replace(
        share,
        key="mount_share",
        name=name,
        value=100 - share.value,
        model=model,
        contributions=lines,
        equation=of_camera and equation,
    )


@dataclass(frozen=True, slots=True, eq=False)
class Datasheet:
    """quantities: in the order of the page. by_session: the same of each single session. warming: the first warm-up.
    air_degC, camera_degC: range of the visits, NaN when it is not known. model: in use."""

    observations: Observations
    details: MeasurementDetails
    model: DriftModel
    quantities: tuple[MeasuredQuantity, ...]
    by_session: tuple[tuple[MeasuredQuantity, ...], ...]
    visits: tuple[Visits, ...]
    warming: Warming | None
    air_degC: tuple[float, float]
    camera_degC: tuple[float, float]

    @property
    def by_key(self) -> Mapping[str, MeasuredQuantity]:
        """The quantities by their names."""
        return {one.key: one for one in self.quantities}


def compute_datasheet(
    observations: Observations, model: DriftModel, details: MeasurementDetails | None = None
) -> Datasheet:
    """SessionError when no session has a reference and set-points."""
    details = details or MeasurementDetails()
    steady = correct_bumps(observations, model.facts.bumps)
    moved = fit_motions(steady)
    of_session = {one.session_id: one for one in compute_hysteresis(steady)}
    evaluations = _evaluate_forms(model, observations)
    by_session: list[tuple[MeasuredQuantity, ...]] = []
    visits: list[Visits] = []
    warmings: list[Warming | None] = []
    for index, facts in enumerate(observations.sessions):
        own = collect_visits(steady, moved, index)
        if not len(own.base_degC):
            continue
        scatter = _estimate_unrepeated(own, model)
        visits.append(own)
        warmings.append(find_warm_up(steady, moved, index))
        by_session.append(
            (
                *compute_coefficients(own, details.u_air_K, details.u_target_ppm_per_K),
                *compute_warm_up_quantities(warmings[-1], own, scatter, details.u_air_K),
                *compute_hysteresis_quantities(of_session.get(facts.session_id), scatter),
            )
        )
    if not by_session:
        raise SessionError("no session has frames at set-points; there is no datasheet")
    pooled = [pool_sessions(same) for same in zip(*by_session, strict=True)]
    scatter = _estimate_unrepeated(visits[0], model)
    left = [one for form in FORMS for one in compute_residual_quantities(form, evaluations.get(form), scatter)]
    whole = _concatenate_visits(visits)
    return Datasheet(
        observations=observations,
        details=details,
        model=model,
        quantities=(*pooled, *left),
        by_session=tuple(by_session),
        visits=tuple(visits),
        warming=next((one for one in warmings if one is not None), None),
        air_degC=(float(whole.air_degC.min()), float(whole.air_degC.max())),
        camera_degC=(float(whole.camera_degC.min()), float(whole.camera_degC.max())),
    )


def _concatenate_visits(visits: list[Visits]) -> Visits:
    names = ("air_degC", "camera_degC", "chamber_degC", "moved", "time_ns")
    return replace(visits[0], **{name: np.concatenate([getattr(one, name) for one in visits]) for name in names})


def _estimate_unrepeated(visits: Visits, model: DriftModel) -> tuple[float, ...]:
    """One standard deviation of each of MOTIONS that temperature and its history do not explain: what the chosen form
    leaves, and no more than the visits scatter about a curve."""
    i, j = model.discrepancy_px.tolist()
    angle = 1e6 * max(i, j) / (model.facts.image_size[0] / 2)
    scatters = [fitted.scatter if (fitted := fit_curve(visits, motion)) else np.inf for motion in range(len(MOTIONS))]
    return tuple(min(pair) for pair in zip((i, j, angle, angle), scatters, strict=True))


def _evaluate_forms(model: DriftModel, observations: Observations) -> dict[str, Evaluation]:
    found: dict[str, Evaluation] = {}
    for one in (model, model.other):
        if one is None:
            continue
        try:
            found[one.form] = evaluate(one, observations)
        except SessionError:  # the page states that this form cannot be scored
            continue
    return found
