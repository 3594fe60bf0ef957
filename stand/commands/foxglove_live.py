"""A stand in Foxglove or Lichtblick as it happens: another client of the daemon's HTTP interface, which publishes what
it reads at a port of this machine. A process of its own: however many look, however slowly, the daemon serves one
client.

    /readings/thermometers   JSON, {"air": 24.0, "granite_inside": null}; null is no measurement
    /state                   JSON, the numbers and words of the stand
    /events                  foxglove.Log
    /camera                  foxglove.CompressedImage, the last frame at half its size
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, cast

import foxglove
from foxglove.channels import CompressedImageChannel, LogChannel
from foxglove.messages import CompressedImage, Log, LogLevel, Timestamp

from thermostand.foundation.clock import NS_PER_S
from thermostand.stand.serving.api_models import StandState

HOST = "127.0.0.1"
_BACKLOG = 8  # messages that wait for a slow viewer; the oldest is dropped
_LEVELS = {"info": LogLevel.Info, "warning": LogLevel.Warning, "error": LogLevel.Error}
_STATE = ("phase", "setpoint_degC", "output_percent", "heater_permitted", "compressor_on", "camera_on", "flap")

# Its time in ns on the stand's clock, and the JPEG; None when there is none.
Picture = Callable[[], tuple[int, bytes] | None]


class FoxgloveServer:
    """Publishes at a port until it is closed. Viewers can read, and nothing else."""

    def __init__(self, name: str, port: int) -> None:
        self._context = foxglove.Context()
        self._server = foxglove.start_server(
            name=name, host=HOST, port=port, capabilities=[], context=self._context, message_backlog_size=_BACKLOG
        )
        self._state = foxglove.Channel("/state", schema={"type": "object"}, context=self._context)
        self._events = LogChannel("/events", context=self._context)
        self._camera = CompressedImageChannel("/camera", context=self._context)
        self._readings: dict[str, foxglove.Channel] = {}
        self._read_ns: dict[str, int] = {}
        self._picture_ns = self._utc_offset_ns = 0

    def close(self) -> None:
        """Viewers are disconnected."""
        self._server.stop()

    def state(self, state: StandState) -> None:
        """Publish what was read since the last state, and the state itself."""
        self._utc_offset_ns = state.utc_offset_ns
        devices: dict[str, dict[str, float | None]] = {}
        for channel, reading in state.readings.items():
            device, _, name = channel.partition(".")
            devices.setdefault(device, {})[name] = reading.value
        for device, values in devices.items():
            time_ns = max(r.time_ns for channel, r in state.readings.items() if channel.startswith(f"{device}."))
            if time_ns > self._read_ns.get(device, 0):
                self._read_ns[device] = time_ns
                self._get_channel(device, values).log(values, log_time=time_ns + state.utc_offset_ns)
        words = {name: getattr(state, name) for name in _STATE}
        words |= {"held_by": ", ".join(state.reasons), "fault": "" if state.fault is None else state.fault.text}
        words["by_hand_setpoint_degC"] = None if state.by_hand is None else state.by_hand.setpoint_degC
        words |= {} if state.run is None else {"doing": state.run.doing, "frames_saved": state.run.frames_saved}
        self._state.log(words, log_time=state.now_ns + state.utc_offset_ns)

    def event(self, event: Mapping[str, object]) -> None:
        """An event as the interface gives it."""
        time_ns = cast("int", event["time_ns"]) + cast("int", event["utc_offset_ns"])
        level, kind = _LEVELS.get(str(event["level"]), LogLevel.Info), str(event["kind"])
        self._events.log(Log(timestamp=_make_timestamp(time_ns), level=level, message=str(event["text"]), name=kind))

    def publish_picture(self, picture: Picture) -> None:
        """The last frame, when somebody looks at frames; it is asked for then only."""
        found = picture() if self._camera.has_sinks() else None
        if found is None or found[0] == self._picture_ns:
            return
        self._picture_ns, jpeg = found
        time_ns = self._picture_ns + self._utc_offset_ns
        image = CompressedImage(timestamp=_make_timestamp(time_ns), frame_id="camera", data=jpeg, format="jpeg")
        self._camera.log(image, log_time=time_ns)

    def _get_channel(self, device: str, values: Mapping[str, object]) -> foxglove.Channel:
        if device not in self._readings:
            properties: dict[str, Any] = {name: {"type": ["number", "null"]} for name in values}
            schema = {"type": "object", "title": device, "properties": properties}
            self._readings[device] = foxglove.Channel(f"/readings/{device}", schema=schema, context=self._context)
        return self._readings[device]


def _make_timestamp(time_ns: int) -> Timestamp:
    return Timestamp(sec=time_ns // NS_PER_S, nsec=time_ns % NS_PER_S)
