"""The drift models against the noise-free truth: on nights of the simulated laboratory, of its cameras of
configs/optics, and of cameras drawn from published numbers.

The laboratory's nights come from the physics of drivers/sim alone, without wires and images, with the noise that the
marker fit has on its images (2.4 mpx) and a camera that tells its temperature in quarters of a degree. No form is to be
changed in view of the cameras of configs/optics: numbers 200 to 202 of each preset.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np

from tests.bench.drift_drawn import Score, drawn_night, effects_of, score
from tests.bench.drift_drawn import figures as drawn_figures
from tests.bench.figures import Figure, absolute, at_least, at_most, progress, ratio_at_most, side_by_side
from tests.benchmark.methods import corrector
from tests.benchmark.nights import GROUPS, TASKS, TRAININGS, case
from tests.benchmark.scoring import Corrector, scores
from tests.compensation import plant_night
from tests.compensation.drawn_cameras import FOCAL_PX, RADIAL, Camera, drawn_camera, drawn_unit, target_mm
from tests.compensation.drawn_nights import START_NS, Bump, Night, cycle, full_night, night, reference, warm_up
from tests.compensation.plant_night import Dwell, Published, WarmUp, warm_up_and_cycles
from thermostand.compensation.drift.anchoring import fit_like
from thermostand.compensation.drift.bumps import find_bumps
from thermostand.compensation.drift.choosing import FORMS, fit
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.thermal_learning import fit_thermal
from thermostand.compensation.drift.training import frame_states
from thermostand.compensation.observations import Float, Observations, concatenate
from thermostand.drivers.camera_preset import Effect
from thermostand.drivers.sim.physics.optics import CameraKind
from thermostand.experiments.steps import Role

PEER = "paper's form"
LEAST_COVERED = 92
ASKED_DEGC = (31, 41, 48, 41, 31, 20, 14, 20)
ANOTHER_NIGHT = [WarmUp(20.0), Dwell(24.0, "reference", 2700, 20)]


def figures(directory: Path) -> Iterator[Figure]:
    """mpx RMS of both coordinates of what is left, and how often the 95 % intervals hold."""
    yield from _laboratory()
    yield from drawn_figures()
    yield from _presets()
    yield from _moving()
    yield from _beyond()
    yield from _bumps()
    for way_degC in ((38, 52, 38, 24, 10, 24), (34, 44, 52, 44, 34, 24, 17, 10, 17, 24)):
        yield from _few(way_degC)
    yield _several()
    yield from _space()
    yield from _units()


def _drawn(seed: int, *more: str) -> Camera:
    """A camera with what repeats, and more."""
    return drawn_camera(seed, *effects_of(seed, unrepeating=False)[0], *more)


def _asked(camera: Camera, way_degC: Sequence[int], seed: int, place_mm: Float | None = None) -> Night:
    """Another night, of held-out temperatures alone."""
    parts = [*warm_up(), *reference(), *cycle(tuple(way_degC), tuple(way_degC))]
    return night(camera, parts, seed, session_id="night-2", place_mm=place_mm)


def _covered(found: Sequence[Score]) -> float:
    return 100 * float(np.mean([one.covered for one in found]))


def _by_form(chosen: DriftModel) -> dict[str, DriftModel]:
    return {model.form: model for model in (chosen, chosen.other) if model is not None}


# ------------------------------------------------------------------------------------------ the simulated laboratory


def _laboratory() -> Iterator[Figure]:
    """At held-out temperatures and in warm-ups elsewhere: medians of several nights. The terms were chosen with nights
    of seeds 1 to 4 in view."""
    found: dict[tuple[str, str, float | None], list[tuple[float, float]]] = {}
    for seed in (5, 6, 7, 8):
        progress(f"drift, one night of each camera, seed {seed}")
        for what, unit, goal, pair in _of_seed(seed):
            found.setdefault((what, unit, goal), []).append(pair)
    for (what, unit, goal), pairs in found.items():
        figure = side_by_side(what, unit, PEER, *zip(*pairs, strict=True))
        yield figure if goal is None else at_most(goal, figure)


def _of_seed(seed: int) -> Iterator[tuple[str, str, float | None, tuple[float, float]]]:
    """What, unit, goal, and the thermal form's value with the paper's."""
    kinds: dict[CameraKind, float] = {"modified": 5.0, "unmodified": 15.0}
    for kind, goal_mpx in kinds.items():
        seen = Night(*plant_night.night(kind, seed, warm_up_and_cycles(2)))
        models = [fit(seen.observed, form=form) for form in ("thermal", "paper")]
        held_out = [score(model, seen) for model in models]
        thermal, paper = (one.rms_mpx for one in held_out)
        yield f"drift, {kind} camera, held-out temperatures", "mpx RMS", goal_mpx, (thermal, paper)
        thermal, paper = (100 * one.covered for one in held_out)
        yield f"  95 % interval, {kind}; 92 to 98 is right", "%", None, (thermal, paper)
        for air_degC in (15.0, 34.0) if kind == "modified" else ():
            elsewhere = plant_night.night(kind, seed, [Dwell(24.0, "reference", 2700, 20), WarmUp(air_degC)])
            thermal, paper = (score(model, Night(*elsewhere), Role.WARM_UP).rms_mpx for model in models)
            yield f"drift, warm-up at {air_degC:g} degC", "mpx RMS", 3.0, (thermal, paper)


PRESETS, NUMBERS = ("nac", "navcam", "dic", "phone"), range(200, 203)
HELD_OUT, SWITCHED_ON = "held-out temperatures", "switching on, another night"
GOAL_MPX = {"what repeats": {HELD_OUT: 5.0, SWITCHED_ON: 6.4}, "and what does not": {HELD_OUT: 10.0}}
REPEATING: tuple[Effect, ...] = ("sag", "dead_zone", "creep", "coarse_sensor", "far_air")
UNREPEATING: tuple[Effect, ...] = ("stick_slip", "unrepeated")
_CHANCE = 0.4


def _published(group: str) -> Iterator[Published]:
    """Of each preset, with the effects that are drawn for its number."""
    for preset in PRESETS:
        for number in NUMBERS:
            rng = np.random.default_rng([22, PRESETS.index(preset), number])
            effects: tuple[Effect, ...] = tuple(name for name in REPEATING if rng.random() < _CHANCE)
            one = UNREPEATING[rng.integers(2)]
            yield Published(preset, number, (*effects, one) if group != "what repeats" else effects)


def _presets() -> Iterator[Figure]:
    """Medians of the cameras at held-out temperatures and when switched on at 20 degC on another night, and how often
    the 95 % intervals of the answers without a flag hold."""
    for group, goals_mpx in GOAL_MPX.items():
        found: dict[str, list[tuple[Score, Score, bool]]] = {HELD_OUT: [], SWITCHED_ON: []}
        for camera in _published(group):
            progress(f"drift, {camera.preset} {camera.drawn}, {', '.join(camera.effects)}")
            first = Night(*plant_night.night(camera, camera.drawn, warm_up_and_cycles()))
            second = Night(*plant_night.night(camera, camera.drawn + 1000, ANOTHER_NIGHT, "night-2"))
            model = fit(first.observed)
            paper = _by_form(model).get("paper", model)
            at_reference_px = first.truth_px[first.observed.of(Role.REFERENCE)].mean(axis=0)
            for what, seen, role in ((HELD_OUT, first, Role.VALIDATION), (SWITCHED_ON, second, Role.WARM_UP)):
                ours, peer = (score(one, seen, role, at_reference_px) for one in (model, paper))
                found[what].append((ours, peer, "dead_zone" in camera.effects))
        for what, rows in found.items():
            yield from _of_presets(f"drift, presets, {group}, {what}", goals_mpx.get(what), rows)


def _of_presets(what: str, goal_mpx: float | None, rows: list[tuple[Score, Score, bool]]) -> Iterator[Figure]:
    ours = [own for own, _, _ in rows]
    left_mpx = [one.rms_mpx for one in ours]
    median = side_by_side(what, "mpx RMS", PEER, left_mpx, [peer.rms_mpx for _, peer, _ in rows])
    yield median if goal_mpx is None else at_most(goal_mpx, median)
    yield absolute("  the worst camera", "mpx RMS", [max(left_mpx)])
    yield at_least(LEAST_COVERED, _holds("", ours))
    yield absolute("  answers without a flag", "%", [100 * float(np.mean([one.unflagged for one in ours]))])
    few = [own for own, _, has_dead_zone in rows if not has_dead_zone]
    yield absolute(f"  the {len(few)} cameras without a dead zone", "mpx RMS", [one.rms_mpx for one in few])
    yield at_least(LEAST_COVERED, _holds(" of these", few))


def _holds(whose: str, found: list[Score]) -> Figure:
    weights = [one.unflagged for one in found]
    share = float(np.average(np.nan_to_num([one.covered_unflagged for one in found]), weights=weights))
    return absolute(f"  95 % intervals of unflagged answers{whose}; 92 to 98 is right", "%", [100 * share])


# ----------------------------------------------------------------------------------------------------- drawn cameras


def _moving() -> Iterator[Figure]:
    """In moving air, learned with frames on the way, without and with what does not repeat; cameras beyond those of
    `make benchmark`."""

    def everywhere(training: Observations) -> Corrector:
        """The thermal form, which stands by all of its answers here."""
        corrected = corrector(fit(training, form="thermal"))
        return lambda made, frames, seen_px: replace(corrected(made, frames, seen_px), inside=None)

    for group in GROUPS:
        progress(f"drift, drawn cameras in moving air, {group}")
        found = [
            one for number in range(40, 46) for one in scores("thermal", everywhere, case(group, number, TRAININGS[1]))
        ]
        for task in TASKS[1:]:
            those = [one for one in found if one.task == task]
            yield absolute(f"drift, {task}; {group}", "mpx RMS", [one.rms_mpx for one in those])
            covered = 100 * float(np.mean([one.covered for one in those]))
            yield at_least(LEAST_COVERED, absolute("  95 % interval, flagged or not", "%", [covered]))


def _beyond() -> Iterator[Figure]:
    """Asked beyond what was fitted, 17..45 degC, in another night: coverage of the 95 % interval, and how much of it
    carries a flag."""
    fitted_degC = (27, 31, 34, 38, 41, 45, 41, 38, 34, 31, 27, 24, 20, 17, 20, 24)
    progress("drift, drawn cameras asked beyond what was fitted")
    found = []
    for seed in range(12):
        parts = [*warm_up(), *reference(), *cycle(fitted_degC, (20, 27, 34, 41))]
        model = fit(night(_drawn(seed), parts, seed).observed)
        found.append(score(model, _asked(_drawn(seed), (10, 14, 17, 20, 31, 48, 52, 48, 41), seed + 50)))
    yield at_least(LEAST_COVERED, absolute("drift, 95 % interval beyond what was fitted", "%", [_covered(found)]))
    yield absolute("  of these, flagged", "%", [100 * (1 - float(np.mean([one.unflagged for one in found])))])


CLEAN_NIGHTS, BUMPED_NIGHTS = 300, 20


def _bumps() -> Iterator[Figure]:
    """How many bumps are found, how many where there are none, and what a fit leaves: nights without slips and fixings
    that settle again, which are steps themselves and have a line of their own. The least gain of a bump was chosen on
    nights from 1000 on."""
    progress(f"drift, {CLEAN_NIGHTS} nights without a bump")
    nights = (drawn_night(500 + seed, unrepeating=False) for seed in range(CLEAN_NIGHTS))
    false = sum(bool(find_bumps(made.observed)) for made in nights)
    yield at_most(1, absolute("drift, nights with a bump that was none", "%", [100 * false / CLEAN_NIGHTS]))
    slips = [seed for seed in range(60) if "stick_slip" in effects_of(seed, unrepeating=True)[0]][:BUMPED_NIGHTS]
    counts = [len(find_bumps(drawn_night(seed, unrepeating=True).observed)) for seed in slips]
    yield absolute("  steps found a night in cameras that slip", "", [float(np.mean(counts))])
    for size_px in (0.05, 0.1, 0.3):
        progress(f"drift, bumps of {size_px} px")
        found, bumped, clean = 0, [], []
        for seed in range(BUMPED_NIGHTS):
            is_found, left_mpx = _bumped(seed, size_px)
            found += is_found
            bumped.append(left_mpx)
            clean.append(_clean_mpx(seed))
        share = 100 * found / BUMPED_NIGHTS
        yield at_least(100, absolute(f"drift, bumps of {size_px:g} px that are found", "%", [share]))
        left = side_by_side("  residual of the truth after it", "mpx RMS", "the same night without", bumped, clean)
        yield at_most(1.5 * float(np.median(clean)), left)


@cache
def _clean_mpx(seed: int) -> float:
    """What is left in the same night without a bump."""
    made = night(_drawn(seed), full_night(), seed)
    return score(fit(made.observed, form="thermal"), made).rms_mpx


def _bumped(seed: int, size_px: float) -> tuple[bool, float]:
    """Whether a bump somewhere in the night is found where it was, to a dwell, and what is left then."""
    rng = np.random.default_rng([19, seed])
    at_h, angle = float(rng.uniform(6.5, 21.0)), rng.uniform(-np.pi, np.pi)
    bump = Bump(at_h, size_px * np.array([np.cos(angle), np.sin(angle)]))
    made = night(_drawn(seed), full_night(), seed, [bump])
    model = fit(made.observed, form="thermal")
    spans_h = [((one.after_ns - START_NS) / 3.6e12, (one.before_ns - START_NS) / 3.6e12) for one in model.facts.bumps]
    is_found = any(after_h - 0.8 < at_h < before_h + 0.8 for after_h, before_h in spans_h)
    return is_found, score(model, made).rms_mpx


def _few(way_degC: tuple[int, ...]) -> Iterator[Figure]:
    """With few set-points: which form is chosen, and what each leaves at others on another night."""
    progress(f"drift, drawn cameras with {len(way_degC)} visits")
    left: dict[str, list[float]] = {form: [] for form in FORMS}
    right, cameras = 0, range(2800, 2806)
    for seed in cameras:
        parts = [*warm_up(), *reference(), *cycle(way_degC, ())]
        chosen = fit(night(_drawn(seed), parts, seed).observed)
        asked = _asked(_drawn(seed), ASKED_DEGC, seed + 50)
        here = {form: score(model, asked).rms_mpx for form, model in _by_form(chosen).items()}
        for form in FORMS:
            left[form].append(here[form])
        right += here[chosen.form] == min(here.values())
    what = f"drift, {len(way_degC)} visits of few set-points, thermal form"
    yield side_by_side(what, "mpx RMS", PEER, left["thermal"], left["paper"])
    yield at_least(100, absolute("  the better form is chosen", "%", [100 * right / len(cameras)]))


def _several() -> Figure:
    """Two nights fitted together, asked about a third, beside fixings that settle again."""
    progress("drift, drawn cameras with two nights")
    found = []
    for seed in range(2900, 2906):
        camera = _drawn(seed, "unrepeated")
        nights = [night(camera, full_night(), 10 * seed + k, session_id=f"night-{k}") for k in range(3)]
        model = fit_thermal(concatenate([one.observed for one in nights[:2]]))
        found.append(score(model, nights[2]))
    what = "drift, 95 % interval of two nights in a third, fixings settle again"
    return at_least(LEAST_COVERED, absolute(what, "%", [_covered(found)]))


POSITIONS = ((0.0, 0.0), (25.0, 8.0), (-60.0, -20.0), (70.0, 22.0))
"""V0..V3: linear mm, rotary deg."""
_STEP = 1e-4


def _space() -> Iterator[Figure]:
    """How far a target at V0..V3 seems to move in space, after compensation, while only the temperature did: on another
    night, without the noise of the markers, with the camera's true calibration at the reference. RMS along the image's
    axes and along the line of sight, um, of the target's middle; and of the markers, mpx."""
    progress("drift, V0..V3 in space, drawn cameras")
    found: dict[str, list[Float]] = {form: [] for form in FORMS}
    for seed in range(3300, 3310):
        chosen = fit(night(_drawn(seed), full_night(), seed).observed)
        places = [target_mm(*each) for each in POSITIONS]
        seen = [_asked(_drawn(seed), ASKED_DEGC, seed + 50_000, place_mm=place) for place in places]
        for form, model in _by_form(chosen).items():
            each = [_moved(model, made, place) for made, place in zip(seen, places, strict=True)]
            found[form].append(np.sqrt(np.mean(np.concatenate(each) ** 2, axis=0)))
    thermal, paper = (np.array(found[form]).T.tolist() for form in ("thermal", "paper"))
    for axis, (name, goal_um) in enumerate((("x", 1.0), ("y", 2.0), ("z", 5.0))):
        what = f"drift, V0..V3 on another night, along {name}"
        yield at_most(goal_um, side_by_side(what, "um RMS", PEER, thermal[axis], paper[axis]))
    yield side_by_side("  in the image", "mpx RMS", PEER, thermal[3], paper[3])


def _moved(model: DriftModel, made: Night, place_mm: Float) -> Float:
    """(F, 4): of each held-out frame how far the target's middle seems to be from where it is at the night's own
    reference, um, and RMS of the markers, mpx."""
    observed, truth = made.observed, made.truth_px
    states = frame_states(observed, model.memory)

    def corrected(role: str) -> Float:
        frames = np.flatnonzero(observed.of(role)).tolist()
        return np.array([model.correct(truth[k], states.where(np.array([k]))) for k in frames])

    away = corrected(Role.VALIDATION) - corrected(Role.REFERENCE).mean(axis=0)
    motions = np.linalg.lstsq(_pose_derivatives(place_mm), away.reshape(len(away), -1).T, rcond=None)[0]
    return np.column_stack([1e3 * motions[:3].T, 1e3 * np.sqrt((away**2).mean(axis=(1, 2)))])


def _pose_derivatives(place_mm: Float) -> Float:
    """(108, 6), px per mm along the axes and per rad about them, through the target's middle."""
    middle = place_mm.mean(axis=0)
    columns: list[Float] = []
    for axis in range(6):
        step = np.zeros(3)
        step[axis % 3] = _STEP
        more = np.asarray(np.cross(step, place_mm - middle), np.float64) if axis > 2 else step
        columns.append(((_seen_px(place_mm + more) - _seen_px(place_mm - more)) / (2 * _STEP)).ravel())
    return np.stack(columns, axis=1)


def _seen_px(place_mm: Float) -> Float:
    """(N, 2): by the calibration of all drawn cameras at the reference."""
    ray = place_mm[:, :2] / place_mm[:, 2:]
    return FOCAL_PX * ray * (1 + RADIAL * (ray**2).sum(axis=1, keepdims=True))


def _units() -> Iterator[Figure]:
    """A new unit of a camera type, seen at two temperatures, with what six other units have shown, on another night:
    beside a model of the unit's own whole night."""
    progress("drift, new units of drawn types")
    found, whole = [], []
    for seed in range(7800, 7810):
        effects, own = effects_of(seed, unrepeating=False)[0], 99
        units = [fit_thermal(night(drawn_unit(seed, k, *effects), full_night(), k).observed) for k in range(6)]
        new = drawn_unit(seed, own, *effects)
        asked = _asked(new, ASKED_DEGC, own + 200)
        seen = night(new, [*warm_up(), *reference(), *cycle((45,), ())], own + 100)
        found.append(score(fit_like(seen.observed, units), asked))
        whole.append(score(fit_thermal(night(new, full_night(), own).observed), asked).rms_mpx)
    what = "drift, a new unit of a known type from two temperatures"
    left = side_by_side(what, "mpx RMS", "its whole night", [one.rms_mpx for one in found], whole)
    yield ratio_at_most(1.5, left)
    yield at_least(LEAST_COVERED, absolute("  95 % interval", "%", [_covered(found)]))
