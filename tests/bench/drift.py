"""The drift models against the noise-free truth: on sessions of the simulated laboratory, of its cameras of
configs/optics, and of cameras drawn from published numbers.

The laboratory's sessions come from the physics of drivers/sim alone, without wires and images, with the noise that the
marker fit has on its images (2.4 mpx) and a camera that tells its temperature in quarters of a degree. No form is to be
changed in view of the cameras of configs/optics: numbers 200 to 202 of each preset.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from tests.bench.drift_drawn import Score, draw_effects, record_drawn_session, score
from tests.bench.drift_drawn import figures as drawn_figures
from tests.bench.figures import (
    Figure,
    compare,
    make_absolute,
    report_progress,
    set_lower_goal,
    set_upper_goal,
    set_upper_ratio_goal,
)
from tests.benchmark.benchmark_cases import GROUPS, TASKS, TRAININGS, make_case
from tests.benchmark.methods import corrector
from tests.benchmark.scoring import Corrector, score_method
from tests.compensation import plant_sessions
from tests.compensation.drawn_cameras import FOCAL_PX, RADIAL, Camera, draw_camera, draw_unit, target_mm
from tests.compensation.drawn_sessions import (
    START_NS,
    Bump,
    DrawnSession,
    cycle,
    make_full_session,
    record_session,
    reference,
    warm_up,
)
from tests.compensation.plant_sessions import Dwell, Published, WarmUp, warm_up_and_cycles
from thermostand.compensation.drift.bumps import find_bumps
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.model_selection import FORMS, fit
from thermostand.compensation.drift.rereference import fit_like
from thermostand.compensation.drift.thermal_fit import fit_thermal
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Float, Observations, concatenate
from thermostand.drivers.camera_preset import Effect
from thermostand.drivers.sim.physics.optics import CameraKind
from thermostand.experiments.steps import Role

PEER = "paper's form"
LEAST_COVERED = 92
ASKED_DEGC = (31, 41, 48, 41, 31, 20, 14, 20)
ANOTHER_SESSION = [WarmUp(20.0), Dwell(24.0, "reference", 2700, 20)]


def figures(directory: Path) -> Iterator[Figure]:
    """mpx RMS of both coordinates of what is left, and how often the 95 % intervals hold."""
    yield from _score_laboratory()
    yield from drawn_figures()
    yield from _score_presets()
    yield from _score_moving_air()
    yield from _score_beyond_range()
    yield from _score_bumps()
    for way_degC in ((38, 52, 38, 24, 10, 24), (34, 44, 52, 44, 34, 24, 17, 10, 17, 24)):
        yield from _score_few_set_points(way_degC)
    yield _score_several_sessions()
    yield from _score_in_space()
    yield from _score_units()


def _draw_camera(seed: int, *more: str) -> Camera:
    """A camera with what repeats, and more."""
    return draw_camera(seed, *draw_effects(seed, unrepeating=False)[0], *more)


def _record_asked_session(
    camera: Camera, way_degC: Sequence[int], seed: int, place_mm: Float | None = None
) -> DrawnSession:
    """Another session, of held-out temperatures alone."""
    parts = [*warm_up(), *reference(), *cycle(tuple(way_degC), tuple(way_degC))]
    return record_session(camera, parts, seed, session_id="session-2", place_mm=place_mm)


def _compute_coverage(found: Sequence[Score]) -> float:
    return 100 * float(np.mean([one.covered for one in found]))


def _map_by_form(chosen: DriftModel) -> dict[str, DriftModel]:
    return {model.form: model for model in (chosen, chosen.other) if model is not None}


# ------------------------------------------------------------------------------------------ the simulated laboratory


def _score_laboratory() -> Iterator[Figure]:
    """At held-out temperatures and in warm-ups elsewhere: medians of several sessions. The terms were chosen with
    sessions of seeds 1 to 4 in view."""
    found: dict[tuple[str, str, float | None], list[tuple[float, float]]] = {}
    for seed in (5, 6, 7, 8):
        report_progress(f"drift, one session of each camera, seed {seed}")
        for what, unit, goal, pair in _score_seed(seed):
            found.setdefault((what, unit, goal), []).append(pair)
    for (what, unit, goal), pairs in found.items():
        figure = compare(what, unit, PEER, *zip(*pairs, strict=True))
        yield figure if goal is None else set_upper_goal(goal, figure)


def _score_seed(seed: int) -> Iterator[tuple[str, str, float | None, tuple[float, float]]]:
    """What, unit, goal, and the thermal form's value with the paper's."""
    kinds: dict[CameraKind, float] = {"modified": 5.0, "unmodified": 15.0}
    for kind, goal_mpx in kinds.items():
        seen = DrawnSession(*plant_sessions.record_plant_session(kind, seed, warm_up_and_cycles(2)))
        models = [fit(seen.observed, form=form) for form in ("thermal", "paper")]
        held_out = [score(model, seen) for model in models]
        thermal, paper = (one.rms_mpx for one in held_out)
        yield f"drift, {kind} camera, held-out temperatures", "mpx RMS", goal_mpx, (thermal, paper)
        thermal, paper = (100 * one.covered for one in held_out)
        yield f"  95 % interval, {kind}; 92 to 98 is right", "%", None, (thermal, paper)
        for air_degC in (15.0, 34.0) if kind == "modified" else ():
            elsewhere = plant_sessions.record_plant_session(
                kind, seed, [Dwell(24.0, "reference", 2700, 20), WarmUp(air_degC)]
            )
            thermal, paper = (score(model, DrawnSession(*elsewhere), Role.WARM_UP).rms_mpx for model in models)
            yield f"drift, warm-up at {air_degC:g} degC", "mpx RMS", 3.0, (thermal, paper)


PRESETS, NUMBERS = ("nac", "navcam", "dic", "phone"), range(200, 203)
HELD_OUT, SWITCHED_ON = "held-out temperatures", "switching on, another session"
GOAL_MPX = {"what repeats": {HELD_OUT: 5.0, SWITCHED_ON: 6.4}, "and what does not": {HELD_OUT: 10.0}}
REPEATING: tuple[Effect, ...] = ("sag", "dead_zone", "creep", "coarse_sensor", "far_air")
UNREPEATING: tuple[Effect, ...] = ("stick_slip", "unrepeated")
_CHANCE = 0.4


def _iterate_published(group: str) -> Iterator[Published]:
    """Of each preset, with the effects that are drawn for its number."""
    for preset in PRESETS:
        for number in NUMBERS:
            rng = np.random.default_rng([22, PRESETS.index(preset), number])
            effects: tuple[Effect, ...] = tuple(name for name in REPEATING if rng.random() < _CHANCE)
            one = UNREPEATING[rng.integers(2)]
            yield Published(preset, number, (*effects, one) if group != "what repeats" else effects)


def _score_presets() -> Iterator[Figure]:
    """Medians of the cameras at held-out temperatures and when switched on at 20 degC on another session, and how often
    the 95 % intervals of the answers without a flag hold."""
    for group, goals_mpx in GOAL_MPX.items():
        found: dict[str, list[tuple[Score, Score, bool]]] = {HELD_OUT: [], SWITCHED_ON: []}
        for camera in _iterate_published(group):
            report_progress(f"drift, {camera.preset} {camera.drawn}, {', '.join(camera.effects)}")
            first = DrawnSession(*plant_sessions.record_plant_session(camera, camera.drawn, warm_up_and_cycles()))
            second = DrawnSession(
                *plant_sessions.record_plant_session(camera, camera.drawn + 1000, ANOTHER_SESSION, "cycle-2")
            )
            model = fit(first.observed)
            paper = _map_by_form(model).get("paper", model)
            at_reference_px = first.truth_px[first.observed.of(Role.REFERENCE)].mean(axis=0)
            for what, seen, role in ((HELD_OUT, first, Role.VALIDATION), (SWITCHED_ON, second, Role.WARM_UP)):
                ours, peer = (score(one, seen, role, at_reference_px) for one in (model, paper))
                found[what].append((ours, peer, "dead_zone" in camera.effects))
        for what, rows in found.items():
            yield from _summarise_presets(f"drift, presets, {group}, {what}", goals_mpx.get(what), rows)


def _summarise_presets(what: str, goal_mpx: float | None, rows: list[tuple[Score, Score, bool]]) -> Iterator[Figure]:
    ours = [own for own, _, _ in rows]
    left_mpx = [one.rms_mpx for one in ours]
    median = compare(what, "mpx RMS", PEER, left_mpx, [peer.rms_mpx for _, peer, _ in rows])
    yield median if goal_mpx is None else set_upper_goal(goal_mpx, median)
    yield make_absolute("  the worst camera", "mpx RMS", [max(left_mpx)])
    yield set_lower_goal(LEAST_COVERED, _summarise_coverage("", ours))
    yield make_absolute("  answers without a flag", "%", [100 * float(np.mean([one.unflagged for one in ours]))])
    few = [own for own, _, has_dead_zone in rows if not has_dead_zone]
    yield make_absolute(f"  the {len(few)} cameras without a dead zone", "mpx RMS", [one.rms_mpx for one in few])
    yield set_lower_goal(LEAST_COVERED, _summarise_coverage(" of these", few))


def _summarise_coverage(whose: str, found: list[Score]) -> Figure:
    weights = [one.unflagged for one in found]
    share = float(np.average(np.nan_to_num([one.covered_unflagged for one in found]), weights=weights))
    return make_absolute(f"  95 % intervals of unflagged answers{whose}; 92 to 98 is right", "%", [100 * share])


# ----------------------------------------------------------------------------------------------------- drawn cameras


def _score_moving_air() -> Iterator[Figure]:
    """In moving air, learned with frames on the way, without and with what does not repeat; cameras beyond those of
    `make benchmark`."""

    def everywhere(training: Observations) -> Corrector:
        """The thermal form, which stands by all of its answers here."""
        corrected = corrector(fit(training, form="thermal"))
        return lambda made, frames, seen_px: replace(corrected(made, frames, seen_px), inside=None)

    for group in GROUPS:
        report_progress(f"drift, drawn cameras in moving air, {group}")
        found = [
            one
            for number in range(40, 46)
            for one in score_method("thermal", everywhere, make_case(group, number, TRAININGS[1]))
        ]
        for task in TASKS[1:]:
            those = [one for one in found if one.task == task]
            yield make_absolute(f"drift, {task}; {group}", "mpx RMS", [one.rms_mpx for one in those])
            covered = 100 * float(np.mean([one.covered for one in those]))
            yield set_lower_goal(LEAST_COVERED, make_absolute("  95 % interval, flagged or not", "%", [covered]))


def _score_beyond_range() -> Iterator[Figure]:
    """Asked beyond what was fitted, 17..45 degC, in another session: coverage of the 95 % interval, and how much of it
    carries a flag."""
    fitted_degC = (27, 31, 34, 38, 41, 45, 41, 38, 34, 31, 27, 24, 20, 17, 20, 24)
    report_progress("drift, drawn cameras asked beyond what was fitted")
    found = []
    for seed in range(12):
        parts = [*warm_up(), *reference(), *cycle(fitted_degC, (20, 27, 34, 41))]
        model = fit(record_session(_draw_camera(seed), parts, seed).observed)
        found.append(
            score(model, _record_asked_session(_draw_camera(seed), (10, 14, 17, 20, 31, 48, 52, 48, 41), seed + 50))
        )
    yield set_lower_goal(
        LEAST_COVERED, make_absolute("drift, 95 % interval beyond what was fitted", "%", [_compute_coverage(found)])
    )
    yield make_absolute("  of these, flagged", "%", [100 * (1 - float(np.mean([one.unflagged for one in found])))])


CLEAN_SESSIONS, BUMPED_SESSIONS = 300, 20


def _score_bumps() -> Iterator[Figure]:
    """How many bumps are found, how many where there are none, and what a fit leaves: sessions without slips and
    fixings that settle again, which are steps themselves and have a line of their own. The least gain of a bump was
    chosen on sessions from 1000 on."""
    report_progress(f"drift, {CLEAN_SESSIONS} sessions without a bump")
    sessions = (record_drawn_session(500 + seed, unrepeating=False) for seed in range(CLEAN_SESSIONS))
    false = sum(bool(find_bumps(made.observed)) for made in sessions)
    yield set_upper_goal(
        1, make_absolute("drift, sessions with a bump that was none", "%", [100 * false / CLEAN_SESSIONS])
    )
    slips = [seed for seed in range(60) if "stick_slip" in draw_effects(seed, unrepeating=True)[0]][:BUMPED_SESSIONS]
    counts = [len(find_bumps(record_drawn_session(seed, unrepeating=True).observed)) for seed in slips]
    yield make_absolute("  steps found a session in cameras that slip", "", [float(np.mean(counts))])
    for size_px in (0.05, 0.1, 0.3):
        report_progress(f"drift, bumps of {size_px} px")
        found, bumped, clean = 0, [], []
        for seed in range(BUMPED_SESSIONS):
            is_found, left_mpx = _score_bumped(seed, size_px)
            found += is_found
            bumped.append(left_mpx)
            clean.append(_score_clean_mpx(seed))
        share = 100 * found / BUMPED_SESSIONS
        yield set_lower_goal(100, make_absolute(f"drift, bumps of {size_px:g} px that are found", "%", [share]))
        left = compare("  residual of the truth after it", "mpx RMS", "the same session without", bumped, clean)
        yield set_upper_goal(1.5 * float(np.median(clean)), left)


@cache
def _score_clean_mpx(seed: int) -> float:
    """What is left in the same session without a bump."""
    made = record_session(_draw_camera(seed), make_full_session(), seed)
    return score(fit(made.observed, form="thermal"), made).rms_mpx


def _score_bumped(seed: int, size_px: float) -> tuple[bool, float]:
    """Whether a bump somewhere in the session is found where it was, to a dwell, and what is left then."""
    rng = np.random.default_rng([19, seed])
    at_h, angle = float(rng.uniform(6.5, 21.0)), rng.uniform(-np.pi, np.pi)
    bump = Bump(at_h, size_px * np.array([np.cos(angle), np.sin(angle)]))
    made = record_session(_draw_camera(seed), make_full_session(), seed, [bump])
    model = fit(made.observed, form="thermal")
    spans_h = [((one.after_ns - START_NS) / 3.6e12, (one.before_ns - START_NS) / 3.6e12) for one in model.facts.bumps]
    is_found = any(after_h - 0.8 < at_h < before_h + 0.8 for after_h, before_h in spans_h)
    return is_found, score(model, made).rms_mpx


def _score_few_set_points(way_degC: tuple[int, ...]) -> Iterator[Figure]:
    """With few set-points: which form is chosen, and what each leaves at others on another session."""
    report_progress(f"drift, drawn cameras with {len(way_degC)} visits")
    left: dict[str, list[float]] = {form: [] for form in FORMS}
    right, cameras = 0, range(2800, 2806)
    for seed in cameras:
        parts = [*warm_up(), *reference(), *cycle(way_degC, ())]
        chosen = fit(record_session(_draw_camera(seed), parts, seed).observed)
        asked = _record_asked_session(_draw_camera(seed), ASKED_DEGC, seed + 50)
        here = {form: score(model, asked).rms_mpx for form, model in _map_by_form(chosen).items()}
        for form in FORMS:
            left[form].append(here[form])
        right += here[chosen.form] == min(here.values())
    what = f"drift, {len(way_degC)} visits of few set-points, thermal form"
    yield compare(what, "mpx RMS", PEER, left["thermal"], left["paper"])
    yield set_lower_goal(100, make_absolute("  the better form is chosen", "%", [100 * right / len(cameras)]))


def _score_several_sessions() -> Figure:
    """Two sessions fitted together, asked about a third, beside fixings that settle again."""
    report_progress("drift, drawn cameras with two sessions")
    found = []
    for seed in range(2900, 2906):
        camera = _draw_camera(seed, "unrepeated")
        sessions = [
            record_session(camera, make_full_session(), 10 * seed + k, session_id=f"session-{k}") for k in range(3)
        ]
        model = fit_thermal(concatenate([one.observed for one in sessions[:2]]))
        found.append(score(model, sessions[2]))
    what = "drift, 95 % interval of two sessions in a third, fixings settle again"
    return set_lower_goal(LEAST_COVERED, make_absolute(what, "%", [_compute_coverage(found)]))


POSITIONS = ((0.0, 0.0), (25.0, 8.0), (-60.0, -20.0), (70.0, 22.0))
"""V0..V3: linear mm, rotary deg."""
_STEP = 1e-4


def _score_in_space() -> Iterator[Figure]:
    """How far a target at V0..V3 seems to move in space, after compensation, while only the temperature did: on another
    session, without the noise of the markers, with the camera's true calibration at the reference. RMS along the
    image's axes and along the line of sight, um, of the target's middle; and of the markers, mpx."""
    report_progress("drift, V0..V3 in space, drawn cameras")
    found: dict[str, list[Float]] = {form: [] for form in FORMS}
    for seed in range(3300, 3310):
        chosen = fit(record_session(_draw_camera(seed), make_full_session(), seed).observed)
        places = [target_mm(*each) for each in POSITIONS]
        seen = [
            _record_asked_session(_draw_camera(seed), ASKED_DEGC, seed + 50_000, place_mm=place) for place in places
        ]
        for form, model in _map_by_form(chosen).items():
            each = [_compute_motion(model, made, place) for made, place in zip(seen, places, strict=True)]
            found[form].append(np.sqrt(np.mean(np.concatenate(each) ** 2, axis=0)))
    thermal, paper = (np.array(found[form]).T.tolist() for form in ("thermal", "paper"))
    for axis, (name, goal_um) in enumerate((("x", 1.0), ("y", 2.0), ("z", 5.0))):
        what = f"drift, V0..V3 on another session, along {name}"
        yield set_upper_goal(goal_um, compare(what, "um RMS", PEER, thermal[axis], paper[axis]))
    yield compare("  in the image", "mpx RMS", PEER, thermal[3], paper[3])


def _compute_motion(model: DriftModel, made: DrawnSession, place_mm: Float) -> Float:
    """(F, 4): of each held-out frame how far the target's middle seems to be from where it is at the session's own
    reference, um, and RMS of the markers, mpx."""
    observed, truth = made.observed, made.truth_px
    states = compute_frame_states(observed, model.memory)

    def corrected(role: str) -> Float:
        frames = np.flatnonzero(observed.of(role)).tolist()
        return np.array([model.correct(truth[k], states.where(np.array([k]))) for k in frames])

    away = corrected(Role.VALIDATION) - corrected(Role.REFERENCE).mean(axis=0)
    motions = np.linalg.lstsq(_compute_pose_derivatives(place_mm), away.reshape(len(away), -1).T, rcond=None)[0]
    return np.column_stack([1e3 * motions[:3].T, 1e3 * np.sqrt((away**2).mean(axis=(1, 2)))])


def _compute_pose_derivatives(place_mm: Float) -> Float:
    """(108, 6), px per mm along the axes and per rad about them, through the target's middle."""
    middle = place_mm.mean(axis=0)
    columns: list[Float] = []
    for axis in range(6):
        step = np.zeros(3)
        step[axis % 3] = _STEP
        more = np.asarray(np.cross(step, place_mm - middle), np.float64) if axis > 2 else step
        columns.append(((_project_px(place_mm + more) - _project_px(place_mm - more)) / (2 * _STEP)).ravel())
    return np.stack(columns, axis=1)


def _project_px(place_mm: Float) -> Float:
    """(N, 2): by the calibration of all drawn cameras at the reference."""
    ray = place_mm[:, :2] / place_mm[:, 2:]
    return FOCAL_PX * ray * (1 + RADIAL * (ray**2).sum(axis=1, keepdims=True))


def _score_units() -> Iterator[Figure]:
    """A new unit of a camera type, seen at two temperatures, with what six other units have shown, on another session:
    beside a model of the unit's own whole session."""
    report_progress("drift, new units of drawn types")
    found, whole = [], []
    for seed in range(7800, 7810):
        effects, own = draw_effects(seed, unrepeating=False)[0], 99
        units = [
            fit_thermal(record_session(draw_unit(seed, k, *effects), make_full_session(), k).observed) for k in range(6)
        ]
        new = draw_unit(seed, own, *effects)
        asked = _record_asked_session(new, ASKED_DEGC, own + 200)
        seen = record_session(new, [*warm_up(), *reference(), *cycle((45,), ())], own + 100)
        found.append(score(fit_like(seen.observed, units), asked))
        whole.append(score(fit_thermal(record_session(new, make_full_session(), own).observed), asked).rms_mpx)
    what = "drift, a new unit of a known type from two temperatures"
    left = compare(what, "mpx RMS", "its whole session", [one.rms_mpx for one in found], whole)
    yield set_upper_ratio_goal(1.5, left)
    yield set_lower_goal(LEAST_COVERED, make_absolute("  95 % interval", "%", [_compute_coverage(found)]))
