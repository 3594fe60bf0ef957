"""A session whose camera came out of a gap with another temperature over the air is not fitted as one, silently."""

from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from tests.recording.full_session import START_NS, frame, record
from thermostand.compensation.cli import app
from thermostand.compensation.observations import check_one_equilibrium
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.errors import SessionError
from thermostand.foundation.items import Event, StepMark, StepState
from thermostand.recording.format.capture_restarts import make_restart_event
from thermostand.recording.reading.session import Session


def items(gap_index: int, *, superseded: bool = False, role: str = "fit"):
    """A frame each half second; the gap comes before the one of `gap_index`, and is stated in the end."""

    def at(time_ns, index):
        parameters = {"role": role, "chamber_degC": 24.0}
        yield StepMark(time_ns, f"capture-{index}", index, "capture", StepState.STARTED, parameters)
        yield frame(time_ns - 50_000_000, index)
        if index == 11:
            if superseded:
                yield from (
                    make_restart_event(time_ns - NS_PER_S // 4, f"capture-{each}", 1, "x") for each in range(gap_index)
                )
            data = {"before_K": 15.2, "after_K": 13.1, "gap_ns": START_NS + gap_index * NS_PER_S // 2 - NS_PER_S // 4}
            yield Event(time_ns, "warning", "camera_offset_changed", "text is for people", data)

    return at


async def test_frames_of_both_sides_are_refused_unless_somebody_wants_them(tmp_path: Path):
    await record(tmp_path / "cycle", items=items(6))
    with pytest.raises(SessionError, match=r"15\.20 K before .* 13\.10 K after"):
        check_one_equilibrium(Session.open(tmp_path / "cycle"))
    for command in (
        ["fit", str(tmp_path / "cycle"), "-o", str(tmp_path / "model.json")],
        ["report", str(tmp_path / "cycle"), "-o", str(tmp_path / "report.html")],
    ):
        refused = CliRunner().invoke(app, command)
        assert refused.exit_code != 0
        assert "only with --across-gap" in refused.output
        reported = CliRunner().invoke(app, [*command, "--across-gap"])
        assert "across-gap" not in reported.output  # it gets as far as these frames, which show no target, take it


@pytest.mark.parametrize(("gap_index", "options"), [(0, {}), (6, {"superseded": True}), (6, {"role": "warm_up"})])
async def test_frames_of_one_side_are_of_one_equilibrium(tmp_path: Path, gap_index: int, options: dict[str, Any]):
    await record(tmp_path / "cycle", items=items(gap_index, **options))
    check_one_equilibrium(Session.open(tmp_path / "cycle"))
