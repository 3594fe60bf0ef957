"""Heating/cooling PID with two degrees of freedom, as pure functions of its state (Omron calls it 2-PID).

With set point r, measurement y, integral time Ti, derivative time Td and coefficient alpha:

    reference   w = (1 - alpha) r + alpha r / (1 + Ti s)
    demand      v = (w - y) (1 + 1 / (Ti s)) - Td s y / (1 + Td s / 8)            in K
    heating     100 % (v - d/2) / Ph,    cooling    100 % (-v - d/2) / Pc         d: dead band, negative = overlap

alpha = 0 is a plain PI-D, alpha = 1 an I-PD; the path from a disturbance to the output does not depend on alpha.
Proportional bands are in K for 100 %. Ti and Td are those of the side that the demand was on in the step before.
Sources: E5CC manual H174 (proportional bands, dead band, cooling band, alpha 0.65 by default).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

DERIVATIVE_FILTER = 8.0  # Td over the time constant of the derivative's own lag


@dataclass(frozen=True, slots=True)
class Side:
    """Tuning of one output. band_K > 0; integral_s = 0 or derivative_s = 0 switches that action off; limit 0..105 %."""

    band_K: float
    integral_s: float
    derivative_s: float
    limit_pct: float = 100.0


@dataclass(frozen=True, slots=True)
class Gains:
    """Tuning of both outputs; see the formula at the top."""

    heat: Side
    cool: Side
    dead_band_K: float = 0.0
    alpha: float = 0.65


class PidState(NamedTuple):
    """What one step leaves for the next; a tuple, because one is made at every step of the plant."""

    reference_degC: float
    integral_K: float
    measured_degC: float
    slope_K_per_s: float
    demand_K: float


class Outputs(NamedTuple):
    """Manipulated values, %; both at once only with an overlapping (negative) dead band."""

    heat_pct: float
    cool_pct: float


OFF = Outputs(0.0, 0.0)


def start(measured_degC: float) -> PidState:
    """The state at the begin of control: the reference lag begins at the measurement, the integral is empty."""
    return PidState(measured_degC, 0.0, measured_degC, 0.0, 0.0)


def resume(outputs: Outputs, setpoint_degC: float, measured_degC: float, gains: Gains) -> PidState:
    """The state from which the next step gives `outputs` again: no bump from manual back to automatic."""
    half_K = gains.dead_band_K / 2
    if outputs.heat_pct > 0:
        demand_K = outputs.heat_pct / 100 * gains.heat.band_K + half_K
    elif outputs.cool_pct > 0:
        demand_K = -outputs.cool_pct / 100 * gains.cool.band_K - half_K
    else:
        demand_K = 0.0
    error_K = (1 - gains.alpha) * (setpoint_degC - measured_degC)
    return PidState(measured_degC, demand_K - error_K, measured_degC, 0.0, demand_K)


def step(
    state: PidState, setpoint_degC: float, measured_degC: float, dt_s: float, gains: Gains
) -> tuple[Outputs, PidState]:
    """One step: the outputs of the coming dt_s and the next state.

    The integral is frozen while the output is saturated and the error would push it further (conditional
    integration), so that a long ramp does not overshoot.
    """
    side = gains.cool if state.demand_K < 0 else gains.heat
    reference_degC = _lag(state.reference_degC, setpoint_degC, dt_s, side.integral_s)
    error_K = gains.alpha * reference_degC + (1 - gains.alpha) * setpoint_degC - measured_degC
    slope_K_per_s = _lag(
        state.slope_K_per_s,
        (measured_degC - state.measured_degC) / dt_s,
        dt_s,
        side.derivative_s / DERIVATIVE_FILTER,
    )
    demand_K = error_K + state.integral_K - side.derivative_s * slope_K_per_s
    integral_K = state.integral_K
    if side.integral_s > 0 and not _saturates(demand_K, error_K, gains):
        integral_K += error_K * dt_s / side.integral_s
    return outputs_of(demand_K, gains), PidState(reference_degC, integral_K, measured_degC, slope_K_per_s, demand_K)


def outputs_of(demand_K: float, gains: Gains) -> Outputs:
    """A demand (K, heating positive) as the two limited outputs."""
    half_K = gains.dead_band_K / 2
    return Outputs(
        heat_pct=min(gains.heat.limit_pct, max(0.0, 100 * (demand_K - half_K) / gains.heat.band_K)),
        cool_pct=min(gains.cool.limit_pct, max(0.0, 100 * (-demand_K - half_K) / gains.cool.band_K)),
    )


def on_time_ns(begin_ns: int, end_ns: int, duty: float, period_ns: int) -> int:
    """How long a time-proportioned output conducts within [begin, end): each period begins with duty x period on.

    Times are counted from the begin of the first period, duty is 0..1.
    """
    on_ns = round(min(1.0, max(0.0, duty)) * period_ns)
    periods, into_ns = divmod(begin_ns, period_ns)
    last, last_into_ns = divmod(end_ns, period_ns)
    return (last - periods) * on_ns + min(last_into_ns, on_ns) - min(into_ns, on_ns)


def _lag(value: float, target: float, dt_s: float, time_constant_s: float) -> float:
    """First-order lag, implicit Euler: stable for every time constant, and without lag for 0."""
    return value + (target - value) * dt_s / (time_constant_s + dt_s)


def _saturates(demand_K: float, error_K: float, gains: Gains) -> bool:
    half_K = gains.dead_band_K / 2
    highest_K = gains.heat.band_K * gains.heat.limit_pct / 100 + half_K
    lowest_K = -gains.cool.band_K * gains.cool.limit_pct / 100 - half_K
    return (demand_K >= highest_K and error_K > 0) or (demand_K <= lowest_K and error_K < 0)
