"""A session as a NeXus file, which the programs of its field open, and the RO-Crate metadata next to every export."""

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from typing import Any

import h5py
import nexusformat.nexus
import numpy as np
import pytest
import silx.io
from rocrate.rocrate import ROCrate
from silx.io.nxdata.parse import get_default

from tests.recording.full_session import ATTACHMENTS, INFO, make_half_second, record
from thermostand.foundation.errors import SessionError
from thermostand.foundation.readings import Frame
from thermostand.recording.exporting import nexus
from thermostand.recording.exporting.export import export
from thermostand.recording.exporting.mcap_export import export_mcap
from thermostand.recording.exporting.nexus import export_nexus
from thermostand.recording.exporting.ro_crate import CRATE_NAME, write_crate
from thermostand.recording.reading.notes import add_note
from thermostand.recording.reading.session import Session

open_hdf5: Any = h5py.File  # its own types are unions of all that a group may hold


def ignore(share, text):
    assert 0.0 <= share <= 1.0


@pytest.fixture
async def exported(tmp_path):
    await record(tmp_path / "s")
    add_note(tmp_path / "s", "windy", "eva", 1)
    session = Session.open(tmp_path / "s")
    export_nexus(session, tmp_path / "cycle.nxs", report=ignore)
    return session, tmp_path / "cycle.nxs"


def test_every_frame_and_reading_is_in_the_file(exported):
    session, path = exported
    with open_hdf5(path) as file:
        detector = file["entry/instrument/camera"]
        frames = list(session.frames())
        assert (detector["data"].chunks, detector["data"].compression) == ((1, 30, 40), "gzip")
        assert (detector["data"][:] == np.stack([frame.image for frame in frames])).all()
        assert detector["time_ns"][:].tolist() == session.frame_times_ns.tolist()
        assert detector["count_time"][:].tolist() == [frame.exposure_s for frame in frames]
        assert [text.decode() for text in detector["step_id"][:]] == [frame.step_id for frame in frames]
        logs = file["entry/telemetry"]
        assert sorted(logs) == session.channels()
        for channel, unit in session.units().items():
            times_ns, values = session.readings(channel)
            assert logs[channel]["time_ns"][:].tolist() == times_ns.tolist()
            np.testing.assert_array_equal(logs[channel]["value"][:], values)
            assert logs[channel]["value"].attrs["units"] == unit
        assert len(file["entry/steps/time"]) == len(session.steps())
        assert len(file["entry/events/time"]) == len(session.events())


def classes(path):
    found = {}
    with open_hdf5(path) as file:
        file.visititems(lambda name, each: found.setdefault(name, each.attrs.get("NX_class")) and None)
    return found


def test_groups_are_of_the_classes_that_nexus_defines(exported):
    found = classes(exported[1])
    known = {
        "entry": "NXentry",
        "entry/instrument": "NXinstrument",
        "entry/instrument/camera": "NXdetector",
        "entry/camera": "NXdata",
        "entry/sample": "NXsample",
        "entry/user": "NXuser",
        "entry/telemetry/thermometers.air": "NXlog",
        "entry/notes/note_1": "NXnote",
        "entry/attachments/attachment_1": "NXnote",
    }
    assert {name: found[name] for name in known} == known


def test_silx_and_nexusformat_open_the_file(exported):
    session, path = exported
    with silx.io.open(str(path)) as file:
        data = get_default(file)
        assert data is not None
        assert (data.signal.shape, data.axes_names) == ((12, 30, 40), ["time (s)", None, None])
    root = nexusformat.nexus.nxload(str(path))
    entry = root["entry"]
    assert (entry.nxclass, entry["instrument/camera"].nxclass) == ("NXentry", "NXdetector")
    assert entry["telemetry/thermometers.air/value"].attrs["units"] == "degC"
    assert str(entry["user/name"]) == INFO.operator
    assert str(entry["attachments/attachment_1/data"]) == ATTACHMENTS["config.yaml"].strip()  # it strips all texts
    assert entry["instrument/camera/data"][3].nxvalue.tobytes() == session.frame(3).image.tobytes()


async def test_frames_of_16_bits_are_not_cut(tmp_path):
    await record(tmp_path / "s", 3, lambda time_ns, index: make_half_second(time_ns, index, np.uint16))
    session = Session.open(tmp_path / "s")
    export_nexus(session, tmp_path / "cycle.nxs", telemetry=False, report=ignore)
    with open_hdf5(tmp_path / "cycle.nxs") as file:
        assert [image.tobytes() for image in file["entry/instrument/camera/data"]] == [
            frame.image.tobytes() for frame in session.frames()
        ]
        assert "telemetry" not in file["entry"]


def test_nothing_appears_when_it_cannot_be_written(exported, tmp_path, monkeypatch):
    session, path = exported
    with pytest.raises(SessionError, match="is in the way"):
        export_nexus(session, path, report=ignore)
    monkeypatch.setattr(nexus._Writer, "_write_log", lambda *_: (_ for _ in ()).throw(OSError(28, "full")))
    with pytest.raises(SessionError, match="full"):
        export_nexus(session, tmp_path / "other.nxs", report=ignore)
    assert not list(tmp_path.glob("other*"))


@pytest.mark.nightly
async def test_memory_stays_flat(tmp_path):
    """Of 400 frames of 1 MP, which are 400 MB, at most a tenth is in memory."""
    script = (
        "import asyncio, sys, resource; from pathlib import Path; import numpy as np\n"
        "from thermostand.recording.reading.session import Session\n"
        "from thermostand.recording.exporting.nexus import export_nexus\n"
        "session = Session.open(Path(sys.argv[1])); export_nexus(session, Path(sys.argv[2] + '0'), frames=False,"
        " report=lambda s, t: None)\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "export_nexus(session, Path(sys.argv[2]), report=lambda s, t: None)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    image = np.random.default_rng(1).integers(0, 255, (1000, 1000), np.uint8)

    def items(time_ns, index):
        for item in make_half_second(time_ns, index):
            yield replace(item, image=image) if isinstance(item, Frame) else item

    await record(tmp_path / "s", 400, items, segment_s=600.0)
    done = subprocess.run(
        [sys.executable, "-c", script, tmp_path / "s", tmp_path / "out.nxs"], capture_output=True, text=True, check=True
    )
    assert int(done.stdout) < 40_000, "KiB"


def load(metadata, folder) -> Any:
    """The crate as rocrate reads it, in a folder of its own where it is of one file."""
    folder.mkdir(exist_ok=True)
    if metadata.parent != folder:
        shutil.copy(metadata, folder / CRATE_NAME)
        named = metadata.name.removesuffix(f"-{CRATE_NAME}")
        shutil.copy(metadata.parent / named, folder / named)
    return ROCrate(folder)


def test_the_crate_of_each_export_is_read_by_rocrate(exported, tmp_path):
    session, path = exported
    export(session, tmp_path / "tables", report=ignore)
    export_mcap(session, tmp_path / "cycle.mcap", report=ignore)
    for each in (path, tmp_path / "cycle.mcap"):
        write_crate(session, each)
    crates = {
        "tables": load(tmp_path / "tables" / CRATE_NAME, tmp_path / "tables"),
        "nexus": load(tmp_path / f"cycle.nxs-{CRATE_NAME}", tmp_path / "of-nexus"),
        "mcap": load(tmp_path / f"cycle.mcap-{CRATE_NAME}", tmp_path / "of-mcap"),
    }
    for crate in crates.values():
        root = crate.root_dataset
        assert str(crate.metadata["conformsTo"]) == "https://w3id.org/ro/crate/1.1"
        assert all(root.get(key) for key in ("name", "description", "datePublished", "license"))
        assert crate.get("#operator")["name"] == INFO.operator
    names = {part.id for part in crates["tables"].root_dataset["hasPart"]}
    assert names == {
        each.name + "/" * each.is_dir() for each in (tmp_path / "tables").iterdir() if each.name != CRATE_NAME
    }
    (part,) = crates["nexus"].root_dataset["hasPart"]
    assert (part.id, int(part["contentSize"])) == ("cycle.nxs", path.stat().st_size)
    graph = json.loads((tmp_path / "tables" / CRATE_NAME).read_text(encoding="utf-8"))["@graph"]
    ids = [entity["@id"] for entity in graph]
    assert len(set(ids)) == len(ids)
