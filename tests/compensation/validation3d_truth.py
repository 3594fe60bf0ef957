"""Validation sessions with known truth, without images: the drawn laboratory's target at V0..V3, a known drift."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.observations import Observations
from thermostand.compensation.validation3d.validate import ValidationFrames

from .calibration_truth import SIZE, VALIDATION, Laboratory, Truth, ellipse_centres
from .synthetic import CAMERA_ABOVE_CHAMBER_K, REFERENCE_DEGC, TARGET, facts

Float = NDArray[np.float64]

TEMPERATURES_degC = (24.0, 30.0, 36.0, 43.0, 50.0, 47.0, 40.0, 33.0, 27.0, 21.0, 16.0, 12.0)
POSITIONS = len(VALIDATION)


@dataclass(frozen=True)
class Moved:
    """What the target itself does at a temperature (index) and position: mm along the camera's axes, rad about them."""

    temperature: int
    position: int
    shift_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    turn_rad: tuple[float, float, float] = (0.0, 0.0, 0.0)


def nothing(xy_px: Float, above_K: float) -> Float:
    return xy_px


def validation_session(
    laboratory: Laboratory,
    truth: Truth,
    drift: Callable[[Float, float], Float] = nothing,
    *,
    noise_px: float = 0.003,
    frames: int = 1,
    moved: tuple[Moved, ...] = (),
    table_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
    temperatures_degC: tuple[float, ...] = TEMPERATURES_degC,
    seed: int = 0,
) -> tuple[Observations, ValidationFrames]:
    """V0..V3 and V0 again at each temperature. drift: (positions, K above the reference) -> where they are seen.
    table_mm: standard deviation of where the table puts the target, along the camera's axes."""
    random = np.random.default_rng((seed, 3))
    visits = [(t, p) for t in range(len(temperatures_degC)) for p in (*range(POSITIONS), 0)]
    centres: list[Float] = []
    for visit, (t, p) in enumerate(visits):
        rotation, translation = laboratory.validation_rotations[p], laboratory.validation_translations_mm[p]
        translation = translation + np.array(table_mm) * random.standard_normal(3)
        again = visit % (POSITIONS + 1) == POSITIONS
        for one in moved:
            if (one.temperature, one.position) == (t, p) and not again:
                rotation, translation = _moved(laboratory, rotation, translation, one)
        seen = ellipse_centres(truth.camera, laboratory.board_mm, rotation, translation, truth.diameter_mm)
        seen = drift(seen, temperatures_degC[t] - REFERENCE_DEGC)
        centres += [seen + noise_px * random.standard_normal(seen.shape) for _ in range(frames)]
    numbers = np.arange(len(visits) * frames).reshape(len(temperatures_degC), POSITIONS + 1, frames)
    chamber = np.repeat([temperatures_degC[t] for t, _ in visits], frames)
    positions = np.array(VALIDATION)
    plan = ValidationFrames(
        positions[:, 0], positions[:, 1], np.array(temperatures_degC), tuple(tuple(row) for row in numbers)
    )
    return _observations(np.array(centres), chamber, noise_px), plan


def _moved(laboratory: Laboratory, rotation: Float, translation: Float, one: Moved) -> tuple[Float, Float]:
    """The target turned about its own middle, then shifted."""
    x, y, z = one.turn_rad
    turn = np.eye(3) + np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])  # small angles
    middle = rotation @ np.array([120.0, 75.0, 0.0]) + translation
    return turn @ rotation, turn @ (translation - middle) + middle + np.array(one.shift_mm)


def _observations(centres_px: Float, chamber_degC: Float, noise_px: float) -> Observations:
    count = len(centres_px)
    return Observations(
        target=TARGET,
        sessions=(facts("cycle-2"),),
        image_size=SIZE,
        preview=np.full((682, 816), 200, np.uint8),
        session=np.zeros(count, np.int64),
        frame=np.arange(count),
        time_ns=1_767_290_400_000_000_000 + np.arange(count) * 60_000_000_000,
        role=np.full(count, "pose"),
        step_id=tuple(f"step-{index}" for index in range(count)),
        chamber_degC=chamber_degC,
        camera_degC=chamber_degC + CAMERA_ABOVE_CHAMBER_K,
        air_degC=chamber_degC.copy(),
        centres_px=centres_px,
        covariance_px2=np.tile(np.eye(2) * max(noise_px, 1e-4) ** 2, (*centres_px.shape[:2], 1, 1)),
        flags=np.zeros(centres_px.shape[:2], np.uint8),
        reasons=("",) * count,
    )
