"""The target file: numbering, geometry, and sentences about what is wrong with it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.markers.target import Target, load_target

TARGETS = Path(__file__).parents[2] / "configs" / "targets"
SMALL = "name: small\ncolumns: 4\nrows: 3\npitch_mm: 10\ndiameter_mm: 4\n"


def test_the_papers_target_is_numbered_from_bottom_left_along_the_long_side_then_up():
    target = load_target(TARGETS / "paper-9x6.yaml")
    xy = target.coordinates_mm()
    assert xy.shape == (54, 2)
    assert xy.dtype == np.float64
    np.testing.assert_array_equal(xy[[0, 1, 8, 9, 53]], [[0, 0], [30, 0], [240, 0], [0, 30], [240, 150]])
    assert (target.row_column(1), target.row_column(10), target.row_column(54)) == ((0, 0), (1, 0), (5, 8))
    assert set(target.diameters_mm()) == {8.0}


def test_the_robot_targets_odd_dot_is_marker_one_at_twice_the_size():
    target = load_target(TARGETS / "robot-cal-tools-10x10.yaml")
    assert target.count == 100
    np.testing.assert_array_equal(target.diameters_mm()[:2], [25.4, 12.7])


def test_measured_coordinates_replace_the_nominal_ones():
    nominal = parse_document(SMALL, Target, "t").coordinates_mm()
    measured = nominal + np.linspace(-0.02, 0.02, 12)[:, None]
    listed = "cmm_mm:\n" + "".join(f"  - [{x:.6f}, {y:.6f}]\n" for x, y in measured)
    np.testing.assert_allclose(parse_document(SMALL + listed, Target, "t").coordinates_mm(), measured, atol=1e-6)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SMALL.replace("columns: 4", "columns: 2"), "t.yaml: columns: "),
        (SMALL.replace("rows: 3", "rows: 5"), "columns is the long side, found 4 columns and 5 rows"),
        (SMALL.replace("diameter_mm: 4", "diameter_mm: 12"), "overlap at a pitch of 10.0 mm"),
        (SMALL.replace("ter_mm: 4", "ter_mm: 8") + "layout: staggered\n", "overlap at a pitch of 10.0 mm"),
        (SMALL + "layout: hexagonal\n", "t.yaml: layout: "),
        (SMALL + "pitch_cm: 1\n", "t.yaml: pitch_cm: unknown key"),
        ("kind: charuco\ncolumns: 8\n", "kind: charuco is a board of squares or tags, which .compensate calibrate"),
        (SMALL + "odd_marker: {number: 13, diameter_mm: 8}\n", "odd_marker.number is 13, but the target has 12"),
        (SMALL + "odd_marker: {number: 1, diameter_mm: 4.5}\n", "differs too little"),
        (SMALL + "odd_marker: {number: 1, diameter_mm: 17}\n", "overlaps its neighbours"),
        (SMALL + "donut_markers: {numbers: [1, 2, 13], hole_mm: 2}\n", "three different ones of 1..12"),
        (SMALL + "donut_markers: {numbers: [1, 2, 2], hole_mm: 2}\n", "three different ones of 1..12"),
        (SMALL + "donut_markers: {numbers: [1, 2], hole_mm: 2}\n", "donut_markers.numbers.3: "),
        (SMALL + "donut_markers: {numbers: [1, 2, 8], hole_mm: 3.5}\n", "0.3 to 0.7 of diameter_mm, not 0.88"),
        (
            SMALL + "donut_markers: {numbers: [1, 5, 9], hole_mm: 2}\n",
            "look the same in a mirror: choose other numbers",
        ),
        (
            SMALL + "donut_markers: {numbers: [1, 2, 8], hole_mm: 2}\nodd_marker: {number: 1, diameter_mm: 6}\n",
            "one of",
        ),
        (SMALL + "minimum_markers: 13\n", "minimum_markers is 13"),
        (SMALL + "cmm_mm: [[0, 0], [10, 0]]\n", "cmm_mm lists 2 centres, but the target has 12"),
        (SMALL + f"cmm_mm: {[[r * 10, c * 10] for c in range(4) for r in range(3)]}\n", "wrong order or unit?"),
    ],
)
def test_a_wrong_target_file_gets_a_sentence(text: str, message: str):
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
        parse_document(text, Target, "t.yaml")


def test_marker_numbers_outside_the_target_are_a_programming_mistake():
    target = parse_document(SMALL, Target, "t")
    for number in (0, 13):
        with pytest.raises(ValueError, match=r"numbered 1\.\.12"):
            target.row_column(number)


def test_a_staggered_targets_second_row_is_half_a_pitch_further_right_and_half_a_pitch_up():
    target = parse_document(SMALL + "layout: staggered\n", Target, "t")
    np.testing.assert_array_equal(target.nominal_mm()[[0, 3, 4, 8]], [[0, 0], [30, 0], [5, 5], [0, 10]])
    assert target.spacing_mm == pytest.approx(np.hypot(5, 5))


@pytest.mark.parametrize("layout", ["square", "staggered"])
def test_neighbouring_cells_are_the_nearest_markers(layout: str):
    target = parse_document(f"{SMALL}layout: {layout}\n", Target, "t")
    cells, places = target.cells(), target.nominal_mm()
    steps = np.abs(cells[:, None] - cells[None]).sum(axis=2)
    away = np.linalg.norm(places[:, None] - places[None], axis=2)
    np.testing.assert_array_equal(steps == 1, np.isclose(away, target.spacing_mm))


def test_the_symmetries_of_a_grid_are_those_of_its_rectangle_or_square():
    def number(columns: int, rows: int, layout: str) -> tuple[int, int]:
        text = f"name: t\ncolumns: {columns}\nrows: {rows}\npitch_mm: 10\ndiameter_mm: 4\nlayout: {layout}\n"
        found = parse_document(text, Target, "t").symmetries()
        return sum(not is_mirror for _, is_mirror in found), sum(is_mirror for _, is_mirror in found)

    assert number(4, 3, "square") == (1, 2)
    assert number(4, 4, "square") == (3, 4)
    assert number(4, 3, "staggered") == (0, 1)
    assert number(4, 6, "staggered") == (1, 0)
