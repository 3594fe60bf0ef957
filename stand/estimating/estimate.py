"""What a plan will take, before anything moves: time, frames, bytes; and whether this stand may do it at all."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from thermostand.experiments.steps import (
    COOL_DOWN_AS_FOUND,
    AnySoak,
    Capture,
    CoolDown,
    KnownStand,
    LABORATORY_degC,
    PlannedStep,
    SetTemperature,
    Situation,
    Soak,
    SoakUntilSettled,
    StartChamber,
    Step,
)
from thermostand.foundation.errors import ConfigError
from thermostand.stand.config.stand_config import StandConfig
from thermostand.stand.estimating.chamber_model import ChamberModel
from thermostand.stand.estimating.durations import ConfiguredStand, price_step
from thermostand.stand.estimating.learned_durations import LearnedDurations

# Measured on recorded sessions: bytes per pixel of a frame of the target with shot noise, and of one telemetry message
# with its share of the index, committed every second.
# Off by two, so is what a plan needs of the disk; a disk that gets full stops the frames and never the telemetry.
_BYTES_PER_PIXEL = {"zstd": 0.573, "raw": 1.0, "roi": 0.103}
_TELEMETRY_BYTES_PER_MESSAGE = 116.0
_SENSOR_PX = (2448, 2048)  # the paper's camera, where the stand's file has no size

_LONGEST_S = 366 * 86400.0  # a longer plan is a slip of the keyboard, and its end soon beyond any calendar


@dataclass(frozen=True, slots=True)
class PricedStep:
    """A step with its expected duration (s), frames and recorded bytes.

    work, stated_s: what of the duration follows from the step, the rest being usual for this kind of work.
    in_band_after_s: of a soak, when the chamber is expected at its set-point, s after the soak begins; None when it is
    there already. warning: why the dwell before a first capture, or a cool-down, is too short, or why the duration of a
    cool-down is not known; "" when there is none.
    """

    planned: PlannedStep
    duration_s: float
    frames: int
    size_bytes: float
    work: str
    stated_s: float
    in_band_after_s: float | None = None
    warning: str = ""

    def as_json(self) -> dict[str, object]:
        """One entry of `stand plan --json`."""
        return {
            "index": self.planned.index,
            "id": self.planned.step_id,
            "kind": self.planned.step.kind,
            "parameters": self.planned.step.parameters,
            "duration_s": self.duration_s,
            "frames": self.frames,
            "bytes": round(self.size_bytes),
            "in_band_after_s": self.in_band_after_s,
            "warning": self.warning,
        }


@dataclass(frozen=True, slots=True)
class _Approach:
    """The chamber on its way between two set-points, `age_s` after the step from one to the other."""

    from_degC: float
    to_degC: float
    age_s: float = 0.0
    captured: bool = False

    def after(self, step: Step, duration_s: float) -> _Approach:
        """Return when the step is done; a new set-point is taken to find the air at the old one."""
        if isinstance(step, StartChamber | SetTemperature):
            return _Approach(self.to_degC, step.chamber_degC, duration_s)
        # A soak that waits for the camera has time enough when its longest is enough.
        lasts_s = step.longest_s if isinstance(step, SoakUntilSettled) else duration_s
        return replace(self, age_s=self.age_s + lasts_s, captured=self.captured or isinstance(step, Capture))


def price_plan(
    plan: Iterable[PlannedStep], config: StandConfig, learned: LearnedDurations | None = None
) -> tuple[PricedStep, ...]:
    """Every step priced; ConfigError naming the first step that goes outside the stand's limits, or saying that
    the whole would take more than a year."""
    learned = learned or LearnedDurations()
    frame_px = sum(
        (camera.width_px or _SENSOR_PX[0]) * (camera.height_px or _SENSOR_PX[1]) for camera in config.cameras.values()
    )
    telemetry_bytes_per_s = _estimate_messages_per_s(config) * _TELEMETRY_BYTES_PER_MESSAGE
    stand, found = ConfiguredStand(config, learned.chamber), Situation()
    approach = _Approach(LABORATORY_degC, LABORATORY_degC)
    priced: list[PricedStep] = []
    for planned in plan:
        check_step(planned, stand)
        step = planned.step
        expected = price_step(step, found, stand, learned.overheads_s)
        duration_s = expected.duration_s
        in_band_after_s = _estimate_in_band_s(step, approach, learned.chamber)
        frames = _count_frames(step, duration_s, in_band_after_s)
        size_bytes = frame_px * _estimate_bytes_per_px(step, frames, config) + duration_s * telemetry_bytes_per_s
        priced.append(
            PricedStep(
                planned=planned,
                duration_s=duration_s,
                frames=frames,
                size_bytes=size_bytes,
                work=expected.work,
                stated_s=expected.stated_s,
                in_band_after_s=in_band_after_s,
                warning=_find_warning(step, approach, learned.chamber, expected.stated_s)
                or _explain_dark_capture(step, found)
                or _explain_unknown(expected.work, learned),
            )
        )
        found, approach = step.situation_after(found), approach.after(step, duration_s)
    total_s = sum(step.duration_s for step in priced)
    if total_s > _LONGEST_S:
        raise ConfigError(f"the plan takes {total_s / 86400:.0f} days; more than a year is refused")
    return tuple(priced)


def estimate_return_s(plan: Iterable[PlannedStep], config: StandConfig, learned: LearnedDurations) -> float:
    """Return how long the chamber, and a camera that is cold, take back to the laboratory's temperature when the plan
    is done, s; 0 on a stand that does not bring it back, or of a plan that ends there."""
    ending, last_degC = config.ending, config.ending.ambient_degC
    for planned in plan:
        if isinstance(planned.step, StartChamber | SetTemperature):
            last_degC = planned.step.chamber_degC
    gap_K = ending.ambient_degC - last_degC
    if not ending.to_ambient or abs(gap_K) <= ending.band_K:
        return 0.0
    chamber, way_s = learned.chamber, 60.0 * abs(gap_K) / config.set_point_K_per_min
    if gap_K < 0.0:
        return min(ending.max_s, max(way_s, chamber.cooling.arrival_s(gap_K, ending.band_K)))
    dew_K = ending.band_K if config.dew is None else ending.ambient_degC - config.dew.lowest_degC(math.nan)
    follows_s = chamber.camera_time_constant_s * max(0.0, math.log(gap_K / max(ending.band_K, dew_K)))
    return min(ending.max_s, max(way_s, chamber.heating.arrival_s(gap_K, ending.band_K)) + follows_s)


def _estimate_in_band_s(step: Step, approach: _Approach, chamber: ChamberModel) -> float | None:
    """Estimate, for a soak, how long, s, until the chamber is in its band; None when it is, and of other steps."""
    after_s = chamber.arrival_s(approach.from_degC, approach.to_degC) - approach.age_s
    return after_s if isinstance(step, AnySoak) and after_s > 0.0 else None


def _count_frames(step: Step, duration_s: float, in_band_after_s: float | None) -> int:
    """Count the looks of a soak, from when the chamber is in its band."""
    if not isinstance(step, SoakUntilSettled):
        return step.frame_count
    return max(0, math.ceil((duration_s - (in_band_after_s or 0.0)) / step.look_every_s))


def _explain_dark_capture(step: Step, found: Situation) -> str:
    """Explain what is wrong with a capture of the target through a flap that no step has opened."""
    if not isinstance(step, Capture) or found.flap_open:
        return ""
    return "the flap is closed, so these frames are dark; put open_flap before them, and close_flap after"


def _find_warning(step: Step, approach: _Approach, chamber: ChamberModel, expected_s: float) -> str:
    """Return what is wrong with the first capture at a set-point, when the camera cannot have followed until then. Of a
    cool-down: that it is too short for a camera that was on. Of a soak that is expected to take expected_s: that it
    will not end in its time."""
    if isinstance(step, CoolDown):
        ends, needs = _format_minutes(step.max_s), _format_minutes(step.needed_s)
        too_short = f"ends after {ends}; the camera needs {needs} to be within its band"
        return f"the cool-down {too_short}" if step.max_s < step.needed_s else ""
    if isinstance(step, Soak):
        return _explain_extension(step, approach, chamber, expected_s)
    arrives_s = chamber.arrival_s(approach.from_degC, approach.to_degC)
    settled_s = chamber.settled_s(approach.from_degC, approach.to_degC)
    if not isinstance(step, Capture) or approach.captured or approach.age_s >= settled_s:
        return ""
    spare_s = approach.age_s - arrives_s
    return (
        f"the dwell at {approach.to_degC:g} degC ends {_format_minutes(abs(spare_s))} "
        f"{'before' if spare_s < 0.0 else 'after'} the chamber arrives; "
        f"the camera needs {_format_minutes(settled_s - arrives_s)} to follow"
    )


def _explain_extension(soak: Soak, approach: _Approach, chamber: ChamberModel, expected_s: float) -> str:
    """Explain until when a soak goes on beyond its time, or that it ends with the chamber outside its band; ""
    otherwise."""
    if expected_s <= soak.duration_s:
        return ""
    arrives_s = chamber.arrival_s(approach.from_degC, approach.to_degC, soak.band_K) - approach.age_s
    arrival = f"the chamber is within {soak.band_K:g} K of {approach.to_degC:g} degC after {_format_minutes(arrives_s)}"
    if arrives_s + soak.last_part_s <= soak.longest_s:
        return f"{arrival}: the soak is expected to go on until {_format_minutes(expected_s)}"
    end = "the run is held then" if soak.unsettled == "hold" else "the frames after it are marked as unsettled"
    return f"{arrival}: too late for a soak of at most {_format_minutes(expected_s)}; {end}"


def _explain_unknown(work: str, learned: LearnedDurations) -> str:
    if work != COOL_DOWN_AS_FOUND or work in learned.overheads_s:
        return ""
    return "as of a camera that was on; one that is cold already takes no time"


def _format_minutes(duration_s: float) -> str:
    return f"{duration_s / 60:.0f} min"


def _estimate_messages_per_s(config: StandConfig) -> float:
    return sum(1.0 / each.poll_s for each in config.equipment if each.settings is not None and each.poll_s is not None)


def _estimate_bytes_per_px(step: Step, frames: int, config: StandConfig) -> float:
    """Return what all frames of a step take, per pixel of one; with `roi` a step's first frame is whole, then one at
    times."""
    recording, whole = config.recording, 0
    if isinstance(step, Capture | SoakUntilSettled) and recording.frame_encoding == "roi" and frames:
        interval_s = step.interval_s if isinstance(step, Capture) else step.look_every_s
        whole = min(frames, 1 + int((frames - 1) * interval_s / recording.whole_every_s))
    return whole * _BYTES_PER_PIXEL["zstd"] + (frames - whole) * _BYTES_PER_PIXEL[recording.frame_encoding]


def check_step(planned: PlannedStep, stand: KnownStand) -> None:
    """ConfigError, naming the step, when it is nothing for this stand or outside its limits."""
    step = planned.step
    where = f"step {planned.index + 1} ({step.kind})"
    try:
        fault = step.stand_fault(stand)
    except ConfigError as error:
        raise ConfigError(f"{where}: {error}") from error
    if fault:
        raise ConfigError(f"{where}: {fault}")
