"""Sessions of drawn cameras: observations as a recording would give them, and the noise-free truth. Centres come
straight from physics, without wires and images.

A session is a list of parts. The chamber follows its set-point in a few minutes, with an overshoot that dies out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.history.thermal_history import ThermalHistory, refine_temperature
from thermostand.compensation.observations import Observations

from .drawn_cameras import (
    STEP_S,
    Camera,
    Float,
    air_near_degC,
    apply_lag,
    centres_px,
    compute_motion_px,
    nodes_degC,
    sensor_degC,
)
from .synthetic import SIZE, TARGET, facts

NS_PER_S = 1_000_000_000
START_NS = 1_767_290_400 * NS_PER_S
NOISE_PX = 0.0024


@dataclass(frozen=True)
class Stretch:
    """`seconds` at a set-point, then frames of a role; the camera is on or off throughout."""

    set_point_degC: float
    seconds: int
    role: str = ""
    frames: int = 0
    interval_s: float = 0.5
    powered: bool = True


@dataclass(frozen=True)
class Bump:
    """What happens to the camera at once: hours after the beginning, and the shift of the image (2,), px, or of each
    marker (54, 2)."""

    after_h: float
    shift_px: Float


@dataclass(frozen=True, eq=False)
class DrawnSession:
    """Observations and the noise-free centres (F, 54, 2), px, without bumps."""

    observed: Observations
    truth_px: Float


WAY_DEGC = (27, 31, 34, 38, 41, 45, 48, 52, 48, 45, 41, 38, 34, 31, 27, 24, 20, 17, 14, 10, 14, 17, 20, 24)
HELD_OUT_DEGC = (14, 20, 27, 34, 41, 48)
DWELL_S = 2700


def warm_up(air_degC: float = 24.0) -> list[Stretch]:
    """Off for four hours, then on and looked at for half an hour."""
    return [
        Stretch(air_degC, 4 * 3600, powered=False),
        Stretch(air_degC, 20, "warm_up", 60, 30.0),
    ]


def reference(seconds: int = DWELL_S) -> list[Stretch]:
    return [Stretch(24.0, seconds, "reference", 20)]


def cycle(
    way_degC: Sequence[float] = WAY_DEGC, held_out_degC: Sequence[float] = HELD_OUT_DEGC, cycles: int = 1
) -> list[Stretch]:
    """The installed thermal cycle."""
    return [
        Stretch(degC, DWELL_S, "validation" if degC in held_out_degC else "fit", 5) for degC in tuple(way_degC) * cycles
    ]


def make_followed_cycle() -> list[Stretch]:
    """The thermal cycle with a frame every two minutes on the way to each of its set-points. They are taken as those of
    a warm-up are: of a camera that is not at rest, and at no set-point that could be left out."""
    parts: list[Stretch] = []
    for stretch in cycle():
        frames = stretch.seconds // 120
        parts += [Stretch(stretch.set_point_degC, 60, "warm_up", frames, 120.0), replace(stretch, seconds=60)]
    return parts


def make_full_session(cycles: int = 1, *, with_warm_up: bool = True) -> list[Stretch]:
    """A warm-up, or a camera that is switched on 55 min before the reference; then the cycle."""
    begin = warm_up() if with_warm_up else [Stretch(24.0, 600)]
    return [*begin, *reference(), *cycle(cycles=cycles)]


def make_unseen_begin(air_degC: float = 20.0, seconds: int = 1800) -> list[Stretch]:
    """For `session(unrecorded=)`: switched on in the room, half an hour before anybody records."""
    return [Stretch(air_degC, 60, powered=False), Stretch(air_degC, seconds)]


def record_session(
    camera: Camera,
    parts: Sequence[Stretch],
    seed: int = 0,
    bumps: Sequence[Bump] = (),
    session_id: str = "cycle-1",
    noise_px: float = NOISE_PX,
    unrecorded: Sequence[Stretch] = (),
    place_mm: Float | None = None,
) -> DrawnSession:
    """One session of a camera that begins as cold as the chamber, or with what happened before and was not recorded.
    place_mm (54, 3): of the target; else where it always is."""
    rng = np.random.default_rng([17, seed])
    plan = _Plan([*unrecorded, *parts])
    before = len(_Plan(unrecorded).powered)
    air = _air_degC(plan.set_point_degC)
    powered = plan.powered
    nodes = nodes_degC(camera, air, powered)
    moved = compute_motion_px(camera, nodes, rng, plan.changes)
    at_s = plan.frames_s
    grid_s = np.asarray(STEP_S * (1.0 + np.arange(len(air))), np.float64)
    at_nodes = np.stack([np.interp(at_s, grid_s, node) for node in nodes.T], axis=1)
    at_moved = np.stack([np.interp(at_s, grid_s, axis) for axis in moved.T], axis=1)
    truth = centres_px(camera, at_nodes, at_moved, place_mm)
    seen = truth + noise_px * rng.standard_normal(truth.shape)
    for bump in bumps:
        seen[at_s >= 3600 * bump.after_h] += bump.shift_px
    stated, near = sensor_degC(camera, nodes, powered), air_near_degC(camera, air, rng)
    return DrawnSession(_observations(plan, session_id, grid_s, seen, stated, near, noise_px, before), truth)


class _Plan:
    """The parts as columns: each step's set-point and supply, each frame's instant, role and step."""

    def __init__(self, parts: Sequence[Stretch]) -> None:
        set_points: list[float] = []
        powered: list[float] = []
        frames: list[tuple[float, str, float, str]] = []
        for number, part in enumerate(parts):
            looked_s = part.interval_s * max(part.frames - 1, 0)
            steps = -(-round(part.seconds + looked_s) // STEP_S)
            begin_s = len(set_points) * STEP_S + part.seconds
            frames += [
                (begin_s + k * part.interval_s, part.role, part.set_point_degC, f"step-{number}")
                for k in range(part.frames)
            ]
            set_points += [part.set_point_degC] * steps
            powered += [float(part.powered)] * steps
        self.set_point_degC, self.powered = np.array(set_points), np.array(powered)
        self.changes: NDArray[np.int64] = np.flatnonzero(np.diff(self.set_point_degC, prepend=np.nan) != 0)
        self.frames_s = np.array([row[0] for row in frames])
        self.roles = [row[1] for row in frames]
        self.chamber_degC = np.array([row[2] for row in frames])
        self.step_ids = tuple(row[3] for row in frames)


def _air_degC(set_point_degC: Float) -> Float:
    """Two lags and a part of the change that overshoots."""
    slow = apply_lag(apply_lag(set_point_degC, 240.0), 150.0)
    return slow + 0.15 * (apply_lag(slow, 300.0) - apply_lag(slow, 900.0))


def _observations(
    plan: _Plan, session_id: str, grid_s: Float, seen: Float, stated: Float, near: Float, noise_px: float, before: int
) -> Observations:
    """before: steps that are not recorded."""
    count = len(plan.roles)
    times_ns = START_NS + np.round(grid_s * NS_PER_S).astype(np.int64)
    frames_ns = START_NS + np.round(plan.frames_s * NS_PER_S).astype(np.int64)
    on = np.isfinite(stated)
    nearest = np.clip(np.searchsorted(grid_s, plan.frames_s, side="right") - 1, 0, len(grid_s) - 1)
    nearest = np.where(on[nearest], nearest, np.minimum(nearest + 1, len(grid_s) - 1))
    since = np.arange(len(times_ns)) >= before
    switched = np.flatnonzero((np.diff(plan.powered, prepend=np.nan) != 0) | (np.arange(len(times_ns)) == before))
    switched = switched[switched >= before]
    supply = times_ns[switched] - STEP_S * NS_PER_S, plan.powered[switched]
    history = ThermalHistory(times_ns[since], near[since], *supply, times_ns[on & since], stated[on & since])
    return Observations(
        target=TARGET,
        sessions=(replace(facts(session_id), simulated=True),),
        image_size=SIZE,
        preview=np.full((682, 816), 200, np.uint8),
        session=np.zeros(count, np.int64),
        frame=np.arange(count),
        time_ns=frames_ns,
        role=np.array(plan.roles),
        step_id=plan.step_ids,
        chamber_degC=plan.chamber_degC,
        camera_degC=stated[nearest],
        air_degC=np.interp(plan.frames_s, grid_s, near),
        centres_px=seen,
        covariance_px2=np.tile(np.eye(2) * noise_px**2, (count, 54, 1, 1)),
        flags=np.zeros((count, 54), np.uint8),
        reasons=("",) * count,
        histories=(refine_temperature(history),),
    )
