"""A ROS 2 node that follows a camera's thermal state and takes its drift out of points and of CameraInfo.

In:  air_temperature, camera_temperature   sensor_msgs/Temperature, every few seconds, from switching the camera on
     camera_power                          std_msgs/Bool; powered until it says otherwise
     points                                geometry_msgs/PolygonStamped, pixels of the raw image in x and y
     camera_info_raw                       sensor_msgs/CameraInfo, as calibrated at the reference temperature
Out: points_reference                      the points as they would be at the reference; z: flags, 0 is calibrated
     camera_info                           with a K of this moment; passed on as it is while the state is unknown
     diagnostics                           diagnostic_msgs/DiagnosticArray: whether corrections hold, and why not

Parameters: model (a drift.json; else the one of this package), max_gap_s (60): temperatures further apart are a gap.
"""

import math
from pathlib import Path

import numpy as np
import rclpy
from camera_drift.drift_runtime import AMBIENT, CAMERA, HISTORY, PLACE, STATE, SWITCHED_ON, Drift
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import Point32, PolygonStamped
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Temperature
from std_msgs.msg import Bool

NAMES = {
    PLACE: "outside the calibrated part of the image",
    CAMERA: "camera's temperature outside the calibrated range",
    AMBIENT: "air's temperature outside the calibrated range",
    SWITCHED_ON: "switched on too recently",
    HISTORY: "not followed for long enough",
    STATE: "a combination of temperatures that was not calibrated",
}


class DriftNode(Node):
    """One camera."""

    def __init__(self):
        super().__init__("camera_drift")
        default = str(Path(__file__).with_name("drift.json"))
        self._drift = Drift.load(self.declare_parameter("model", default).value)
        self._max_gap_s = float(self.declare_parameter("max_gap_s", 60.0).value)
        self._air_s = self._camera_s = math.nan
        self._camera_degC = math.nan
        self._powered = 1.0
        self.create_subscription(Temperature, "air_temperature", self._on_air, 10)
        self.create_subscription(Temperature, "camera_temperature", self._on_camera, 10)
        self.create_subscription(Bool, "camera_power", self._on_power, 10)
        self.create_subscription(PolygonStamped, "points", self._on_points, 10)
        self.create_subscription(CameraInfo, "camera_info_raw", self._on_camera_info, 10)
        self._points = self.create_publisher(PolygonStamped, "points_reference", 10)
        self._camera_info = self.create_publisher(CameraInfo, "camera_info", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "diagnostics", 10)

    def _on_air(self, message):
        """Moves the state on, by the time between the stamps of two readings."""
        now_s = _seconds(message.header.stamp)
        dt_s, self._air_s = now_s - self._air_s, now_s
        is_fresh = abs(now_s - self._camera_s) <= self._max_gap_s
        camera_degC = self._camera_degC if is_fresh else math.nan
        if math.isnan(dt_s) or 0 <= dt_s <= self._max_gap_s:
            self._drift.advance(0.0 if math.isnan(dt_s) else dt_s, message.temperature, self._powered, camera_degC)
        else:
            self._drift.advance(dt_s, math.nan, self._powered, camera_degC)
        self._report(message.header.stamp)

    def _on_camera(self, message):
        self._camera_s, self._camera_degC = _seconds(message.header.stamp), message.temperature

    def _on_power(self, message):
        self._powered = 1.0 if message.data else 0.0

    def _on_points(self, message):
        places = np.array([(point.x, point.y) for point in message.polygon.points], float).reshape(-1, 2)
        moved, flags = self._drift.correct(places), self._drift.flags(places)
        out = PolygonStamped(header=message.header)
        out.polygon.points = [
            Point32(x=float(x), y=float(y), z=float(flag)) for (x, y), flag in zip(moved, flags, strict=True)
        ]
        self._points.publish(out)

    def _on_camera_info(self, message):
        """Publish camera info with K changed alone: what is rectified with it comes to where it was at the reference.
        P, and with it the rectified image, stays. The turn about the optical axis has no place in K, and is left out.
        """
        k = self._drift.intrinsics(np.array(message.k, float).reshape(3, 3))
        if np.isfinite(k).all():
            k[1, 0] = 0.0
            message.k = [float(value) for value in k.ravel()]
        self._camera_info.publish(message)

    def _report(self, stamp):
        width, height = self._drift.image_size_px
        middle = np.array([[(width - 1) / 2, (height - 1) / 2]])
        flags = int(self._drift.flags(middle)[0])
        status = DiagnosticStatus(name="camera drift", hardware_id=self._drift.camera_serial)
        status.level, status.message = DiagnosticStatus.OK, "calibrated"
        if flags:
            status.level = DiagnosticStatus.WARN
            status.message = "; ".join(text for flag, text in NAMES.items() if flags & flag)
        if not np.isfinite(self._drift.shift(middle)).all():
            status.level = DiagnosticStatus.ERROR
        out = DiagnosticArray(status=[status])
        out.header.stamp = stamp
        self._diagnostics.publish(out)


def _seconds(stamp):
    return stamp.sec + 1e-9 * stamp.nanosec


def main():
    """Run the node until it is interrupted."""
    rclpy.init()
    node = DriftNode()
    try:
        rclpy.spin(node)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
