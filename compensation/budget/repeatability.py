"""How well the table comes back: what home checks recorded, and V0 seen again at the end of each temperature."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.budget.session_temperatures import CaptureState, capture_states
from thermostand.compensation.one_camera import channel_of
from thermostand.foundation.events import HOME_RESIDUAL, HOME_RESIDUAL_LARGE
from thermostand.foundation.items import Event
from thermostand.markers.detection import Detection, DetectionError, detect
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session


@dataclass(frozen=True, slots=True)
class Repeatability:
    """Root mean square of `count` returns, in `unit`; NaN when there was none."""

    rms: float
    unit: str
    count: int


def home_residuals(events: Sequence[Event], unit: str) -> Repeatability:
    """Where the axes that move in `unit` (mm or deg) found their homes, against where they expected them."""
    recorded = [
        event.data
        for event in events
        if event.kind in (HOME_RESIDUAL, HOME_RESIDUAL_LARGE) and event.data.get("unit") == unit
    ]
    found = [float(residual) for data in recorded if isinstance(residual := data.get("residual"), int | float)]
    return Repeatability(_rms(np.array(found)), unit, len(found))


def v0_repeats(session: Session, target: Target) -> Repeatability:
    """How far the image of V0 is from where it was, when the table returns to it at the end of a temperature, px.

    Per coordinate, over all markers and temperatures; frames of a capture are averaged. The camera's drift in
    these minutes is included: an upper limit.
    """
    pairs = _first_and_last_of_v0(capture_states(session))
    wanted = {capture.step_id for pair in pairs for capture in pair}
    centres = _mean_centres(session, target, wanted) if wanted else {}
    moved = [
        centres[again.step_id] - centres[first.step_id]
        for first, again in pairs
        if again.step_id in centres and first.step_id in centres
    ]
    return Repeatability(_rms(np.array(moved)), "px", len(moved))


def _first_and_last_of_v0(captures: Sequence[CaptureState]) -> list[tuple[CaptureState, CaptureState]]:
    """The first pose after the last repeat is V0 (experiments/validation.py), and the next repeat is V0 again."""
    pairs: list[tuple[CaptureState, CaptureState]] = []
    first: CaptureState | None = None
    for capture in captures:
        if capture.role == "pose" and first is None:
            first = capture
        elif capture.role == "repeatability" and first is not None:
            pairs.append((first, capture))
            first = None
    return pairs


def _mean_centres(session: Session, target: Target, wanted: set[str]) -> dict[str, NDArray[np.float64]]:
    """Step -> mean centres (N, 2) of its frames, NaN for markers that one of them lacks."""
    seen: dict[str, list[NDArray[np.float64]]] = {}
    previous: Detection | None = None
    own = channel_of(session)
    for frame in session.frames():
        if frame.step_id not in wanted or frame.channel != own:
            continue
        try:
            previous = detect(frame.image, target, previous)
        except DetectionError:
            continue
        good = (previous.flags == 0)[:, None]
        seen.setdefault(frame.step_id, []).append(np.where(good, previous.centres_px, np.nan))
    return {step_id: np.mean(frames, axis=0) for step_id, frames in seen.items()}


def _rms(values: NDArray[np.float64]) -> float:
    known = values[np.isfinite(values)]
    return float(np.sqrt(np.mean(known**2))) if known.size else math.nan
