"""The report's part in three dimensions: the file of `compensate validate` read back, where the table stood."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.reporting.report import render_report
from thermostand.compensation.reporting.report_numbers import (
    Extras,
    TablePositions,
    collect_numbers,
    list_table_positions,
)
from thermostand.compensation.validation3d.document import load_validation, serialise_validation
from thermostand.compensation.validation3d.validate import Deviations, SpatialValidation
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import StepMark, StepState

from .synthetic import observations, quadratic

TEMPERATURES, POSITIONS = 3, 2
PLACES = ((70.0, 0.0), (95.0, 8.0))


def deviations(name: str, size_um: float, seed: int) -> Deviations:
    rng = np.random.default_rng(seed)
    in_space = (TEMPERATURES, POSITIONS, 3)
    translation = size_um * rng.standard_normal(in_space)
    translation[2, 1] = np.nan  # not seen there
    return Deviations(
        name=name,
        translation_um=translation,
        rotation_mrad=rng.standard_normal(in_space),
        noise_um=rng.uniform(0.1, 0.2, in_space),
        model_um=rng.uniform(0.1, 0.2, in_space),
        stand_um=rng.uniform(0.1, 0.2, in_space),
        u_mrad=rng.uniform(0.01, 0.02, in_space),
        repeat_um=rng.standard_normal((TEMPERATURES, 3)),
        table_um=rng.uniform(0.1, 0.2, 3),
        chi=rng.uniform(0.9, 1.1, (TEMPERATURES, POSITIONS)),
    )


@pytest.fixture(scope="module")
def validation() -> SpatialValidation:
    return SpatialValidation(
        names=("V0", "V1"),
        linear_mm=np.array([70.0, 95.0]),
        rotary_deg=np.array([0.0, 8.0]),
        distance_mm=np.array([896.0, 921.0]),
        chamber_degC=np.array([24.0, 47.0, 14.0]),
        camera_degC=np.array([43.5, 63.85, 35.5]),
        frame_count=np.full((TEMPERATURES, POSITIONS), 5),
        outside=np.array([[0.0, 0.0], [1.0, 0.25], [0.0, np.nan]]),
        flags=np.array([[0, 0], [2 + 16, 1], [0, 0]], np.uint8),
        before=deviations("before compensation", 80.0, 1),
        after=deviations("after compensation", 1.0, 2),
        camera_alone=None,
        with_stand=None,
        lens="pinhole",
        model="thermal: homography",
        session_id="cycle-2",
        simulated=True,
    )


def written(validation: SpatialValidation, folder: Path) -> Path:
    path = folder / "validation.json"
    path.write_text(serialise_validation(validation))
    return path


def steps(moves: tuple[tuple[float, float], ...], role: str, prefix: str) -> list[StepMark]:
    found: list[StepMark] = []
    for number, place in enumerate(moves):
        for axis, position in zip(("linear", "rotary"), place, strict=True):
            move: dict[str, object] = {"axis": axis, "position": position}
            for state in (StepState.STARTED, StepState.DONE):
                found.append(StepMark(number, f"{prefix}-move-{number}-{axis}", number, "move_to", state, move))
        found.append(
            StepMark(number, f"{prefix}-capture-{number}", number, "capture", StepState.STARTED, {"role": role})
        )
    return found


def test_a_validation_is_read_back_as_it_was_written(validation: SpatialValidation, tmp_path: Path):
    alone = replace(
        validation, camera_alone=deviations("alone", 50.0, 3), with_stand=deviations("with the stand", 1.0, 4)
    )
    for one in (validation, alone):
        found = load_validation(written(one, tmp_path))
        assert serialise_validation(found) == serialise_validation(one)
        np.testing.assert_array_equal(found.after.u_um, one.after.u_um)
        np.testing.assert_array_equal(found.flags, one.flags)


@pytest.mark.parametrize(
    ("key", "value", "complaint"),
    [
        ("format", "thermostand report 1", "format"),
        ("camera_degC", [40.0], r"arrays do not fit.*\(1,\)"),
        ("outside_because", [[["moon"], []], [[], []], [[], []]], "MOON"),
        ("results", [], "results"),
        ("frames", None, "frames"),
    ],
)
def test_another_file_is_refused_with_a_sentence(
    validation: SpatialValidation, tmp_path: Path, key: str, value: object, complaint: str
):
    path = written(validation, tmp_path)
    path.write_text(json.dumps({**json.loads(path.read_text()), key: value}))
    with pytest.raises(SessionError, match=f"not a validation.*{complaint}"):
        load_validation(path)


def test_no_file_and_no_json_are_refused_with_a_sentence(tmp_path: Path):
    with pytest.raises(SessionError, match="no such file"):
        load_validation(tmp_path / "none.json")
    (tmp_path / "page.html").write_text("<html>")
    with pytest.raises(SessionError, match="not a validation"):
        load_validation(tmp_path / "page.html")


def test_the_report_has_table_1_and_figure_15_when_a_validation_is_given(validation: SpatialValidation):
    session = observations(quadratic, 0.005)
    extras = Extras(positions=TablePositions(((0.0, 0.0), (90.0, 15.0)), PLACES), validation=validation)
    page = render_report(session, None, None, extras)
    before, after = validation.before.mean_um, validation.after.mean_um
    assert page.count("<td>142.0</td><td>28.7</td><td>80 %</td>") == 2  # first of all, and in its section
    assert page.count(f"<td>{before[2]:.1f}</td><td>{after[2]:.2f}</td>") == 2
    assert "In three dimensions" in page
    assert "<td>V1 *</td>" in page
    assert "<td>0.0298</td><td>0.2126</td><td>0.2326</td>" in page  # the paper's Table 1
    ids = re.findall(r'\bid="([^"]+)"', page)
    assert len(ids) == len(set(ids))
    numbers = collect_numbers(session, None, None, extras)
    assert isinstance(numbers.validation, dict)
    assert numbers.validation["results"][1]["mean_um"] == after.tolist()
    assert numbers.positions.poses == PLACES


def test_a_target_that_never_moved_has_no_such_section():
    session = observations(quadratic, 0.005)
    session = replace(session, role=np.full(len(session.role), "calibration"))
    assert "In three dimensions" not in render_report(session, None, None)
    drawn = render_report(session, None, None, Extras(positions=TablePositions(poses=PLACES)))
    assert drawn.count("<svg") == 1
    assert "In three dimensions" in drawn
    assert "Table 1" not in drawn


def test_positions_are_those_of_the_recorded_moves_each_once():
    grid = ((0.0, -15.0), (0.0, 15.0))
    first = steps(grid, "calibration", "a") + steps((*PLACES, PLACES[0]), "pose", "b")
    found = list_table_positions([first, steps((*PLACES, (10.0, -20.0)), "pose", "c")])
    assert found.calibration == grid
    assert found.poses == (*PLACES, (10.0, -20.0))
    assert list_table_positions([steps(PLACES, "fit", "d")]) == TablePositions()
