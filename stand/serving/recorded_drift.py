"""How the markers moved over a recorded session, from a part of its frames: for a look at it, or at two together.
A fit with all of them is `compensate`'s. It takes seconds: in a process of its own, at the lowest priority.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from thermostand.experiments.steps import Role
from thermostand.foundation.documents import parse_document
from thermostand.markers.target import Target
from thermostand.recording.reading.session import Session
from thermostand.stand.serving.preview import Previewer
from thermostand.stand.serving.shot import DRIFT_ROLES, FrameShot, is_reference

MOST_FRAMES = 120  # enough for a curve; each takes tens of ms at the lowest priority


@dataclass(frozen=True, slots=True)
class DriftPoint:
    """mean_px: length of the mean drift since the reference, worst_px: the largest of a marker."""

    time_ns: int
    mean_px: float
    worst_px: float


@dataclass(frozen=True, slots=True)
class SessionDrift:
    """The drift of one camera, in order of time. trouble: why frames had no drift, "" when all had."""

    camera: str
    points: tuple[DriftPoint, ...]
    trouble: str = ""


@dataclass(frozen=True, slots=True)
class RecalledReference:
    """The reference of one camera of an interrupted run: the frame that drift counts from, and the role of its last
    frame."""

    shot: FrameShot
    last_role: str


def find_run_references(path: Path | str) -> tuple[RecalledReference, ...]:
    """Return what drift was measured against when the run of this session was interrupted, for each camera whose frames
    are recorded; found by the rule that held when they came. SessionError when the session cannot be read."""
    session = Session.open(path)
    table = session.frames_table()
    found: list[RecalledReference] = []
    for camera in dict.fromkeys(table.camera.tolist()):
        reference, before = None, ""
        for index in np.flatnonzero((table.camera == camera) & ~table.superseded).tolist():
            role = str(table.role[index])
            reference = index if is_reference(role, before, is_first=reference is None) else reference
            before = role
        if reference is not None:
            frame = session.frame(reference)
            shot = FrameShot(camera, frame.time_ns, frame.image, str(table.role[reference]), as_reference=True)
            found.append(RecalledReference(shot, before))
    return tuple(found)


def compute_session_drift(path: Path | str, target_text: str) -> SessionDrift:
    """The drift of a session's first camera against its first reference frame (without one: its first frame), in at
    most MOST_FRAMES frames spread over the session. Its own target is taken, else `target_text`. SessionError when the
    session cannot be read."""
    session = Session.open(path)
    table = session.frames_table()
    usable = np.isin(table.role, [role for role in DRIFT_ROLES if role]) & ~table.superseded
    if not usable.any():
        return SessionDrift("", (), "no frames whose drift is measured")
    camera = str(table.camera[usable][0])
    usable &= table.camera == camera
    chosen = np.flatnonzero(usable)
    if len(chosen) > MOST_FRAMES:
        chosen = chosen[np.linspace(0, len(chosen) - 1, MOST_FRAMES).round().astype(int)]
    references = np.flatnonzero(usable & (table.role == Role.REFERENCE))
    reference = int(references[0]) if len(references) else int(chosen[0])
    text = session.attachment("target.yaml") or target_text
    previewer = Previewer(parse_document(text, Target, "the target of the session"))
    trouble = ""
    points: list[DriftPoint] = []
    for index in (reference, *chosen.tolist()):
        frame = session.frame(index)
        seen = previewer.look(FrameShot(camera, frame.time_ns, frame.image, str(table.role[index]), not points))
        if seen.mean_px is not None and seen.worst_px is not None:
            points.append(DriftPoint(frame.time_ns, seen.mean_px, seen.worst_px))
        trouble = trouble or seen.trouble
    return SessionDrift(camera, tuple(sorted(points[1:], key=lambda point: point.time_ns)), trouble)
