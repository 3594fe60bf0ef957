"""Three cameras of 5 MP on one line, a frame of each every 0.5 s: none is lost, and the session is as long as of
one."""

from collections import Counter
from pathlib import Path

import pytest

from thermostand.recording.reading.scan import Files, verify
from thermostand.recording.reading.session import Session

from .conftest import require_aravis
from .test_several_cameras import recorded, simulated

pytestmark = pytest.mark.nightly

RECIPE = """
name: captures
experiments:
  - calibration: {equilibrium_s: 600, linear_mm: [0, 80], rotary_deg: [0, 10], frames_per_position: 6}
"""
LONGEST = 1.2  # of the session of one camera


def run_session(cameras: int, out: Path) -> tuple[float, Counter[str], int]:
    """Stand time from the first to the last reading (s), frames by camera, frames that were lost."""
    data = simulated()
    for number, name in enumerate(["left", "right"][: cameras - 1]):
        camera = {"address": f"127.0.0.{31 + number}", "serial_number": f"TS-000{2 + number}", "packet_size": 8000}
        data["cameras"][name] = {**camera, "boot_s": 4.0, "poll_s": 5.0}
    path = recorded(data, RECIPE, out)
    assert verify(path).files is Files.SOUND
    session = Session.open(path)
    metas = session.frame_metas()
    later = metas[cameras:]  # the simulated scene's first image is slow
    times_ns = session.readings("thermometers.air")[0]
    duration_s = float(times_ns[-1] - times_ns[0]) / 1e9
    return duration_s, Counter(meta.channel for meta in metas), sum(meta.dropped for meta in later)


def test_three_cameras_lose_no_frame_and_take_as_long_as_one(tmp_path: Path):
    require_aravis()
    alone_s, _, _ = run_session(1, tmp_path / "one")
    together_s, frames, lost = run_session(3, tmp_path / "three")
    assert frames == {"camera.image": 24, "left.image": 24, "right.image": 24}
    assert lost == 0
    assert together_s <= LONGEST * alone_s
