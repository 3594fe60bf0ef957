"""The exported ROS 2 package, with stubs in ROS's place: the node corrects as the runtime module does, and says when
not to trust it.
"""

from __future__ import annotations

import ast
import importlib
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from thermostand.compensation.apply.runtime_export import build_runtime_model, export_ros2
from thermostand.compensation.drift_runtime import Drift

from .made_up_models import thermal
from .ros2_stub import MESSAGES, Header, Point32, Polygon, StubNode, Time, stub_modules

PLACES = np.array([[320.0, 200.0], [5.0, 5.0]])
K = np.array([[900.0, 0.0, 319.0], [0.0, 905.0, 241.0], [0.0, 0.0, 1.0]])


@pytest.fixture
def node(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    export_ros2(thermal(), tmp_path)
    for name, module in stub_modules().items():
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield importlib.import_module("camera_drift.drift_node").DriftNode()
    for name in [name for name in sys.modules if name.split(".")[0] == "camera_drift"]:
        del sys.modules[name]


def header(seconds: float) -> Any:
    return Header(stamp=Time(sec=int(seconds), nanosec=round(1e9 * (seconds % 1))))


def temperature(seconds: float, degC: float) -> Any:
    return MESSAGES["sensor_msgs"]["Temperature"](header=header(seconds), temperature=degC)


def points(places: np.ndarray[Any, Any]) -> Any:
    polygon = Polygon(points=[Point32(x=x, y=y) for x, y in places.tolist()])
    return MESSAGES["geometry_msgs"]["PolygonStamped"](header=header(1.0), polygon=polygon)


def live(node: StubNode, drift: Drift, seconds: float, count: int, air_degC: float, camera_degC: float) -> float:
    """Both are fed the same, every ten seconds."""
    for _ in range(count):
        seconds += 10
        node.send("camera_temperature", temperature(seconds, camera_degC))
        node.send("air_temperature", temperature(seconds, air_degC))
        drift.advance(10.0, air_degC, 1.0, camera_degC)
    return seconds


def begun(node: StubNode) -> tuple[Drift, float]:
    drift = Drift(dict(build_runtime_model(thermal())))
    node.send("camera_temperature", temperature(99.5, 44.0))
    node.send("air_temperature", temperature(100.0, 24.0))
    drift.advance(0.0, 24.0, 1.0, 44.0)
    return drift, live(node, drift, 100.0, 1500, 24.0, 44.0)


def test_points_are_corrected_as_by_the_runtime_module_and_flagged(node: StubNode):
    drift, _ = begun(node)
    node.send("points", points(PLACES))
    out = node.published["points_reference"][-1].polygon.points
    np.testing.assert_allclose([(point.x, point.y) for point in out], drift.correct(PLACES), atol=1e-9)
    assert [int(point.z) for point in out] == drift.flags(PLACES).tolist()
    assert out[1].z != 0


def test_a_point_projected_with_the_new_camera_matrix_is_seen_where_the_drift_puts_it(node: StubNode):
    drift, _ = begun(node)
    info = MESSAGES["sensor_msgs"]["CameraInfo"](k=K.ravel().tolist(), p=list(range(12)))
    node.send("camera_info_raw", info)
    now = node.published["camera_info"][-1]
    assert now.p == list(range(12))
    assert now.k[3] == 0
    matrix = drift.intrinsics(K)
    for ray in np.array([[0.0, 0.0, 1.0], [0.02, -0.01, 1.0]]):
        at_reference, seen = (K @ ray)[:2], (matrix @ ray)[:2]
        np.testing.assert_allclose(drift.correct(seen[None])[0], at_reference, atol=2e-3)
    np.testing.assert_allclose(np.array(now.k).reshape(3, 3)[0], matrix[0], atol=1e-12)


def test_what_is_unknown_is_reported_and_camera_info_passes_unchanged(node: StubNode):
    info = MESSAGES["sensor_msgs"]["CameraInfo"](k=K.ravel().tolist())
    node.send("camera_info_raw", info)
    assert node.published["camera_info"][-1].k == K.ravel().tolist()
    node.send("points", points(PLACES))
    assert all(math.isnan(point.x) for point in node.published["points_reference"][-1].polygon.points)
    node.send("air_temperature", temperature(1.0, math.nan))
    status = node.published["diagnostics"][-1].status[0]
    assert (status.level, status.hardware_id) == (b"\2", "TS-0001")


@pytest.mark.parametrize("jump_s", [3600.0, -5.0])
def test_a_gap_or_a_clock_that_steps_back_begins_again(node: StubNode, jump_s: float):
    _, seconds = begun(node)
    assert node.published["diagnostics"][-1].status[0].level == b"\0"
    node.send("camera_temperature", temperature(seconds + jump_s, 44.0))
    node.send("air_temperature", temperature(seconds + jump_s, 24.0))
    assert node.published["diagnostics"][-1].status[0].level == b"\2"


def test_a_camera_without_power_or_with_a_silent_sensor_is_followed(node: StubNode):
    drift, seconds = begun(node)
    node.send("camera_power", MESSAGES["std_msgs"]["Bool"](data=False))
    for _ in range(30):
        seconds += 10
        node.send("air_temperature", temperature(seconds, 24.0))
        fresh = seconds - 15100.0 <= 60
        drift.advance(10.0, 24.0, 0.0, 44.0 if fresh else math.nan)
    node.send("points", points(PLACES))
    out = node.published["points_reference"][-1].polygon.points
    np.testing.assert_allclose([(point.x, point.y) for point in out], drift.correct(PLACES), atol=1e-9)


def test_the_package_is_what_colcon_wants(tmp_path: Path):
    written = export_ros2(thermal(), tmp_path)
    names = {str(path.relative_to(tmp_path)) for path in written}
    assert names == {
        "package.xml", "setup.py", "setup.cfg", "resource/camera_drift", "camera_drift/__init__.py",
        "camera_drift/drift_node.py", "camera_drift/drift_runtime.py", "camera_drift/drift.json",
    }  # fmt: skip
    root = ET.parse(tmp_path / "package.xml").getroot()
    depends = {one.text for one in root.findall("exec_depend")}
    tree = ast.parse((tmp_path / "camera_drift" / "drift_node.py").read_text())
    imported = {one.module.split(".")[0] for one in ast.walk(tree) if isinstance(one, ast.ImportFrom) and one.module}
    assert imported - {"pathlib", "camera_drift"} <= depends
    assert root.findtext("version") == "0.0.0"
    compile((tmp_path / "setup.py").read_text(), "setup.py", "exec")
