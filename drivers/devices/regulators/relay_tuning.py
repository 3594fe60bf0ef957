"""Autotuning by the relay method, as pure functions: the heat is switched between two levels about the output that
holds the temperature, and the limit cycle that follows shows the ultimate gain and period.

With levels +-d about a bias, hysteresis e, amplitude a of the temperature, the upper level for a share s of a period,

    Ku = 4 d sin(pi s) / (pi sqrt(a^2 - e^2)),    Tu = the period

(describing function of a relay with hysteresis; sin(pi s) is for a pulse that is not half of the period). The bias
follows the shares until they are even, so that the experiment neither drifts nor cools: both levels heat or give
nothing, and the compressor stays as it is. Sources: K. J. Astrom, T. Hagglund, Automatica 20 (1984) 645-651 (the
method), and Advanced PID Control (ISA 2006) 8.3.

The rule is AMIGO in its frequency response form (Advanced PID Control, 7.5) for a small gain ratio 1 / (Kp Ku): a
chamber with its slow wall is one (the simulated one: 0.03).

    K = 0.3 Ku,    Ti = 0.6 Tu,    Td = 0.15 Tu

It keeps a largest sensitivity of 1.4, where Ziegler-Nichols (0.6 Ku, 0.5 Tu, 0.125 Tu) makes a chamber ring whose lags
differ from those it was tuned in; Tyreus-Luyben (Ku / 2.2, 2.2 Tu, Tu / 6.3) settles late behind a wall that is slower
than Ti. approach_s, 3 Tu, is ours: in steps of Tu / 2 the shortest whose overshoot in the standard chamber stays
within 0.1 K.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from pydantic import Field

from thermostand.drivers.devices.regulators.pid import Law
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.documents import Document

# Round numbers; nothing was measured.
_PERIODS = 4  # that have to agree
_AGREE = 0.2  # each with their mean: amplitude and period; and the shares with one half
_LEAST_PERCENT = 2.0  # amplitude of the output with which a limit cycle is still above the noise
_APPROACH_Tu = 3.0  # ultimate periods until the cycle is even; round number, not measured


class TuningSettings(Document):
    """amplitude_percent: of the output about what holds the temperature, less where that is nearer to 0 or to the law's
    upper limit. hysteresis_K: above the noise of the thermometer. It is broken off when the temperature leaves the
    set-point by more than limit_K, or after limit_s."""

    amplitude_percent: float = Field(default=20.0, ge=_LEAST_PERCENT, le=50)
    hysteresis_K: float = Field(default=0.05, ge=0.005, le=1)
    limit_K: float = Field(default=3.0, ge=0.5, le=10)
    limit_s: float = Field(default=7200.0, ge=600, le=36_000)


@dataclass(frozen=True, slots=True)
class Period:
    """One period of the limit cycle: how long, the share of its upper level, amplitudes of temperature and output."""

    duration_s: float
    share: float
    amplitude_K: float
    amplitude_percent: float


@dataclass(frozen=True, slots=True)
class UltimatePoint:
    """What the limit cycle has shown."""

    ultimate_gain_percent_per_K: float
    ultimate_period_s: float
    amplitude_K: float
    amplitude_percent: float


@dataclass(frozen=True, slots=True)
class Tuning:
    """Where the experiment is. is_high: the upper level is given; since_ns: from then on; rose_ns: when the upper level
    of the period under way began (None before the first)."""

    set_point_degC: float
    begin_ns: int
    bias_percent: float
    is_high: bool
    fell_ns: int | None = None
    rose_ns: int | None = None
    lowest_degC: float = math.inf
    highest_degC: float = -math.inf
    periods: tuple[Period, ...] = ()
    failure: str = ""


def begin(set_point_degC: float, output_percent: float, now_ns: int) -> Tuning:
    """About the output that has held the set-point."""
    return Tuning(set_point_degC, now_ns, output_percent, is_high=True)


def amplitude_percent(bias_percent: float, settings: TuningSettings, law: Law) -> float:
    """The amplitude of the output: both levels within 0 and the law's upper limit."""
    return max(0.0, min(settings.amplitude_percent, bias_percent, law.highest_percent - bias_percent))


def output_percent(tuning: Tuning, settings: TuningSettings, law: Law) -> float:
    """The level that is given now."""
    amplitude = amplitude_percent(tuning.bias_percent, settings, law)
    return tuning.bias_percent + (amplitude if tuning.is_high else -amplitude)


def step(tuning: Tuning, measured_degC: float, now_ns: int, settings: TuningSettings, law: Law) -> Tuning:
    """The experiment after a measurement; with a failure it is over."""
    seen = replace(
        tuning,
        lowest_degC=min(tuning.lowest_degC, measured_degC),
        highest_degC=max(tuning.highest_degC, measured_degC),
        failure=_explain_failure(tuning, measured_degC, now_ns, settings, law),
    )
    above_K = measured_degC - tuning.set_point_degC
    if seen.failure:
        return seen
    if tuning.is_high and above_K > settings.hysteresis_K:
        return replace(seen, is_high=False, fell_ns=now_ns)
    if not tuning.is_high and above_K < -settings.hysteresis_K:
        return _begin_upper_level(seen, now_ns, settings, law)
    return seen


def find_ultimate_point(tuning: Tuning, settings: TuningSettings) -> UltimatePoint | None:
    """The ultimate point, once the last periods agree."""
    last = tuning.periods[-_PERIODS:]
    if len(last) < _PERIODS or not all(abs(2 * each.share - 1) <= 2 * _AGREE for each in last):
        return None
    period_s = sum(each.duration_s for each in last) / len(last)
    amplitude_K = sum(each.amplitude_K for each in last) / len(last)
    for each in last:
        if abs(each.duration_s / period_s - 1) > _AGREE or abs(each.amplitude_K / amplitude_K - 1) > _AGREE:
            return None
    if amplitude_K <= 2 * settings.hysteresis_K:
        return None
    output = sum(each.amplitude_percent * math.sin(math.pi * each.share) for each in last) / len(last)
    gain = 4 * output / (math.pi * math.sqrt(amplitude_K**2 - settings.hysteresis_K**2))
    return UltimatePoint(gain, period_s, amplitude_K, output)


def tune(law: Law, point: UltimatePoint) -> Law:
    """The law with the constants of the rule at the top; its limits stay."""
    Ku, Tu = point.ultimate_gain_percent_per_K, point.ultimate_period_s
    changes = {
        "gain_percent_per_K": round(0.3 * Ku, 2),
        "integral_s": round(0.6 * Tu, 1),
        "derivative_s": round(0.15 * Tu, 1),
        "approach_s": round(_APPROACH_Tu * Tu),
        "tracking_s": None,
    }
    return law.model_copy(update=changes)


def _begin_upper_level(tuning: Tuning, now_ns: int, settings: TuningSettings, law: Law) -> Tuning:
    """The upper level begins: with it a period ends, and the bias goes towards even shares."""
    fresh = replace(tuning, is_high=True, rose_ns=now_ns, lowest_degC=math.inf, highest_degC=-math.inf)
    if tuning.rose_ns is None or tuning.fell_ns is None:
        return fresh
    duration_ns = now_ns - tuning.rose_ns
    share = (tuning.fell_ns - tuning.rose_ns) / duration_ns
    amplitude = amplitude_percent(tuning.bias_percent, settings, law)
    period = Period(duration_ns / NS_PER_S, share, (tuning.highest_degC - tuning.lowest_degC) / 2, amplitude)
    bias = tuning.bias_percent + (2 * share - 1) * amplitude
    return replace(fresh, bias_percent=bias, periods=(*tuning.periods, period))


def _explain_failure(tuning: Tuning, measured_degC: float, now_ns: int, settings: TuningSettings, law: Law) -> str:
    at = f"at {tuning.set_point_degC:g} degC"
    if abs(measured_degC - tuning.set_point_degC) > settings.limit_K:
        return f"{measured_degC:.1f} degC is more than {settings.limit_K:g} K from the set-point; is anything open?"
    if now_ns - tuning.begin_ns > settings.limit_s * NS_PER_S:
        return f"no even limit cycle {at} within {settings.limit_s:g} s; try another set-point or amplitude_percent"
    if amplitude_percent(tuning.bias_percent, settings, law) < _LEAST_PERCENT:
        return (
            f"{at} it is held by an output of {tuning.bias_percent:.1f} %, too near to a limit to swing about; tune at "
            "a set-point that needs more heat, or less"
        )
    return ""


def format_yaml(law: Law) -> str:
    """One line for the `regulator` section of a stand's file, without what is as by default."""
    values = ", ".join(f"{name}: {value:g}" for name, value in law.model_dump(exclude_defaults=True).items())
    return f"law: {{{values}}}"
