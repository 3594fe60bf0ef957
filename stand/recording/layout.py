"""What a session looks like on the disk: a folder with two series of segments, and names inside them."""

from __future__ import annotations

FRAMES = "frames"
TELEMETRY = "telemetry"
FINISHED = ".mcap"
UNFINISHED = ".mcap.part"
SESSION_METADATA = "session"
SEGMENT_METADATA = "segment"
DEVICES = "devices"  # key of a channel's metadata: the names of the devices on its topic, with commas between
