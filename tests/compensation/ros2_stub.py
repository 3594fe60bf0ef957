"""Stubs of ROS 2, as much as the exported node uses, so that it runs where no ROS is: messages that hold what is put
into them, and a Node that calls its subscribers at once. Not ROS: no executors, no quality of service, no wires.
"""

from __future__ import annotations

import copy
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any, ClassVar


class StubMessage:
    """Fields with defaults, overruled by keywords; an unknown field is an error, as in ROS."""

    fields: ClassVar[dict[str, Any]] = {}

    def __init__(self, **given: Any) -> None:
        unknown = set(given) - set(self.fields)
        if unknown:
            raise AssertionError(f"{type(self).__name__} has no field {unknown}")
        for name, default in self.fields.items():
            setattr(self, name, given.get(name, copy.deepcopy(default)))


def stub_message(name: str, /, **fields: Any) -> type[StubMessage]:
    return type(name, (StubMessage,), {"fields": fields})


Time = stub_message("Time", sec=0, nanosec=0)
Header = stub_message("Header", stamp=Time(), frame_id="")
Point32 = stub_message("Point32", x=0.0, y=0.0, z=0.0)
Polygon = stub_message("Polygon", points=[])
DiagnosticStatus = stub_message("DiagnosticStatus", level=b"\0", name="", message="", hardware_id="", values=[])
DiagnosticStatus.OK, DiagnosticStatus.WARN, DiagnosticStatus.ERROR = b"\0", b"\1", b"\2"  # type: ignore[attr-defined]
MESSAGES = {
    "diagnostic_msgs": {
        "DiagnosticStatus": DiagnosticStatus,
        "DiagnosticArray": stub_message("DiagnosticArray", header=Header(), status=[]),
    },
    "geometry_msgs": {
        "Point32": Point32,
        "PolygonStamped": stub_message("PolygonStamped", header=Header(), polygon=Polygon()),
    },
    "sensor_msgs": {
        "CameraInfo": stub_message("CameraInfo", header=Header(), height=0, width=0, d=[], k=[0.0] * 9, p=[0.0] * 12),
        "Temperature": stub_message("Temperature", header=Header(), temperature=0.0, variance=0.0),
    },
    "std_msgs": {"Bool": stub_message("Bool", data=False)},
}


class StubNode:
    """Keeps what is published, and hands on what a test sends."""

    parameters: ClassVar[dict[str, Any]] = {}

    def __init__(self, name: str) -> None:
        self.name = name
        self.published: dict[str, list[Any]] = {}
        self._subscribers: dict[str, tuple[type, Callable[[Any], None]]] = {}

    def declare_parameter(self, name: str, default: Any) -> Any:
        return type("Parameter", (), {"value": self.parameters.get(name, default)})

    def create_subscription(self, kind: type, topic: str, callback: Callable[[Any], None], depth: int) -> None:
        self._subscribers[topic] = kind, callback

    def create_publisher(self, kind: type, topic: str, depth: int) -> Any:
        sent = self.published.setdefault(topic, [])

        def publish(message: Any) -> None:
            assert isinstance(message, kind)
            sent.append(message)

        return type("Publisher", (), {"publish": staticmethod(publish)})

    def send(self, topic: str, message: Any) -> None:
        kind, callback = self._subscribers[topic]
        assert isinstance(message, kind)
        callback(message)


def stub_modules() -> dict[str, ModuleType]:
    """For sys.modules."""
    found = {"rclpy": ModuleType("rclpy"), "rclpy.node": ModuleType("rclpy.node")}
    found["rclpy.node"].Node = StubNode  # type: ignore[attr-defined]
    for package, messages in MESSAGES.items():
        found[package], module = ModuleType(package), ModuleType(f"{package}.msg")
        for name, message in messages.items():
            setattr(module, name, message)
        found[f"{package}.msg"] = module
    assert not set(found) & set(sys.modules), "there is a real ROS here: use it"
    return found
