"""The air temperature by a body in the chamber: a check that relies on neither of the two probes.

A body of lag L follows the air T by dB/dt = (T - B) / L, so that T = B + L dB/dt: independently of the probes, a body
that warms shows how warm the air around it is. Both are taken over the same window, the body's rate by least squares.
L is known roughly only; the error that makes grows with how far the body is from the air, and so does what is allowed.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from statistics import fmean

from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.events import guard_rule
from thermostand.stand.config.chamber_section import CameraCrosscheckConfig, GraniteCrosscheckConfig
from thermostand.stand.guarding.plausibility import make_stateful_rule
from thermostand.stand.safety.fault import Fault, Readings, Rule, get_value

AIR_WARMER_THAN_SHOWN = guard_rule(
    "air_warmer_than_shown", "a body in the chamber warms as if the air were warmer than shown"
)
_COVERAGE = 3.0  # with 1 K of noise in the granite its rate says nothing of the air
_GRANITE_WINDOW_S, _CAMERA_WINDOW_S = 60.0, 120.0  # of a rate: the camera shows its temperature in steps of 0.25 K
_GRANITE_SHARE, _CAMERA_SHARE = 0.4, 0.5
"""What a lag that is a third off, and drawn chambers differ by as much, makes of how far a body is from the air."""
_CHANGE_S = 900.0  # of the estimate lately: a failure shows within minutes, what is learned of the lag takes longer
_STILL_AIR_K = 3.0  # air that went so far moves every camera that is not stuck
_GAP_S = 60.0  # between two readings; after a longer one the window begins again


@dataclass(frozen=True, slots=True)
class CrosscheckSample:
    """What body and probe showed at one time."""

    time_ns: int
    body_degC: float
    probe_degC: float


@dataclass(frozen=True, slots=True)
class AirEstimate:
    """Over one window: the air as estimated by the body, as the probe shows it, and the body itself, degC; what the
    probe has risen, K. uncertain_K: of the estimated air, by the scatter of the body, with k = 3."""

    air_degC: float
    probe_degC: float
    body_degC: float
    probe_risen_K: float
    uncertain_K: float = 0.0

    def excess_K(self, limit_K: float, share: float) -> float:
        """Return how far the estimated air is above all that is allowed: limit_K, and that share of how far probe and
        body are apart; below 0 all is well. A probe that rises fast has a lag of its own, and is neither stuck nor
        outside."""
        apart_K = abs(self.probe_degC - self.body_degC)
        allowed_K = limit_K + share * apart_K + max(0.0, self.probe_risen_K) + self.uncertain_K
        return self.air_degC - self.probe_degC - allowed_K


def estimate_air(looks: Sequence[CrosscheckSample], window_s: float, lag_s: float) -> AirEstimate | None:
    """Return what a window says of the air around a body of that lag; None before it is full. One wild value of the
    body changes nothing: medians of three."""
    if len(looks) < 5 or looks[-1].time_ns - looks[0].time_ns < 0.9 * to_ns(window_s):
        return None
    read_degC = [look.body_degC for look in looks]
    bodies_degC = [sorted(three)[1] for three in zip(read_degC, read_degC[1:], read_degC[2:], strict=False)]
    times_s = [(look.time_ns - looks[0].time_ns) / NS_PER_S for look in looks[1:-1]]
    middle_s, body_degC = fmean(times_s), fmean(bodies_degC)
    product = sum((at - middle_s) * (each - body_degC) for at, each in zip(times_s, bodies_degC, strict=True))
    spread_s2 = sum((at - middle_s) ** 2 for at in times_s)
    rate_K_s = product / spread_s2
    bends_K2 = [(c - 2 * b + a) ** 2 for a, b, c in zip(read_degC, read_degC[1:], read_degC[2:], strict=False)]
    probe_degC, risen_K = fmean(look.probe_degC for look in looks), looks[-1].probe_degC - looks[0].probe_degC
    uncertain_K = _COVERAGE * lag_s * math.sqrt(fmean(bends_K2) / 6 / spread_s2)  # 6: of white noise
    return AirEstimate(body_degC + lag_s * rate_K_s, probe_degC, body_degC, risen_K, uncertain_K)


def update_window(
    looks: tuple[CrosscheckSample, ...], readings: Readings, body: str, probe: str, window_s: float
) -> tuple[CrosscheckSample, ...]:
    """The window with what is new, if that is a measurement which is not suspect; a new one after a gap."""
    reading, probe_degC = readings.latest(body), get_value(readings, probe)
    if reading is None or math.isnan(reading.value) or reading.cause == "suspect" or math.isnan(probe_degC):
        return looks
    if looks and reading.time_ns <= looks[-1].time_ns:
        return looks
    if looks and reading.time_ns - looks[-1].time_ns > to_ns(_GAP_S):
        looks = ()
    oldest_ns = reading.time_ns - to_ns(window_s)
    kept = tuple(look for look in looks if look.time_ns >= oldest_ns)
    return (*kept, CrosscheckSample(reading.time_ns, reading.value, probe_degC))


@dataclass(frozen=True, slots=True)
class GraniteState:
    """The window; by how much the estimated air was lately above the probe, and the probe above the granite, K: None
    before the first window is full."""

    looks: tuple[CrosscheckSample, ...] = ()
    lately_K: float | None = None
    lately_apart_K: float = 0.0

    def update(self, looks: tuple[CrosscheckSample, ...], found: AirEstimate) -> GraniteState:
        """Return what was lately, with one more window in it."""
        above_K, apart_K = found.air_degC - found.probe_degC, found.probe_degC - found.body_degC
        if self.lately_K is None or not self.looks:
            return GraniteState(looks, above_K, apart_K)
        share = min(1.0, (looks[-1].time_ns - self.looks[-1].time_ns) / to_ns(_CHANGE_S))
        lately_K = self.lately_K + share * (above_K - self.lately_K)
        return GraniteState(looks, lately_K, self.lately_apart_K + share * (apart_K - self.lately_apart_K))

    def compute_change_K(self, found: AirEstimate, limits: GraniteCrosscheckConfig) -> float:
        """Return how far the estimated air has gone from the probe lately, beyond what is allowed. The error of the lag
        has been there before, and so does not count."""
        if self.lately_K is None:
            return -math.inf
        apart_K = abs(found.probe_degC - found.body_degC - self.lately_apart_K)
        allowed_K = limits.change_K + _GRANITE_SHARE * apart_K + max(0.0, found.probe_risen_K) + found.uncertain_K
        return found.air_degC - found.probe_degC - self.lately_K - allowed_K


def crosscheck_by_granite(limits: GraniteCrosscheckConfig, lag_s: float, granite: str, probe: str) -> Rule:
    """The granite warms as in air that is warmer than `probe` shows, which is stuck, drifts, or hangs outside."""

    def step(last: GraniteState | None, readings: Readings, now_ns: int) -> tuple[GraniteState | None, Fault | None]:
        last = last or GraniteState()
        looks = update_window(last.looks, readings, granite, probe, _GRANITE_WINDOW_S)
        found = estimate_air(looks, _GRANITE_WINDOW_S, lag_s)
        if found is None:
            return replace(last, looks=looks), None
        if found.excess_K(limits.limit_K, _GRANITE_SHARE) > 0 or last.compute_change_K(found, limits) > 0:
            return replace(last, looks=looks), _make_fault(found, granite, probe)
        return last.update(looks, found), None

    return make_stateful_rule(step)


def _make_fault(found: AirEstimate, body: str, probe: str) -> Fault:
    text = f"{body} warms as in air of {found.air_degC:.1f} degC, but {probe} shows {found.probe_degC:.1f} degC"
    return Fault(AIR_WARMER_THAN_SHOWN, text)


@dataclass(frozen=True, slots=True)
class CameraState:
    """The camera since `on_since_ns`; its excess over the air, K, None until it is learned from `excesses_K`. The air
    shown when its temperature last changed, at `changed_ns`."""

    on_since_ns: int
    changed_ns: int
    changed_air_degC: float
    looks: tuple[CrosscheckSample, ...] = ()
    excesses_K: tuple[float, ...] = ()
    excess_K: float | None = None

    def is_implausible(self, air_degC: float) -> bool:
        """Return whether the camera did not notice what the air did."""
        still_ns = self.looks[-1].time_ns - self.changed_ns if self.looks else 0
        moved_K = abs(air_degC - self.changed_air_degC)
        return still_ns >= to_ns(_CAMERA_WINDOW_S) and moved_K >= _STILL_AIR_K


_EXCESSES = 100  # looks from which the camera's excess is learned


def crosscheck_by_camera(limits: CameraCrosscheckConfig, lag_s: float, camera: str, air: str) -> Rule:
    """The camera, which heats itself by what was learned when it had been on for a while, warms as in air that is
    warmer than `air` shows. Blind while it is off and warms up, and while it does not move though the air does."""

    def step(last: CameraState | None, readings: Readings, now_ns: int) -> tuple[CameraState | None, Fault | None]:
        air_degC = get_value(readings, air)
        looks = update_window(last.looks if last else (), readings, camera, air, _CAMERA_WINDOW_S)
        if not looks:
            return None, None
        if last is None or len(looks) == 1:  # also after it was off
            return CameraState(looks[-1].time_ns, looks[-1].time_ns, air_degC, looks), None
        seen = _update_camera(last, looks)
        if seen.is_implausible(air_degC):
            return seen, None
        found = estimate_air(looks, _CAMERA_WINDOW_S, lag_s)
        if found is None or looks[-1].time_ns - seen.on_since_ns < to_ns(limits.settle_s):
            return seen, None
        if seen.excess_K is None:
            return (seen if seen is last else _learn_excess(seen, found)), None
        own = replace(found, air_degC=found.air_degC - seen.excess_K, body_degC=found.body_degC - seen.excess_K)
        return seen, _make_fault(own, camera, air) if own.excess_K(limits.limit_K, _CAMERA_SHARE) > 0 else None

    return make_stateful_rule(step)


def _update_camera(last: CameraState, looks: tuple[CrosscheckSample, ...]) -> CameraState:
    if looks is last.looks:
        return last
    newest = looks[-1]
    if newest.body_degC == last.looks[-1].body_degC:
        return replace(last, looks=looks)
    return replace(last, looks=looks, changed_ns=newest.time_ns, changed_air_degC=newest.probe_degC)


def _learn_excess(seen: CameraState, found: AirEstimate) -> CameraState:
    excesses_K = (*seen.excesses_K, found.air_degC - found.probe_degC)
    if len(excesses_K) < _EXCESSES:
        return replace(seen, excesses_K=excesses_K)
    return replace(seen, excesses_K=(), excess_K=fmean(excesses_K))
