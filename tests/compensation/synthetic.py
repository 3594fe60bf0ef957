"""Observations with a known drift, made without images and without the program's own polynomials."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.observations import Observations, SessionFacts
from thermostand.markers.target import Target

Float = NDArray[np.float64]
Drift = Callable[[Float, float], Float]
"""(positions at the reference (N, 2), K above the reference) -> where they are seen (N, 2), px."""

TARGET = Target(name="paper-9x6", columns=9, rows=6, pitch_mm=30, diameter_mm=8)
SIZE = (2448, 2048)
CAMERA_ABOVE_CHAMBER_K = 15.0
REFERENCE_DEGC = 24.0
REFERENCE_FRAMES = 8
FIT_DEGC = (10.0, 17.0, 24.0, 31.0, 38.0, 45.0, 52.0)
HELD_OUT_DEGC = (14.0, 20.0, 27.0, 34.0, 41.0, 48.0)


def facts(session_id: str = "cycle-1", camera: str = "TS-0001") -> SessionFacts:
    return SessionFacts(session_id, "thermal-cycle", camera, "operator", "0.1.0", None, 0)


def places_px() -> Float:
    """Where the 54 markers are at the reference temperature."""
    row, column = np.divmod(np.arange(54), 9)
    return np.stack([170.0 + 263 * column, 1690.0 - 263 * row], axis=1)


def observations(
    drift: Drift,
    noise_px: float = 0.0,
    seed: int = 0,
    fit_degC: tuple[float, ...] = FIT_DEGC,
    held_out_degC: tuple[float, ...] = HELD_OUT_DEGC,
    frames_per_point: int = 2,
    session: SessionFacts | None = None,
) -> Observations:
    """Reference frames, then every set-point in turn; the claimed covariance is the true one (1 mpx without noise)."""
    points = [("reference", REFERENCE_DEGC)] * REFERENCE_FRAMES
    points += [("fit", degC) for degC in fit_degC for _ in range(frames_per_point)]
    points += [("validation", degC) for degC in held_out_degC for _ in range(frames_per_point)]
    chamber = np.array([degC for _, degC in points])
    seen = np.array([drift(places_px(), degC - REFERENCE_DEGC) for degC in chamber])
    count = len(points)
    rng = np.random.default_rng(seed)
    return Observations(
        target=TARGET,
        sessions=(session or facts(),),
        image_size=SIZE,
        preview=np.full((682, 816), 200, np.uint8),
        session=np.zeros(count, np.int64),
        frame=np.arange(count),
        time_ns=1_767_290_400_000_000_000 + np.arange(count) * 2_700_000_000_000,
        role=np.array([role for role, _ in points]),
        step_id=tuple(f"step-{index}" for index in range(count)),
        chamber_degC=chamber,
        camera_degC=chamber + CAMERA_ABOVE_CHAMBER_K,
        air_degC=chamber.copy(),
        centres_px=seen + noise_px * rng.standard_normal(seen.shape),
        covariance_px2=np.tile(np.eye(2) * max(noise_px, 1e-3) ** 2, (count, 54, 1, 1)),
        flags=np.zeros((count, 54), np.uint8),
        reasons=("",) * count,
    )


def quadratic(reference_px: Float, above_K: float) -> Float:
    """About the paper's drift: 0.2 and 0.6 px RMS; the frame scales, J moves most, both bend with temperature."""
    x, y = ((reference_px - [1223.5, 1023.5]) / 1224).T
    warm = above_K + 0.004 * above_K**2
    return reference_px + np.stack([0.009 * warm + 0.006 * x * above_K, 0.033 * warm + 0.006 * y * above_K], axis=1)


def polynomial_drift(degree: int, seed: int) -> tuple[Drift, Callable[[Float, float], Float]]:
    """A drift whose displacement is exactly a random polynomial of total degree n in the *measured* position and the
    temperature (monomials of scaled variables), and that displacement, (positions, K above the reference) -> px."""
    rng = np.random.default_rng(seed)
    powers = [(a, b, c) for a in range(degree) for b in range(degree) for c in range(degree) if a + b + c < degree]
    weights = rng.normal(0, 0.15, (len(powers), 2))

    def displacement(measured_px: Float, above_K: float) -> Float:
        x, y = ((measured_px - [1223.5, 1023.5]) / 1224).T
        t = above_K / 28
        terms = np.stack([x**a * y**b * t**c for a, b, c in powers], axis=1)
        return t * terms @ weights  # the factor t: no displacement at the reference

    def drift(reference_px: Float, above_K: float) -> Float:
        measured = reference_px
        for _ in range(30):  # contracts by the drift's slope, about 1e-3, each time
            measured = reference_px - displacement(measured, above_K)
        return measured

    return drift, displacement
