"""Sessions as xarray, pandas and Arrow: values by name, images that are read where they are cut."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from dask.config import set as set_dask

from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Batch, StepMark, StepState
from thermostand.foundation.readings import Frame, Reading
from thermostand.recording.format import images
from thermostand.recording.format.capture_restarts import make_restart_event
from thermostand.recording.reading.session import Session

from .full_session import MS, START_NS, frame, record

S = 1_000_000_000


def items(time_ns: int, index: int):
    """A frame a second; the air warms by 1 K a second, the linear axis moves on 2 mm."""
    share = (time_ns - START_NS) / S
    yield Batch("thermometers", time_ns, (Reading("thermometers.air", 20 + share, "degC", time_ns),))
    readings = (Reading("linear.position", 100 + 2 * share, "mm", time_ns), Reading("linear.moving", 1.0, "1", time_ns))
    yield Batch("linear", time_ns, readings)
    parameters: dict[str, object] = {"frames": 1, "role": "fit", "chamber_degC": 20.0 + index}
    yield StepMark(time_ns, f"capture-{index}", index, "capture", StepState.STARTED, parameters)
    if index == 4:
        yield make_restart_event(time_ns, "capture-3", 1, "from a cold camera")
    yield frame(time_ns - 50 * MS, index)


async def test_images_and_coordinates_are_those_of_the_session(tmp_path: Path):
    await record(tmp_path / "s", 8, items)
    session = Session.open(tmp_path / "s")
    arrays = session.to_xarray()
    assert list(arrays) == ["camera"]
    frames, table = arrays["camera"], session.frames_table()
    assert frames.image.dims == ("time", "row", "column")
    assert frames.image.chunksizes["time"] == (1,) * 8
    assert frames.image.attrs["units"] == "DN"
    expected = np.stack([each.image for each in session.frames()])
    np.testing.assert_array_equal(frames.image.values, expected)
    assert frames.image.dtype == expected.dtype
    np.testing.assert_array_equal(frames.image[2:5, 3:9, 10:2:-2].values, expected[2:5, 3:9, 10:2:-2])
    np.testing.assert_array_equal(frames.image[-1, 7].values, expected[-1, 7])
    np.testing.assert_array_equal(frames.time.values, table.time_ns.astype("datetime64[ns]"))
    for name, column in table.columns().items():
        if name not in ("file", "time_ns", "camera", "role", "chamber_degC"):
            np.testing.assert_array_equal(frames[name].values, column, err_msg=name)
    assert frames.superseded.values.tolist() == [index == 3 for index in range(8)]
    assert frames.linear_position.attrs["units"] == "mm"
    assert frames.attrs["camera"] == "camera"


async def test_readings_stand_on_their_own_instants_and_at_the_frames(tmp_path: Path):
    await record(tmp_path / "s", 8, items)
    session = Session.open(tmp_path / "s")
    arrays = session.to_xarray()
    time_ns, value = session.readings("thermometers.air")
    own = arrays.telemetry["thermometers.air"]
    assert own.attrs["units"] == "degC"
    np.testing.assert_array_equal(own.thermometers_time.values, time_ns.astype("datetime64[ns]"))
    np.testing.assert_array_equal(own.values, value)
    aligned = arrays["camera"]["thermometers.air"]
    np.testing.assert_array_equal(aligned.values, session.frames_table().air_degC)
    assert np.isnan(arrays["camera"]["thermometers.granite_inside"].values).all()  # declared, never read


async def test_a_cut_reads_the_frames_it_needs_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    await record(tmp_path / "s", 8, items)
    arrays = Session.open(tmp_path / "s").to_xarray()
    decoded: list[int] = []
    decode = images.decode_image
    monkeypatch.setattr(
        "thermostand.recording.format.decoded_items.decode_image",
        lambda data: decoded.append(1) or decode(data),
    )
    region = arrays["camera"].image[2:5, :4, :4]
    assert decoded == []
    with set_dask(scheduler="synchronous"):
        region.compute()
    assert len(decoded) == 3


async def test_a_region_of_all_frames_is_in_memory_once(tmp_path: Path):
    await record(tmp_path / "s", 8, items)
    session = Session.open(tmp_path / "s")
    region = session.to_xarray()["camera"].image[:, 3:9, 10:20]
    expected = np.stack([each.image for each in session.frames()])[:, 3:9, 10:20]
    kept = region.persist()
    first, second, part = region.compute(), region.compute(), region[2:5].compute()
    for found in (kept.compute(), first, second):
        np.testing.assert_array_equal(found.values, expected)
    np.testing.assert_array_equal(part.values, expected[2:5])
    np.testing.assert_array_equal(region[::-2].values, expected[::-2])
    np.testing.assert_array_equal(region.mean("time").values, expected.mean(0))
    np.testing.assert_array_equal((region + 1).values, expected + 1)
    np.testing.assert_array_equal(region.transpose("row", "time", "column").values, expected.transpose(1, 0, 2))
    assert not np.shares_memory(first.values, second.values)
    assert type(first.data) is np.ndarray
    with pytest.raises(ValueError, match="read-only"):
        first.values[0] = 0
    first.copy().values[0] = 0
    np.testing.assert_array_equal(first.values, expected)
    blocks = kept.data.blocks[3].compute()
    assert np.shares_memory(kept.compute().values, kept.compute().values), "nothing is copied"
    np.testing.assert_array_equal(blocks, expected[3:4])


async def test_cameras_are_apart_and_sizes_are_not_mixed(tmp_path: Path):
    def two(time_ns: int, index: int):
        yield frame(time_ns, index)
        image = np.full((4, 6 + index // 2), index, np.uint16)
        yield Frame("second.image", image, time_ns + 1, 0.1, 0.0, 40.0, index, index, significant_bits=12)

    await record(tmp_path / "s", 4, two)
    arrays = Session.open(tmp_path / "s").to_xarray()
    assert set(arrays) == {"camera", "second"}
    assert arrays["camera"].sizes["time"] == 4
    with pytest.raises(KeyError):
        arrays["third"]
    with pytest.raises(SessionError) as caught:
        arrays["second"]
    assert "6 x 4 px" in str(caught.value)
    assert "7 x 4 px" in str(caught.value)


async def test_damage_is_reported_when_it_is_computed(tmp_path: Path):
    await record(tmp_path / "s", 4, items)
    session = Session.open(tmp_path / "s")
    frames = session.to_xarray()["camera"]
    segment = session.frame_segments[0]
    data = bytearray(segment.read_bytes())
    data[len(data) // 3] ^= 0xFF
    segment.write_bytes(data)
    with pytest.raises(SessionError) as caught:
        frames.image.compute()
    assert str(segment) in str(caught.value)


async def test_readings_and_the_table_of_frames_become_frames_of_pandas_and_polars(tmp_path: Path):
    await record(tmp_path / "s", 8, items)
    session = Session.open(tmp_path / "s")
    air, table = session.readings("thermometers.air"), session.frames_table()
    series = air.to_pandas()
    np.testing.assert_array_equal(series.to_numpy(), air.value)
    np.testing.assert_array_equal(series.index.to_numpy(), air.time_ns.astype("datetime64[ns]"))
    rows = table.to_pandas()
    assert list(rows.columns) == list(table.columns())
    np.testing.assert_array_equal(rows["air_degC"].to_numpy(), table.air_degC)
    assert rows["role"].tolist() == table.role.tolist()
    frame_of_polars = pl.from_arrow(table.to_arrow())
    assert isinstance(frame_of_polars, pl.DataFrame)
    assert frame_of_polars["step_id"].to_list() == table.step_id.tolist()
    assert frame_of_polars["time_ns"].to_list() == table.time_ns.tolist()


@pytest.mark.parametrize("package", ["xarray", "dask"])
async def test_a_package_that_is_missing_is_named_with_its_extra(tmp_path: Path, package: str):
    await record(tmp_path / "s", 1, items)
    program = (
        f"import sys; sys.modules[{package!r}] = None\n"
        "from thermostand.recording.reading.session import Session\n"
        "from thermostand.foundation.errors import SessionError\n"
        "try: Session.open(sys.argv[1]).to_xarray()\n"
        "except SessionError as error: print(error)\n"
    )
    ended = subprocess.run([sys.executable, "-c", program, tmp_path / "s"], capture_output=True, text=True, check=True)
    assert ended.stdout.startswith(f"{package} ")
    assert "thermostand[arrays]" in ended.stdout
