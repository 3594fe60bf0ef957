"""The settings of a recording: who records what, and how."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields
from typing import Any, Literal, Self

from thermostand.recording.format.images import FrameEncoding
from thermostand.recording.format.layout import FORMAT

_NOT_EMPTY = ("uid", "extent", "holes")  # left out of the record when they are


@dataclass(frozen=True, slots=True)
class SessionInfo:
    """Who recorded what with which; the metadata record `session` of every segment.

    simulated: the devices were fakes, in real or virtual time. On a virtual clock `host` is not recorded: that run on
    another machine is the same session.

    format: of the files. extent: of a part that was cut out of a session, the range and how the run
    ended, as JSON; holes: of a copy of a session that is not whole, what the original lacked (holes.py). uid:
    of this session alone, in hex digits, also when another one of its second and recipe has the same `session_id`; on a
    virtual clock it follows from the seed.
    """

    session_id: str
    recipe: str
    camera_serial: str
    operator: str
    software_version: str
    clock_source: Literal["wall", "virtual"]
    simulated: bool = False
    host: str = ""
    format: str = str(FORMAT)
    extent: str = ""
    holes: str = ""
    uid: str = ""

    def metadata(self) -> dict[str, str]:
        """The fields as MCAP metadata."""
        texts: dict[str, str] = {**asdict(self), "simulated": str(self.simulated).lower()}
        if self.clock_source == "virtual":
            del texts["host"]
        return {name: text for name, text in texts.items() if text or name not in _NOT_EMPTY}

    @classmethod
    def of(cls, metadata: Mapping[str, str]) -> Self:
        """The inverse: segments that are added to a session have its own record; a field it lacks is ""."""
        known: dict[str, Any] = {field.name: metadata.get(field.name, "") for field in fields(cls)}
        return cls(**{**known, "simulated": known["simulated"] == "true"})


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """How to record. `telemetry_commit_s` is on the stand's clock: on a virtual one VIRTUAL_COMMIT_S costs nothing
    that a real night would lose and spares tens of thousands of disk syncs. A segment is closed at the first commit
    after it has `segment_bytes` or `segment_s`, whichever is first. While the disk takes nothing, `waiting_messages`
    are kept in memory (100 MB or so); beyond that readings are dropped, and nothing else.

    With less than `stop_frames_below_bytes` free on the disk no frames are recorded, so that telemetry can continue;
    with less than `alert_below_fraction` of the disk free there is a warning."""

    frame_encoding: FrameEncoding = "zstd"
    telemetry_commit_s: float = 1.0
    segment_bytes: int = 1_000_000_000
    segment_s: float = 600.0
    queue_frames: int = 20
    waiting_messages: int = 200_000
    stop_frames_below_bytes: int = 2_000_000_000
    alert_below_fraction: float = 0.10


USUAL = RecordingSettings()
VIRTUAL_COMMIT_S = 20.0  # between commits on a virtual clock: well under a second of the host's
