"""One table: what each part of the stand does to the image of a session, in um on the target and in px."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from thermostand.compensation.budget.correction import (
    granite_mm,
    indices,
    post_mm,
    refraction_px,
    target_strain,
    varied,
)
from thermostand.compensation.budget.geometry import Geometry, StandTemperatures
from thermostand.compensation.budget.refraction import Index, ciddor_1996, edlen_1966, tilted_shift_mm
from thermostand.compensation.budget.repeatability import Repeatability, home_residuals, v0_repeats
from thermostand.compensation.budget.session_temperatures import capture_states, mean_state, states_at
from thermostand.foundation.errors import SessionError
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session

Effect = Callable[[StandTemperatures, Geometry], tuple[float, float]]
"""(state, geometry) -> (um on or of the target, px in the image)."""


@dataclass(frozen=True, slots=True)
class Contribution:
    """One line. um, px: at its largest over the session's captures, with sign. u_um, u_px: their standard
    uncertainties; NaN for a scatter, which is one itself. where: the place in the image. corrected: whether
    correction.py takes it out, so that only the uncertainty stays.
    """

    name: str
    um: float
    u_um: float
    px: float
    u_px: float
    where: str
    corrected: bool


@dataclass(frozen=True, slots=True)
class Budget:
    """A session's contributions against its reference state; coolest and warmest air at the camera during captures."""

    reference: StandTemperatures
    air_degC: tuple[float, float]
    contributions: tuple[Contribution, ...]


def budget(session: Session, target: Target, geometry: Geometry) -> Budget:
    """The stand's part in a session. Reference: the mean of the captures of role reference, else the first capture.

    SessionError when a thermometer was silent in all captures.
    """
    captures = [capture for capture in capture_states(session) if _is_known(capture.state)]
    if not captures:
        raise SessionError(
            f"{session.path}: in no capture were all five thermometers alive: the stand cannot be judged"
        )
    reference = mean_state([c.state for c in captures if c.role == "reference"] or [captures[0].state])
    ends_ns = np.array([time_ns for capture in captures for time_ns in (capture.start_ns, capture.end_ns)], np.int64)
    states = [*(capture.state for capture in captures), *filter(_is_known, states_at(session, ends_ns))]
    thermal = _thermal(states, reference, geometry, _outermost_mm(target))
    events = session.events()
    table = (
        _linear("linear table, resolution", geometry.linear_mm, target, geometry),
        _rotary("rotary table, resolution", geometry.rotary_deg, target, geometry),
        *_homes(home_residuals(events, "mm"), home_residuals(events, "deg"), target, geometry),
        *_repeats(v0_repeats(session, target), geometry),
    )
    air = [state.air_degC for state in states]
    return Budget(reference, (min(air), max(air)), (*thermal, *table))


def table(budget: Budget) -> str:
    """The budget for a console."""
    reference = budget.reference
    lines = [
        f"reference: air {reference.air_degC:.2f}, granite {reference.granite_inside_degC:.2f} / "
        f"{reference.granite_outside_degC:.2f}, artifact {reference.artifact_degC:.2f}, laboratory "
        f"{reference.laboratory_degC:.2f} degC; captures at {budget.air_degC[0]:.1f} to {budget.air_degC[1]:.1f} degC",
        f"{'contribution':44} {'um':>9} {'u':>8} {'px':>9} {'u':>8}  at",
    ]
    for line in budget.contributions:
        numbers = (_number(line.um, 9, 2), _number(line.u_um, 8, 2), _number(line.px, 9, 4), _number(line.u_px, 8, 4))
        lines.append(f"{line.name:44} {' '.join(numbers)}  {line.where}{', correctable' if line.corrected else ''}")
    return "\n".join(lines)


def _thermal(
    states: Sequence[StandTemperatures], reference: StandTemperatures, geometry: Geometry, radius_mm: float
) -> list[Contribution]:
    um_per_px = 1e3 * geometry.distance_mm.value / geometry.focal_px
    corner_px = np.array([(geometry.image_px[0] - 1) / 2, (geometry.image_px[1] - 1) / 2])

    def granite(state: StandTemperatures, stand: Geometry) -> tuple[float, float]:
        away_mm = granite_mm(state, reference, stand)
        return 1e3 * away_mm, -away_mm / stand.distance_mm.value * float(np.linalg.norm(corner_px))

    def post(state: StandTemperatures, stand: Geometry) -> tuple[float, float]:
        up_mm = post_mm(state, reference, stand)
        return 1e3 * up_mm, up_mm * stand.focal_px / stand.distance_mm.value

    def growth(state: StandTemperatures, stand: Geometry) -> tuple[float, float]:
        outwards_mm = target_strain(state, reference, stand) * radius_mm
        return 1e3 * outwards_mm, outwards_mm * stand.focal_px / stand.distance_mm.value

    def refraction(index: Index) -> Effect:
        def of(state: StandTemperatures, stand: Geometry) -> tuple[float, float]:
            moved = refraction_px(state, stand, corner_px, index) - refraction_px(reference, stand, corner_px, index)
            outwards_px = float(np.sign(moved[0]) * np.linalg.norm(moved))
            return outwards_px * um_per_px, outwards_px

        return of

    def tilted(state: StandTemperatures, stand: Geometry) -> tuple[float, float]:
        tilt_rad, interface_mm = math.radians(stand.interface_tilt_deg), stand.interface_mm.value
        now, before = (
            tilted_shift_mm(tilt_rad, stand.distance_mm.value, interface_mm, *indices(at, stand))
            for at in (state, reference)
        )
        return 1e3 * (now - before), (now - before) * stand.focal_px / stand.distance_mm.value

    edge = f"the outermost marker, {radius_mm:.0f} mm"
    tilt = f"refraction, interface tilted {geometry.interface_tilt_deg:g} deg"
    return [
        _largest("granite along the axis", granite, states, geometry, "the frame's corner", corrected=True),
        _largest("granite post under the camera", post, states, geometry, "everywhere, vertical", corrected=True),
        _largest("expansion of the target", growth, states, geometry, edge, corrected=True),
        _largest(
            "refraction, Ciddor 1996", refraction(ciddor_1996), states, geometry, "the frame's corner", corrected=True
        ),
        _largest(
            "the same by Edlen 1966, as in the paper", refraction(edlen_1966), states, geometry, "the frame's corner"
        ),
        _largest(tilt, tilted, states, geometry, "everywhere"),
    ]


def _largest(
    name: str,
    effect: Effect,
    states: Sequence[StandTemperatures],
    geometry: Geometry,
    where: str,
    corrected: bool = False,
) -> Contribution:
    """The effect in the state where it is largest; uncertainty by varying every uncertain input."""
    state = max(states, key=lambda at: abs(effect(at, geometry)[1]))
    nominal = np.array(effect(state, geometry))
    off = [np.array(effect(*inputs)) - nominal for inputs in varied(state, geometry)]
    u_um, u_px = np.sqrt(np.sum(np.square(off), axis=0))
    return Contribution(name, float(nominal[0]), float(u_um), float(nominal[1]), float(u_px), where, corrected)


def _linear(name: str, away_mm: float, target: Target, geometry: Geometry) -> Contribution:
    """A table that is `away_mm` too far: a scale."""
    distance_mm, radius_mm = geometry.distance_mm.value, _outermost_mm(target)
    px = away_mm / distance_mm * radius_mm / distance_mm * geometry.focal_px
    return Contribution(name, 1e3 * away_mm, math.nan, px, math.nan, "the outermost marker", False)


def _rotary(name: str, turned_deg: float, target: Target, geometry: Geometry) -> Contribution:
    """A table that is turned: the target's edge comes nearer by r phi, and its image moves outwards."""
    distance_mm, radius_mm = geometry.distance_mm.value, _outermost_mm(target)
    nearer_mm = radius_mm * math.radians(turned_deg)
    px = nearer_mm / distance_mm * radius_mm / distance_mm * geometry.focal_px
    return Contribution(name, 1e3 * nearer_mm, math.nan, px, math.nan, "the outermost marker", False)


def _homes(linear: Repeatability, rotary: Repeatability, target: Target, geometry: Geometry) -> list[Contribution]:
    found: list[Contribution] = []
    if linear.count:
        found.append(_linear(f"linear table, {linear.count} home checks", linear.rms, target, geometry))
    if rotary.count:
        found.append(_rotary(f"rotary table, {rotary.count} home checks", rotary.rms, target, geometry))
    return found


def _repeats(repeats: Repeatability, geometry: Geometry) -> list[Contribution]:
    if not repeats.count:
        return []
    um = 1e3 * repeats.rms * geometry.distance_mm.value / geometry.focal_px
    name = f"V0 seen again, {repeats.count} times, with the camera"
    return [Contribution(name, um, math.nan, repeats.rms, math.nan, "per coordinate", False)]


def _outermost_mm(target: Target) -> float:
    """From the target's middle to its outermost marker."""
    places = target.coordinates_mm()
    return float(np.linalg.norm(places - (places.min(axis=0) + places.max(axis=0)) / 2, axis=1).max())


def _is_known(state: StandTemperatures) -> bool:
    return all(math.isfinite(getattr(state, name)) for name in StandTemperatures.__dataclass_fields__)


def _number(value: float, width: int, digits: int) -> str:
    return f"{value:{width}.{digits}f}" if math.isfinite(value) else " " * width
