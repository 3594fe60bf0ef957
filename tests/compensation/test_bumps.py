"""Steps in a session: found where they are, with their size, and fitted around; none in sessions without any."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from tests.nightly import mark_nightly
from thermostand.compensation.drift.bumps import find_bumps
from thermostand.compensation.drift.drift_model import DriftModel
from thermostand.compensation.drift.evaluation import evaluate
from thermostand.compensation.drift.model_file import load_model, save_model
from thermostand.compensation.drift.model_selection import fit
from thermostand.compensation.drift.training_data import compute_frame_states
from thermostand.compensation.observations import Mask, Observations
from thermostand.compensation.reporting.report import write_report
from thermostand.experiments.steps import Role

from .drawn_cameras import draw_camera
from .drawn_sessions import (
    START_NS,
    Bump,
    DrawnSession,
    make_followed_cycle,
    make_full_session,
    record_session,
    reference,
    warm_up,
)

AT_H = 13.0
SHIFT_PX = np.array([0.03, -0.04])


@cache
def bumped(seed: int = 0) -> DrawnSession:
    """The same for all tests, who read it only."""
    return record_session(draw_camera(seed), make_full_session(), bumps=[Bump(AT_H, SHIFT_PX)])


@cache
def fitted() -> DriftModel:
    return fit(bumped().observed)


def left_mpx(model: DriftModel, made: DrawnSession) -> float:
    """RMS of what the model leaves of the truth without the bump at held-out temperatures."""
    observed, truth = made.observed, made.truth_px
    states = compute_frame_states(observed, model.memory)
    place_px = truth[observed.of(Role.REFERENCE)].mean(axis=0)
    frames = np.flatnonzero(observed.of(Role.VALIDATION)).tolist()
    left = [place_px - model.correct(truth[k], states.where(np.array([k]))) for k in frames]
    return 1e3 * float(np.sqrt(np.mean(np.square(left))))


def hours(ns: int) -> float:
    return (ns - START_NS) / 3.6e12


@pytest.mark.parametrize("seed", range(3))
def test_a_bump_of_a_twentieth_of_a_pixel_is_found_when_and_how_far(seed: int) -> None:
    (found,) = find_bumps(bumped(seed).observed)
    assert hours(found.after_ns) < AT_H < hours(found.before_ns)
    assert hours(found.before_ns) - hours(found.after_ns) < 0.8
    assert found.marker is None
    off = np.abs(np.array(found.motions_px[:2]) - SHIFT_PX)
    assert (off < 4 * np.array(found.sigma_px[:2]) + 0.002).all()
    assert off.max() < 0.01


@pytest.mark.parametrize("seed", range(4))
def test_a_clean_session_has_none(seed: int) -> None:
    effects = ("creep", "coarse_sensor") if seed % 2 else ("sag", "far_air")
    assert find_bumps(record_session(draw_camera(seed, *effects), make_full_session(), seed).observed) == ()


@pytest.mark.parametrize("seed", [2002, mark_nightly(2005)])
def test_a_camera_on_its_way_is_not_taken_for_one_that_was_touched(seed: int) -> None:
    camera = draw_camera(seed, "creep", "coarse_sensor")
    parts = [*warm_up(), *reference(), *make_followed_cycle()]
    assert find_bumps(record_session(camera, parts, seed).observed) == ()
    (found,) = find_bumps(record_session(camera, parts, seed, bumps=[Bump(AT_H, SHIFT_PX)]).observed)
    assert hours(found.after_ns) - 0.3 < AT_H < hours(found.before_ns) + 0.3
    assert np.array(found.motions_px[:2]) == pytest.approx(SHIFT_PX, abs=0.01)


def test_the_fit_goes_around_a_bump() -> None:
    clean, made = record_session(draw_camera(0), make_full_session()), bumped()
    models = [fit(one.observed, form="thermal") for one in (clean, made)]
    left = [left_mpx(model, one) for model, one in zip(models, (clean, made), strict=True)]
    assert left[1] < 1.5 * left[0] + 0.5
    scored = [evaluate(model, one.observed).rms_after_px for model, one in zip(models, (clean, made), strict=True)]
    assert np.hypot(*scored[1]) < 1.5 * np.hypot(*scored[0])


def test_a_bump_before_the_reference_moves_the_warm_up_not_the_session() -> None:
    camera = draw_camera(2)
    made = record_session(camera, make_full_session(), bumps=[Bump(4.6, np.array([0.2, 0.1]))])
    model = fit(made.observed, form="thermal")
    assert len(model.facts.bumps) == 1
    assert (
        left_mpx(model, made)
        < 1.5 * left_mpx(fit(record_session(camera, make_full_session()).observed, form="thermal"), made) + 0.5
    )


def test_one_marker_that_moves_is_named() -> None:
    shift = np.zeros((54, 2))
    shift[17] = SHIFT_PX
    (found,) = find_bumps(record_session(draw_camera(1), make_full_session(), bumps=[Bump(AT_H, shift)]).observed)
    assert found.marker == 17
    assert np.array(found.motions_px[:2]) == pytest.approx(SHIFT_PX, abs=0.008)


def test_bumps_stand_in_the_model_file(tmp_path: Path) -> None:
    model = fitted()
    assert len(model.facts.bumps) == 1
    save_model(model, tmp_path / "model.json")
    again = load_model(tmp_path / "model.json")
    assert again.facts.bumps == model.facts.bumps
    assert again.other is not None
    assert again.other.facts.bumps == model.facts.bumps


def test_a_few_frames_are_too_few_to_tell() -> None:
    made = bumped().observed
    few = made.time_ns < made.time_ns[60]
    assert find_bumps(_only(made, few)) == ()


def _only(made: Observations, keep: Mask) -> Observations:
    return replace(made, reasons=tuple("" if kept else "left out" for kept in keep.tolist()))


@pytest.mark.usefixtures("undrawn")
def test_the_report_says_when_and_how_far(tmp_path: Path) -> None:
    made, model = bumped().observed, fitted()
    write_report(tmp_path / "report.html", made, model, evaluate(model, made))
    page, numbers = (tmp_path / "report.html").read_text(), json.loads((tmp_path / "report.json").read_text())
    assert "that no temperature explains" in page
    (bump,) = numbers["bumps"]
    assert bump["after"] < "2026-01-02T07:00:00" < bump["before"]
    assert bump["motions_px"][:2] == pytest.approx(SHIFT_PX.tolist(), abs=0.01)
