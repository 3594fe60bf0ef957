"""The settings of a recording: how it is recorded."""

from __future__ import annotations

from dataclasses import dataclass

from thermostand.recording.format.images import FrameEncoding


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """How to record. `telemetry_commit_s` is on the stand's clock: on a virtual one VIRTUAL_COMMIT_S costs nothing
    that a real session would lose and spares tens of thousands of disk syncs. A segment is closed at the first commit
    after it has `segment_bytes` or `segment_s`, whichever is first. While the disk takes nothing, `waiting_messages`
    are kept in memory (100 MB or so); beyond that readings are dropped, and nothing else.

    With less than `stop_frames_below_bytes` free on the disk no frames are recorded, so that telemetry can continue;
    with less than `alert_below_fraction` of the disk free there is a warning."""

    frame_encoding: FrameEncoding = "zstd"
    telemetry_commit_s: float = 1.0
    segment_bytes: int = 1_000_000_000
    # Round numbers; nothing was measured.
    segment_s: float = 600.0
    queue_frames: int = 20
    waiting_messages: int = 200_000
    stop_frames_below_bytes: int = 2_000_000_000
    alert_below_fraction: float = 0.10


USUAL = RecordingSettings()
# At 427 times real time it is 50 ms of the host's; a commit each second would be a disk sync for each second of a run.
VIRTUAL_COMMIT_S = 20.0  # between commits on a virtual clock: well under a second of the host's
