"""What one night says of switching the camera on: how far the image moves, how long it takes, how warm the camera gets,
and which part of the drift over temperature follows the camera's own warming.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from thermostand.compensation.datasheet.coefficients import curve
from thermostand.compensation.datasheet.motions import MOTIONS, UNITS, Visits, Warming
from thermostand.compensation.datasheet.quantity import Contribution, Quantity, direct
from thermostand.compensation.observations import Float

UNREPEATED = "what the chosen form leaves unexplained"
_GROUP = "Switching on"
_NAMES = ("Drift in the warm-up, I", "Drift in the warm-up, J", "Change of scale in the warm-up")
_SETTLED = 0.9
_LAST_S = 300.0
_MOST_EXPONENTIALS = 10
_NO_WARM_UP = "no warm-up was recorded at the reference's place"
_OF_RESIDUALS = "residuals of a line and exponentials"
_NO_CURVE = "no temperature coefficient to compare with"


def warming_quantities(
    warming: Warming | None, visits: Visits, scatter: Sequence[float], u_air_K: float
) -> list[Quantity]:
    """All of them; NaN with a reason where nothing was recorded. scatter: of MOTIONS, what does not repeat."""
    share = _share(warming, visits, scatter, u_air_K)
    return [
        *_drifts(warming, scatter, u_air_K),
        _settling(warming, scatter),
        _rate(warming, scatter),
        _self_heating(visits, u_air_K),
        share,
        _rest(share),
    ]


def _drifts(warming: Warming | None, scatter: Sequence[float], u_air_K: float) -> list[Quantity]:
    found: list[Quantity] = []
    for motion, name in enumerate(_NAMES):
        key, unit = f"warm_up_{MOTIONS[motion]}", UNITS[motion]
        if warming is None:
            found.append(Quantity(key, _GROUP, name, unit, math.nan, "", (), _NO_WARM_UP))
            continue
        value = float(warming.moved[-1, motion])
        minutes = warming.since_s[[0, -1]] / 60
        risen_K = max(float(warming.camera_degC[-1] - warming.camera_degC[0]), 1.0)
        model = f"y at {minutes[1]:z.1f} min minus y at {minutes[0]:z.1f} min"
        model += " after switching on" if warming.known else " of the recording"
        lines = (
            direct("what does not repeat", "A", math.sqrt(2) * scatter[motion], unit, UNREPEATED),
            direct("noise of the frames", "A", math.sqrt(2) * frame_noise(warming.since_s, warming.moved[:, motion]),
                   unit, _OF_RESIDUALS),
            Contribution("temperature it began at", "B", u_air_K, "K", value / risen_K, "thermometer and its place"),
        )  # fmt: skip
        found.append(Quantity(key, _GROUP, name, unit, value, model, lines))
    return found


def frame_noise(since_s: Float, values: Float) -> float:
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


def _settling(warming: Warming | None, scatter: Sequence[float]) -> Quantity:
    key, name = "settling_s", "Time to 90 % of the drift in the recorded warm-up"
    if warming is None:
        return Quantity(key, _GROUP, name, "s", math.nan, "", (), _NO_WARM_UP)
    whole = warming.moved[-1, :2]
    size = float(np.linalg.norm(whole))
    along = warming.moved[:, :2] @ whole / max(size, 1e-12)
    model = f"first time after which the drift along its direction stays above {_SETTLED:.0%} of its last value"
    noise = math.sqrt(2) * frame_noise(warming.since_s, along)
    if size < 10 * noise:
        return Quantity(
            key, _GROUP, name, "s", math.nan, model, (), "the warm-up moves the image by no more than noise"
        )
    below = int(np.flatnonzero(along < _SETTLED * size)[-1])
    after = min(below + 1, len(along) - 1)
    step_s, step_px = warming.since_s[after] - warming.since_s[below], along[after] - along[below]
    value = float(warming.since_s[below] + step_s * (_SETTLED * size - along[below]) / max(float(step_px), 1e-12))
    rate = max(_slope(warming.since_s, along, value), 1e-9)
    lines = (
        Contribution("drift at that time", "A", noise, "px", 1 / rate, _OF_RESIDUALS),
        Contribution("what does not repeat", "A", float(np.hypot(scatter[0], scatter[1])), "px", 1 / rate,
                     UNREPEATED),
        direct("instant of switching on", "B", 0.5, "s", "a second between commands and readings"),
    )  # fmt: skip
    return Quantity(key, _GROUP, name, "s", value, model, lines)


def _slope(at_s: Float, values: Float, middle_s: float) -> float:
    near = np.abs(at_s - middle_s) <= _LAST_S
    if near.sum() < 3:
        return 0.0
    return abs(float(np.polyfit(at_s[near] - middle_s, values[near], 1)[0]))


def _rate(warming: Warming | None, scatter: Sequence[float]) -> Quantity:
    key, name, unit = "rate_at_end", "Drift still going on at the end of the warm-up", "mpx/min"
    if warming is None:
        return Quantity(key, _GROUP, name, unit, math.nan, "", (), _NO_WARM_UP)
    last = warming.since_s >= warming.since_s[-1] - _LAST_S
    if last.sum() < 4:
        return Quantity(key, _GROUP, name, unit, math.nan, "", (), "fewer than four frames in its last five minutes")
    minutes = (warming.since_s[last] - warming.since_s[-1]) / 60
    terms = np.stack([np.ones_like(minutes), minutes], axis=1)
    fitted = np.linalg.lstsq(terms, 1e3 * warming.moved[last, :2], rcond=None)[0]
    left = 1e3 * warming.moved[last, :2] - terms @ fitted
    variance = float((left**2).sum()) / max(2 * int(last.sum()) - 4, 1)
    u = math.sqrt(variance * float(np.linalg.inv(terms.T @ terms)[1, 1]))
    within_min = float(np.ptp(minutes))
    lines = (
        direct("scatter of the frames about a line", "A", u, unit, "least squares"),
        Contribution("what does not repeat", "A", 1e3 * math.hypot(scatter[0], scatter[1]), "mpx", 0.1 / within_min,
                     "a tenth of what the chosen form leaves may fall into these minutes"),
    )  # fmt: skip
    model = "length of the slope of a line through I and J over the last five minutes"
    return Quantity(key, _GROUP, name, unit, float(np.linalg.norm(fitted[1])), model, lines)


def _self_heating(visits: Visits, u_air_K: float) -> Quantity:
    name, model = "Self-heating, by its own sensor", "camera's own sensor minus the air near it, at the reference"
    excess = visits.camera_degC - visits.air_degC
    if not len(excess):
        return Quantity("self_heating_K", _GROUP, name, "K", math.nan, model, (), "no air temperature near the camera")
    lines = (
        direct("thermometer and its place", "B", u_air_K, "K", "stated, else assumed"),
        direct("the camera's sensor", "B", 0.25 / math.sqrt(12), "K", "steps of at most 0.25 K; its offset is unknown"),
    )
    return Quantity("self_heating_K", _GROUP, name, "K", float(excess[0]), model, lines)


def _share(warming: Warming | None, visits: Visits, scatter: Sequence[float], u_air_K: float) -> Quantity:
    """Of the shift per K of the air, how much the camera's own warming moves the image per K of its own sensor. The
    rest follows the surroundings: mount, fixture, and what of the camera stays at the air's temperature then."""
    key, name = "camera_share", "Part of the shift that follows the camera itself"
    model = (
        "(h · c) / (c · c); h: shift in the warm-up per K of the camera's sensor, c: shift per K of the air; the rest "
        "follows mount and surroundings, which are taken to stay at the air's temperature in the warm-up; above 100 % "
        "they move the image back"
    )
    fitted = [curve(visits, axis) for axis in (0, 1)]
    if warming is None or fitted[0] is None or fitted[1] is None:
        return Quantity(key, _GROUP, name, "%", math.nan, model, (), _NO_WARM_UP if warming is None else _NO_CURVE)
    slope = np.array([one.slope for one in fitted if one])
    u_slope = np.array([one.u_slope for one in fitted if one])
    risen_K = float(warming.camera_degC[-1] - warming.camera_degC[0])
    size = float(slope @ slope)
    if risen_K < 2 or size < 1e-10:
        return Quantity(key, _GROUP, name, "%", math.nan, model, (), "the camera warmed by less than 2 K")
    h = warming.moved[-1, :2] / risen_K
    share = float(h @ slope) / size
    by_slope = (h - 2 * share * slope) / size
    lines = (
        Contribution("drift in the warm-up", "A", math.sqrt(2) * max(scatter[:2]), "px",
                     100 / (risen_K * math.sqrt(size)), UNREPEATED),
        Contribution("coefficient along I", "A", float(u_slope[0]), "px/K", 100 * float(by_slope[0]), "as above"),
        Contribution("coefficient along J", "A", float(u_slope[1]), "px/K", 100 * float(by_slope[1]), "as above"),
        Contribution("warming of the camera", "B", u_air_K, "K", 100 * share / risen_K, "of its own sensor"),
    )  # fmt: skip
    return Quantity(key, _GROUP, name, "%", 100 * share, model, lines)


def _rest(share: Quantity) -> Quantity:
    """What the camera's share leaves, as uncertain as that."""
    lines = tuple(replace(line, sensitivity=-line.sensitivity) for line in share.contributions)
    name, model = "Part of the shift that follows mount and surroundings", "100 % less the part that follows the camera"
    return replace(share, key="mount_share", name=name, value=100 - share.value, model=model, contributions=lines)
