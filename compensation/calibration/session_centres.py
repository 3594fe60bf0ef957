"""Calibration session -> marker centres at each table position.

A position is one capture step with the role `calibration`; its frames are averaged. Where the table stands is what its
axes reported at rest between the moves before and after, else where they were sent.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Literal, Self

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.calibration.least_squares import Float
from thermostand.compensation.camera_selection import find_channel
from thermostand.foundation.errors import CalibrationError, SessionError
from thermostand.foundation.items import StepMark, StepState
from thermostand.foundation.progress import Report
from thermostand.markers.detection import Detection, DetectionError, detect
from thermostand.markers.target import Target
from thermostand.recording.format.decoded_items import decode_frame
from thermostand.recording.reading.session import Session


@dataclass(frozen=True, slots=True, eq=False)
class MeanCentres:
    """centres_px (N, 2): weighted means, NaN for a marker that no frame has. covariance_px2 (N, 2, 2): of the means, as
    the frames' covariances predict. squares: whitened scatter of the frames about the means, degrees: its degrees of
    freedom."""

    centres_px: Float
    covariance_px2: Float
    squares: float
    degrees: int


def average_centres(centres_px: Float, covariance_px2: Float) -> MeanCentres:
    """Average frames' centres (F, N, 2) with covariances (F, N, 2, 2), which are NaN where a frame lacks a marker."""
    good = np.isfinite(centres_px[:, :, 0])
    information = np.zeros_like(covariance_px2)
    information[good] = np.linalg.inv(covariance_px2[good])
    total = information.sum(axis=0)
    seen = good.any(axis=0)
    covariance = np.full(total.shape, np.nan)
    covariance[seen] = np.linalg.inv(total[seen])
    weighted = np.einsum("fnij,fnj->ni", information, np.where(good[:, :, None], centres_px, 0.0))
    mean = np.einsum("nij,nj->ni", covariance, weighted)
    off = np.where(good[:, :, None], centres_px - mean, 0.0)
    squares = float(np.einsum("fni,fnij,fnj->", off, information, off))
    return MeanCentres(mean, covariance, squares, 2 * int(good.sum() - seen.sum()))


def compute_scatter_chi(means: list[MeanCentres]) -> float:
    """Scatter of the frames about their means over the scatter predicted; NaN when there is one frame each."""
    degrees = sum(mean.degrees for mean in means)
    return float(np.sqrt(sum(mean.squares for mean in means) / degrees)) if degrees else float("nan")


Axis = Literal["linear", "rotary"]
AXES: tuple[Axis, Axis] = ("linear", "rotary")
_END_NS = np.iinfo(np.int64).max


@dataclass(frozen=True, slots=True)
class TableVisit:
    """A capture: where the axes (linear mm, rotary deg) were sent, when they came to rest and when they moved on."""

    role: str
    sent: dict[str, float]
    since_ns: dict[str, int]
    until_ns: dict[str, int]


def list_visits(steps: Sequence[StepMark], roles: Collection[str]) -> dict[str, TableVisit]:
    """Step id -> visit of the captures with one of these roles, in order; SessionError when an axis was not moved
    before one."""
    sent: dict[str, float] = {}
    since_ns: dict[str, int] = {}
    visits: dict[str, TableVisit] = {}
    for mark in steps:
        if mark.kind == "move_to":
            axis = str(mark.parameters.get("axis"))
            if mark.state is StepState.STARTED:
                for visit in visits.values():
                    visit.until_ns.setdefault(axis, mark.time_ns)
            elif mark.state is StepState.DONE:
                sent[axis], since_ns[axis] = float(str(mark.parameters.get("position"))), mark.time_ns
        elif mark.kind == "capture" and mark.parameters.get("role") in roles and mark.state is StepState.STARTED:
            role = str(mark.parameters["role"])
            if not all(axis in sent for axis in AXES):
                raise SessionError(f"step {mark.index + 1}: a {role} capture, but no move of both axes before it")
            visits[mark.step_id] = TableVisit(role, dict(sent), dict(since_ns), {})
    return visits


def read_position(session: Session, axis: Axis, visit: TableVisit) -> float:
    """Return the mean of what the axis reported at rest during the visit, else where it was sent; mm or deg."""
    try:
        times_ns, values = session.readings(f"{axis}.position")
        moving_ns, moving = session.readings(f"{axis}.moving")
    except SessionError:
        return visit.sent[axis]
    resting = np.isin(times_ns, moving_ns[moving == 0])
    here = resting & (times_ns >= visit.since_ns[axis]) & (times_ns <= visit.until_ns.get(axis, _END_NS))
    reported = values[here & np.isfinite(values)]
    return float(reported.mean()) if len(reported) else visit.sent[axis]


ROLE = "calibration"
_LEAST_MARKERS = 12  # round number; nothing was measured
_LEAST_POSITIONS = 5  # round number; nothing was measured


@dataclass(frozen=True, slots=True, eq=False)
class Views:
    """P pictures with the N markers of a board.

    Attributes
    ----------
    centres_px
        (P, N, 2) as (x, y), centres of the outlines, px; NaN where not seen.
    covariance_px2
        (P, N, 2, 2), px^2; NaN likewise.
    image_size
        (width, height), px.
    """

    centres_px: Float
    covariance_px2: Float
    image_size: tuple[int, int]

    @property
    def seen(self) -> NDArray[np.bool_]:
        """(P, N): markers with a centre."""
        return np.isfinite(self.centres_px[:, :, 0])

    @property
    def variance_px2(self) -> float:
        """The variance of a coordinate, as the mean over all markers."""
        return float(np.nanmean(np.diagonal(self.covariance_px2, axis1=2, axis2=3)))

    def select(self, chosen: NDArray[np.bool_]) -> Self:
        """The pictures chosen (P,)."""
        values = {field.name: getattr(self, field.name) for field in fields(self)}
        return replace(self, **{name: one[chosen] for name, one in values.items() if isinstance(one, np.ndarray)})


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class Positions(Views):
    """Views at P table positions, each the mean of some frames.

    Attributes
    ----------
    linear_mm, rotary_deg
        (P,), where the table was.
    centres_px
        (P, N, 2) as (x, y), px; NaN where a marker was missing or flagged in every frame.
    frames
        (P,), frames averaged.
    flags
        (P, N) uint8, all flags of the frames.
    chi
        Scatter of the frames about their mean over the scatter that the detections' covariances predict; NaN with one
        frame each.
    """

    linear_mm: Float
    rotary_deg: Float
    frames: NDArray[np.int64]
    flags: NDArray[np.uint8]
    chi: float

    @property
    def sigma_px(self) -> float:
        """Detection sigma per coordinate of the means: root mean square over all markers."""
        return float(np.sqrt(self.variance_px2))


def observe_positions(session: Session, target: Target, report: Report | None = None) -> Positions:
    """Find the target in the calibration frames of a session.

    Parameters
    ----------
    session
        A session with frames of the role CALIBRATION.
    target
        The target that they show.
    report
        Is called with the number of each frame and a text about it; None shows nothing.

    Returns
    -------
    Positions
        A view for each position of the table, the mean of its frames.

    Raises
    ------
    SessionError
        When the session has no such frames.
    CalibrationError
        When too few show enough of the target.
    """
    visits = list_visits(session.steps(), {ROLE})
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
    linear, rotary = (np.array([read_position(session, axis, visits[step_id]) for step_id in kept]) for axis in AXES)
    return combine_detections(linear, rotary, [found[step_id] for step_id in kept], size)


def combine_detections(
    linear_mm: Float, rotary_deg: Float, detections: Sequence[Sequence[Detection]], image_size: tuple[int, int]
) -> Positions:
    """The positions of detections: weighted means, whose covariance grows by the scatter where the frames disagree."""
    means = [_average_frames(frames) for frames in detections]
    chi = compute_scatter_chi(means)
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


def _average_frames(frames: Sequence[Detection]) -> MeanCentres:
    flagged = np.array([found.flags for found in frames]) != 0
    centres = np.where(flagged[:, :, None], np.nan, np.array([found.centres_px for found in frames]))
    return average_centres(centres, np.array([found.covariance_px2 for found in frames]))


def _detect_all(
    session: Session, target: Target, wanted: Mapping[str, list[Detection]], report: Report | None
) -> tuple[tuple[int, int] | None, str]:
    """Put each wanted step's detections into its list; the image size, and why a frame could not be used."""
    previous: Detection | None = None
    size: tuple[int, int] | None = None
    refused = ""
    own = find_channel(session)
    for number, image in enumerate(session.images(), 1):
        detections = wanted.get(image.meta.step_id) if image.meta.channel == own else None
        if report is not None:
            report(number, f"frame {number} of {session.frame_count}")
        if detections is None:
            continue
        pixels = decode_frame(image).image
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
