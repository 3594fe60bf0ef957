"""Of a session of several cameras, the frames of one: a model is a camera's own."""

from __future__ import annotations

from operator import attrgetter

from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.session import Session


def select_camera(session: Session, name: str | None) -> None:
    """The session's frames are those of the camera of that name from now on; SessionError when it has none. None: of
    the leading one."""
    if name is None:
        return
    if name not in (names := _list_cameras(session)):
        raise SessionError(
            f"{session.path}: no frames of a camera {name}; it has those of {', '.join(names) or 'none'}"
        )
    session.camera = name


def find_channel(session: Session) -> str:
    """The channel of the camera's frames; "" when the session has none."""
    names = _list_cameras(session)
    return f"{session.camera if session.camera in names else names[0]}.image" if names else ""


def read_serial(session: Session) -> str:
    """The camera's serial number: of several they are recorded in the order in which they expose."""
    text = session.metadata.get("camera_serial", "")
    serials, names = text.split(", "), _list_cameras(session)
    return serials[names.index(session.camera)] if session.camera in names and len(names) == len(serials) else text


def find_camera_name(session: Session, serial: str) -> str | None:
    """The camera of a session of several that has this serial number; None when no single one has."""
    names, serials = _list_cameras(session), session.metadata.get("camera_serial", "").split(", ")
    return names[serials.index(serial)] if len(names) == len(serials) > 1 and serials.count(serial) == 1 else None


def read_frame_temperatures(session: Session) -> dict[int, float]:
    """The camera's own temperature (degC, NaN: unknown) at the instants of its frames, and the others' at theirs."""
    metas, own = session.frame_metas(), find_channel(session)
    return {meta.time_ns: meta.camera_degC for meta in sorted(metas, key=lambda meta: meta.channel == own)}


def list_camera_frames(session: Session) -> list[int]:
    """The numbers of the camera's frames among all of the session."""
    own = find_channel(session)
    return [number for number, meta in enumerate(session.frame_metas()) if meta.channel == own]


def _list_cameras(session: Session) -> tuple[str, ...]:
    """List the cameras of a session in the order of the recording."""
    channels = dict.fromkeys(meta.channel for meta in sorted(session.frame_metas(), key=attrgetter("published_ns")))
    return tuple(channel.removesuffix(".image") for channel in channels)
