"""What the cameras of a stand need of the line they share, before any of them is opened."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from thermostand.drivers.settings import CameraSettings
from thermostand.drivers.wires.camera_line import compute_frame_wire_s, compute_packet_delay_ns
from thermostand.drivers.wires.camera_settings import GigeCameraSettings, frame_bytes

_SENSOR_PX = (2448, 2048)  # of a camera whose size nobody states, as in the plan's estimate of the disk
_PACKET_SIZE = 1500  # of a camera that finds its own: what every network carries


def add_line_share(settings: CameraSettings, cameras: Iterable[CameraSettings]) -> CameraSettings:
    """The settings; those of a GigE camera with the number of cameras on its line, which are all GigE cameras of the
    stand unless the stand's file states it."""
    if not isinstance(settings, GigeCameraSettings) or settings.line_shared_by is not None:
        return settings
    all_of_them = sum(isinstance(each, GigeCameraSettings) for each in cameras)
    return settings if all_of_them == 1 else settings.model_copy(update={"line_shared_by": all_of_them})


@dataclass(frozen=True, slots=True)
class CameraLine:
    """One camera's part. delay_ns: between two of its packets. frame_s: from the first to the last of a frame.
    share: of the line's time at the camera's frame_rate_hz, 0..1."""

    name: str
    shared_by: int
    line_Mbps: float
    packet_size: int
    delay_ns: int
    frame_s: float
    share: float

    def __str__(self) -> str:
        return (
            f"{self.name}: {self.shared_by} on a line of {self.line_Mbps:g} Mbit/s, {self.delay_ns / 1e3:.1f} us "
            f"between packets of {self.packet_size} bytes, a frame takes {self.frame_s:.2f} s, "
            f"{self.share:.0%} of the line's time"
        )


def compute_line_shares(cameras: Mapping[str, CameraSettings]) -> tuple[CameraLine, ...]:
    """Compute the share of the line of each GigE camera, in the order of the stand's file."""
    lines: list[CameraLine] = []
    for name, camera in cameras.items():
        settings = add_line_share(camera, cameras.values())
        if not isinstance(settings, GigeCameraSettings):
            continue
        shared_by, packet_size = settings.line_shared_by or 1, settings.packet_size or _PACKET_SIZE
        delay_ns = settings.packet_delay_ns
        if delay_ns is None:
            delay_ns = compute_packet_delay_ns(packet_size, settings.line_Mbps, shared_by)
        pixels = (settings.width_px or _SENSOR_PX[0]) * (settings.height_px or _SENSOR_PX[1])
        size = frame_bytes(settings.pixel_format, pixels)
        alone_s = compute_frame_wire_s(size, packet_size, settings.line_Mbps)
        frame_s = compute_frame_wire_s(size, packet_size, settings.line_Mbps, delay_ns)
        lines.append(
            CameraLine(
                name, shared_by, settings.line_Mbps, packet_size, delay_ns, frame_s, alone_s * settings.frame_rate_hz
            )
        )
    return tuple(lines)


def explain_overload(cameras: Mapping[str, CameraSettings], interval_s: float) -> str:
    """Return why the line does not carry a frame of each camera every `interval_s`, "" when it does."""
    for line in compute_line_shares(cameras):
        if line.frame_s > interval_s:
            return (
                f"a frame every {interval_s} s is faster than the line of {line.line_Mbps:g} Mbit/s that "
                f"{line.shared_by} cameras share: a frame of cameras.{line.name} takes {line.frame_s:.2f} s"
            )
    return ""
