"""Identification of unordered centres: every marker in its place, or a refusal that says why."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from tests.nightly import mark_nightly
from thermostand.markers.candidate_search import Candidates
from thermostand.markers.grid_identification import (
    DetectionError,
    Identified,
    compute_roll_deg,
    find_placements,
    identify,
)
from thermostand.markers.target import OddMarker, Target, load_target

from .renderer import Float, Scene, compute_true_centres_px

PAPER = load_target(Path(__file__).parents[2] / "configs" / "targets" / "paper-9x6.yaml")
SQUARE = Target(name="square", columns=6, rows=6, pitch_mm=30, diameter_mm=8)
ODD = SQUARE.model_copy(update={"odd_marker": OddMarker(number=1, diameter_mm=14)})


def seen(scene: Scene, seed: int = 0, missing: Sequence[int] = (), clutter: int = 0) -> tuple[Candidates, Float]:
    """Shuffled, slightly wrong candidates of a scene without `missing`, and the true centres in order."""
    rng = np.random.default_rng(seed)
    truth = compute_true_centres_px(scene)
    areas = np.array([np.pi / 4 * (disc[2] * scene.f_px / scene.distance_mm) ** 2 for disc in scene.discs_mm()])
    kept = np.setdiff1d(np.arange(len(truth)), np.array(missing, dtype=int) - 1)
    strewn = rng.uniform(truth.min(axis=0) - 200, truth.max(axis=0) + 200, (clutter, 2))
    strewn = strewn[np.linalg.norm(strewn[:, None] - truth, axis=2).min(axis=1) > 70]  # discs do not overlap
    points = np.vstack([truth[kept] + rng.normal(0, 0.05, (len(kept), 2)), strewn])
    sizes = np.append(areas[kept], np.full(len(strewn), np.median(areas)))
    order = rng.permutation(len(points))
    return Candidates(points[order], sizes[order], np.zeros(len(order))), truth


def wrong(found: Identified, candidates: Candidates, truth: Float) -> int:
    """How many identified markers are not where the truth has them."""
    got = found.candidate >= 0
    off = np.linalg.norm(candidates.centres_px[found.candidate[got]] - truth[got], axis=1)
    return int((off > 1).sum())


POSES = {
    "frontal": Scene(),
    "roll 20": Scene(roll_deg=20),
    "roll 45": Scene(roll_deg=45, distance_mm=1300),
    "roll -70": Scene(roll_deg=-70, distance_mm=1300),
    "tilt 30": Scene(tilt_y_deg=30),
    "tilt 45 about x": Scene(tilt_x_deg=45),
    "tilt 45 about y": Scene(tilt_y_deg=-45),
    "tilt 45, roll 20": Scene(tilt_y_deg=45, roll_deg=20),
    "wide field, distortion": Scene(f_px=2600, distance_mm=330, k1=-0.25),
}


@pytest.mark.parametrize("pose", POSES)
def test_every_marker_is_identified_in_every_pose(pose: str):
    candidates, truth = seen(POSES[pose])
    found = identify(candidates, PAPER)
    assert (found.candidate >= 0).all()
    assert wrong(found, candidates, truth) == 0
    assert compute_roll_deg(found.homography, PAPER) == pytest.approx(POSES[pose].roll_deg, abs=3)


@pytest.mark.parametrize("missing", [(1,), (9,), (20,), (54,), (3, 20, 33, 50)])
def test_missing_markers_leave_gaps_and_shift_nothing(missing: tuple[int, ...]):
    candidates, truth = seen(Scene(roll_deg=10), missing=missing)
    found = identify(candidates, PAPER)
    assert tuple(np.flatnonzero(found.candidate < 0) + 1) == missing
    assert wrong(found, candidates, truth) == 0


def test_clutter_is_never_taken_for_a_marker():
    outcomes: list[int] = []
    for seed in range(12):
        candidates, truth = seen(Scene(roll_deg=15, tilt_y_deg=20), seed, clutter=30)
        try:
            found = identify(candidates, PAPER)
        except DetectionError:
            continue
        outcomes.append(wrong(found, candidates, truth))
    assert len(outcomes) >= 10
    assert set(outcomes) == {0}


@pytest.mark.parametrize("roll", [80, 90, 100, -90])
def test_a_quarter_turn_of_a_symmetrical_grid_is_refused(roll: float):
    candidates, _ = seen(Scene(roll_deg=roll))
    with pytest.raises(DetectionError, match=r"the 9x6 grid of paper-9x6 is ambiguous at roll -?\d+ deg"):
        identify(candidates, PAPER)


@pytest.mark.parametrize("roll", [90, 120, 180])
def test_a_nominal_roll_or_the_frame_before_settles_what_the_image_leaves_open(roll: float):
    candidates, truth = seen(Scene(roll_deg=roll))
    mounted = PAPER.model_copy(update={"nominal_roll_deg": roll - 10})
    found = identify(candidates, mounted)
    assert wrong(found, candidates, truth) == 0
    moved, moved_truth = seen(Scene(roll_deg=roll + 5, shift_mm=(40, 10)))
    assert wrong(identify(moved, PAPER, found.homography), moved, moved_truth) == 0


def test_a_square_grid_is_refused_between_two_of_its_four_readings():
    candidates, truth = seen(Scene(rows=6, columns=6, roll_deg=20))
    assert wrong(identify(candidates, SQUARE), candidates, truth) == 0
    candidates, _ = seen(Scene(rows=6, columns=6, roll_deg=40))
    with pytest.raises(DetectionError, match="ambiguous at roll"):
        identify(candidates, SQUARE)


@pytest.mark.parametrize("roll", range(-180, 180, 45))
def test_an_odd_marker_settles_every_roll(roll: float):
    candidates, truth = seen(Scene(rows=6, columns=6, roll_deg=roll, tilt_y_deg=30, diameters_mm={1: 14.0}))
    assert wrong(identify(candidates, ODD), candidates, truth) == 0


def test_without_its_odd_marker_the_target_is_refused():
    candidates, _ = seen(Scene(rows=6, columns=6))
    with pytest.raises(DetectionError, match=r"36 of 36 .* square, .* odd marker 1"):
        identify(candidates, ODD)


def test_a_missing_column_is_refused_and_the_frame_before_settles_it():
    column = tuple(range(1, 54, 9))
    candidates, truth = seen(Scene(), missing=column)
    with pytest.raises(DetectionError, match=r"48 of 54 .* more than one place"):
        identify(candidates, PAPER)
    before = identify(seen(Scene())[0], PAPER).homography
    found = identify(candidates, PAPER, before)
    assert tuple(np.flatnonzero(found.candidate < 0) + 1) == column
    assert wrong(found, candidates, truth) == 0


@pytest.mark.parametrize("seeds", [range(6), mark_nightly(range(6, 12))])
def test_a_side_that_clutter_hides_is_found_or_refused_and_never_read_one_column_off(seeds: range):
    outcomes: list[int] = []
    for seed in seeds:
        candidates, truth = seen(Scene(roll_deg=5), seed, clutter=60)
        try:
            found = identify(candidates, PAPER)
        except DetectionError:
            continue
        outcomes.append(wrong(found, candidates, truth))
    assert len(outcomes) >= 5
    assert set(outcomes) == {0}


def test_a_growth_that_missed_a_column_and_went_on_into_clutter_is_set_right():
    truth = compute_true_centres_px(Scene(roll_deg=5))
    beyond = 2 * truth[8] - truth[7]
    points = np.vstack([truth, beyond])
    lattice = {(n % 9, n // 9): n for n in range(54) if n % 9} | {(9, 0): 54}
    best = min(find_placements(lattice, points, PAPER), key=lambda p: p.residual_px)
    assert sorted(best.candidate) == list(range(54))


@pytest.mark.parametrize("roll", range(-180, 180, 60))
def test_a_staggered_grid_of_an_odd_number_of_rows_is_identified_at_every_roll(roll: float):
    target = Target(name="asymmetric", layout="staggered", columns=4, rows=11, pitch_mm=40, diameter_mm=8)
    scene = Scene(columns=4, rows=11, staggered=True, pitch_mm=40, roll_deg=roll, tilt_x_deg=40)
    candidates, truth = seen(scene, missing=(7,))
    found = identify(candidates, target)
    assert tuple(np.flatnonzero(found.candidate < 0) + 1) == (7,)
    assert wrong(found, candidates, truth) == 0


@pytest.mark.parametrize(("columns", "rows"), [(3, 3), (20, 14), (40, 30)])
def test_targets_of_any_size_are_identified_through_a_wide_lens(columns: int, rows: int):
    target = Target(name="t", columns=columns, rows=rows, pitch_mm=240 / (columns - 1), diameter_mm=2)
    pose = Scene(
        columns=columns, rows=rows, pitch_mm=target.pitch_mm, diameter_mm=2, f_px=2600, distance_mm=330, k1=-0.25
    )
    truth = compute_true_centres_px(pose)
    order = np.random.default_rng(1).permutation(len(truth))
    candidates = Candidates(truth[order], np.full(len(truth), 100.0), np.zeros(len(truth)))
    found = identify(candidates, target)
    assert (found.candidate >= 0).all()
    assert wrong(found, candidates, truth) == 0


def test_too_few_markers_are_refused_with_their_number():
    candidates, _ = seen(Scene(), missing=range(1, 24))
    with pytest.raises(DetectionError, match="found 31 of 54 markers of paper-9x6: 41 are needed"):
        identify(candidates, PAPER)
    for points in (np.zeros((0, 2)), np.array([[1.0, 2.0], [3.0, 4.0]])):
        with pytest.raises(DetectionError, match="found 0 of 54"):
            identify(Candidates(points, np.ones(len(points)), np.zeros(len(points))), PAPER)
