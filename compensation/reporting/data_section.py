"""What was recorded, what was flagged or left out and why, and by which programs."""

from __future__ import annotations

import math
from collections.abc import Iterator

from thermostand.compensation.reporting.numbers import Numbers, SessionNumbers, UnusableFrames
from thermostand.compensation.reporting.page import Facts, Heading, Paragraph, Part, Table

_DOUBTFUL_BY_CHANCE = 0.02
"""Of the frames, at most: of 200 with noise alone 1 was doubtful (docs/decisions.md)."""
_LISTED_REASONS, _LISTED_FRAMES = 30, 8


def data_section(numbers: Numbers) -> Iterator[Part]:
    """Sessions, flags, frames left out, versions."""
    yield Heading("Recorded data")
    for session in numbers.sessions:
        yield Facts(_session(session, numbers))
    yield Heading("Measured with")
    yield Facts(list(numbers.measured_with.items()))
    if numbers.unusable:
        yield from _unusable(numbers.unusable)
    made_by = ", ".join(f"{name} {version}" for name, version in numbers.versions.items())
    yield Paragraph(f"Made by {made_by}.", aside=True)


def _session(session: SessionNumbers, numbers: Numbers) -> list[tuple[str, str]]:
    low, high = session.camera_degC
    width, height = numbers.image_px
    lines = [
        ("Session", f"{session.session_id} (recipe {session.recipe}, operator {session.operator or 'not named'})"),
        ("Camera", f"{numbers.camera}, {width} x {height} px"),
        ("Recorded", f"{utc(session.begin)} to {utc(session.end)} by thermostand {session.software_version}"),
        ("Frames", _frames(session)),
        ("Chamber", ", ".join(f"{value:g}" for value in session.chamber_degC) + " °C"),
        ("Camera's temperature", "not known" if math.isnan(low) else f"{low:z.2f} to {high:z.2f} °C"),
        ("Markers", _markers(session, numbers)),
    ]
    if session.doubtful > max(1.0, _DOUBTFUL_BY_CHANCE * session.frames):
        lines.append(("Noise", _doubt(session)))
    if session.incomplete_segments:
        lines.append(("Not read", f"{session.incomplete_segments} segments that were not finished"))
    return lines


def _doubt(session: SessionNumbers) -> str:
    return (
        f"{session.doubtful} frames are not described by the camera's noise (texture, print, compression, flicker): "
        "how uncertain their centres are is estimated from how the residuals of each frame hang together"
    )


def utc(instant: str) -> str:
    """ISO 8601 to what is read on a page."""
    return f"{instant[:16].replace('T', ' ')} UTC"


def _frames(session: SessionNumbers) -> str:
    listed = ", ".join(f"{count} {role.replace('_', '-')}" for role, count in session.frames_by_role.items())
    left_out = f"; {session.unusable} of them cannot be used" if session.unusable else ""
    return f"{session.frames} ({listed}){left_out}"


def _markers(session: SessionNumbers, numbers: Numbers) -> str:
    """How many centres there are, and how many were set aside and why."""
    text = f"{numbers.target}, {session.centres} centres in usable frames, {session.set_aside} set aside"
    listed = ", ".join(f"{count} {flag}" for flag, count in session.flags.items())
    return text + (f" ({listed})" if listed else "")


def _unusable(unusable: tuple[UnusableFrames, ...]) -> Iterator[Part]:
    yield Heading("Frames left out")
    rows = [(one.reason, one.session_id, str(len(one.frames)), _places(one.frames)) for one in unusable]
    yield Table(("reason", "session", "how many", "frames, from 0"), rows[:_LISTED_REASONS])
    if len(rows) > _LISTED_REASONS:
        yield Paragraph(
            f"and {len(rows) - _LISTED_REASONS} more reasons; all are in the file beside this page.", aside=True
        )


def _places(frames: tuple[int, ...]) -> str:
    listed = ", ".join(str(frame) for frame in frames[:_LISTED_FRAMES])
    return listed + (", …" if len(frames) > _LISTED_FRAMES else "")
