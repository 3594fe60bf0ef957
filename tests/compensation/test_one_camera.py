"""Of a session of several cameras each has observations, temperatures and a serial number of its own."""

import asyncio
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from thermostand.compensation.cli import app
from thermostand.compensation.drift.facts import ModelFacts
from thermostand.compensation.drift.model_file import save_model
from thermostand.compensation.drift.paper_model import DegreeScore, PaperModel, exponents
from thermostand.compensation.history.thermal_history import recorded_history
from thermostand.compensation.observations import observe
from thermostand.compensation.one_camera import name_of, own_frames, take
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, Item
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.reading.session import Session

from .conftest import STAND, published, record_items

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
    path = tmp_path_factory.mktemp("several") / "night"
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
    take(session, "side")
    assert recorded_history(session).camera_degC[0] == pytest.approx(leading.camera_degC[0] + WARMER_K, abs=0.5)
    with pytest.raises(SessionError, match="no frames of a camera top; it has those of camera, side"):
        observe(path, camera="top")
    assert own_frames(session) == [1, 3, 5]
    assert (name_of(session, "TS-0002"), name_of(session, "TS-0009")) == ("side", None)
    for command in (["apply", str(model_of(path.parent, "TS-0009"))], ["budget"], ["calibrate"]):
        out = [] if command == ["budget"] else ["-o", str(path.parent / "out")]
        result = CliRunner().invoke(app, [*command, str(path), "--camera", "top", *out])
        assert "no frames of a camera top" in result.output


def model_of(folder: Path, serial: str) -> Path:
    count = len(exponents(1))
    facts = ModelFacts(
        image_size=(640, 480),
        hull_px=np.array([[0.0, 0.0], [639.0, 0.0], [639.0, 479.0], [0.0, 479.0]]),
        reference_degC=44.0,
        reference_chamber_degC=24.0,
        reference_centres_px=np.array([[10.0, 9.0]]),
        target_name="small",
        camera_serial=serial,
        session_ids=("night",),
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
