"""What a session looks like on the disk: a folder with two series of segments, and names inside them."""

from __future__ import annotations

FRAMES = "frames"
TELEMETRY = "telemetry"
FINISHED = ".mcap"
UNFINISHED = ".mcap.part"
TEMPORARY = ".mcap.tmp"  # a copy that is being made; whoever made it and was killed left nothing of value
DAMAGED = ".mcap.damaged"  # the original of a segment from which a salvage could not take everything
SESSION_METADATA = "session"
SEGMENT_METADATA = "segment"
DEVICES = "devices"  # key of a channel's metadata: the names of the devices on its topic, with commas between
