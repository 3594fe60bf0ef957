"""Image to identified centres: first frames, tracking, flags, and the CSV table."""

from __future__ import annotations

import csv
import dataclasses
import time
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from thermostand.foundation.errors import SessionError
from thermostand.markers.candidate_search import Candidates
from thermostand.markers.detection import (
    Detection,
    DetectionError,
    Flag,
    Noise,
    convert_to_grey,
    detect,
    follow,
    predict_rows,
)
from thermostand.markers.detections_table import COLUMNS, DetectedImage, format_flags, write_detections
from thermostand.markers.eccentricity import compute_disc_centres
from thermostand.markers.grid_identification import identify
from thermostand.markers.homography import fit_homography, project
from thermostand.markers.image_file import read_image
from thermostand.markers.target import OddMarker, Target, load_target
from thermostand.stand.config.stand_config import find_packaged

from .renderer import Float, Scene, compute_true_centres_px, photograph, render

PAPER = load_target(Path(__file__).parents[2] / "configs" / "targets" / "paper-9x6.yaml")
HALF = Scene(size=(1224, 1024), f_px=4386)
CAMERA = Noise(1 + 1 / 12, 1 / 40)


@cache
def half_frame() -> Float:
    return render(HALF)


@cache
def further_away() -> Detection:
    """What was found at 1150 mm."""
    return detect(photograph(HALF, render(dataclasses.replace(HALF, distance_mm=1150)), 1), PAPER, noise=CAMERA)


def rms_mpx(detection: Detection, scene: Scene) -> float:
    return 1e3 * float(np.sqrt(np.nanmean((detection.centres_px - compute_true_centres_px(scene)) ** 2)))


@pytest.mark.parametrize(
    ("scene", "limit_mpx"),
    [
        (Scene(), 3.0),
        (dataclasses.replace(HALF, roll_deg=20, distance_mm=1100), 5),
        (dataclasses.replace(HALF, roll_deg=45, distance_mm=1300), 5),
        (dataclasses.replace(HALF, tilt_y_deg=30, roll_deg=-10), 5),
        (dataclasses.replace(HALF, tilt_x_deg=45, distance_mm=1100), 6),
        (dataclasses.replace(HALF, f_px=1300, distance_mm=320, k1=-0.25), 6),
        (Scene(size=(640, 480), f_px=1000), 8),
    ],
    ids=["5 MP", "roll 20", "roll 45", "tilt 30", "tilt 45", "wide field, distortion", "8 px dots"],
)
def test_a_first_frame_is_searched_identified_and_measured(scene: Scene, limit_mpx: float):
    found = detect(photograph(scene, render(scene), 1), PAPER, noise=CAMERA)
    assert found.found == 54
    assert not found.flags.any()
    assert rms_mpx(found, scene) < limit_mpx
    assert np.all(np.linalg.eigvalsh(found.covariance_px2) > 0)


@pytest.mark.parametrize("shift_mm", [(0.02, -0.01), (0.5, 0.3), (6.0, 0.0), (30.0, 0.0)])
def test_the_next_frame_follows_the_target_however_far_it_moved(shift_mm: tuple[float, float]):
    moved = dataclasses.replace(HALF, shift_mm=shift_mm, distance_mm=1150)
    found = detect(photograph(moved, render(moved), 2), PAPER, previous=further_away(), noise=CAMERA)
    assert found.found == 54
    assert rms_mpx(found, moved) < 5


def test_tracking_agrees_with_a_fresh_search_far_below_the_noise():
    """Within 1 mpx; the noise scatters these centres by 3.4 mpx."""
    image = photograph(HALF, half_frame(), 5)
    fresh = detect(image, PAPER, noise=CAMERA)
    tracked = detect(image, PAPER, previous=detect(photograph(HALF, half_frame(), 6), PAPER), noise=CAMERA)
    np.testing.assert_allclose(tracked.centres_px, fresh.centres_px, atol=1e-3)


@pytest.mark.parametrize("what", ["the same scene", "a missing marker", "glare"])
def test_a_target_is_followed_by_its_rows_alone_to_the_same_bits(what: str):
    scene = dataclasses.replace(HALF, missing=(20,) if what == "a missing marker" else ())
    clean = render(scene) if scene.missing else half_frame().copy()
    first = detect(photograph(scene, clean, 1), PAPER, noise=CAMERA)
    if what == "glare":
        x, y = compute_true_centres_px(HALF)[30]
        v, u = np.indices(clean.shape)
        clean += 400 * np.exp(-((u - x - 17) ** 2 + (v - y) ** 2) / (2 * 7.0**2))
    image = np.asarray(photograph(scene, clean, 2), np.uint8)
    rows = predict_rows(first, PAPER, len(image))
    assert 0.3 < rows.mean() < 0.6
    others = np.random.default_rng(1).integers(0, 256, image.shape, np.uint8)
    followed = follow(np.where(rows[:, None], image, others), rows, PAPER, first, CAMERA)
    assert followed is not None
    whole = detect(image, PAPER, first, CAMERA)
    for name in ("centres_px", "covariance_px2", "chi", "flags", "homography"):
        np.testing.assert_array_equal(getattr(followed, name), getattr(whole, name))


def test_a_target_that_takes_more_rows_is_not_followed():
    first = half_tracked()
    image = np.asarray(photograph(HALF, half_frame(), 2), np.uint8)
    rows = predict_rows(first, PAPER, len(image))
    assert follow(image, rows, PAPER, first, CAMERA) is not None
    for row in np.flatnonzero(np.diff(rows.astype(int)) > 0) + 6:  # the first rows of the bands
        without = rows.copy()
        without[row] = False
        assert follow(image, without, PAPER, first, CAMERA) is None
    moved = dataclasses.replace(HALF, shift_mm=(0.0, 6.0))
    assert follow(np.asarray(photograph(moved, render(moved), 2), np.uint8), rows, PAPER, first, CAMERA) is None


def test_a_turned_target_keeps_its_numbers_when_tracked_past_a_quarter_turn():
    previous: Detection | None = None
    for roll in (60, 85, 110):
        scene = dataclasses.replace(HALF, roll_deg=roll, distance_mm=1400)
        previous = detect(photograph(scene, render(scene), roll), PAPER, previous=previous)
        assert rms_mpx(previous, scene) < 10


def test_a_missing_marker_is_nan_flagged_and_looked_for_again():
    gap = dataclasses.replace(HALF, missing=(20,))
    first = detect(photograph(gap, render(gap), 1), PAPER, noise=CAMERA)
    assert first.found == 53
    assert Flag(int(first.flags[19])) & Flag.MISSING
    assert np.isnan(first.centres_px[19]).all()
    assert np.isnan(first.covariance_px2[19]).all()
    assert not np.delete(first.flags, 19).any()
    again = detect(photograph(HALF, half_frame(), 2), PAPER, previous=first, noise=CAMERA)
    assert again.found == 54
    assert not again.flags.any()


def test_a_disc_cut_by_the_border_is_missing_and_one_near_it_is_flagged():
    scene = dataclasses.replace(HALF, roll_deg=6)
    beyond_px = compute_true_centres_px(scene)[45, 0] - 5
    scene = dataclasses.replace(scene, shift_mm=(-beyond_px * scene.distance_mm / scene.f_px, 0))
    assert compute_true_centres_px(scene)[[45, 36], 0] == pytest.approx(
        [5, 19], abs=1
    )  # the discs are 17.5 px in radius
    found = detect(photograph(scene, render(scene), 1), PAPER, noise=CAMERA)
    assert np.flatnonzero(found.flags).tolist() == [36, 45]
    assert found.flags[36] == Flag.BORDER
    assert Flag(int(found.flags[45])) & (Flag.BORDER | Flag.MISSING) == Flag.BORDER | Flag.MISSING
    assert np.flatnonzero(np.isnan(found.centres_px[:, 0])).tolist() == [45]
    assert rms_mpx(found, scene) < 5


def test_glare_on_an_outline_flags_that_marker_and_no_other():
    image = half_frame().copy()
    x, y = compute_true_centres_px(HALF)[30]
    v, u = np.indices(image.shape)
    image += 400 * np.exp(-((u - x - 17) ** 2 + (v - y) ** 2) / (2 * 7.0**2))
    found = detect(photograph(HALF, image, 1), PAPER, noise=CAMERA)
    assert found.flags[30] == Flag.SATURATED | Flag.REFITTED
    assert np.linalg.norm(found.centres_px[30] - [x, y]) < 0.05
    assert not np.delete(found.flags, 30).any()


@cache
def half_tracked() -> Detection:
    return detect(photograph(HALF, half_frame(), 9), PAPER, noise=CAMERA)


def spoiled(seed: int) -> tuple[Float, NDArray[np.intp]]:
    """Eight glare spots of 2..600 DN and eight straight occluders at random places round random outlines: the image
    without noise, and the numbers of the markers, glare first."""
    rng = np.random.default_rng(seed)
    image, truth = half_frame().copy(), compute_true_centres_px(HALF)
    hit = rng.choice(54, 16, replace=False)
    for n in hit[:8]:
        angle, away, width = rng.uniform(0, 2 * np.pi), rng.uniform(8, 32), rng.uniform(2, 14)
        v, u = around(truth[n], 80)
        x, y = truth[n] + away * np.array([np.cos(angle), np.sin(angle)])
        image[v, u] += 10 ** rng.uniform(0.3, 2.8) * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2 * width**2))
    for n in hit[8:]:
        angle, (x, y) = rng.uniform(0, 2 * np.pi), truth[n]
        v, u = around(truth[n], 40)
        beyond = (u - x) * np.cos(angle) + (v - y) * np.sin(angle) > rng.uniform(5, 16)
        image[v, u] = np.where(beyond & (np.hypot(u - x, v - y) < 40), rng.uniform(50, 150), image[v, u])
    return image, hit


def around(centre: Float, half_px: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows (n, 1) and columns (1, n) of the half frame near a point."""
    x, y = centre.astype(int)
    return (
        np.arange(max(y - half_px, 0), min(y + half_px, 1024))[:, None],
        np.arange(max(x - half_px, 0), min(x + half_px, 1224))[None],
    )


def sigmas(found: Detection, which: NDArray[np.intp]) -> Float:
    """How many of its own standard deviations each centre is off."""
    error = (found.centres_px - compute_true_centres_px(HALF))[which]
    return np.sqrt(np.einsum("ni,nij,nj->n", error, np.linalg.inv(found.covariance_px2[which]), error))


@pytest.mark.parametrize("images", [range(12), pytest.param(range(12, 60), marks=pytest.mark.nightly)])
def test_no_marker_that_glare_or_an_occluder_spoils_is_silently_wrong(images: range):
    """16 spoiled markers each: what is not flagged, and what was refitted, is within 5 of its own sigmas."""
    unflagged, refitted = list[float](), list[float]()
    flagged = 0
    for seed in images:
        image, hit = spoiled(seed)
        found = detect(photograph(HALF, image, seed), PAPER, half_tracked(), CAMERA)
        assert not np.delete(found.flags, hit).any()
        flagged += np.count_nonzero(found.flags)
        unflagged += sigmas(found, np.flatnonzero(found.flags == 0)).tolist()
        refitted += sigmas(found, np.flatnonzero(found.flags & Flag.REFITTED)).tolist()
    assert flagged > 11.6 * len(images)
    assert len(refitted) > 6.6 * len(images)
    assert max(unflagged) < 5
    assert max(refitted) < 5
    assert 0.7 < np.sqrt(np.mean(np.square(refitted)) / 2) < 1.1


def test_a_sheet_over_a_quarter_of_each_disc_of_a_column_leaves_them_within_five_of_their_sigmas():
    image, column = half_frame().copy(), np.arange(0, 54, 9)
    image[:, : int(compute_true_centres_px(HALF)[0, 0] - 7)] = 90
    found = detect(photograph(HALF, image, 1), PAPER, half_tracked(), CAMERA)
    assert np.all(found.flags[column] == Flag.REFITTED)
    assert sigmas(found, column).max() < 5


def test_a_marker_hidden_to_two_thirds_keeps_its_flag():
    image, (x, y) = half_frame().copy(), compute_true_centres_px(HALF)[20]
    v, u = around(np.array([x, y]), 40)
    image[v, u] = np.where(np.arctan2(v - y, u - x) > -np.pi / 3, 90, image[v, u])
    found = detect(photograph(HALF, image, 1), PAPER, half_tracked(), CAMERA)
    assert Flag(int(found.flags[20])) & (Flag.POOR_FIT | Flag.MISSING)
    assert not found.flags[20] & Flag.REFITTED


def test_a_few_markers_cannot_vouch_for_another_ones_shape():
    """Seven clean ones of a 4 x 2 target: the spoiled one stays poor."""
    scene = dataclasses.replace(HALF, columns=4, rows=2)
    target = PAPER.model_copy(update={"columns": 4, "rows": 2})
    image, (x, y) = render(scene), compute_true_centres_px(scene)[5]
    image[int(y - 4) : int(y + 4), int(x + 12) : int(x + 22)] = 120
    found = detect(photograph(scene, image, 1), target, noise=CAMERA)
    assert found.flags.tolist() == [0, 0, 0, 0, 0, Flag.POOR_FIT, 0, 0]


def test_without_a_noise_model_the_covariance_comes_from_the_residuals():
    image = photograph(HALF, half_frame(), 3)
    known, unknown = detect(image, PAPER, noise=CAMERA), detect(image, PAPER, noise=Noise(4 * (1 + 1 / 12), 4 / 40))
    np.testing.assert_allclose(unknown.chi, known.chi / 2, rtol=1e-3)
    np.testing.assert_allclose(unknown.covariance_px2, known.covariance_px2, rtol=1e-2)
    assert np.median(detect(image, PAPER).chi) == pytest.approx(1)


@pytest.mark.parametrize("light", [False, True])
def test_light_discs_16_bits_and_colour_are_measured_too(light: bool):
    scene = dataclasses.replace(HALF, disc_DN=200.0, ground_DN=30.0) if light else HALF
    target = PAPER.model_copy(update={"polarity": "light" if light else "dark"})
    image = photograph(scene, render(scene), 4)
    deep = image.astype(np.uint16) * 16
    colour = np.repeat(image[:, :, None], 3, axis=2)
    pictures: list[Any] = [image, deep, colour]
    results = [detect(picture, target) for picture in pictures]
    for result in results:
        assert result.found == 54
        assert rms_mpx(result, scene) < 5
    np.testing.assert_array_equal(results[0].centres_px, results[2].centres_px)
    with pytest.raises(DetectionError, match="found 0 of 54 markers"):
        detect(image, PAPER.model_copy(update={"polarity": "dark" if light else "light"}))


def test_the_double_size_corner_dot_fixes_the_orientation():
    scene = Scene(columns=10, rows=10, pitch_mm=25.4, diameter_mm=12.7, diameters_mm={1: 25.4}, size=(640, 480),
                  f_px=700, distance_mm=900, roll_deg=150, tilt_x_deg=25)  # fmt: skip
    target = Target(
        name="t", columns=10, rows=10, pitch_mm=25.4, diameter_mm=12.7, odd_marker=OddMarker(number=1, diameter_mm=25.4)
    )
    found = detect(photograph(scene, render(scene), 1), target)
    assert found.found == 100
    assert rms_mpx(found, scene) < 20


def test_images_without_the_target_are_refused_with_a_sentence():
    rng = np.random.default_rng(1)
    for image in (np.zeros((1024, 1224), np.uint8), rng.integers(0, 255, (1024, 1224)).astype(np.uint8)):
        with pytest.raises(DetectionError, match=r"found \d+ of 54 markers of paper-9x6: 41 are needed"):
            detect(image, PAPER)
    with pytest.raises(DetectionError, match="an image of 30 x 20 pixels is too small"):
        detect(np.zeros((20, 30), np.uint8), PAPER)


def test_a_dark_frame_after_a_good_one_is_refused():
    first = detect(photograph(HALF, half_frame(), 1), PAPER)
    with pytest.raises(DetectionError, match="found 0 of 54"):
        detect(np.full((1024, 1224), 3, np.uint8), PAPER, previous=first)


def test_the_image_is_only_read():
    image = photograph(HALF, half_frame(), 1)
    before = image.copy()
    image.setflags(write=False)
    detect(image, PAPER, previous=detect(image, PAPER))
    np.testing.assert_array_equal(image, before)


def test_what_is_no_image_is_a_programming_mistake():
    for wrong in (np.zeros((4, 4), np.float64), np.zeros((4, 4, 2), np.uint8), np.zeros((0, 4), np.uint8)):
        with pytest.raises(ValueError, match="an image"):
            convert_to_grey(wrong)  # pyright: ignore[reportArgumentType] - wrong on purpose


def test_image_files_are_read_as_grey_and_bad_ones_get_a_sentence(tmp_path: Path):
    deep = np.arange(12, dtype=np.uint16).reshape(3, 4) * 5000
    cv2.imwrite(str(tmp_path / "deep.png"), deep)
    np.testing.assert_array_equal(read_image(tmp_path / "deep.png"), deep)
    cv2.imwrite(str(tmp_path / "colour.png"), np.full((3, 4, 3), 90, np.uint8))
    assert read_image(tmp_path / "colour.png").shape == (3, 4)
    (tmp_path / "bad.png").write_bytes(b"\x89PNG nonsense")
    (tmp_path / "empty.png").touch()
    for name in ("bad.png", "empty.png"):
        with pytest.raises(DetectionError, match=rf"{name}: not an image"):
            read_image(tmp_path / name)
    with pytest.raises(DetectionError, match=r"none\.png: cannot be read \(No such file"):
        read_image(tmp_path / "none.png")


def test_the_table_has_a_row_per_marker_with_the_agreed_columns(tmp_path: Path):
    gap = dataclasses.replace(HALF, missing=(54,))
    found = detect(photograph(gap, render(gap), 1), PAPER)
    write_detections(tmp_path / "out.csv", PAPER, [DetectedImage("a.png", None, found), DetectedImage("7", 123, found)])
    rows = list(csv.DictReader((tmp_path / "out.csv").read_text(encoding="utf-8").splitlines()))
    assert tuple(rows[0]) == COLUMNS
    outline = "image,time_ns,marker,row,column,x_px,y_px,var_x_px2,cov_xy_px2,var_y_px2,flags"
    assert ",".join(COLUMNS) == f"{outline},disc_x_px,disc_y_px,disc_var_x_px2,disc_cov_xy_px2,disc_var_y_px2"
    assert len(rows) == 108
    assert [rows[9][key] for key in ("image", "time_ns", "marker", "row", "column", "flags")] == [
        "a.png", "", "10", "1", "0", "OK",
    ]  # fmt: skip
    assert rows[54]["time_ns"] == "123"
    assert [float(rows[9]["x_px"]), float(rows[9]["y_px"])] == pytest.approx(found.centres_px[9], abs=1e-6)
    assert float(rows[9]["cov_xy_px2"]) == pytest.approx(found.covariance_px2[9, 0, 1], rel=1e-6)
    discs_px, discs_px2 = compute_disc_centres(found, PAPER)
    assert [float(rows[9]["disc_x_px"]), float(rows[9]["disc_y_px"])] == pytest.approx(discs_px[9], abs=1e-6)
    assert float(rows[9]["disc_var_y_px2"]) == pytest.approx(discs_px2[9, 1, 1], rel=1e-6)
    assert rows[53]["x_px"] == rows[53]["disc_x_px"] == rows[53]["disc_var_x_px2"] == "nan"
    assert "MISSING" in rows[53]["flags"].split("|")


def test_flags_are_written_as_names():
    assert format_flags(0) == "OK"
    assert format_flags(Flag.POOR_FIT | Flag.BORDER) == "POOR_FIT|BORDER"


def test_nothing_half_written_is_left_when_an_image_fails(tmp_path: Path):
    found = detect(photograph(HALF, half_frame(), 1), PAPER)

    def images() -> Iterator[DetectedImage]:
        yield DetectedImage("a.png", None, found)
        raise DetectionError("b.png: not an image, or damaged")

    (tmp_path / "out.csv").write_text("older")
    with pytest.raises(DetectionError, match=r"b\.png"):
        write_detections(tmp_path / "out.csv", PAPER, images())
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
    assert (tmp_path / "out.csv").read_text() == "older"
    with pytest.raises(SessionError, match="cannot be written"):
        write_detections(tmp_path / "nowhere" / "out.csv", PAPER, [])


# Images that show no target, or one that no camera sees so, end in a sentence and soon.


TARGET = load_target(find_packaged("targets", "paper-9x6"))
LONGEST_CPU_S = 30.0


def dots(columns: int, rows: int, astray_px: float) -> NDArray[np.uint8]:
    """So many black dots of 14 px in a grid of 22 px."""
    rng, image = np.random.default_rng(1), np.full((rows * 22 + 22, columns * 22 + 22), 200, np.uint8)
    for row in range(rows):
        for column in range(columns):
            x, y = np.array([column, row]) * 22 + 22 + rng.normal(0, astray_px, 2)
            cv2.circle(image, (round(x * 16), round(y * 16)), 7 * 16, 30, -1, cv2.LINE_AA, 4)
    return image


@pytest.mark.parametrize(("columns", "rows"), [(86, 70), (40, 30)])
@pytest.mark.parametrize("astray_px", [0.0, 1.0])
def test_thousands_of_dots_are_refused_soon(columns: int, rows: int, astray_px: float):
    start_s = time.process_time()
    with pytest.raises(DetectionError, match="paper-9x6 has 54 markers"):
        detect(dots(columns, rows, astray_px), TARGET)
    assert time.process_time() - start_s < LONGEST_CPU_S


@pytest.mark.parametrize("horizon", [0.1, 0.48, 0.9])
def test_spots_in_the_shape_of_a_plane_seen_across_its_horizon_are_refused(horizon: float):
    """At this part of the target's length."""
    x_mm = TARGET.coordinates_mm()[:, 0]
    at_mm = x_mm.min() + horizon * np.ptp(x_mm)
    homography = np.array([[2.0, 0.0, 300.0], [0.0, -2.0, 300.0], [0.01, 0.0, -0.01 * at_mm]])
    mapped = np.column_stack([TARGET.coordinates_mm(), np.ones(TARGET.count)]) @ homography.T
    spots = Candidates(mapped[:, :2] / mapped[:, 2:], np.full(TARGET.count, 150.0), np.zeros(TARGET.count))
    with pytest.raises(DetectionError):
        identify(spots, TARGET)
    with pytest.raises(DetectionError, match="a flat target"):
        project(homography, TARGET.coordinates_mm())


def test_spots_on_a_line_and_in_one_place_are_no_plane():
    target_mm = TARGET.coordinates_mm()
    for places in (np.column_stack([np.arange(54.0), np.zeros(54)]), np.zeros((54, 2))):
        with pytest.raises(DetectionError, match="a flat target"):
            fit_homography(target_mm, places)


@pytest.mark.parametrize("kind", [np.uint8, np.uint16])
@pytest.mark.parametrize("level", [0, 255, -1])
def test_an_image_of_one_colour_or_of_clipped_noise_has_no_target(kind: type[np.uint8] | type[np.uint16], level: int):
    noise = np.random.default_rng(5).normal(-300, 100, (480, 640)).clip(0, 255)
    image: Any = (np.full((480, 640), level) if level >= 0 else noise).astype(kind)
    with pytest.raises(DetectionError):
        detect(image, TARGET)
