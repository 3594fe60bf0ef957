"""Calibration session -> marker centres at each table position.

A position is one capture step with the role `calibration`; its frames are averaged. Where the table stands is what its
axes reported at rest between the moves before and after, else where they were sent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from compensation.calibration.errors import CalibrationError
from compensation.calibration.least_squares import Float
from compensation.markers.detection import Detection, DetectionError, detect
from compensation.target import Target
from drivers.interface import SessionError
from stand.hub import StepMark, StepState
from stand.progress import Report
from stand.recording.items import frame_of
from stand.recording.session import Session

ROLE = "calibration"
Axis = Literal["linear", "rotary"]
AXES: tuple[Axis, Axis] = ("linear", "rotary")
_END_NS = np.iinfo(np.int64).max
_LEAST_MARKERS = 12
_LEAST_POSITIONS = 5


@dataclass(frozen=True, slots=True, eq=False)
class Positions:
    """P table positions with the N markers of a target.

    linear_mm, rotary_deg (P,). centres_px (P, N, 2): mean centres of the ellipses in the images, NaN where a marker was
    missing or flagged in every frame. covariance_px2 (P, N, 2, 2): of the means. frames (P,): frames averaged.
    flags (P, N) uint8: all flags of the frames. chi: scatter of the frames about their mean over the scatter the
    detections' covariances predict, NaN with one frame each. image_size: (width, height), px.
    """

    linear_mm: Float
    rotary_deg: Float
    centres_px: Float
    covariance_px2: Float
    frames: NDArray[np.int64]
    flags: NDArray[np.uint8]
    chi: float
    image_size: tuple[int, int]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(P, N): markers with a centre."""
        return np.isfinite(self.centres_px[:, :, 0])

    @property
    def sigma_px(self) -> float:
        """Detection sigma per coordinate of the means: root mean square over all markers."""
        return float(np.sqrt(np.nanmean(np.diagonal(self.covariance_px2, axis1=2, axis2=3))))

    def part(self, chosen: NDArray[np.bool_]) -> Positions:
        """The positions chosen (P,)."""
        return Positions(
            self.linear_mm[chosen],
            self.rotary_deg[chosen],
            self.centres_px[chosen],
            self.covariance_px2[chosen],
            self.frames[chosen],
            self.flags[chosen],
            self.chi,
            self.image_size,
        )


@dataclass(slots=True)
class _Visit:
    """A capture under way: where the axes were sent, when they came to rest and when they moved on."""

    sent: dict[str, float]
    since_ns: dict[str, int]
    until_ns: dict[str, int]
    detections: list[Detection] = field(default_factory=list[Detection])


def observe_positions(session: Session, target: Target, report: Report | None = None) -> Positions:
    """Find the target in the calibration frames of a session; `report` counts them.

    SessionError when it has none. CalibrationError when too few show enough of the target.
    """
    visits = _visits(session.steps())
    if not visits:
        raise SessionError(
            f"{session.path}: has no capture with the role {ROLE}; record one with the calibration recipe"
        )
    size, refused = _detect_all(session, target, visits, report)
    kept = [visit for visit in visits.values() if visit.detections]
    if size is None or len(kept) < _LEAST_POSITIONS:
        why = f"; {refused}" if refused else ""
        raise CalibrationError(
            f"{session.path}: the target was found at {len(kept)} positions, {_LEAST_POSITIONS} are needed{why}"
        )
    place = {axis: np.array([_place(session, axis, visit) for visit in kept]) for axis in AXES}
    return combined(place["linear"], place["rotary"], [visit.detections for visit in kept], size)


def combined(
    linear_mm: Float, rotary_deg: Float, detections: Sequence[Sequence[Detection]], image_size: tuple[int, int]
) -> Positions:
    """The positions of detections: weighted means, whose covariance grows by the scatter where the frames disagree."""
    means = [_mean(frames) for frames in detections]
    degrees = sum(mean.degrees for mean in means)
    chi = float(np.sqrt(sum(mean.squares for mean in means) / degrees)) if degrees else float("nan")
    growth = max(1.0, chi) ** 2 if degrees else 1.0
    return Positions(
        linear_mm=linear_mm,
        rotary_deg=rotary_deg,
        centres_px=np.array([mean.centres_px for mean in means]),
        covariance_px2=np.array([mean.covariance_px2 for mean in means]) * growth,
        frames=np.array([len(frames) for frames in detections]),
        flags=np.array([np.bitwise_or.reduce([found.flags for found in frames]) for frames in detections]),
        chi=chi,
        image_size=image_size,
    )


@dataclass(frozen=True, slots=True, eq=False)
class _Mean:
    centres_px: Float
    covariance_px2: Float
    squares: float
    degrees: int


def _mean(frames: Sequence[Detection]) -> _Mean:
    """Weighted mean of a position's frames, their squared whitened scatter about it and its degrees of freedom."""
    centres = np.array([found.centres_px for found in frames])
    covariance = np.array([found.covariance_px2 for found in frames])
    good = np.isfinite(centres[:, :, 0]) & (np.array([found.flags for found in frames]) == 0)
    information = np.zeros_like(covariance)
    information[good] = np.linalg.inv(covariance[good])
    total = information.sum(axis=0)
    seen = good.any(axis=0)
    mean_covariance = np.full(total.shape, np.nan)
    mean_covariance[seen] = np.linalg.inv(total[seen])
    weighted = np.einsum("fnij,fnj->ni", information, np.where(good[:, :, None], centres, 0.0))
    mean = np.einsum("nij,nj->ni", mean_covariance, weighted)
    off = np.where(good[:, :, None], centres - mean, 0.0)
    squares = float(np.einsum("fni,fnij,fnj->", off, information, off))
    return _Mean(mean, mean_covariance, squares, 2 * int(good.sum() - seen.sum()))


def _visits(steps: Sequence[StepMark]) -> dict[str, _Visit]:
    """Step id of each calibration capture -> its visit."""
    sent: dict[str, float] = {}
    since_ns: dict[str, int] = {}
    visits: dict[str, _Visit] = {}
    for mark in steps:
        if mark.kind == "MoveTo":
            axis = str(mark.parameters.get("axis"))
            if mark.state is StepState.STARTED:
                for visit in visits.values():
                    visit.until_ns.setdefault(axis, mark.time_ns)
            elif mark.state is StepState.DONE:
                sent[axis], since_ns[axis] = float(str(mark.parameters.get("position"))), mark.time_ns
        elif mark.kind == "Capture" and mark.parameters.get("role") == ROLE and mark.state is StepState.STARTED:
            if not all(axis in sent for axis in AXES):
                raise SessionError(f"step {mark.index}: a calibration capture, but no move of both axes before it")
            visits[mark.step_id] = _Visit(dict(sent), dict(since_ns), {})
    return visits


def _detect_all(
    session: Session, target: Target, visits: Mapping[str, _Visit], report: Report | None
) -> tuple[tuple[int, int] | None, str]:
    """Put each calibration frame's detection into its visit; the image size, and why a frame could not be used."""
    previous: Detection | None = None
    size: tuple[int, int] | None = None
    refused = ""
    for number, image in enumerate(session.images(), 1):
        visit = None if image.meta is None else visits.get(image.meta.step_id)
        if report is not None:
            report(number, f"frame {number} of {session.frame_count}")
        if visit is None:
            continue
        pixels = frame_of(image).image
        shape = (pixels.shape[1], pixels.shape[0])
        if size not in (None, shape):
            raise SessionError(f"{session.path}: frame {number - 1} has the size {shape}, those before it {size}")
        size = shape
        try:
            previous = detect(pixels, target, previous)
        except DetectionError as error:
            refused = f"frame {number - 1}: {error}"
            continue
        if np.count_nonzero(previous.flags == 0) >= _LEAST_MARKERS:
            visit.detections.append(previous)
    return size, refused


def _place(session: Session, axis: Axis, visit: _Visit) -> float:
    """Mean of what the axis reported at rest during the visit, else where it was sent."""
    try:
        times_ns, values = session.readings(f"{axis}.position")
        moving_ns, moving = session.readings(f"{axis}.moving")
    except SessionError:
        return visit.sent[axis]
    resting = np.isin(times_ns, moving_ns[moving == 0])
    here = resting & (times_ns >= visit.since_ns[axis]) & (times_ns <= visit.until_ns.get(axis, _END_NS))
    reported = values[here & np.isfinite(values)]
    return float(reported.mean()) if len(reported) else visit.sent[axis]
