"""Recorded session -> arrays over frames: marker centres, temperatures, what each frame was taken for.

Pixels as in markers/detection.py: x = column = I to the right, y = row = J down, integers are centres.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field, replace
from itertools import islice
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from thermostand.compensation.camera_selection import find_channel, list_camera_frames, read_serial, select_camera
from thermostand.compensation.finding.finder import Finder
from thermostand.compensation.finding.piece import FoundMarkers, concatenate_markers, split_into_pieces
from thermostand.compensation.history.thermal_history import ThermalHistory, read_history
from thermostand.experiments.steps import Role
from thermostand.foundation.documents import parse_document, parse_yaml
from thermostand.foundation.errors import ConfigError, SessionError
from thermostand.foundation.items import Event
from thermostand.foundation.progress import Report, hide_progress
from thermostand.foundation.readings import TEMPERATURE_SUSPECT, UNSETTLED, Frame
from thermostand.markers.noise import Noise, estimate_noise
from thermostand.markers.target import Target
from thermostand.recording.format.capture_restarts import find_restart_times, is_superseded
from thermostand.recording.format.manifest import Manifest, read_manifest
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.recording.reading.session import Say, Session, open_whole

# Whether all frames of a session are of one thermal equilibrium of the camera.
#
# The event `camera_offset_changed` says that the camera's temperature minus that of the air around it, at settled
# set-points, was another one before a gap than after it: the same temperature then stands for two states of the camera,
# and a model fitted to both describes neither.

CHANGED = "camera_offset_changed"
_TRANSIENT_ROLES = frozenset({"warm_up", "settling", "other"})  # of a camera that is not in equilibrium anyway


class MixedEquilibria(SessionError):
    """A session has frames of two equilibria of the camera."""


def check_one_equilibrium(session: Session) -> None:
    """TwoEquilibria when there are frames at settled set-points on both sides of such a gap."""
    times_ns: list[int] | None = None
    for event in session.events():
        gap_ns = event.data.get("gap_ns")
        if event.kind != CHANGED or not isinstance(gap_ns, int):
            continue
        times_ns = _list_settled_frames_ns(session) if times_ns is None else times_ns
        if times_ns and min(times_ns) <= gap_ns < max(times_ns):
            raise MixedEquilibria(
                f"{session.path}: camera minus air was {_format_kelvin(event, 'before_K')} before the gap at "
                f"{session.utc.local_text(gap_ns)} and {_format_kelvin(event, 'after_K')} after it; its frames are of "
                "two equilibria of the camera, and are used together only with --across-gap"
            )


def check_sessions(sessions: Iterable[Session], *, across_gap: bool) -> None:
    """Each of them, unless they are wanted together."""
    if not across_gap:
        for session in sessions:
            check_one_equilibrium(session)


def _format_kelvin(event: Event, name: str) -> str:
    value_K = event.data.get(name)
    return f"{value_K:.2f} K" if isinstance(value_K, int | float) else "unknown"


def _list_settled_frames_ns(session: Session) -> list[int]:
    """Instants of the frames that count and were taken at a settled set-point."""
    roles = {mark.step_id: mark.parameters.get("role") for mark in session.steps() if "role" in mark.parameters}
    begins_ns = find_restart_times(session.events())
    return [
        meta.time_ns
        for meta in session.frame_metas()
        if roles.get(meta.step_id, "warm_up") not in _TRANSIENT_ROLES
        and not is_superseded(meta.time_ns, meta.step_id, begins_ns)
    ]


Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

Progress = Callable[[str, float], AbstractContextManager[Report]]
"""`progress` of foundation, or anything like it: (title, total) -> a context that yields report(done, text)."""

_NOISE_FRAMES = 4  # round number; nothing was measured
_PREVIEW_WIDTH_PX = 816  # a third of a 5 MP frame, which is enough on a page


@dataclass(frozen=True, slots=True)
class SessionFacts:
    """The facts of a session from which frames come. simulated: whether the laboratory was, None when the session does
    not say. incomplete: segments that a killed recorder left behind and that were not read. utc: from its instants to
    UTC. spots: what a thermal imager saw of the camera, name -> (time_ns, degC). suspect: frames that the noise model
    does not describe, so that the covariance of their centres is an estimate (markers.Detection). uid: of the session
    alone. sha256: of its manifest, which has those of all its files; "" where there is none."""

    session_id: str
    recipe: str
    camera_serial: str
    operator: str
    software_version: str
    simulated: bool | None
    incomplete: int
    utc: UtcOffsets = field(default_factory=UtcOffsets)
    spots: Mapping[str, tuple[NDArray[np.int64], Float]] = field(
        default_factory=dict[str, tuple[NDArray[np.int64], Float]], compare=False
    )
    uid: str = ""
    suspect: int = 0
    sha256: str = ""


@dataclass(frozen=True, slots=True, eq=False)
class Observations:
    """F frames of a target with N markers, in order of time within each of the sessions.

    Attributes
    ----------
    session
        (F,), index into `sessions`.
    frame
        (F,), number within its session, from 0.
    time_ns
        (F,) int64, the middle of the exposure.
    role
        (F,), values of `Role`.
    chamber_degC, camera_degC, air_degC
        (F,): the set-point, the camera's own temperature, and that of the air near the camera; NaN when unknown.
    centres_px, covariance_px2
        (F, N, 2) as (x, y), and (F, N, 2, 2); NaN when the marker is missing or flagged.
    flags
        (F, N), bits of `Flag`.
    reasons
        (F,): why the frame cannot be used, "" when it can.
    preview
        The first usable frame, reduced, grey.
    image_size
        (width, height) of the frames, px.
    histories
        What each of the sessions recorded of the camera's surroundings; empty when that is not known.
    not_known
        What arrays and tables do not say (times, air, supply, set_points, uncertainty), and what is taken instead.
    """

    target: Target
    sessions: tuple[SessionFacts, ...]
    image_size: tuple[int, int]
    preview: NDArray[np.uint8]
    session: NDArray[np.int64]
    frame: NDArray[np.int64]
    time_ns: NDArray[np.int64]
    role: NDArray[np.str_]
    step_id: tuple[str, ...]
    chamber_degC: Float
    camera_degC: Float
    air_degC: Float
    centres_px: Float
    covariance_px2: Float
    flags: NDArray[np.uint8]
    reasons: tuple[str, ...]
    histories: tuple[ThermalHistory, ...] = ()
    not_known: Mapping[str, str] = field(default_factory=dict[str, str])

    @property
    def usable(self) -> Mask:
        """(F,): frames with markers and a camera temperature."""
        return np.array([not reason for reason in self.reasons], bool)

    @property
    def simulated(self) -> bool:
        """Whether any of the frames are known to be of a simulated laboratory."""
        return any(session.simulated for session in self.sessions)

    @property
    def roles_text(self) -> str:
        """How many usable frames there are of each role, as in `20 reference, 12 other`."""
        counts = {role: int(self.of(role).sum()) for role in Role}
        return ", ".join(f"{count} {role}" for role, count in counts.items() if count) or "none"

    @property
    def left_out(self) -> dict[str, int]:
        """How many frames cannot be used, by the reason."""
        return dict(Counter(reason for reason in self.reasons if reason))

    def of(self, *roles: str) -> Mask:
        """(F,): usable frames taken for one of these purposes."""
        return self.usable & np.isin(self.role, [str(role) for role in roles])

    def find_switch_on_ns(self, session: int, before_ns: int) -> int | None:
        """Return when the camera's supply last came on before an instant of a session; None when that is not
        recorded."""
        if not self.histories:
            return None
        history = self.histories[session]
        rises = history.powered_ns[1:][np.diff(history.powered) > 0]
        earlier = rises[rises <= before_ns]
        return int(earlier[-1]) if len(earlier) else None


def read_session_target(session: Session) -> Target:
    """The target attached to the session; SessionError when none is, ConfigError when it is wrong."""
    text = session.attachment("target.yaml")
    if text is None:
        raise SessionError(f"{session.path}: no target.yaml is attached; name the target with --target")
    return parse_document(text, Target, f"{session.path}: target.yaml")


def estimate_session_noise(session: Session) -> Noise | None:
    """The camera's noise, from the first frames; None when they do not determine it."""
    try:
        channel = find_channel(session)
        first = list(islice((each for each in session.frames() if each.channel == channel), _NOISE_FRAMES))
    except SessionError:  # the search for the markers comes to the same frame, and reports where it is
        return None
    partial = [frame.windows for frame in first if frame.windows is not None]
    return estimate_noise([frame.image for frame in first if frame.image.ndim == 2], partial[-1] if partial else None)


def observe_session(
    session: Session, target: Target, finder: Finder | None = None, report: Report | None = None
) -> Observations:
    """Find the target in every frame; `report` counts frames. finder: how, else one frame after the other.

    A frame without the target, of another size or without a camera temperature stays, with its reason. SessionError
    when no frame can be used at all.
    """
    pieces = split_into_pieces(session, target, estimate_session_noise(session))
    total = sum(piece.frames for piece in pieces)

    def counted(done: int) -> None:
        if report is not None:
            report(done, f"frame {done} of {total}")

    if not pieces:
        raise SessionError(f"{session.path}: no frame can be used; it has no frames")
    found = concatenate_markers((finder or Finder())(pieces, counted))
    seen = np.flatnonzero(found.reason == "")
    if not len(seen):
        raise SessionError(f"{session.path}: no frame can be used; {found.reason[0]}")
    return _build_observations(session, target, found, int(seen[0]))


def read_frames(session: Session) -> Iterator[Frame]:
    """The session's frames in order; the SessionError of one that cannot be read names it."""
    done = 0
    try:
        for frame in session.frames():
            yield frame
            done += 1
    except SessionError as error:
        raise SessionError(f"{error}; this was frame {done}, counted from 0") from error


def observe(
    paths: Path | str | Sequence[Path | str],
    progress: Progress | None = None,
    target: Target | None = None,
    finder: Finder | None = None,
    *,
    across_gap: bool = False,
    incomplete: Say | None = None,
    camera: str | None = None,
) -> Observations:
    """Find the markers in all frames of all sessions, each frame once.

    Parameters
    ----------
    paths : path or sequence of paths
        The folders of the sessions.
    progress : callable, optional
        Reports the progress, such as foundation.progress.
    target : Target, optional
        Used instead of those that are attached to the sessions.
    finder : Finder, optional
        How the markers are found. By default one frame is searched after the other.
    across_gap : bool
        Accept frames of two equilibria of the camera in a session.
    incomplete : callable, optional
        Accept sessions of which something is missing; it gets the sentence that says what.
    camera : str, optional
        The name of the camera, in sessions of several. By default the leading one is taken.

    Returns
    -------
    Observations
        The frames with their centres, covariances and temperatures.

    Raises
    ------
    SessionError
        When a session has frames of two equilibria without `across_gap`, or is incomplete without `incomplete`.
    """
    sessions = [open_whole(path, incomplete) for path in ([paths] if isinstance(paths, Path | str) else paths)]
    for session in sessions:
        select_camera(session, camera)
    check_sessions(sessions, across_gap=across_gap)
    targets = [target or read_session_target(session) for session in sessions]
    parts: list[Observations] = []
    done = 0
    with (progress or hide_progress)("find markers", sum(session.frame_count for session in sessions)) as report:
        for session, its_target in zip(sessions, targets, strict=True):
            parts.append(observe_session(session, its_target, finder, _offset_progress(report, done)))
            done += session.frame_count
    return concatenate(parts)


def _offset_progress(report: Report, done_before: float) -> Report:
    def continued(done: float, text: str) -> None:
        report(done_before + done, text)

    return continued


def _build_observations(session: Session, target: Target, found: FoundMarkers, first: int) -> Observations:
    """first: the first frame with the target, whose size the others must have."""
    known = session.frames_table()
    own = np.array(list_camera_frames(session), np.int64)
    camera_degC, step_id = known.camera_degC[own], known.step_id[own]
    reasons = _explain_unusable(found, first, camera_degC, known.superseded[own], known.flags[own])
    purposes = [_check_purpose(role, degC) for role, degC in zip(known.role[own], known.chamber_degC[own], strict=True)]
    unusable = (found.flags != 0) | np.array([bool(reason) for reason in reasons])[:, None]
    image = session.frame(int(own[first])).image
    return Observations(
        target=target,
        sessions=(_collect_facts(session, int(np.count_nonzero(found.suspect))),),
        image_size=(image.shape[1], image.shape[0]),
        preview=_make_preview(image),
        session=np.zeros(len(reasons), np.int64),
        frame=own,
        time_ns=found.time_ns,
        role=np.array([str(role) for role, _ in purposes]),
        step_id=tuple(step_id.tolist()),
        chamber_degC=np.array([chamber_degC for _, chamber_degC in purposes]),
        camera_degC=camera_degC,
        air_degC=known.air_degC[own],
        centres_px=np.where(unusable[:, :, None], np.nan, found.centres_px),
        covariance_px2=np.where(unusable[:, :, None, None], np.nan, found.covariance_px2),
        flags=np.where((found.reason == "")[:, None], found.flags, 0).astype(np.uint8),
        reasons=reasons,
        histories=(read_history(session),),
    )


def _explain_unusable(
    found: FoundMarkers, first: int, camera_degC: Float, superseded: NDArray[np.bool_], flags: NDArray[np.str_]
) -> tuple[str, ...]:
    """Return why each frame cannot be used, "" when it can."""
    width, height = found.size_px[first].tolist()
    columns = (found.size_px.tolist(), found.reason.tolist(), camera_degC.tolist(), superseded.tolist(), flags.tolist())
    reasons: list[str] = []
    for size_px, reason, degC, is_restarted, flagged in zip(*columns, strict=True):
        if is_restarted:
            reason = "its capture was restarted"
        elif size_px != [width, height]:
            reason = f"the image has {size_px[0]} x {size_px[1]} pixels, the session's {width} x {height}"
        elif not reason and math.isnan(degC):
            reason = "the camera's temperature is unknown"
        elif not reason and TEMPERATURE_SUSPECT in flagged.split(","):
            reason = "the camera's temperature is suspect"
        elif not reason and UNSETTLED in flagged.split(","):
            reason = "the chamber was not in its band when the soak before it ended"
        reasons.append(reason)
    return tuple(reasons)


def _check_purpose(role: str, chamber_degC: float) -> tuple[str, float]:
    """Role and set-point of a frame, from those of its step; OTHER, and NaN, unless both are known."""
    if role not in set(Role) or math.isnan(chamber_degC):
        return Role.OTHER, math.nan
    return role, chamber_degC


def _collect_facts(session: Session, suspect: int) -> SessionFacts:
    fields = ("session_id", "recipe", "operator", "software_version")
    texts = {name: session.metadata.get(name, "") for name in fields} | {"camera_serial": read_serial(session)}
    simulated = {"true": True, "false": False}.get(session.metadata.get("simulated", ""))
    manifest = read_manifest(session.path)
    return SessionFacts(
        **texts,
        simulated=simulated,
        incomplete=len(session.incomplete),
        utc=session.utc,
        spots=_read_spots(session),
        suspect=suspect,
        uid=session.metadata.get("uid", ""),
        sha256=manifest.sha256 if isinstance(manifest, Manifest) else "",
    )


def _read_spots(session: Session) -> dict[str, tuple[NDArray[np.int64], Float]]:
    """The thermal imager's; nothing is read where the stand had none."""
    try:
        config = parse_yaml(session.attachment("config.yaml") or "", "config.yaml")
    except ConfigError:
        return {}
    if not isinstance(config, dict) or "imager" not in config:
        return {}
    names = [name for name in session.channels() if name.startswith("imager.") and name != "imager.clock_offset"]
    return {name.removeprefix("imager."): session.readings(name) for name in names}


def _make_preview(image: NDArray[np.uint8] | NDArray[np.uint16]) -> NDArray[np.uint8]:
    """The image at a width for the report; averaging before rounding takes most of the noise away."""
    import cv2  # fits from arrays need no OpenCV

    height, width = image.shape
    factor = max(1, math.ceil(width / _PREVIEW_WIDTH_PX))
    reduced = cv2.resize(image, (width // factor, height // factor), interpolation=cv2.INTER_AREA)
    brightest = max(int(reduced.max()), 1)
    return np.round(reduced * (255 / brightest)).astype(np.uint8)


def concatenate(parts: Sequence[Observations]) -> Observations:
    """The frames of several sessions, one after the other.

    SessionError when camera, target or image size differ: one model is of one camera.
    """
    parts = _disambiguate_ids(parts)
    first = parts[0]
    for index, part in enumerate(parts[1:], 1):
        _check_same(first, part)
        if part.sessions[0] in [known.sessions[0] for known in parts[:index]]:
            raise SessionError(f"session {part.sessions[0].session_id} is given twice")
    lengths = np.cumsum([0] + [len(part.sessions) for part in parts])
    columns = ("frame", "time_ns", "role", "chamber_degC", "camera_degC", "air_degC", "centres_px", "covariance_px2")
    return replace(
        first,
        sessions=tuple(facts for part in parts for facts in part.sessions),
        session=np.concatenate([part.session + shift for part, shift in zip(parts, lengths, strict=False)]),
        step_id=tuple(step_id for part in parts for step_id in part.step_id),
        reasons=tuple(reason for part in parts for reason in part.reasons),
        histories=tuple(history for part in parts for history in part.histories),
        not_known={name: text for part in parts for name, text in part.not_known.items()},
        **{name: np.concatenate([getattr(part, name) for part in parts]) for name in (*columns, "flags")},
    )


def _disambiguate_ids(parts: Sequence[Observations]) -> list[Observations]:
    """Sessions of one second and recipe have the same id: behind the first one's it says which they are."""
    known: dict[str, str] = {}
    named: list[Observations] = []
    for part in parts:
        (facts, *others) = part.sessions
        if known.setdefault(facts.session_id, facts.uid) != facts.uid:
            facts = replace(facts, session_id=f"{facts.session_id} ({facts.uid})")
        named.append(replace(part, sessions=(facts, *others)))
    return named


def _check_same(first: Observations, other: Observations) -> None:
    here, second = first.sessions[0], other.sessions[0]
    pairs = {
        "camera": (here.camera_serial, second.camera_serial),
        "target": (first.target.name, other.target.name),
        "number of markers": (first.target.count, other.target.count),
        "image size": (first.image_size, other.image_size),
    }
    for name, (one, two) in pairs.items():
        if one != two:
            raise SessionError(
                f"sessions {here.session_id} and {second.session_id} cannot be combined: {name} {one} and {two}"
            )
