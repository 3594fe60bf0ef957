"""Which devices have answered, as events of the recording: a session says with what it was recorded."""

from __future__ import annotations

from dataclasses import asdict

from drivers.settings import CameraSettings, Identity
from foundation.items import Event

KIND = "device_identity"


def identity_event(device: str, identity: Identity, now_ns: int, camera: CameraSettings | None = None) -> Event:
    """With the device's name, what it tells of itself, and of a camera the lens that its settings state ("" when they
    do not)."""
    data: dict[str, object] = {"device": device, **asdict(identity)}
    text = f"{device}: {identity}"
    if not identity.serial_number:
        text += "; it tells no serial number"
    if camera is not None:
        data["lens"] = camera.lens
        text += f", lens {camera.lens}" if camera.lens else ", its lens is not stated"
    return Event(now_ns, "info", KIND, text, data)
