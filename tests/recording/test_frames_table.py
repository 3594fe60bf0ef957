"""The table of a session's frames, and readings at other instants."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from thermostand.foundation.items import Batch, StepMark, StepState
from thermostand.foundation.readings import Reading
from thermostand.recording.format.capture_restarts import make_restart_event
from thermostand.recording.reading.interpolation import GAP_NS, interpolate
from thermostand.recording.reading.session import Session

from .full_session import MS, START_NS, frame, record

S = 1_000_000_000
PERIOD_NS = S // 2


def items(time_ns: int, index: int):
    """A capture of one frame each half second; the linear axis moves on 2 mm a second, and the air warms by 1 K."""
    share = (time_ns - START_NS) / S
    yield Batch("thermometers", time_ns, (Reading("thermometers.air", 20 + share, "degC", time_ns),))
    yield Batch(
        "linear",
        time_ns,
        (Reading("linear.position", 100 + 2 * share, "mm", time_ns), Reading("linear.moving", 1.0, "1", time_ns)),
    )
    parameters: dict[str, object] = {"frames": 1, "role": "fit", "chamber_degC": 20 + index}
    yield StepMark(time_ns, f"capture-{index}", index, "capture", StepState.STARTED, parameters if index else {})
    yield frame(time_ns - 50 * MS, index)


async def test_a_row_says_where_a_frame_is_and_what_is_known_of_it(tmp_path: Path):
    await record(tmp_path / "s", 12, items)
    session = Session.open(tmp_path / "s")
    table = session.frames_table()
    assert len(table) == session.frame_count == 12
    np.testing.assert_array_equal(table.time_ns, session.frame_times_ns)
    assert table.step_id.tolist() == [f"capture-{index}" for index in range(12)]
    assert table.role.tolist() == ["", *["fit"] * 11]
    np.testing.assert_array_equal(table.chamber_degC, [np.nan, *range(21, 32)])
    np.testing.assert_array_equal(table.camera_degC, [frame.camera_degC for frame in session.frames()])
    assert np.isnan(table.camera_degC[3])
    share = (table.time_ns - START_NS) / S
    np.testing.assert_allclose(table.air_degC, np.where(share < 0, np.nan, 20 + share), rtol=1e-12)
    np.testing.assert_allclose(table.positions["linear"], np.where(share < 0, np.nan, 100 + 2 * share), rtol=1e-12)
    assert set(table.file) == {f"frames/{path.name}" for path in session.frame_segments}
    assert len(set(table.file)) > 1
    assert not table.superseded.any()


async def test_its_columns_have_names_and_one_length(tmp_path: Path):
    await record(tmp_path / "s", 3, items)
    columns = Session.open(tmp_path / "s").frames_table().columns()
    assert list(columns)[:2] == ["file", "time_ns"]
    assert list(columns)[-1] == "linear_position"
    assert {column.shape for column in columns.values()} == {(3,)}


async def test_frames_before_a_new_beginning_of_their_capture_are_superseded(tmp_path: Path):
    def again(time_ns: int, index: int):
        yield from items(time_ns, index)
        if index == 1:
            yield make_restart_event(time_ns, "capture-1", 1, "from a cold camera")

    await record(tmp_path / "s", 3, again)
    session = Session.open(tmp_path / "s")
    assert session.frames_table().superseded.tolist() == [False, True, False]


async def test_a_session_without_frames_has_an_empty_table(tmp_path: Path):
    await record(tmp_path / "s", 3, lambda time_ns, index: list(items(time_ns, index))[:2])
    table = Session.open(tmp_path / "s").frames_table()
    assert len(table) == 0
    assert table.positions["linear"].shape == (0,)


@pytest.mark.parametrize(
    ("at_s", "beyond_s", "expected"),
    [
        (0.0, 0, 1.0),
        (30.0, 0, 2.0),
        (60.0, 0, 3.0),
        (61.0, 0, np.nan),  # a gap of 121 s follows
        (180.9, 0, np.nan),
        (181.0, 0, np.nan),  # the end of a gap belongs to it
        (200.5, 0, 7.5),
        (-1.0, 0, np.nan),
        (-1.0, 5, 1.0),
        (220.0, 0, 8.0),
        (225.0, 5, 8.0),
        (225.1, 5, np.nan),
    ],
)
def test_readings_are_linear_between_and_unknown_across_gaps(at_s: float, beyond_s: int, expected: float):
    times_ns = np.array([0, 30, 60, 181, 220], np.int64) * S + START_NS
    values = np.array([1.0, np.nan, 3.0, 7.0, 8.0])
    found = interpolate(times_ns, values, np.array([START_NS + int(at_s * S)]), beyond_s * S)
    np.testing.assert_allclose(found, [expected], rtol=1e-12)


def test_no_reading_and_one_reading():
    at_ns = np.array([0, 1], np.int64)
    assert np.isnan(interpolate(np.empty(0, np.int64), np.empty(0), at_ns)).all()
    np.testing.assert_array_equal(interpolate(np.array([1]), np.array([5.0]), at_ns), [np.nan, 5.0])
    assert GAP_NS == 120 * S
