"""A camera of three heat reservoirs (sensor, lens, base), with or without play in its mount: observations and truth.

It shares no code with the fitter: lags are exact solutions between knots of the air's temperature, the image is that of
a pinhole camera whose parts expand.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.history.thermal_history import ThermalHistory
from thermostand.compensation.observations import Observations

from .synthetic import SIZE, TARGET, facts

Float = NDArray[np.float64]

NS_PER_S = 1_000_000_000
START_NS = 1_767_290_400 * NS_PER_S
STEP_S = 10
SENSOR, LENS, BASE = (480.0, 15.0), (1500.0, 10.0), (3600.0, 0.0)
"""Time constant, s, and self-heating, K."""

NOISE_PX = 0.003
PLAYS_X, PLAYS_Y = ((4.0, 6e-3), (8.0, 6e-3), (14.0, 4e-3)), ((3.0, 12e-3), (7.0, 10e-3), (12.0, 8e-3))


@dataclass(frozen=True)
class Part:
    """`seconds` at an air temperature, powered or not, then frames of a role."""

    air_degC: float
    seconds: int
    powered: bool = True
    role: str = ""
    frames: int = 0
    interval_s: int = 10


def warm_up(air_degC: float) -> list[Part]:
    """Off for four hours, then on and looked at for half an hour."""
    return [Part(air_degC, 4 * 3600, False), Part(air_degC, 20, role="warm_up", frames=60, interval_s=30)]


def reference() -> list[Part]:
    return [Part(24.0, 3 * 3600, role="reference", frames=20)]


def cycle(held_out_degC: Sequence[float] = (20.0, 34.0, 48.0)) -> list[Part]:
    """Up and down in set-points of 45 min; the held-out ones lie between the others."""
    way = (31, 34, 38, 45, 48, 52, 48, 45, 38, 34, 31, 24, 20, 17, 10, 17, 20, 24)
    return [Part(float(degC), 2700, role="validation" if degC in held_out_degC else "fit", frames=5) for degC in way]


def session(
    parts: Sequence[Part], seed: int = 0, session_id: str = "cycle-1", plays: bool = False
) -> tuple[Observations, Float]:
    """Observations and the noise-free centres (F, 54, 2)."""
    rng = np.random.default_rng(seed)
    air, power, roles, chamber, steps, at = [24.0], [1.0], [], [], [], []
    for number, part in enumerate(parts):
        count = part.seconds // STEP_S
        for frame in range(max(part.frames, 1)):
            more = count if frame == 0 else part.interval_s // STEP_S
            air += [part.air_degC] * more
            power += [float(part.powered)] * more
            if part.frames:
                roles.append(part.role)
                chamber.append(part.air_degC)
                steps.append(f"step-{number}")
                at.append(len(air) - 1)
    air_degC, powered = np.array(air), np.array(power)
    sensor, lens, base = (_reservoir(air_degC, powered, *kind) for kind in (SENSOR, LENS, BASE))
    slack = [_slack(sensor - 24, kind) if plays else np.zeros(len(sensor)) for kind in (PLAYS_X, PLAYS_Y)]
    truth = np.array([_image(*(float(own[k]) for own in (sensor - 39, lens - 34, base - 24, *slack))) for k in at])
    times_ns = START_NS + np.arange(len(air)) * STEP_S * NS_PER_S
    stated = sensor + 0.01 * rng.standard_normal(len(sensor))
    on = powered > 0
    index = np.array(at)
    count = len(at)
    found = Observations(
        target=TARGET,
        sessions=(facts(session_id),),
        image_size=SIZE,
        preview=np.full((682, 816), 200, np.uint8),
        session=np.zeros(count, np.int64),
        frame=np.arange(count),
        time_ns=times_ns[index],
        role=np.array(roles),
        step_id=tuple(steps),
        chamber_degC=np.array(chamber),
        camera_degC=stated[index],
        air_degC=air_degC[index],
        centres_px=truth + NOISE_PX * rng.standard_normal(truth.shape),
        covariance_px2=np.tile(np.eye(2) * NOISE_PX**2, (count, 54, 1, 1)),
        flags=np.zeros((count, 54), np.uint8),
        reasons=("",) * count,
        histories=(ThermalHistory(times_ns, air_degC, times_ns[:-1], powered[1:], times_ns[on], stated[on]),),
    )
    return found, truth


def _reservoir(air_degC: Float, powered: Float, tau_s: float, heating_K: float) -> Float:
    """First order towards air + self-heating, in equilibrium at the start."""
    keep = np.exp(-STEP_S / tau_s)
    found = [air_degC[0] + heating_K * powered[0]]
    for air, power in zip(air_degC[1:], powered[1:], strict=True):
        found.append(air + heating_K * power + (found[-1] - air - heating_K * power) * keep)
    return np.array(found)


def _slack(driver: Float, kinds: Sequence[tuple[float, float]]) -> Float:
    """Weighted positions of parts that move only when pushed."""
    total = np.zeros(len(driver))
    for half_gap, weight in kinds:
        place = driver[0]
        for index, push in enumerate(driver):
            place = push - half_gap if place < push - half_gap else min(place, push + half_gap)
            total[index] += weight * place
    return total


def _image(sensor_K: float, lens_K: float, base_K: float, slack_x: float, slack_y: float) -> Float:
    """(54, 2): where the discs are seen; K from the reference state."""
    row, column = np.divmod(np.arange(54), 9)
    x, y = 30.0 * (column - 4), -30.0 * (row - 2.5)
    bent = sensor_K + 0.004 * sensor_K**2
    f_px = 7246 * (1 + 5e-6 * (lens_K + 0.004 * lens_K**2))
    roll = 0.6e-6 * sensor_K
    depth_mm = 826 + 4e-4 * base_K
    i, j = f_px * (x - roll * y) / depth_mm, f_px * (y + roll * x) / depth_mm
    centre = (1223.5 + 0.0085 * bent + slack_x, 1023.5 + 0.036 * bent - 0.004 * lens_K + slack_y)
    turned = 7246 * 0.5e-6 * base_K, 7246 * 1.2e-6 * base_K  # the camera as a whole, with its base
    return np.stack([centre[0] + i + turned[0], centre[1] + j + turned[1]], axis=1)
