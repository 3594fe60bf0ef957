"""A session of the first format, recorded on 2026-11-22 and kept as it was: every later version opens it."""

from pathlib import Path

import numpy as np

from stand.recording.session import Session
from stand.recording.verify import verify

SESSION = Path(__file__).parent / "data" / "20260101T180000Z-format-1"


def test_a_session_of_the_first_format_opens_and_verifies():
    session = Session.open(SESSION)
    frames = list(session.frames())
    times_ns, air_degC = session.readings("thermometers.air")
    assert len(frames) == 3
    assert frames[0].image.shape == (600, 880)
    assert len(times_ns) > 40
    assert np.isfinite(air_degC).all()
    assert session.attachments.keys() == {"config.yaml", "recipe.yaml", "target.yaml"}
    assert [event.kind for event in session.events()][-1] == "run.end"
    assert all(event.data == {} for event in session.events())
    verify(SESSION)
