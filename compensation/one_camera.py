"""Of a session of several cameras, the frames of one: a model is a camera's own."""

from __future__ import annotations

from recording.reading.session import Session

_LEADING = "camera.image"  # of the camera whose temperature the stand goes by


def others_ns(session: Session) -> frozenset[int]:
    """When the other cameras' frames were exposed; no two frames of a session have one instant."""
    metas = session.frame_metas
    channels = dict.fromkeys(meta.channel for _, meta in metas)
    if len(channels) < 2:
        return frozenset()
    own = _LEADING if _LEADING in channels else next(iter(channels))
    return frozenset(time_ns for time_ns, meta in metas if meta.channel != own)
