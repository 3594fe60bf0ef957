"""Whether the intervals of the thermal form hold, and how much wider they are than they had to be, for each kind of
question, over cameras that nothing was chosen on: drawn ones (numbers 12000 on) and simulated presets (numbers 212 on).

claimed over left is the RMS standard deviation that is claimed over the RMS of what is left of the truth, the median of
the cameras. The factors were chosen on other numbers (compensation/drift/claims.py).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np

from tests.bench.drift_drawn import Score, score
from tests.bench.figures import Figure, make_absolute, report_progress, set_lower_goal
from tests.compensation.drawn_cameras import REPEATING, UNREPEATING, draw_camera
from tests.compensation.drawn_sessions import (
    DWELL_S,
    DrawnSession,
    Stretch,
    cycle,
    make_followed_cycle,
    record_session,
    reference,
    warm_up,
)
from tests.compensation.plant_sessions import Dwell, Published, WarmUp, record_plant_session, warm_up_and_cycles
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.observations import Float
from thermostand.drivers.camera_preset import Effect
from thermostand.experiments.steps import Role

DRAWN, PRESETS = range(12000, 12024), range(8)
LEAST_COVERED, MOST_COVERED, LEAST_FLAGGED = 92.0, 98.0, 90.0
MOST_CLAIMED = 1.5
_CHANCE = 0.4
_PRESET_REPEATING: tuple[Effect, ...] = ("sag", "dead_zone", "creep", "coarse_sensor", "far_air")
_PRESET_UNREPEATING: tuple[Effect, ...] = ("stick_slip", "unrepeated")
_OTHER_WAY_DEGC = (15, 36, 22, 47, 29, 18, 42, 26, 50, 33, 12, 43)
_STEPS_DEGC = (21, 25, 29, 33, 30, 34, 38, 42, 46, 43, 39, 35, 31, 27, 23, 19, 15, 12, 16, 20, 24)
_NARROW_DEGC = (27, 31, 34, 38, 41, 45, 41, 38, 34, 31, 27, 24, 20, 17, 20, 24)
_FAR_DEGC = (14, 10, 14, 48, 52, 48)
_WARM_UPS_DEGC = (15.0, 34.0)
SET_POINT, SESSION, MOVING = "set-point left out", "session left out", "small steps in another session"
WARM_UP, UNTAUGHT, BEYOND = "warm-up elsewhere", "warm-up, none was fitted", "extrapolation"

Scores = Iterator[tuple[str, Score]]


def figures(directory: Path) -> Iterator[Figure]:
    """Coverage without and with a flag, and claimed over left, by kind of question."""
    worlds: dict[str, tuple[Callable[[int], Scores], Sequence[int]]] = {
        "drawn": (ask_drawn, DRAWN),
        "preset": (ask_preset, PRESETS),
    }
    for world, (ask, numbers) in worlds.items():
        found: dict[str, list[Score]] = {}
        for number in numbers:
            report_progress(f"coverage, {world} camera {number}")
            for kind, one in ask(number):
                found.setdefault(kind, []).append(one)
        for kind, scores in found.items():
            yield from _list_figures(f"coverage, {world} cameras, {kind}", scores)


def _list_figures(what: str, scores: Sequence[Score]) -> Iterator[Figure]:
    yield make_absolute(what, "mpx RMS left", [one.rms_mpx for one in scores])
    share = np.array([one.unflagged for one in scores])
    if share.sum():
        covered = 100 * float(np.average(np.nan_to_num([one.covered_unflagged for one in scores]), weights=share))
        figure = make_absolute("  95 % intervals without a flag, 92 to 98 is right", "%", [covered])
        yield set_lower_goal(LEAST_COVERED, figure)
    if (1 - share).sum():
        covered = 100 * float(np.average(np.nan_to_num([one.covered_flagged for one in scores]), weights=1 - share))
        yield set_lower_goal(LEAST_FLAGGED, make_absolute("  with a flag", "%", [covered]))
    ratios = [one.claimed_mpx / one.rms_mpx for one in scores]
    yield make_absolute("  claimed over left, median; 1.0 to 1.5 is right", "", ratios)
    yield make_absolute("    of the camera with the least", "", [min(ratios)])
    yield make_absolute("    of the camera with the most", "", [max(ratios)])


def draw_case(number: int) -> tuple[tuple[str, ...], bool]:
    """The effects of a drawn camera, every second with one that does not repeat; and whether frames on the way were
    recorded, as of every second pair."""
    rng = np.random.default_rng([40, number])
    effects = [name for name in REPEATING if rng.random() < _CHANCE]
    if number % 2:
        effects.append(UNREPEATING[rng.integers(2)])
    return tuple(effects), (number // 2) % 2 == 1


def ask_drawn(number: int) -> Scores:
    """Scores of one drawn camera, by the kind of question."""
    effects, is_followed = draw_case(number)
    camera, begin = draw_camera(number, *effects), [*warm_up(), *reference()]

    def record(parts: Sequence[Stretch], seed: int, session_id: str) -> DrawnSession:
        return record_session(camera, parts, number + seed, session_id=session_id)

    first = record([*begin, *(make_followed_cycle() if is_followed else cycle())], 0, "session-1")
    model, at_reference = fit(first.observed, form="thermal"), _average_reference(first)
    yield SET_POINT, score(model, first)
    other = record(
        [*begin, *(Stretch(float(degC), DWELL_S, "validation", 5) for degC in _OTHER_WAY_DEGC)], 1, "session-2"
    )
    yield SESSION, score(model, other, reference_px=at_reference)
    steps = [Stretch(float(degC), 60, "validation", 4, 240.0) for degC in _STEPS_DEGC]
    yield MOVING, score(model, record([*begin, *steps], 2, "session-3"), reference_px=at_reference)
    untaught_by = record([*reference(8 * 3600), *cycle()], 3, "session-4")
    untaught = fit(untaught_by.observed, form="thermal")
    for seed, degC in enumerate(_WARM_UPS_DEGC, 4):
        made = record([*reference(), *warm_up(degC)], seed, "session-5")
        yield WARM_UP, score(model, made, Role.WARM_UP, at_reference)
        yield UNTAUGHT, score(untaught, made, Role.WARM_UP, _average_reference(untaught_by))
    narrow = record([*begin, *cycle(_NARROW_DEGC, (20, 27, 34, 41))], 6, "session-6")
    far = record([*begin, *(Stretch(float(degC), DWELL_S, "validation", 5) for degC in _FAR_DEGC)], 7, "session-7")
    yield BEYOND, score(fit(narrow.observed, form="thermal"), far, reference_px=_average_reference(narrow))


def ask_preset(number: int) -> Scores:
    """Scores of one simulated camera of configs/optics, by the kind of question."""
    rng = np.random.default_rng([41, number])
    effects: list[Effect] = [name for name in _PRESET_REPEATING if rng.random() < _CHANCE]
    if number % 2:
        effects.append(_PRESET_UNREPEATING[rng.integers(2)])
    preset = ("nac", "navcam", "dic", "phone")[number % 4]
    camera = Published(preset, 212 + number // 4, tuple(effects))

    def record(parts: Sequence[WarmUp | Dwell], seed: int, session_id: str) -> DrawnSession:
        return DrawnSession(*record_plant_session(camera, camera.drawn + seed, parts, session_id))

    begin = [WarmUp(24.0), Dwell(24.0, "reference", 2700, 20)]
    first = record(warm_up_and_cycles(), 0, "session-1")
    model, at_reference = fit(first.observed, form="thermal"), _average_reference(first)
    yield SET_POINT, score(model, first)
    other = record([*begin, *(Dwell(float(degC), "validation") for degC in _OTHER_WAY_DEGC)], 1000, "session-2")
    yield SESSION, score(model, other, reference_px=at_reference)
    for degC in _WARM_UPS_DEGC:
        made = record([Dwell(24.0, "reference", 2700, 20), WarmUp(degC)], 2000, "session-3")
        yield WARM_UP, score(model, made, Role.WARM_UP, at_reference)
    narrow = record([*begin, *_make_visits(_NARROW_DEGC, "fit")], 3000, "session-4")
    far = record([*begin, *_make_visits(_FAR_DEGC, "validation")], 4000, "session-5")
    yield BEYOND, score(fit(narrow.observed, form="thermal"), far, reference_px=_average_reference(narrow))


def _make_visits(way_degC: Sequence[int], role: str) -> list[WarmUp | Dwell]:
    return [Dwell(float(degC), role) for degC in way_degC]


def _average_reference(made: DrawnSession) -> Float:
    return made.truth_px[made.observed.of(Role.REFERENCE)].mean(axis=0)
