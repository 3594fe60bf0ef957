"""What a plan will take, before anything moves: time, frames, bytes; and whether this stand may do it at all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from drivers.interface import ConfigError
from experiments.steps import (
    Capture,
    MoveTo,
    PlannedStep,
    SetTemperature,
    StartChamber,
    Step,
    estimate_s,
    frames_of,
    kind_of,
    parameters_of,
)
from stand.config import StandConfig

# Measured on recorded sessions: bytes per pixel of a PNG of the target with shot noise, and of one telemetry message
# with its share of the index, committed every second.
_BYTES_PER_PIXEL = {"png": 0.47, "raw": 1.0, "roi": 0.074}
_TELEMETRY_BYTES_PER_MESSAGE = 116.0
_SENSOR_PX = (2448, 2048)

_LONGEST_S = 366 * 86400.0  # a longer plan is a slip of the keyboard, and its end soon beyond any calendar


@dataclass(frozen=True, slots=True)
class PricedStep:
    """A step with its expected duration (s), frames and recorded bytes."""

    planned: PlannedStep
    duration_s: float
    frames: int
    size_bytes: float

    def as_json(self) -> dict[str, object]:
        """One entry of `stand plan --json`."""
        return {
            "index": self.planned.index,
            "id": self.planned.step_id,
            "kind": kind_of(self.planned.step),
            "parameters": parameters_of(self.planned.step),
            "duration_s": self.duration_s,
            "frames": self.frames,
            "bytes": round(self.size_bytes),
        }


def price(plan: Iterable[PlannedStep], config: StandConfig) -> tuple[PricedStep, ...]:
    """Every step priced; ConfigError naming the first step that goes outside the stand's limits, or saying that
    the whole would take more than a year."""
    width_px = config.camera.width_px or _SENSOR_PX[0]
    height_px = config.camera.height_px or _SENSOR_PX[1]
    frame_px = width_px * height_px
    polled = (config.regulator, config.relays, config.thermometers, config.flap, config.camera, *config.axes.values())
    messages_per_s = sum(1.0 / device.poll_s for device in polled)
    priced: list[PricedStep] = []
    for planned in plan:
        _check(planned, config)
        duration_s, frames = estimate_s(planned.step, config.camera.boot_s), frames_of(planned.step)
        size_bytes = (
            frame_px * _image_bytes_per_px(planned.step, config)
            + duration_s * messages_per_s * _TELEMETRY_BYTES_PER_MESSAGE
        )
        priced.append(PricedStep(planned, duration_s, frames, size_bytes))
    total_s = sum(step.duration_s for step in priced)
    if total_s > _LONGEST_S:
        raise ConfigError(f"the plan takes {total_s / 86400:.0f} days; more than a year is refused")
    return tuple(priced)


def _image_bytes_per_px(step: Step, config: StandConfig) -> float:
    """What all frames of a step take, per pixel of one; with `roi` a step's first frame is whole, then one at times."""
    frames, recording = frames_of(step), config.recording
    whole = 0
    if isinstance(step, Capture) and recording.frame_encoding == "roi":
        whole = min(frames, 1 + int((frames - 1) * step.interval_s / recording.whole_every_s))
    return whole * _BYTES_PER_PIXEL["png"] + (frames - whole) * _BYTES_PER_PIXEL[recording.frame_encoding]


def _check(planned: PlannedStep, config: StandConfig) -> None:
    step = planned.step
    where = f"step {planned.index} ({kind_of(step)})"
    if isinstance(step, StartChamber | SetTemperature):
        low, high = config.limits.chamber_degC
        if not low <= step.chamber_degC <= high:
            raise ConfigError(f"{where}: {step.chamber_degC} degC is outside limits.chamber_degC {low}..{high}")
    if isinstance(step, MoveTo):
        axis = next((axis for name, axis in config.axes.items() if name == step.axis), None)
        if axis is None:
            raise ConfigError(f"{where}: this stand has no axis {step.axis!r}, only {', '.join(config.axes) or 'none'}")
        if not axis.limits[0] <= step.position <= axis.limits[1]:
            raise ConfigError(
                f"{where}: {step.position} {axis.unit} is outside the limits {axis.limits} of {step.axis}"
            )
    if isinstance(step, Capture) and step.frames > 1 and step.interval_s < 1 / config.camera.frame_rate_hz - 1e-9:
        rate_hz = config.camera.frame_rate_hz
        raise ConfigError(f"{where}: a frame every {step.interval_s} s is faster than camera.frame_rate_hz {rate_hz}")
