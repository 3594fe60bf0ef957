"""Frames as they are recorded, and the topics of the leading camera."""

from thermostand.foundation.readings import Frame
from thermostand.recording.format.images import FrameContext, name_frame_topics
from thermostand.recording.writing.frames import PublishedFrame, encode_frame
from thermostand.recording.writing.segment import MessageRecord
from thermostand.recording.writing.session_spec import make_frames_topic

CAMERA_TOPICS = tuple(map(make_frames_topic, name_frame_topics("camera.image")))


def make_frame_records(frame: Frame, published_ns: int | None = None) -> list[MessageRecord]:
    """The two messages of a frame, published at its own instant unless another is given."""
    return encode_frame(PublishedFrame(frame, FrameContext(frame.time_ns if published_ns is None else published_ns)))


def encode_description(frame: Frame) -> bytes:
    """The first of them, without what belongs to its place."""
    return bytes(make_frame_records(frame)[0].data)
