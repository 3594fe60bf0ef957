"""Work that takes long says how far it is; work that does not says nothing."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.recording.damage import write_segment
from thermostand.foundation.progress import show_late_progress
from thermostand.recording.format.layout import FRAMES, TELEMETRY
from thermostand.recording.repair.salvage import salvage_session
from thermostand.stand.commands.sessions.session_commands import app


def test_short_work_is_not_shown(capsys: pytest.CaptureFixture[str]):
    with show_late_progress("repair", 10.0) as report:
        for done in range(10):
            report(done, "0001.mcap")
    assert capsys.readouterr().err == ""


def test_long_work_is_shown_from_its_first_report_on_and_then_at_each_tenth(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("thermostand.foundation.progress._LATE_NS", 0)
    with show_late_progress("repair", 10.0) as report:
        for done in (0.01, 0.02, 1.0, 1.5, 9.0):
            report(done, "0001.mcap")
    lines = capsys.readouterr().err.splitlines()
    assert [line.split()[1] for line in lines] == ["0%", "10%", "90%"]
    assert all(line.startswith("repair: ") and line.endswith("0001.mcap") for line in lines)


def test_a_salvage_and_a_verification_say_how_far_they_are(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("thermostand.foundation.progress._LATE_NS", 0)
    write_segment(tmp_path / "s" / TELEMETRY, TELEMETRY, range(3), finish=True)
    write_segment(tmp_path / "s" / FRAMES, FRAMES, range(3))
    for command in ("repair", "verify"):
        output = CliRunner().invoke(app, [command, str(tmp_path / "s")]).stderr
        assert re.search(rf"^{command}: +\d+%  0:00:\d\d left  ", output), output


def test_a_search_for_sound_bytes_in_a_damaged_place_is_reported_as_it_goes(tmp_path: Path):
    """16 MB of bytes that nobody has written as zeros: no record in them, so it is one search."""
    write_segment(tmp_path / TELEMETRY, TELEMETRY, range(3), finish=True)
    written = write_segment(tmp_path / FRAMES, FRAMES, range(3))
    (part,) = (tmp_path / FRAMES).glob("*.part")
    part.write_bytes(written.data + b"\x55" * (16 << 20))
    shares: list[float] = []
    salvage_session(tmp_path, lambda share, name: shares.append(share))
    assert shares == sorted(shares)
    assert sum(0.1 < share < 0.95 for share in shares) >= 3
    assert shares[-1] == 1.0
