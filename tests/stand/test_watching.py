"""What a person at the terminal sees of a run, of this process and of a daemon's: lines and messages."""

from __future__ import annotations

import io
from collections.abc import AsyncGenerator
from contextlib import asynccontextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from rich.live import Live

from tests.stand.fake_service import FakeService
from tests.stand.test_control_cli import STATUS
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import RUN_START
from thermostand.foundation.items import Batch, Event, Item, StepMark, StepState
from thermostand.stand.commands.control_cli import format_idle_lines
from thermostand.stand.commands.live import PlainLines, RunFollower, TerminalPanel, format_line, format_panel
from thermostand.stand.commands.remedies import get_next_command
from thermostand.stand.commands.status_snapshot import StatusSnapshot, make_snapshot
from thermostand.stand.serving.api_models import HeatByHand, ReadingState, StandState

BEGIN_NS = 1_767_290_400 * NS_PER_S  # 2026-01-01 18:00:00 UTC
MOMENT = StatusSnapshot(
    BEGIN_NS,
    "thermal-cycle on a stand",
    share=0.25,
    step=12,
    steps=87,
    doing="soak for 45 min",
    setpoint_degC=31.0,
    air_degC=30.983,
    frames=120,
    frames_planned=640,
    drift_px=0.1234,
    disk_free_bytes=12_300_000_000,
    end_ns=BEGIN_NS + 3600 * NS_PER_S,
    end_within_s=720.0,
)


class SetClock:
    """Shows what it is set to."""

    def __init__(self) -> None:
        self.ns = BEGIN_NS

    def now_ns(self) -> int:
        return self.ns


class Followed:
    """A run of this process as it is shown, whose service is a desk."""

    def __init__(self, folder: Path) -> None:
        self.moments: list[StatusSnapshot] = []
        self.lines: list[str] = []
        self.desk = FakeService(run=STATUS)
        self.session = folder / "all nights" / "20260101T180000Z-demo"
        self.following = RunFollower(self.moments.append, self.lines.append, folder / "all nights")
        self.following.watch(self.desk.hub)
        self.desk.hub.publish(RUN_START.at(BEGIN_NS, session=self.session.name, recipe="demo", steps=2, frames=2))

    def publish(self, item: Item) -> None:
        self.desk.hub.publish(item)


@asynccontextmanager
async def followed(folder: Path, *, desk_answers: bool = True) -> AsyncGenerator[Followed]:
    """Its service answers while inside."""
    found = Followed(folder)
    front = found.following.follow_service(found.desk, found.session) if desk_answers else nullcontext()
    async with front:
        yield found


async def test_a_run_is_followed_from_the_moment_it_answers_and_before_the_next_look_when_a_step_begins(tmp_path: Path):
    async with followed(tmp_path) as run:
        run.publish(Batch("all", BEGIN_NS, ()))
        assert [(each.title, each.step, each.steps) for each in run.moments] == [("thermal-cycle on a stand", 12, 87)]
        run.publish(Batch("all", BEGIN_NS + NS_PER_S // 2, ()))
        assert len(run.moments) == 1  # terminals are slow
        run.desk.run = STATUS.model_copy(update={"step": 13})
        run.publish(StepMark(BEGIN_NS + NS_PER_S // 2, "13", 13, "soak", StepState.STARTED, {}))
        run.publish(Batch("all", BEGIN_NS + NS_PER_S // 2, ()))
        assert [each.step for each in run.moments] == [12, 13]


async def test_each_warning_says_what_to_type(tmp_path: Path):
    async with followed(tmp_path) as run:
        run.publish(Event(BEGIN_NS, "info", "reported", "of no importance"))
        run.publish(Event(BEGIN_NS, "warning", "held", "held by an operator's pause", {"reason": "operator"}))
    (line,) = run.lines
    assert line.startswith("warning: 2026-01-01 1")
    assert "an operator's pause" in line
    assert "`stand continue`" in line


@pytest.mark.parametrize(
    ("kind", "data", "command"),
    [
        ("held", {"reason": "interlock"}, "`stand status`"),  # some rules end by themselves
        ("guard.stuck", {"action": "hold"}, "`stand reset`"),
        ("guard.stuck", {"action": "abort"}, "`stand resume DIR --reset`"),
        ("guard.stuck", {"action": "abort"}, "`stand reset` where a daemon has the stand"),
        ("guard.not_recorded", {"action": "hold", "ends_itself": True}, "by itself"),
        ("prompt", {}, "`stand continue`"),
        ("disk_nearly_full", {}, "`stand session archive`"),
        ("idle_log_not_recorded", {}, "see that the disk has space"),
        ("flap_not_shut", {}, "close it by hand"),
        ("of a later version", {}, "`stand status`"),
    ],
)
def test_messages_name_the_next_command(kind: str, data: dict[str, object], command: str):
    assert command in get_next_command(kind, data)


async def test_a_run_that_has_ended_early_is_resumed_by_the_name_of_its_folder(tmp_path: Path):
    async with followed(tmp_path, desk_answers=False) as run:
        run.publish(Event(BEGIN_NS, "error", "run.end", "aborted: stopped by the operator", {"status": "stopped"}))
    assert f"`stand resume '{run.session}'` continues it" in run.lines[0]


def test_the_panel_has_a_line_for_each_question():
    assert format_panel(MOMENT) == [
        "step 12 of 87: soak for 45 min",
        "set 31.00 °C   air 30.98 °C   camera –",
        "frames 120 of 640   drift 0.123 px   disk 12.3 GB free",
        "━━━━━━╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌ 25%   ends 2026-01-01 19:00 UTC ± 12 min (in 1:00:00)",
    ]
    held = replace(MOMENT, held="held by an operator's pause", frames_lost=3)
    assert "operator's pause" in format_panel(held)[0]
    assert "3 LOST" in format_panel(held)[2]


def test_the_same_is_one_line_in_a_log():
    assert format_line(MOMENT) == (
        "run:  25%  2026-01-01 18:00  step 12 of 87: soak for 45 min; set 31.00 °C, air 30.98 °C, camera –; "
        "frames 120 of 640, drift 0.123 px, disk 12.3 GB free; ends 2026-01-01 19:00 UTC ± 12 min (in 1:00:00)"
    )


def test_a_stand_that_a_daemon_has_is_shown_alike():
    air = ReadingState(value=23.98, unit="degC", quality="good", time_ns=BEGIN_NS)  # pyright: ignore[reportArgumentType]
    run = STATUS.model_copy(update={"end_within_s": 90.0, "frames_planned": 640, "reasons": ()})
    state = StandState(
        stand="a stand",
        version="0",
        simulated=True,
        now_ns=run.now_ns,
        utc_offset_ns=0,
        phase="held",
        run=run,
        reasons=("operator",),
        readings={"thermometers.air": air},
        setpoint_degC=24.0,
    )
    seen = make_snapshot(state, 0.2)
    assert (seen.title, seen.step, seen.steps, seen.frames) == ("thermal-cycle on a stand", 12, 87, 120)
    assert (seen.setpoint_degC, seen.air_degC, seen.camera_degC, seen.drift_px) == (24.0, 23.98, None, 0.2)
    assert (bool(seen.held), seen.end_within_s) == (True, 90.0)
    idle = make_snapshot(state.model_copy(update={"run": None, "reasons": (), "queue_halted": "somebody pressed STOP"}))
    assert (idle.doing, idle.held, idle.end_ns) == ("no run", "somebody pressed STOP", None)
    by_hand = HeatByHand(setpoint_degC=40.0, since_ns=BEGIN_NS)
    heated = state.model_copy(update={"run": None, "reasons": (), "phase": "idle", "by_hand": by_hand})
    since = "heated by hand to 40 °C since 2026-01-01 18:00:00 UTC"
    assert make_snapshot(heated).doing == f"no run; {since}"
    assert f"state         {since}" in format_idle_lines("out", heated)
    hand = by_hand.model_copy(update={"cut_ns": BEGIN_NS + 60 * NS_PER_S})
    cut = heated.model_copy(update={"by_hand": hand, "now_ns": air.time_ns + 61 * NS_PER_S})
    lines = list(format_idle_lines("out", cut))
    assert any(line.startswith(f"state         {since}; ") and "18:01:00 UTC" in line for line in lines)
    assert "temperatures  thermometers.air 23.98 degC, 0:01:01 ago" in lines


def shown_shares(lines: list[str]) -> list[int]:
    return [int(line[4:].split("%")[0]) for line in lines]


@pytest.mark.parametrize(("is_virtual", "shares"), [(False, [0, 5, 10]), (True, [10])])
def test_without_a_terminal_a_line_a_minute_and_in_virtual_time_one_at_each_tenth(
    capsys: pytest.CaptureFixture[str], is_virtual: bool, shares: list[int]
):
    clock = SetClock()
    lines = PlainLines(clock, is_virtual=is_virtual)
    for second in range(0, 130, 10):
        clock.ns = BEGIN_NS + second * NS_PER_S
        lines.show(replace(MOMENT, share=second / 1200))
    lines.tell("warning: it\nis so")
    reported = capsys.readouterr().err.splitlines()
    assert shown_shares(reported[:-1]) == shares
    assert reported[-1] == "warning: it\\nis so"


def test_on_a_terminal_messages_stand_above_the_panel(monkeypatch: pytest.MonkeyPatch):
    out = io.StringIO()
    console = Console(file=out, force_terminal=True, width=80, color_system=None)
    with Live(console=console, auto_refresh=False) as live:
        foot = TerminalPanel(live, SetClock())
        foot.show(MOMENT)
        foot.show(replace(MOMENT, doing="too soon after the last"))
        foot.tell("warning: held; `stand continue` ends the pause")
        before = out.getvalue()
        foot.draw()
    text = out.getvalue()
    assert "too soon" not in before
    assert "too soon" in text  # at the end the last one is drawn
    assert before.index("thermal-cycle on a stand") < before.index("warning: held") < before.rindex("step 12 of 87")
