"""Frames as they are recorded, and the topics of the leading camera."""

from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import Circumstances, frame_topics
from thermostand.recording.writing.forms import frames_topic
from thermostand.recording.writing.frames import PublishedFrame, frame_records
from thermostand.recording.writing.segment import MessageRecord

CAMERA_TOPICS = tuple(map(frames_topic, frame_topics("camera.image")))


def stored(frame: Frame, published_ns: int | None = None) -> list[MessageRecord]:
    """The two messages of a frame, published at its own instant unless another is given."""
    return frame_records(PublishedFrame(frame, Circumstances(frame.time_ns if published_ns is None else published_ns)))


def described(frame: Frame) -> bytes:
    """The first of them, without what belongs to its place."""
    return bytes(stored(frame)[0].data)
