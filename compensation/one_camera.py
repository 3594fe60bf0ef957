"""Of a session of several cameras, the frames of one: a model is a camera's own."""

from __future__ import annotations

from thermostand.foundation.errors import SessionError
from thermostand.recording.reading.session import Session


def take(session: Session, name: str | None) -> None:
    """The session's frames are those of the camera of that name from now on; SessionError when it has none. None: of
    the leading one."""
    if name is None:
        return
    if name not in (names := _names(session)):
        raise SessionError(
            f"{session.path}: no frames of a camera {name}; it has those of {', '.join(names) or 'none'}"
        )
    session.camera = name


def others_ns(session: Session) -> frozenset[int]:
    """When the other cameras' frames were exposed; no two frames of a session have one instant."""
    names = _names(session)
    if len(names) < 2:
        return frozenset()
    own = f"{session.camera if session.camera in names else names[0]}.image"
    return frozenset(time_ns for time_ns, meta in session.frame_metas if meta.channel != own)


def serial_of(session: Session) -> str:
    """The camera's serial number: of several they are recorded in the order in which they expose."""
    text = session.metadata.get("camera_serial", "")
    serials, names = text.split(", "), _names(session)
    return serials[names.index(session.camera)] if session.camera in names and len(names) == len(serials) else text


def name_of(session: Session, serial: str) -> str | None:
    """The camera of a session of several that has this serial number; None when no single one has."""
    names, serials = _names(session), session.metadata.get("camera_serial", "").split(", ")
    return names[serials.index(serial)] if len(names) == len(serials) > 1 and serials.count(serial) == 1 else None


def own_frames(session: Session) -> list[int]:
    """The numbers of the camera's frames among all of the session."""
    others = others_ns(session)
    return [number for number, time_ns in enumerate(session.frame_times_ns.tolist()) if time_ns not in others]


def _names(session: Session) -> tuple[str, ...]:
    channels = dict.fromkeys(meta.channel for _, meta in session.frame_metas)
    return tuple(channel.removesuffix(".image") for channel in channels)
