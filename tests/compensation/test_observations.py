"""A recorded session becomes arrays over frames, and nothing is dropped in silence."""

from __future__ import annotations

import asyncio
import re
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from thermostand.compensation.camera_selection import find_camera_name, list_camera_frames, select_camera
from thermostand.compensation.cli import app
from thermostand.compensation.drift.displacements import average_reference_centres, compute_displacements
from thermostand.compensation.drift.model_facts import ModelFacts
from thermostand.compensation.drift.model_file import save_model
from thermostand.compensation.drift.paper_model import DegreeScore, PaperModel, list_exponents
from thermostand.compensation.history.thermal_history import read_history
from thermostand.compensation.observations import (
    Observations,
    concatenate,
    observe,
    observe_session,
    read_session_target,
)
from thermostand.experiments.steps import Role
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.instants import format_local
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Frame, Reading
from thermostand.markers.detection import Flag
from thermostand.recording.format.capture_restarts import make_restart_event
from thermostand.recording.format.records import list_frame_places
from thermostand.recording.reading.session import Session
from thermostand.recording.repair.salvage import salvage_session

from .conftest import DARK, GLARE, SEQUENCE, STAND, START_NS, TARGET_YAML, Recorded, published, record, record_items
from .made_up_models import paper
from .synthetic import facts, observations, quadratic


@pytest.fixture(scope="module")
def observed(recorded: Recorded) -> Observations:
    session = Session.open(recorded.path)
    return observe_session(session, read_session_target(session))


@pytest.fixture(scope="module")
def recorded_frame(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session of one frame."""
    path = tmp_path_factory.mktemp("frame") / "cycle"
    asyncio.run(record(path, {"target.yaml": TARGET_YAML}, frames=1))
    return path


def test_every_frame_has_its_role_and_temperatures(observed: Observations):
    assert list(zip(observed.role, observed.chamber_degC, strict=True)) == SEQUENCE
    np.testing.assert_array_equal(observed.camera_degC, [degC + 20 for _, degC in SEQUENCE])
    assert observed.step_id[4] == "step-4"
    assert observed.frame.tolist() == list(range(len(SEQUENCE)))
    assert observed.image_size == (640, 480)
    assert observed.sessions[0].session_id == "cycle"
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
    observe_session(session, read_session_target(session), report=lambda done, text: reported.append((done, text)))
    count = len(SEQUENCE)
    assert reported == [(done, f"frame {done} of {count}") for done in (0, 10, count)]  # the segments' ends


@pytest.mark.parametrize(("word", "simulated"), [("true", True), ("false", False), (None, None), ("maybe", None)])
def test_a_session_says_whether_it_is_simulated_or_nothing(recorded_frame: Path, word: str | None, simulated: object):
    session = Session.open(recorded_frame)
    session.metadata.pop("simulated", None)
    session.metadata.update({} if word is None else {"simulated": word})
    seen = observe_session(session, read_session_target(session))
    assert seen.sessions[0].simulated is simulated
    assert seen.simulated is bool(simulated)


def test_a_damaged_frame_is_named(recorded: Recorded, tmp_path: Path):
    damaged = tmp_path / "damaged"
    shutil.copytree(recorded.path, damaged)
    session = Session.open(damaged)
    segment = session.frame_segments[0]
    place = list_frame_places(segment)[2]
    data = bytearray(segment.read_bytes())
    data[place.chunk.offset + place.chunk.length // 2] ^= 0xFF
    segment.write_bytes(data)
    when = re.escape(format_local(place.time_ns))
    with pytest.raises(SessionError, match=rf"{segment.name}: .* {when}$"):
        observe_session(session, read_session_target(session))


def test_frames_of_a_capture_that_was_restarted_do_not_count(tmp_path: Path):
    after_ns = START_NS + 2 * 60 * NS_PER_S + 1
    again = make_restart_event(after_ns, "step-1", 1, "after a long interruption")
    asyncio.run(record(tmp_path / "cycle", {"target.yaml": TARGET_YAML}, frames=4, events={2: again}))
    session = Session.open(tmp_path / "cycle")
    seen = observe_session(session, read_session_target(session))
    assert seen.reasons == ("", "its capture was restarted", "", "")
    assert np.isnan(seen.centres_px[1]).all()


def test_a_session_without_or_with_a_wrong_target_is_refused(tmp_path: Path):
    asyncio.run(record(tmp_path / "none", {}, frames=1))
    with pytest.raises(SessionError, match=r"no target\.yaml is attached"):
        read_session_target(Session.open(tmp_path / "none"))
    asyncio.run(record(tmp_path / "wrong", {"target.yaml": "name: x\n"}, frames=1))
    with pytest.raises(ConfigError, match=r"target\.yaml: columns"):
        read_session_target(Session.open(tmp_path / "wrong"))


def test_a_session_that_never_shows_the_target_is_refused(tmp_path: Path):
    asyncio.run(record(tmp_path / "cycle", {"target.yaml": TARGET_YAML}, frames=3))
    session = Session.open(tmp_path / "cycle")
    with pytest.raises(SessionError, match="no frame can"):
        observe_session(session, read_session_target(session).model_copy(update={"columns": 12, "minimum_markers": 72}))


def test_sessions_are_put_end_to_end_with_references_of_their_own():
    first, moved = observations(quadratic), observations(quadratic, session=facts("cycle-2"))
    both = concatenate([first, replace(moved, centres_px=moved.centres_px + 5.0)])
    assert both.session.tolist() == [0] * 34 + [1] * 34
    centres, variance = average_reference_centres(both)
    np.testing.assert_allclose(centres[1] - centres[0], 5.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(variance, 1e-6 / 8)
    rows = compute_displacements(both, both.of(Role.VALIDATION))
    count = len(rows.frame) // 2
    np.testing.assert_allclose(rows.displacement_px[:count], rows.displacement_px[count:], rtol=0, atol=1e-9)
    np.testing.assert_allclose(rows.variance_px2, 1e-6 * (1 + 1 / 8))


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        ({"sessions": (facts("cycle-2", camera="other"),)}, "camera TS-0001 and other"),
        ({"image_size": (640, 480), "sessions": (facts("cycle-2"),)}, "image size"),
        ({}, "cycle-1 is given twice"),
    ],
)
def test_sessions_that_do_not_belong_together_are_refused(change: dict[str, object], sentence: str):
    first = observations(quadratic)
    with pytest.raises(SessionError, match=sentence):
        concatenate([first, replace(first, **change)])


def test_a_session_without_reference_frames_has_no_displacements():
    lonely = observations(quadratic)
    lonely = replace(lonely, role=np.where(lonely.role == "reference", "other", lonely.role))
    with pytest.raises(SessionError, match=r"cycle-1 .* reference frames"):
        compute_displacements(lonely, lonely.of(Role.FIT))


def test_missing_markers_are_left_out_one_by_one():
    some = observations(quadratic)
    centres = some.centres_px.copy()
    centres[9, 3] = np.nan  # in one frame
    centres[:8, 4] = np.nan  # never seen at the reference
    rows = compute_displacements(replace(some, centres_px=centres), some.of(Role.FIT))
    assert len(rows.frame) == 14 * 53 - 1
    assert 4 not in rows.marker


# A session of which segments are missing is fitted, reported and applied only when that is asked for.


runner = CliRunner()


@pytest.fixture
def holed(recorded: Recorded, tmp_path: Path) -> Path:
    """The second segment of the frames, ten minutes of the session, is missing."""
    path = Path(shutil.copytree(recorded.path, tmp_path / "cycle"))
    assert len(list((path / "frames").glob("*.mcap"))) == 2
    (path / "frames" / "0000.mcap").unlink()
    return path


def ask(*arguments: object) -> tuple[int, str]:
    result = runner.invoke(app, [str(argument) for argument in arguments])
    return result.exit_code, " ".join(result.stderr.split())


def test_the_markers_of_incomplete_sessions_are_found_when_it_is_asked_for(holed: Path, tmp_path: Path):
    out = tmp_path / "markers.csv"
    status, answer = ask("detect", holed, "-o", out)
    assert status == 1
    assert "is incomplete; missing: frames/0000.mcap (to 2026-01-01 18:1" in answer
    assert answer.endswith("to read the rest")
    assert not out.exists()
    status, answer = ask("detect", holed, "-o", out, "--incomplete")
    assert status == 0
    assert f"warning: {holed}: is incomplete; missing: frames/0000.mcap" in answer
    assert 0 < len({line.split(",")[0] for line in out.read_text().splitlines()[1:]}) < len(SEQUENCE)


@pytest.mark.parametrize(
    "command",
    [
        ("fit", "{session}", "-o", "{out}"),
        ("report", "{session}", "-o", "{out}"),
        ("budget", "{session}"),
        ("calibrate", "{session}", "-o", "{out}"),
    ],
)
def test_each_command_refuses_it_with_the_same_sentence(holed: Path, tmp_path: Path, command: tuple[str, ...]):
    out = tmp_path / "out.html"
    status, answer = ask(*(text.format(session=holed, out=out) for text in command))
    assert status == 1
    assert answer.startswith(f"error: {holed}: is incomplete; missing: frames/0000.mcap (to ")
    assert answer.endswith("to read the rest")
    assert not out.exists()
    _, answer = ask(*(text.format(session=holed, out=out) for text in command), "--incomplete")
    assert answer.startswith(f"warning: {holed}: is incomplete; missing: frames/0000.mcap (to ")


def test_corrections_want_the_whole_session_too(holed: Path, recorded: Recorded, tmp_path: Path):
    model, points = tmp_path / "model.json", tmp_path / "points.csv"
    save_model(paper(), model)
    time_ns = Session.open(recorded.path).frame_times_ns[-1]
    points.write_text(f"x_px,y_px,time_ns\n320,240,{time_ns}\n")
    for source in ((holed,), (points, "--session", holed)):
        out = tmp_path / "out"
        status, answer = ask("apply", model, *source, "-o", out)
        assert status == 1
        assert answer.endswith("to read the rest")
        assert not out.exists()
    status, answer = ask("apply", model, points, "--session", holed, "-o", tmp_path / "out.csv", "--incomplete")
    assert (status, answer.startswith(f"warning: {holed}: is incomplete; missing: frames/0000.mcap")) == (0, True)


@pytest.fixture
def unfinished(recorded: Recorded, tmp_path: Path) -> Path:
    """A killed recorder has left the second segment of the frames."""
    path = Path(shutil.copytree(recorded.path, tmp_path / "cycle"))
    last = path / "frames" / "0001.mcap"
    last.rename(last.with_name("0001.mcap.part"))
    return path


def test_what_a_killed_recorder_left_is_not_left_out_in_silence(unfinished: Path, tmp_path: Path):
    out = tmp_path / "markers.csv"
    status, answer = ask("detect", unfinished, "-o", out)
    assert status == 1
    assert answer.startswith(f"error: {unfinished}: frames/0001.mcap.part is not finished")
    assert f"`stand session repair {unfinished}`" in answer
    assert not out.exists()
    status, answer = ask("detect", unfinished, "-o", out, "--incomplete")
    assert status == 0
    assert f"warning: {unfinished}: frames/0001.mcap.part is not finished" in answer
    salvage_session(unfinished)
    status, answer = ask("detect", unfinished, "-o", out)
    assert (status, "warning" in answer) == (0, False)


# Of a session of several cameras each has observations, temperatures and a serial number of its own.


FRAMES, APART_NS, WARMER_K = 3, 1_000_000, 7.0


def of_both(index: int, time_ns: int) -> Iterator[Item]:
    for item in published(index, time_ns):
        yield item
        if isinstance(item, Frame):
            later_ns = time_ns + APART_NS
            warmer = {"channel": "side.image", "time_ns": later_ns, "camera_degC": item.camera_degC + WARMER_K}
            yield replace(item, **warmer)
            for name, degC in (("camera", item.camera_degC), ("side", item.camera_degC + WARMER_K)):
                yield Batch(name, later_ns, (Reading(f"{name}.temperature", degC, "degC", later_ns),))


@pytest.fixture(scope="module")
def two_cameras(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("several") / "cycle"
    devices = {**STAND, "side": "camera"}
    asyncio.run(record_items(path, of_both, FRAMES, 60, devices=devices, serials="TS-0001, TS-0002"))
    return path


def test_each_camera_of_a_session_is_observed_by_its_name(two_cameras: Path):
    path = two_cameras
    leading, side = observe(path), observe(path, camera="side")
    assert (side.time_ns - leading.time_ns).tolist() == [APART_NS] * FRAMES
    assert (side.camera_degC - leading.camera_degC).tolist() == pytest.approx([WARMER_K] * FRAMES)
    assert [each.sessions[0].camera_serial for each in (leading, side)] == ["TS-0001", "TS-0002"]
    session = Session.open(path)
    select_camera(session, "side")
    assert read_history(session).camera_degC[0] == pytest.approx(leading.camera_degC[0] + WARMER_K, abs=0.5)
    with pytest.raises(SessionError, match=r"camera top; .* camera, side"):
        observe(path, camera="top")
    assert list_camera_frames(session) == [1, 3, 5]
    assert (find_camera_name(session, "TS-0002"), find_camera_name(session, "TS-0009")) == ("side", None)
    for command in (["apply", str(model_of(path.parent, "TS-0009"))], ["budget"], ["calibrate"]):
        out = [] if command == ["budget"] else ["-o", str(path.parent / "out")]
        result = CliRunner().invoke(app, [*command, str(path), "--camera", "top", *out])
        assert "of a camera top" in result.output


def model_of(folder: Path, serial: str) -> Path:
    count = len(list_exponents(1))
    facts = ModelFacts(
        image_size=(640, 480),
        hull_px=np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]]),
        reference_degC=44.0,
        reference_chamber_degC=24.0,
        reference_centres_px=np.array([[10.0, 9.0]]),
        target_name="small",
        camera_serial=serial,
        session_ids=("cycle",),
        software_version="0",
        camera_range_degC=(0.0, 90.0),
    )
    score = DegreeScore(degree=1, terms=count, condition=9.0, rms_px=(0.1, 0.1), fold_chamber_degC=(), fold_rms_px=())
    still, sure = np.zeros((2, count)), np.array([1e-6 * np.eye(count)] * 2)
    model = PaperModel(
        facts=facts,
        degree=1,
        coefficients=still,
        coefficient_covariance=sure,
        discrepancy_px=np.array([0.02, 0.03]),
        scores=(score,),
        candidates=(),
    )
    path = folder / f"{serial}.json"
    save_model(model, path)
    return path


@pytest.mark.parametrize(
    ("serial", "options", "camera_degC"),
    [("TS-0002", (), 7.0), ("TS-0001", ("--camera", "side"), 7.0), ("TS-0001", (), 0.0)],
)
def test_a_model_corrects_the_frames_of_its_own_camera_or_the_one_named(
    two_cameras: Path, tmp_path: Path, serial: str, options: tuple[str, ...], camera_degC: float
):
    out = tmp_path / "out"
    result = CliRunner().invoke(
        app, ["apply", str(model_of(tmp_path, serial)), str(two_cameras), "-o", str(out), *options]
    )
    assert result.exit_code == 0, result.output
    rows = (out / "images.csv").read_text().splitlines()[1:]
    leading = observe(two_cameras).camera_degC
    assert [float(row.split(",")[3]) for row in rows] == pytest.approx((leading + camera_degC).tolist(), abs=1e-3)
