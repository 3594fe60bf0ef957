"""Cameras as others have published them, drawn from ranges: how they warm and how their image moves. Written before any
model was fitted to them, and sharing nothing with the fitter or with the simulated laboratory.

Numbers: change of scale -31 ppm/K (OSIRIS-REx NavCam), +18.5 ppm/K (MESSENGER NAC), 30..50 ppm/K (lenses of image
correlation, Pan et al. 2015; with their mounts); principal point 0.01..0.14 px/K (Smith and Cope 2010, Handel 2008,
Podbreznik and Potocnik 2012); settling with time constants of 10..90 min; self-heating of the chip 12..22 K; creep of
an adhesive 5.5 h. For what does not repeat nobody has published a number: fixings 4..12 mpx, slips 4..90 mpx.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields, replace
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

STEP_S = 10
UNIT_SCATTER = 0.15
CHIP, BODY, CELL, GLASS, MOUNT = range(5)
REFERENCE_DEGC = 24.0
FOCAL_PX, RADIAL = 7246.0, -0.12
_DISTANCE_MM, _PITCH_MM = 826.0, 30.0


@dataclass(frozen=True)
class Effects:
    """What a camera has beyond smooth and quick: sag of the lens with the roll, a dead zone in its mount, creep of an
    adhesive; stick-slip and places of fixings that do not repeat; a temperature sensor of 0.5 K steps with lag and
    offset; an air sensor far away."""

    sag: bool = False
    dead_zone: bool = False
    creep: bool = False
    stick_slip: bool = False
    unrepeated: bool = False
    coarse_sensor: bool = False
    far_air: bool = False


REPEATING = ("sag", "dead_zone", "creep", "coarse_sensor", "far_air")
UNREPEATING = ("stick_slip", "unrepeated")
ALL_EFFECTS = tuple(field.name for field in fields(Effects))


@dataclass(frozen=True, eq=False)
class Camera:
    """One drawn camera.

    rates (5, 5), 1/s: how the nodes follow each other; to_air (5,), 1/s: how they follow the air. heat_K_per_s (5,).
    *_px_per_K (2,): of the principal point, by the node that moves it. scale_per_K: of lens cell and glass. bend_per_K:
    how much all of it grows with temperature. tilt_per_K (2,): of the chip against the cell. turn_per_K (3,), rad:
    of the mount.
    """

    effects: Effects
    rates: Float
    to_air: Float
    heat_K_per_s: Float
    body_px_per_K: Float
    cell_px_per_K: Float
    scale_per_K: tuple[float, float]
    distortion_per_K: float
    bend_per_K: float
    tilt_per_K: Float
    turn_per_K: Float
    roll_rad: float
    sag_px: float
    sag_K: float
    play_K: Float
    play_px_per_K: Float
    creep_px_per_K: Float
    creep_s: float
    slip_K: float
    slip_px_per_K: Float
    fixing_px: float
    sensor_lag_s: float
    sensor_offset_K: float
    air_lag_s: float
    air_share: float

    def with_effects(self, *names: str) -> Camera:
        """The same camera with these effects only."""
        return replace(self, effects=Effects(**dict.fromkeys(names, True)))


def draw_camera(seed: int, *effects: str) -> Camera:
    """The camera of this number, with these effects; its numbers are the same whichever they are."""
    rng = np.random.default_rng([16, seed])
    rates, to_air, heat = _network(rng)
    kind = ("navcam", "nac", "dic")[seed % 3]
    ppm = {"navcam": rng.uniform(-36, -26), "nac": rng.uniform(15, 22), "dic": rng.uniform(30, 50)}[kind]
    cell_share = rng.uniform(0.3, 0.7)
    drift_px_per_K = _direction(rng) * np.exp(rng.uniform(np.log(0.01), np.log(0.14)))
    body_share = rng.uniform(0.3, 0.8)
    return Camera(
        effects=Effects(**dict.fromkeys(effects, True)),
        rates=rates,
        to_air=to_air,
        heat_K_per_s=heat,
        body_px_per_K=drift_px_per_K * body_share,
        cell_px_per_K=drift_px_per_K * (1 - body_share) + 0.2 * np.linalg.norm(drift_px_per_K) * _direction(rng),
        scale_per_K=(1e-6 * ppm * cell_share, 1e-6 * ppm * (1 - cell_share)),
        distortion_per_K=rng.normal(0, 2e-5),
        bend_per_K=rng.uniform(-0.004, 0.004),
        tilt_per_K=rng.normal(0, 3e-6, 2),
        turn_per_K=rng.normal(0, 1.0e-6, 3),
        roll_rad=rng.uniform(-np.pi, np.pi),
        sag_px=rng.uniform(0.05, 0.25),
        sag_K=rng.uniform(20, 40),
        play_K=rng.uniform(1.0, 6.0, 2),
        play_px_per_K=np.stack([_direction(rng) * rng.uniform(0.003, 0.012) for _ in range(2)]),
        creep_px_per_K=_direction(rng) * rng.uniform(0.1, 0.3) * np.linalg.norm(drift_px_per_K),
        creep_s=3600 * 5.5 * np.exp(rng.uniform(-0.25, 0.25)),
        slip_K=rng.uniform(2.0, 6.0),
        slip_px_per_K=_direction(rng) * rng.uniform(0.002, 0.010),
        fixing_px=rng.uniform(0.004, 0.012),
        sensor_lag_s=rng.uniform(30, 180),
        sensor_offset_K=rng.uniform(-1.5, 1.5),
        air_lag_s=rng.uniform(120, 600),
        air_share=rng.uniform(0.85, 1.0),
    )


def draw_unit(seed: int, number: int, *effects: str) -> Camera:
    """A unit of the type that the camera of this seed is the middle of: each of its numbers 15 % off, one standard
    deviation; of the heat flows all together, as the sizes of its parts are."""
    rng, middle = np.random.default_rng([31, seed, number]), draw_camera(seed, *effects)
    quicker = 1 + UNIT_SCATTER * rng.standard_normal()
    changed: dict[str, object] = {name: getattr(middle, name) * quicker for name in ("rates", "to_air", "heat_K_per_s")}
    for field in fields(middle):
        value = getattr(middle, field.name)
        if field.name not in (*changed, "effects", "air_share"):
            stated = np.asarray(value) * (1 + UNIT_SCATTER * rng.standard_normal(np.shape(value)))
            changed[field.name] = (
                stated if isinstance(value, np.ndarray) else tuple(stated) if stated.ndim else float(stated)
            )
    return replace(middle, **changed)


def _direction(rng: np.random.Generator) -> Float:
    angle = rng.uniform(-np.pi, np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


def _network(rng: np.random.Generator) -> tuple[Float, Float, Float]:
    """Chip on body on mount, body to lens cell to glass; all but the chip lose heat to the air. The capacities are
    scaled until the slowest of the network's time constants is the drawn one, 10..90 min."""
    capacity = np.array([25.0, 260.0, 180.0, 90.0, 900.0]) * np.exp(rng.uniform(-0.3, 0.3, 5))
    joint = np.zeros((5, 5))
    for one, other, conductance in ((CHIP, BODY, 0.35), (BODY, CELL, 0.25), (CELL, GLASS, 0.15), (BODY, MOUNT, 0.12)):
        joint[one, other] = joint[other, one] = conductance * np.exp(rng.uniform(-0.4, 0.4))
    loss = np.array([0.005, 0.14, 0.07, 0.012, 0.18]) * np.exp(rng.uniform(-0.3, 0.3, 5))
    wanted_s = 60 * np.exp(rng.uniform(np.log(10), np.log(90)))
    rates = (joint - np.diag(joint.sum(axis=1) + loss)) / capacity[:, None]
    slowest_s = float(np.max(-1 / np.linalg.eigvals(rates).real))
    scale = slowest_s / wanted_s
    power_W = np.zeros(5)
    power_W[CHIP] = 1.0
    warm_K = np.linalg.solve(-rates, power_W / capacity)
    power_W *= rng.uniform(12, 22) / warm_K[CHIP]
    rates, losses, heat = rates * scale, loss / capacity * scale, power_W / capacity * scale
    return rates, losses, heat


def nodes_degC(camera: Camera, air_degC: Float, powered: Float) -> Float:
    """(K, 5): every STEP_S, beginning as cold as the air; air and supply (K,) hold for the step that ends there."""
    values, vectors = np.linalg.eig(camera.rates)  # real: the network without its capacities is symmetric
    inverse = np.linalg.inv(vectors)
    driven = (air_degC[:, None] * camera.to_air + powered[:, None] * camera.heat_K_per_s) @ inverse.T
    begin = inverse @ np.full(5, air_degC[0])
    modes = [
        _first_order(driven[:, mode] * np.expm1(value * STEP_S) / value, float(np.exp(value * STEP_S)), begin[mode])
        for mode, value in enumerate(values)
    ]
    return np.stack(modes, axis=1) @ vectors.T


def _first_order(gained: Float, keep: float, begin: float) -> Float:
    """s = keep s + gained, for each of the steps."""
    states = accumulate(gained.tolist(), lambda state, gain: gain + keep * state, initial=begin)
    return np.array(list(states)[1:])


def compute_settled_degC(camera: Camera, air_degC: float) -> Float:
    """(5,): a powered camera after a long time."""
    return np.asarray(np.linalg.solve(-camera.rates, camera.to_air * air_degC + camera.heat_K_per_s), np.float64)


def apply_lag(values: Float, tau_s: float) -> Float:
    """First order, beginning in equilibrium."""
    keep = float(np.exp(-STEP_S / tau_s))
    return _first_order(values * (1 - keep), keep, float(values[0]))


def compute_motion_px(camera: Camera, nodes: Float, rng: np.random.Generator, changes: NDArray[np.int64]) -> Float:
    """(K, 2): how far the whole image has moved by sag, plays, creep and what does not repeat. changes: the indices at
    which the chamber was given another set-point."""
    away_K = nodes - compute_settled_degC(camera, REFERENCE_DEGC)
    total = np.zeros((len(nodes), 2))
    effects = camera.effects
    if effects.sag:
        down = np.array([np.sin(camera.roll_rad), np.cos(camera.roll_rad)])
        total += down * camera.sag_px * np.expm1(away_K[:, CELL] / camera.sag_K)[:, None]
    if effects.dead_zone:
        for half_K, weight in zip(camera.play_K, camera.play_px_per_K, strict=True):
            total += np.array(list(_apply_backlash(away_K[:, MOUNT], half_K)))[:, None] * weight
    if effects.creep:
        total += apply_lag(away_K[:, CELL], camera.creep_s)[:, None] * camera.creep_px_per_K
    if effects.stick_slip:
        total += np.array(list(_slips(away_K[:, BODY], camera.slip_K, rng)))[:, None] * camera.slip_px_per_K
    if effects.unrepeated:
        total += _fixings(camera, rng, len(nodes), changes)
    return total


def _apply_backlash(driver: Float, half: float) -> Iterator[float]:
    place = float(driver[0])
    for push in driver.tolist():
        place = min(max(place, push - half), push + half)
        yield place


def _slips(driver: Float, threshold: float, rng: np.random.Generator) -> Iterator[float]:
    """A contact that sticks until it is pushed further than a threshold, new each time, and then slips most of the
    way."""
    place, limit = float(driver[0]), threshold
    for push in driver.tolist():
        if abs(push - place) > limit:
            place += (push - place) * float(rng.uniform(0.6, 1.0))
            limit = threshold * float(rng.uniform(0.5, 1.5))
        yield place


def _fixings(camera: Camera, rng: np.random.Generator, count: int, changes: NDArray[np.int64]) -> Float:
    """A place that is another one after each change, within fixing_px (one standard deviation), reached in 20 min."""
    wanted = np.zeros((count, 2))
    place = np.zeros(2)
    for begin, end in zip(changes, [*changes[1:], count], strict=True):
        place = 0.6 * place + 0.8 * camera.fixing_px * rng.standard_normal(2)
        wanted[begin:end] = place
    return np.stack([apply_lag(wanted[:, axis], 1200.0) for axis in (0, 1)], axis=1)


def target_mm(linear_mm: float = 0.0, rotary_deg: float = 0.0) -> Float:
    """(54, 3): the 9 x 6 discs before the camera, further away by linear_mm, turned about the vertical."""
    row, column = np.divmod(np.arange(54), 9)
    along, up, turn = _PITCH_MM * (column - 4.0), -_PITCH_MM * (row - 2.5), np.radians(rotary_deg)
    return np.stack([along * np.cos(turn), up, _DISTANCE_MM + linear_mm + along * np.sin(turn)], axis=1)


def centres_px(camera: Camera, nodes: Float, moved: Float, place_mm: Float | None = None) -> Float:
    """(K, 54, 2): where the discs are seen, with temperatures (K, 5) and motions (K, 2); place_mm (54, 3): where they
    are, by default `target_mm()`."""
    away_K = nodes - compute_settled_degC(camera, REFERENCE_DEGC)
    bent = away_K * (1 + camera.bend_per_K * away_K)
    place_mm = target_mm() if place_mm is None else place_mm
    world = place_mm[:, :2] / place_mm[:, 2:]
    mount = away_K[:, MOUNT, None]
    turn = mount * camera.turn_per_K
    x = world[:, 0] + turn[:, 1:2] - turn[:, 2:3] * world[:, 1]
    y = world[:, 1] - turn[:, 0:1] + turn[:, 2:3] * world[:, 0]
    stretch = 1 + bent[:, CELL, None] * camera.scale_per_K[0] + bent[:, GLASS, None] * camera.scale_per_K[1]
    radial = 1 + (RADIAL + camera.distortion_per_K * away_K[:, GLASS, None]) * (x**2 + y**2)
    tilt = (away_K[:, BODY] - away_K[:, CELL] / 2)[:, None, None] * camera.tilt_per_K
    lean = 1 + tilt[:, :, 0] * x + tilt[:, :, 1] * y
    shift = bent[:, BODY, None] * camera.body_px_per_K + bent[:, CELL, None] * camera.cell_px_per_K + moved
    i = FOCAL_PX * stretch * radial * lean * x + 1223.5 + shift[:, 0:1]
    j = FOCAL_PX * stretch * radial * lean * y + 1023.5 + shift[:, 1:2]
    return np.stack([i, j], axis=2)


def sensor_degC(camera: Camera, nodes: Float, powered: Float) -> Float:
    """(K,): what the camera tells of its own temperature, NaN while it is off."""
    chip = nodes[:, CHIP]
    stated = np.round(chip / 0.1) * 0.1
    if camera.effects.coarse_sensor:
        stated = np.round((apply_lag(chip, camera.sensor_lag_s) + camera.sensor_offset_K) / 0.5) * 0.5
    return np.where(powered > 0, stated, np.nan)


def air_near_degC(camera: Camera, air_degC: Float, rng: np.random.Generator) -> Float:
    """(K,): what the stand's thermometer tells of the air."""
    stated = air_degC
    if camera.effects.far_air:
        stated = REFERENCE_DEGC + camera.air_share * (apply_lag(air_degC, camera.air_lag_s) - REFERENCE_DEGC)
    return stated + 0.003 * rng.standard_normal(len(air_degC))
