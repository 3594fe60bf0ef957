"""A recorded session becomes arrays over frames, and nothing is dropped in silence."""

from __future__ import annotations

import asyncio
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from thermostand.compensation.drift.displacements import displacements, reference_centres
from thermostand.compensation.observations import Observations, concatenate, observe_session, session_target
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.instants import local_text
from thermostand.markers.detection import Flag
from thermostand.recording.format.records import frame_places
from thermostand.recording.format.restarts import restarted
from thermostand.recording.reading.session import Session

from .conftest import DARK, GLARE, SEQUENCE, START_NS, TARGET_YAML, Recorded, record
from .synthetic import facts, observations, quadratic


@pytest.fixture(scope="module")
def observed(recorded: Recorded) -> Observations:
    session = Session.open(recorded.path)
    return observe_session(session, session_target(session))


@pytest.fixture(scope="module")
def recorded_frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of one frame."""
    path = tmp_path_factory.mktemp("frame") / "night"
    asyncio.run(record(path, {"target.yaml": TARGET_YAML}, frames=1))
    return path


def test_every_frame_has_its_role_and_temperatures(observed: Observations):
    assert list(zip(observed.role, observed.chamber_degC, strict=True)) == SEQUENCE
    np.testing.assert_array_equal(observed.camera_degC, [degC + 20 for _, degC in SEQUENCE])
    assert observed.step_id[4] == "step-4"
    assert observed.frame.tolist() == list(range(len(SEQUENCE)))
    assert observed.image_size == (640, 480)
    assert observed.sessions[0].session_id == "night"
    assert observed.sessions[0].camera_serial == "TS-0001"


def test_centres_are_where_they_truly_are(observed: Observations, recorded: Recorded):
    error = observed.centres_px - recorded.true_px
    assert np.argwhere(np.isnan(error[:, :, 0]) & observed.usable[:, None]).tolist() == [list(GLARE)]
    assert 1e3 * np.sqrt(np.nanmean(error**2)) < 8  # mpx; discs of 10 px in radius
    claimed = np.sqrt(np.nanmean(np.diagonal(observed.covariance_px2, axis1=2, axis2=3)))
    assert np.sqrt(np.nanmean(error**2)) == pytest.approx(claimed, rel=0.2)


def test_a_frame_without_the_target_stays_with_its_reason(observed: Observations):
    assert np.flatnonzero(~observed.usable).tolist() == [DARK]
    assert np.isnan(observed.centres_px[DARK]).all()
    assert np.isnan(observed.covariance_px2[DARK]).all()
    assert "small" in observed.reasons[DARK]
    assert not observed.of(Role.FIT)[DARK]
    assert observed.of(Role.REFERENCE, Role.FIT).sum() == 10


def test_a_flagged_centre_is_not_used(observed: Observations):
    assert np.argwhere(observed.flags).tolist() == [list(GLARE)]
    assert observed.flags[GLARE] == Flag.REFITTED  # it has a centre, from a part of its outline
    assert np.isnan(observed.centres_px[GLARE]).all()
    assert np.isnan(observed.covariance_px2[GLARE]).all()


def test_air_is_interpolated_between_readings_and_unknown_after_the_last(observed: Observations):
    np.testing.assert_allclose(observed.air_degC[:-1], observed.chamber_degC[:-1] + 0.1, rtol=0, atol=1e-9)
    assert np.isnan(observed.air_degC[-1])


def test_progress_counts_frames(recorded: Recorded):
    session, reported = Session.open(recorded.path), list[tuple[float, str]]()
    observe_session(session, session_target(session), report=lambda done, text: reported.append((done, text)))
    count = len(SEQUENCE)
    assert reported == [(done, f"frame {done} of {count}") for done in (0, 10, count)]  # the segments' ends


@pytest.mark.parametrize(("word", "simulated"), [("true", True), ("false", False), (None, None), ("maybe", None)])
def test_a_session_says_whether_it_is_simulated_or_nothing(recorded_frame: Path, word: str | None, simulated: object):
    session = Session.open(recorded_frame)
    session.metadata.pop("simulated", None)
    session.metadata.update({} if word is None else {"simulated": word})
    seen = observe_session(session, session_target(session))
    assert seen.sessions[0].simulated is simulated
    assert seen.simulated is bool(simulated)


def test_a_damaged_frame_is_named(recorded: Recorded, tmp_path: Path):
    damaged = tmp_path / "damaged"
    shutil.copytree(recorded.path, damaged)
    session = Session.open(damaged)
    segment = session.frame_segments[0]
    place = frame_places(segment)[2]
    data = bytearray(segment.read_bytes())
    data[place.chunk.offset + place.chunk.length // 2] ^= 0xFF
    segment.write_bytes(data)
    when = re.escape(local_text(place.time_ns))
    with pytest.raises(SessionError, match=rf"{segment.name}: .*; this was the frame of {when}$"):
        observe_session(session, session_target(session))


def test_frames_of_a_capture_that_was_restarted_do_not_count(tmp_path: Path):
    after_ns = START_NS + 2 * 60 * NS_PER_S + 1
    again = restarted(after_ns, "step-1", 1, "after a long interruption")
    asyncio.run(record(tmp_path / "night", {"target.yaml": TARGET_YAML}, frames=4, events={2: again}))
    session = Session.open(tmp_path / "night")
    seen = observe_session(session, session_target(session))
    assert seen.reasons == ("", "its capture was restarted", "", "")
    assert np.isnan(seen.centres_px[1]).all()


def test_a_session_without_or_with_a_wrong_target_is_refused(tmp_path: Path):
    asyncio.run(record(tmp_path / "none", {}, frames=1))
    with pytest.raises(SessionError, match=r"no target\.yaml is attached"):
        session_target(Session.open(tmp_path / "none"))
    asyncio.run(record(tmp_path / "wrong", {"target.yaml": "name: x\n"}, frames=1))
    with pytest.raises(ConfigError, match=r"target\.yaml: columns"):
        session_target(Session.open(tmp_path / "wrong"))


def test_a_session_that_never_shows_the_target_is_refused(tmp_path: Path):
    asyncio.run(record(tmp_path / "night", {"target.yaml": TARGET_YAML}, frames=3))
    session = Session.open(tmp_path / "night")
    with pytest.raises(SessionError, match="no frame can be used"):
        observe_session(session, session_target(session).model_copy(update={"columns": 12, "minimum_markers": 72}))


def test_sessions_are_put_end_to_end_with_references_of_their_own():
    first, moved = observations(quadratic), observations(quadratic, session=facts("night-2"))
    both = concatenate([first, replace(moved, centres_px=moved.centres_px + 5.0)])
    assert both.session.tolist() == [0] * 34 + [1] * 34
    centres, variance = reference_centres(both)
    np.testing.assert_allclose(centres[1] - centres[0], 5.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(variance, 1e-6 / 8)
    rows = displacements(both, both.of(Role.VALIDATION))
    count = len(rows.frame) // 2
    np.testing.assert_allclose(rows.displacement_px[:count], rows.displacement_px[count:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows.variance_px2, 1e-6 * (1 + 1 / 8))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"sessions": (facts("night-2", camera="other"),)}, "camera TS-0001 and other"),
        ({"image_size": (640, 480), "sessions": (facts("night-2"),)}, "image size"),
        ({}, "night-1 is given twice"),
    ],
)
def test_sessions_that_do_not_belong_together_are_refused(change: dict[str, object], sentence: str):
    first = observations(quadratic)
    with pytest.raises(SessionError, match=sentence):
        concatenate([first, replace(first, **change)])


def test_a_session_without_reference_frames_has_no_displacements():
    lonely = observations(quadratic)
    lonely = replace(lonely, role=np.where(lonely.role == "reference", "other", lonely.role))
    with pytest.raises(SessionError, match="night-1 has no usable reference frames"):
        displacements(lonely, lonely.of(Role.FIT))


def test_missing_markers_are_left_out_one_by_one():
    some = observations(quadratic)
    centres = some.centres_px.copy()
    centres[9, 3] = np.nan  # in one frame
    centres[:8, 4] = np.nan  # never seen at the reference
    rows = displacements(replace(some, centres_px=centres), some.of(Role.FIT))
    assert len(rows.frame) == 14 * 53 - 1
    assert 4 not in rows.marker
