"""When a soaking camera has settled: a judgement of what was seen so far, arrays in, verdict out.

Settled is what an observer can claim, not what may be: each rate counts with twice its standard uncertainty (about
95 %), and it counts where in the window it is largest. A drift that turns within the window, as that of a fast and a
slow part against each other does, is therefore not taken for one that has come to rest.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from thermostand.experiments.steps import SoakUntilSettled
from thermostand.foundation.clock import NS_PER_S
from thermostand.stand.config.chamber_section import BAND_K

if TYPE_CHECKING:
    from thermostand.markers.detection import Detection

Float = NDArray[np.float64]

COVERAGE = 2.0  # k: an interval of two standard uncertainties holds 95 %
# A soak waits longer in proportion where the display is coarse.
_ROUNDING = 0.6  # digits over the time that is seen, as a standard uncertainty
_LEAST_LOOKS = 4  # one more than a parabola needs
_LEAST_MARKERS = 4  # shift, turn and scale are four


@dataclass(frozen=True, slots=True)
class Rate:
    """A rate of change per minute, with its standard uncertainty; NaN when it cannot be estimated."""

    per_min: float = math.nan
    uncertainty: float = math.nan

    @property
    def bound(self) -> float:
        """What it surely does not exceed."""
        return abs(self.per_min) + COVERAGE * self.uncertainty


@dataclass(frozen=True, slots=True)
class SettlingData:
    """Readings and looks since the soak was last undisturbed, oldest first, times in s.

    chamber, camera: (2, n), time and degC, NaN where a reading was BAD. digit_K: of the camera's thermometer, 0 when it
    never moved. looks: (n, 6), time, the four of `measure_movement` added up, and their standard uncertainty.
    """

    chamber: Float
    camera: Float
    digit_K: float
    looks: Float


@dataclass(frozen=True, slots=True)
class Verdict:
    """camera: K/min. drift: px/min. missing: why it is not settled, "" when it is."""

    camera: Rate
    drift: Rate
    missing: str

    @property
    def settled(self) -> bool:
        """Whether nothing is missing."""
        return not self.missing

    @property
    def rates(self) -> str:
        """The rates in words, as in `0.02 +- 0.02 K/min, 0.60 +- 0.11 mpx/min`."""
        return (
            f"camera {self.camera.per_min:+.3f} +- {COVERAGE * self.camera.uncertainty:.3f} K/min, "
            f"image {1e3 * self.drift.per_min:+.2f} +- {1e3 * COVERAGE * self.drift.uncertainty:.2f} mpx/min"
        )


def judge_settling(seen: SettlingData, soak: SoakUntilSettled, now_s: float) -> Verdict:
    """Return whether the camera has settled, by the last `soak.window_s` before `now_s`; the soak's age is not
    judged."""
    camera = fit_camera_rate(_select_last(seen.camera, now_s - soak.window_s), seen.digit_K)
    slack_s = soak.look_every_s / 2.0
    looks = seen.looks[seen.looks[:, 0] >= now_s - soak.window_s - slack_s]
    drift = fit_drift_rate(looks[:, 0], looks[:, 1:5], looks[:, 5])
    return Verdict(camera, drift, _find_missing(seen, soak, now_s, looks, camera, drift))


def _find_missing(
    seen: SettlingData, soak: SoakUntilSettled, now_s: float, looks: Float, camera: Rate, drift: Rate
) -> str:
    begin_s = now_s - soak.window_s
    chamber = _select_last(seen.chamber, begin_s)
    if not _covers(seen.chamber, begin_s) or not (np.abs(chamber[1] - soak.chamber_degC) <= BAND_K).all():
        return f"the chamber was not within {BAND_K:g} K of its set-point for {soak.window_s / 60:g} min"
    if not _covers(seen.camera, begin_s) or math.isnan(camera.bound):
        return "the camera's temperature was not always known"
    if looks.size == 0 or looks[0, 0] > begin_s + soak.look_every_s / 2.0 or math.isnan(drift.bound):
        return "the target was not seen often enough"
    if camera.bound >= soak.camera_K_per_min:
        return f"the camera's temperature changes by up to {camera.bound:.3f} K/min"
    if drift.bound >= soak.drift_px_per_min:
        return f"the image moves by up to {1e3 * drift.bound:.2f} mpx/min"
    return ""


def fit_camera_rate(readings: Float, digit_K: float) -> Rate:
    """K/min of readings (2, n) in s and degC by a straight line; NaN with fewer than three or a BAD one.

    Rounding does not average out while all readings show the same digit or two: it counts with what covers 95 % of the
    ways to round the worst slope (_ROUNDING). Scatter beyond that counts as independent.
    """
    time_min, camera_degC = readings[0] / 60.0, readings[1]
    if readings.shape[1] < 3 or not np.isfinite(camera_degC).all():
        return Rate()
    away_min = time_min - time_min.mean()
    spread_min2 = float((away_min**2).sum())
    slope = float((away_min * camera_degC).sum()) / spread_min2
    left_K = camera_degC - camera_degC.mean() - slope * away_min
    scatter = math.sqrt(float((left_K**2).sum()) / (readings.shape[1] - 2) / spread_min2)
    rounding = _ROUNDING * digit_K / float(time_min[-1] - time_min[0])
    return Rate(slope, math.hypot(scatter, rounding))


def fit_drift_rate(time_s: Float, moved_px: Float, uncertainty_px: Float) -> Rate:
    """px/min of positions (n, quantities) by a parabola each: the largest, over quantities and within the time seen.

    `uncertainty_px` (n,) is that of a position; where positions scatter more than that, their scatter counts (Birge's
    ratio). NaN with fewer than four looks.
    """
    if len(time_s) < _LEAST_LOOKS:
        return Rate()
    time_min = (time_s - time_s.mean()) / 60.0
    weight = 1.0 / uncertainty_px[:, None]
    terms = np.stack((np.ones_like(time_min), time_min, time_min**2), axis=1)
    covariance = np.linalg.inv((terms * weight).T @ (terms * weight))
    coefficients = covariance @ (terms * weight**2).T @ (moved_px - moved_px[0])
    left = (moved_px - moved_px[0] - terms @ coefficients) * weight
    birge = np.sqrt(np.maximum(1.0, (left**2).sum(axis=0) / (len(time_s) - 3)))
    rates: list[Rate] = []
    for end_min in (time_min[0], time_min[-1]):  # a parabola is steepest at one of its ends
        gradient = np.array((0.0, 1.0, 2.0 * end_min))
        uncertainty = math.sqrt(float(gradient @ covariance @ gradient))
        rates += [
            Rate(float(rate), uncertainty * float(ratio))
            for rate, ratio in zip(gradient @ coefficients, birge, strict=True)
        ]
    return max(rates, key=lambda rate: rate.bound)


def measure_movement(before: Detection, now: Detection) -> tuple[Float, float] | None:
    """Return how the image has moved since `before`, px: along I and J, and by growing and turning, those two as the
    RMS over the markers; and the standard uncertainty of the position `now`. None when too few markers are seen in
    both.

    A shift alone would miss a focal length that is still on its way.
    """
    both = (before.flags == 0) & (now.flags == 0)
    if both.sum() < _LEAST_MARKERS:
        return None
    step = now.centres_px[both] - before.centres_px[both]
    arm = before.centres_px[both] - before.centres_px[both].mean(axis=0)
    radius_px = math.sqrt(float((arm**2).sum(axis=1).mean()))
    grown = float((arm * step).sum(axis=1).mean()) / radius_px
    turned = float((arm[:, 0] * step[:, 1] - arm[:, 1] * step[:, 0]).mean()) / radius_px
    variance_px2 = np.diagonal(now.covariance_px2[both], axis1=1, axis2=2)
    moved = np.array((*step.mean(axis=0), grown, turned))
    return moved, math.sqrt(float(variance_px2.mean()) / int(both.sum()))


def find_digit_K(camera_degC: Float) -> float:
    """The smallest step between readings (n,), 0 when there is none."""
    steps = np.abs(np.diff(camera_degC[np.isfinite(camera_degC)]))
    return float(steps[steps > 0.0].min(initial=math.inf)) if (steps > 0.0).any() else 0.0


def _select_last(readings: Float, begin_s: float) -> Float:
    return readings[:, readings[0] >= begin_s]


def _covers(readings: Float, begin_s: float) -> bool:
    """Return whether something was read before `begin_s`, too, so that the whole window is seen."""
    return readings.shape[1] > 0 and bool(readings[0, 0] <= begin_s)


def to_seconds(time_ns: int) -> float:
    """An instant as s, for the arrays here; a double holds it to less than a us."""
    return time_ns / NS_PER_S
