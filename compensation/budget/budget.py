"""One table: what each part of the stand does to the image of a session, in um on the target and in px."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.budget.geometry import Geometry, ThermometerState, UncertainValue
from thermostand.compensation.camera_selection import find_channel
from thermostand.foundation.errors import SessionError
from thermostand.foundation.events import HOME_RESIDUAL, HOME_RESIDUAL_LARGE
from thermostand.foundation.items import Event, StepState
from thermostand.markers.detection import Detection, DetectionError, detect
from thermostand.markers.target import Target
from thermostand.recording.reading.interpolation import interpolate
from thermostand.recording.reading.session import Session

_SENSORS = tuple(name.removesuffix("_degC") for name in ThermometerState.__dataclass_fields__)


@dataclass(frozen=True, slots=True)
class CaptureState:
    """A capture step of the session and the stand in the middle of it. role: reference, fit, pose ..., or empty."""

    step_id: str
    role: str
    chamber_degC: float
    start_ns: int
    end_ns: int
    state: ThermometerState


def read_stand_states(session: Session, times_ns: NDArray[np.int64]) -> list[ThermometerState]:
    """The thermometers at each instant; NaN where one was BAD or silent for more than two minutes.

    SessionError when the session has no such thermometer.
    """
    columns = [interpolate(*session.readings(f"thermometers.{sensor}"), times_ns) for sensor in _SENSORS]
    return [ThermometerState(*map(float, row)) for row in np.stack(columns, axis=1)]


def average_states(states: Sequence[ThermometerState]) -> ThermometerState:
    """The mean of each thermometer over the states that know it; NaN when none does."""
    table = np.array([[getattr(state, f"{sensor}_degC") for sensor in _SENSORS] for state in states])
    known = np.isfinite(table)
    counts = np.maximum(known.sum(axis=0), 1)
    means = np.where(known.any(axis=0), np.where(known, table, 0.0).sum(axis=0) / counts, math.nan)
    return ThermometerState(*map(float, means))


def collect_capture_states(session: Session) -> list[CaptureState]:
    """Every capture that was completed, in order; SessionError when there is none."""
    started = {mark.step_id: mark for mark in session.steps() if mark.kind == "capture" and mark.state == "started"}
    ended = {mark.step_id: mark.time_ns for mark in session.steps() if mark.state == StepState.DONE}
    marks = [mark for mark in started.values() if mark.step_id in ended]
    if not marks:
        raise SessionError(f"{session.path}: no capture was completed, so there is no state of the stand to judge")
    middles = np.array([(mark.time_ns + ended[mark.step_id]) // 2 for mark in marks], np.int64)
    found: list[CaptureState] = []
    for mark, state in zip(marks, read_stand_states(session, middles), strict=True):
        chamber = mark.parameters.get("chamber_degC")
        chamber_degC = float(chamber) if isinstance(chamber, int | float) else math.nan
        role = str(mark.parameters.get("role") or "")
        found.append(CaptureState(mark.step_id, role, chamber_degC, mark.time_ns, ended[mark.step_id], state))
    return found


KELVIN = 273.15
_PA_PER_TORR = 133.322
_GAS_J_per_mol_K = 8.314472

Index = Callable[[float, float, float, float], float]
"""(temperature_degC, pressure_Pa, vapour_Pa, wavelength_um) -> n - 1."""


def compute_saturation_Pa(temperature_degC: float) -> float:
    """Saturation vapour pressure over water (IAPWS-IF97, as NIST uses it), supercooled below 0 degC."""
    T = temperature_degC + KELVIN
    k1, k2, k3, k4, k5 = 1.16705214528e3, -7.24213167032e5, -1.70738469401e1, 1.20208247025e4, -3.23255503223e6
    k6, k7, k8, k9, k10 = 1.49151086135e1, -4.82326573616e3, 4.05113405421e5, -2.38555575678e-1, 6.50175348448e2
    omega = T + k9 / (T - k10)
    a = omega**2 + k1 * omega + k2
    b = k3 * omega**2 + k4 * omega + k5
    c = k6 * omega**2 + k7 * omega + k8
    return 1e6 * (2 * c / (-b + math.sqrt(b * b - 4 * a * c))) ** 4


def edlen_1966(temperature_degC: float, pressure_Pa: float, vapour_Pa: float, wavelength_um: float) -> float:
    """n - 1 by B. Edlen, The refractive index of air, Metrologia 2 (1966) 71."""
    S = wavelength_um**-2
    standard = (8342.13 + 2406030 / (130 - S) + 15997 / (38.9 - S)) * 1e-8
    p, pv = pressure_Pa / _PA_PER_TORR, vapour_Pa / _PA_PER_TORR
    density = p * (1 + p * (0.817 - 0.0133 * temperature_degC) * 1e-6) / (720.775 * (1 + 0.0036610 * temperature_degC))
    return standard * density - pv * (5.722 - 0.0457 * S) * 1e-8


def ciddor_1996(
    temperature_degC: float, pressure_Pa: float, vapour_Pa: float, wavelength_um: float, co2_ppm: float = 450.0
) -> float:
    """n - 1 by P. E. Ciddor, Refractive index of air: new equations for the visible, Appl. Opt. 35 (1996) 1566."""
    S = wavelength_um**-2
    axs = 1e-8 * (5792105 / (238.0185 - S) + 167917 / (57.362 - S)) * (1 + 5.34e-7 * (co2_ppm - 450))
    vs = 1.022e-8 * (295.235 + 2.6422 * S - 0.032380 * S**2 + 0.004028 * S**3)
    enhancement = 1.00062 + 3.14e-8 * pressure_Pa + 5.6e-7 * temperature_degC**2
    xv = enhancement * vapour_Pa / pressure_Pa
    molar = _compute_molar_density(temperature_degC, pressure_Pa, xv)
    # The molar masses of dry air and water cancel: densities count relative to those of the standard conditions.
    air = molar * (1 - xv) / _compute_molar_density(15.0, 101325.0, 0.0)
    water = molar * xv / _compute_molar_density(20.0, 1333.0, 1.0)
    return air * axs + water * vs


def _compute_molar_density(t: float, p: float, xv: float) -> float:
    """mol/m^3 of moist air, xv its mole fraction of water: BIPM 1981/91 compressibility (Ciddor, equation 12)."""
    T = t + KELVIN
    dry = 1.58123e-6 - 2.9331e-8 * t + 1.1043e-10 * t**2
    moist = (5.707e-6 - 2.051e-8 * t) * xv + (1.9898e-4 - 2.376e-6 * t) * xv**2
    compressibility = 1 - p / T * (dry + moist) + (p / T) ** 2 * (1.83e-11 - 0.765e-8 * xv**2)
    return p / (compressibility * _GAS_J_per_mol_K * T)


Float = NDArray[np.float64]


def compute_ray_shift_mm(
    radius_mm: Float | float, distance_mm: float, interface_mm: float, n1: float, n2: float
) -> Float:
    """Return how much further out the ray arrives, mm, for radii of any shape; negative when n1 < n2 (warm camera)."""
    tangent = np.asarray(radius_mm, dtype=np.float64) / distance_mm
    sine = n1 / n2 * tangent / np.sqrt(1 + tangent**2)
    return (distance_mm - interface_mm) * (sine / np.sqrt(1 - sine**2) - tangent)


def compute_tilt_shift_mm(tilt_rad: float, distance_mm: float, interface_mm: float, n1: float, n2: float) -> float:
    """The common shift of the whole image by an interface that is turned by tilt_rad: what it does to the axis."""
    return (distance_mm - interface_mm) * float(np.tan(tilt_rad - np.arcsin(n1 / n2 * np.sin(tilt_rad))))


def compute_refraction_px(
    offset_px: Float, focal_px: float, distance_mm: float, interface_mm: float, n1: float, n2: float
) -> Float:
    """Return how far an image point (..., 2), px from the principal point, is moved: outwards when the camera's air is
    warm.

    The ray that reaches the target's point left at a smaller radius by `shift_mm`, to first order in it.
    """
    radius_px = np.linalg.norm(offset_px, axis=-1, keepdims=True)
    radius_mm = radius_px / focal_px * distance_mm
    moved_px = -compute_ray_shift_mm(radius_mm, distance_mm, interface_mm, n1, n2) / distance_mm * focal_px
    return offset_px * moved_px / np.where(radius_px > 0, radius_px, 1.0)


@dataclass(frozen=True, slots=True)
class Repeatability:
    """Root mean square of `count` returns, in `unit`; NaN when there was none."""

    rms: float
    unit: str
    count: int


def measure_home_repeatability(events: Sequence[Event], unit: str) -> Repeatability:
    """Measure where the axes that move in `unit` (mm or deg) found their homes, against where they expected them."""
    recorded = [
        event.data
        for event in events
        if event.kind in (HOME_RESIDUAL, HOME_RESIDUAL_LARGE) and event.data.get("unit") == unit
    ]
    found = [float(residual) for data in recorded if isinstance(residual := data.get("residual"), int | float)]
    return Repeatability(_compute_rms(np.array(found)), unit, len(found))


def measure_v0_repeatability(session: Session, target: Target) -> Repeatability:
    """Return how far the image of V0 is from where it was, when the table returns to it at the end of a temperature,
    px.

    Per coordinate, over all markers and temperatures; frames of a capture are averaged. The camera's drift in
    these minutes is included: an upper limit.
    """
    pairs = _pair_v0_captures(collect_capture_states(session))
    wanted = {capture.step_id for pair in pairs for capture in pair}
    centres = _average_centres(session, target, wanted) if wanted else {}
    moved = [
        centres[again.step_id] - centres[first.step_id]
        for first, again in pairs
        if again.step_id in centres and first.step_id in centres
    ]
    return Repeatability(_compute_rms(np.array(moved)), "px", len(moved))


def _pair_v0_captures(captures: Sequence[CaptureState]) -> list[tuple[CaptureState, CaptureState]]:
    """The first pose after the last repeat is V0 (experiments/validation.py), and the next repeat is V0 again."""
    pairs: list[tuple[CaptureState, CaptureState]] = []
    first: CaptureState | None = None
    for capture in captures:
        if capture.role == "pose" and first is None:
            first = capture
        elif capture.role == "repeatability" and first is not None:
            pairs.append((first, capture))
            first = None
    return pairs


def _average_centres(session: Session, target: Target, wanted: set[str]) -> dict[str, NDArray[np.float64]]:
    """Step -> mean centres (N, 2) of its frames, NaN for markers that one of them lacks."""
    seen: dict[str, list[NDArray[np.float64]]] = {}
    previous: Detection | None = None
    own = find_channel(session)
    for frame in session.frames():
        if frame.step_id not in wanted or frame.channel != own:
            continue
        try:
            previous = detect(frame.image, target, previous)
        except DetectionError:
            continue
        good = (previous.flags == 0)[:, None]
        seen.setdefault(frame.step_id, []).append(np.where(good, previous.centres_px, np.nan))
    return {step_id: np.mean(frames, axis=0) for step_id, frames in seen.items()}


def _compute_rms(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan


def compute_displacement_px(
    state: ThermometerState, reference: ThermometerState, geometry: Geometry, xy_px: Float
) -> Float:
    """The displacement of image points (..., 2) by granite, post, target and air, from `reference` to `state`."""
    centre = (np.array(geometry.image_px) - 1) / 2
    offset = np.asarray(xy_px, dtype=np.float64) - centre
    scale = (
        compute_target_strain(state, reference, geometry)
        - compute_granite_mm(state, reference, geometry) / geometry.distance_mm.value
    )
    post = compute_post_mm(state, reference, geometry) * geometry.focal_px / geometry.distance_mm.value
    roll = math.radians(geometry.camera_roll_deg)
    down = np.array([math.sin(roll), math.cos(roll)])
    refraction = compute_air_refraction_px(state, geometry, offset) - compute_air_refraction_px(
        reference, geometry, offset
    )
    return scale * offset + post * down + refraction


def vary_inputs(state: ThermometerState, geometry: Geometry) -> Iterator[tuple[ThermometerState, Geometry]]:
    """State and geometry with one uncertain input after the other larger by its standard uncertainty."""
    for name in Geometry.model_fields:
        quantity = getattr(geometry, name)
        if isinstance(quantity, UncertainValue) and quantity.u > 0:
            larger = UncertainValue(value=quantity.value + quantity.u, u=quantity.u)
            yield state, geometry.model_copy(update={name: larger})
    for field in fields(ThermometerState):
        on_granite = geometry.granite_gradient_K if field.name.startswith("granite") else 0.0
        yield state.warmer_by(**{field.name: math.hypot(geometry.thermometer_K, on_granite)}), geometry


def compute_granite_mm(state: ThermometerState, reference: ThermometerState, geometry: Geometry) -> float:
    """Return how much the base has moved the target away from the camera."""
    inside_K = state.granite_inside_degC - reference.granite_inside_degC
    outside_K = state.granite_outside_degC - reference.granite_outside_degC
    lengths_mm_K = geometry.granite_inside_mm.value * inside_K + geometry.granite_outside_mm.value * outside_K
    return geometry.granite_per_K.value * lengths_mm_K


def compute_post_mm(state: ThermometerState, reference: ThermometerState, geometry: Geometry) -> float:
    """Return how much the post has lifted the camera."""
    inside_K = state.granite_inside_degC - reference.granite_inside_degC
    return geometry.granite_per_K.value * geometry.post_mm.value * inside_K


def compute_target_strain(state: ThermometerState, reference: ThermometerState, geometry: Geometry) -> float:
    """Relative growth of the target."""
    return geometry.target_per_K.value * (state.artifact_degC - reference.artifact_degC)


def compute_air_refraction_px(
    state: ThermometerState, geometry: Geometry, offset_px: Float, index: Index = ciddor_1996
) -> Float:
    """Return how far points (..., 2), px from the principal point, appear outwards by the air's indices on both
    sides."""
    n1, n2 = compute_indices(state, geometry, index)
    return compute_refraction_px(
        offset_px, geometry.focal_px, geometry.distance_mm.value, geometry.interface_mm.value, n1, n2
    )


def compute_indices(state: ThermometerState, geometry: Geometry, index: Index = ciddor_1996) -> tuple[float, float]:
    """Refractive indices of the air at the camera and of the laboratory's."""
    pressure_Pa = geometry.pressure_Pa.value
    laboratory_Pa = geometry.relative_humidity.value * compute_saturation_Pa(state.laboratory_degC)
    chamber_Pa = min(laboratory_Pa, compute_saturation_Pa(state.air_degC))
    n1 = 1 + index(state.air_degC, pressure_Pa, chamber_Pa, geometry.wavelength_um)
    return n1, 1 + index(state.laboratory_degC, pressure_Pa, laboratory_Pa, geometry.wavelength_um)


Effect = Callable[[ThermometerState, Geometry], tuple[float, float]]
"""(state, geometry) -> (um on or of the target, px in the image)."""


@dataclass(frozen=True, slots=True)
class BudgetLine:
    """One line. um, px: at its largest over the session's captures, with sign. u_um, u_px: their standard
    uncertainties; NaN for a scatter, which is one itself. where: the place in the image. corrected: whether
    a validation takes it out, so that only the uncertainty stays.
    """

    name: str
    um: float
    px: float
    where: str
    u_um: float = math.nan
    u_px: float = math.nan
    corrected: bool = False


@dataclass(frozen=True, slots=True)
class Budget:
    """A session's contributions against its reference state; coolest and warmest air at the camera during captures."""

    reference: ThermometerState
    air_degC: tuple[float, float]
    contributions: tuple[BudgetLine, ...]


def compute_budget(session: Session, target: Target, geometry: Geometry) -> Budget:
    """The stand's part in a session. Reference: the mean of the captures of role reference, else the first capture.

    SessionError when a thermometer was silent in all captures.
    """
    captures = [capture for capture in collect_capture_states(session) if _is_known(capture.state)]
    if not captures:
        raise SessionError(
            f"{session.path}: in no capture were all five thermometers alive: the stand cannot be judged"
        )
    reference = average_states([c.state for c in captures if c.role == "reference"] or [captures[0].state])
    ends_ns = np.array([time_ns for capture in captures for time_ns in (capture.start_ns, capture.end_ns)], np.int64)
    states = [*(capture.state for capture in captures), *filter(_is_known, read_stand_states(session, ends_ns))]
    thermal = _compute_thermal_lines(states, reference, geometry, _compute_target_radius_mm(target))
    events = session.events()
    table = (
        _make_linear_line("linear table, resolution", geometry.linear_mm, target, geometry),
        _make_rotary_line("rotary table, resolution", geometry.rotary_deg, target, geometry),
        *_make_home_lines(
            measure_home_repeatability(events, "mm"), measure_home_repeatability(events, "deg"), target, geometry
        ),
        *_make_repeat_lines(measure_v0_repeatability(session, target), geometry),
    )
    air = [state.air_degC for state in states]
    return Budget(reference, (min(air), max(air)), (*thermal, *table))


def format_budget(budget: Budget) -> str:
    """The budget for a console."""
    reference = budget.reference
    lines = [
        f"reference: air {reference.air_degC:.2f}, granite {reference.granite_inside_degC:.2f} / "
        f"{reference.granite_outside_degC:.2f}, artifact {reference.artifact_degC:.2f}, laboratory "
        f"{reference.laboratory_degC:.2f} degC; captures at {budget.air_degC[0]:.1f} to {budget.air_degC[1]:.1f} degC",
        f"{'contribution':44} {'um':>9} {'u':>8} {'px':>9} {'u':>8}  at",
    ]
    for line in budget.contributions:
        numbers = (
            _format_number(line.um, 9, 2),
            _format_number(line.u_um, 8, 2),
            _format_number(line.px, 9, 4),
            _format_number(line.u_px, 8, 4),
        )
        lines.append(f"{line.name:44} {' '.join(numbers)}  {line.where}{', correctable' if line.corrected else ''}")
    return "\n".join(lines)


def _compute_thermal_lines(
    states: Sequence[ThermometerState], reference: ThermometerState, geometry: Geometry, radius_mm: float
) -> list[BudgetLine]:
    um_per_px = 1e3 * geometry.distance_mm.value / geometry.focal_px
    corner_px = np.array([(geometry.image_px[0] - 1) / 2, (geometry.image_px[1] - 1) / 2])

    def granite(state: ThermometerState, stand: Geometry) -> tuple[float, float]:
        away_mm = compute_granite_mm(state, reference, stand)
        return 1e3 * away_mm, -away_mm / stand.distance_mm.value * float(np.linalg.norm(corner_px))

    def post(state: ThermometerState, stand: Geometry) -> tuple[float, float]:
        up_mm = compute_post_mm(state, reference, stand)
        return 1e3 * up_mm, up_mm * stand.focal_px / stand.distance_mm.value

    def growth(state: ThermometerState, stand: Geometry) -> tuple[float, float]:
        outwards_mm = compute_target_strain(state, reference, stand) * radius_mm
        return 1e3 * outwards_mm, outwards_mm * stand.focal_px / stand.distance_mm.value

    def refraction(index: Index) -> Effect:
        def of(state: ThermometerState, stand: Geometry) -> tuple[float, float]:
            moved = compute_air_refraction_px(state, stand, corner_px, index) - compute_air_refraction_px(
                reference, stand, corner_px, index
            )
            outwards_px = float(np.sign(moved[0]) * np.linalg.norm(moved))
            return outwards_px * um_per_px, outwards_px

        return of

    def tilted(state: ThermometerState, stand: Geometry) -> tuple[float, float]:
        tilt_rad, interface_mm = math.radians(stand.interface_tilt_deg), stand.interface_mm.value
        now, before = (
            compute_tilt_shift_mm(tilt_rad, stand.distance_mm.value, interface_mm, *compute_indices(at, stand))
            for at in (state, reference)
        )
        return 1e3 * (now - before), (now - before) * stand.focal_px / stand.distance_mm.value

    edge = f"the outermost marker, {radius_mm:.0f} mm"
    tilt = f"refraction, interface tilted {geometry.interface_tilt_deg:g} deg"
    return [
        _find_largest_effect("granite along the axis", granite, states, geometry, "the frame's corner", corrected=True),
        _find_largest_effect(
            "granite post under the camera", post, states, geometry, "everywhere, vertical", corrected=True
        ),
        _find_largest_effect("expansion of the target", growth, states, geometry, edge, corrected=True),
        _find_largest_effect(
            "refraction, Ciddor 1996", refraction(ciddor_1996), states, geometry, "the frame's corner", corrected=True
        ),
        _find_largest_effect(
            "the same by Edlen 1966, as in the paper", refraction(edlen_1966), states, geometry, "the frame's corner"
        ),
        _find_largest_effect(tilt, tilted, states, geometry, "everywhere"),
    ]


def _find_largest_effect(
    name: str,
    effect: Effect,
    states: Sequence[ThermometerState],
    geometry: Geometry,
    where: str,
    corrected: bool = False,
) -> BudgetLine:
    """The effect in the state where it is largest; uncertainty by varying every uncertain input."""
    state = max(states, key=lambda at: abs(effect(at, geometry)[1]))
    nominal = np.array(effect(state, geometry))
    off = [np.array(effect(*inputs)) - nominal for inputs in vary_inputs(state, geometry)]
    u_um, u_px = np.sqrt(np.sum(np.square(off), axis=0))
    um, px = nominal.tolist()
    return BudgetLine(name, um, px, where, u_um=float(u_um), u_px=float(u_px), corrected=corrected)


def _make_linear_line(name: str, away_mm: float, target: Target, geometry: Geometry) -> BudgetLine:
    """A table that is `away_mm` too far: a scale."""
    distance_mm, radius_mm = geometry.distance_mm.value, _compute_target_radius_mm(target)
    px = away_mm / distance_mm * radius_mm / distance_mm * geometry.focal_px
    return BudgetLine(name, 1e3 * away_mm, px, "the outermost marker")


def _make_rotary_line(name: str, turned_deg: float, target: Target, geometry: Geometry) -> BudgetLine:
    """A table that is turned: the target's edge comes nearer by r phi, and its image moves outwards."""
    distance_mm, radius_mm = geometry.distance_mm.value, _compute_target_radius_mm(target)
    nearer_mm = radius_mm * math.radians(turned_deg)
    px = nearer_mm / distance_mm * radius_mm / distance_mm * geometry.focal_px
    return BudgetLine(name, 1e3 * nearer_mm, px, "the outermost marker")


def _make_home_lines(
    linear: Repeatability, rotary: Repeatability, target: Target, geometry: Geometry
) -> list[BudgetLine]:
    found: list[BudgetLine] = []
    if linear.count:
        found.append(_make_linear_line(f"linear table, {linear.count} home checks", linear.rms, target, geometry))
    if rotary.count:
        found.append(_make_rotary_line(f"rotary table, {rotary.count} home checks", rotary.rms, target, geometry))
    return found


def _make_repeat_lines(repeats: Repeatability, geometry: Geometry) -> list[BudgetLine]:
    if not repeats.count:
        return []
    um = 1e3 * repeats.rms * geometry.distance_mm.value / geometry.focal_px
    name = f"V0 seen again, {repeats.count} times, with the camera"
    return [BudgetLine(name, um, repeats.rms, "per coordinate")]


def _compute_target_radius_mm(target: Target) -> float:
    """Compute the distance from the target's middle to its outermost marker."""
    places = target.coordinates_mm()
    return float(np.linalg.norm(places - (places.min(axis=0) + places.max(axis=0)) / 2, axis=1).max())


def _is_known(state: ThermometerState) -> bool:
    return all(math.isfinite(getattr(state, name)) for name in ThermometerState.__dataclass_fields__)


def _format_number(value: float, width: int, digits: int) -> str:
    return f"{value:{width}.{digits}f}" if math.isfinite(value) else " " * width
