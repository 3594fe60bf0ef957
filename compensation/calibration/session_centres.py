"""Calibration session -> marker centres at each table position.

A position is one capture step with the role `calibration`; its frames are averaged. Where the table stands is what its
axes reported at rest between the moves before and after, else where they were sent.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.averages import MeanCentres, mean_centres, scatter_chi
from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.calibration.visits import AXES, place, visits_for
from thermostand.compensation.one_camera import channel_of
from thermostand.foundation.errors import CalibrationError, SessionError
from thermostand.foundation.progress import Report
from thermostand.markers.detection import Detection, DetectionError, detect
from thermostand.markers.target import Target
from thermostand.recording.format.decoded_items import frame_of
from thermostand.recording.reading.session import Session

ROLE = "calibration"
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
        names = ("linear_mm", "rotary_deg", "centres_px", "covariance_px2", "frames", "flags")
        return replace(self, **{name: getattr(self, name)[chosen] for name in names})


def observe_positions(session: Session, target: Target, report: Report | None = None) -> Positions:
    """Find the target in the calibration frames of a session; `report` counts them.

    SessionError when it has none. CalibrationError when too few show enough of the target.
    """
    visits = visits_for(session.steps(), {ROLE})
    if not visits:
        raise SessionError(
            f"{session.path}: has no capture with the role {ROLE}; record one with the calibration recipe"
        )
    found = {step_id: list[Detection]() for step_id in visits}
    size, refused = _detect_all(session, target, found, report)
    kept = [step_id for step_id, detections in found.items() if detections]
    if size is None or len(kept) < _LEAST_POSITIONS:
        why = f"; {refused}" if refused else ""
        raise CalibrationError(
            f"{session.path}: the target was found at {len(kept)} positions, {_LEAST_POSITIONS} are needed{why}"
        )
    linear, rotary = (np.array([place(session, axis, visits[step_id]) for step_id in kept]) for axis in AXES)
    return combined(linear, rotary, [found[step_id] for step_id in kept], size)


def combined(
    linear_mm: Float, rotary_deg: Float, detections: Sequence[Sequence[Detection]], image_size: tuple[int, int]
) -> Positions:
    """The positions of detections: weighted means, whose covariance grows by the scatter where the frames disagree."""
    means = [_mean(frames) for frames in detections]
    chi = scatter_chi(means)
    growth = 1.0 if math.isnan(chi) else max(1.0, chi) ** 2
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


def _mean(frames: Sequence[Detection]) -> MeanCentres:
    flagged = np.array([found.flags for found in frames]) != 0
    centres = np.where(flagged[:, :, None], np.nan, np.array([found.centres_px for found in frames]))
    return mean_centres(centres, np.array([found.covariance_px2 for found in frames]))


def _detect_all(
    session: Session, target: Target, wanted: Mapping[str, list[Detection]], report: Report | None
) -> tuple[tuple[int, int] | None, str]:
    """Put each wanted step's detections into its list; the image size, and why a frame could not be used."""
    previous: Detection | None = None
    size: tuple[int, int] | None = None
    refused = ""
    own = channel_of(session)
    for number, image in enumerate(session.images(), 1):
        detections = wanted.get(image.meta.step_id) if image.meta.channel == own else None
        if report is not None:
            report(number, f"frame {number} of {session.frame_count}")
        if detections is None:
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
            detections.append(previous)
    return size, refused
