"""What a person at the terminal sees of a run: lines and messages, from the run's own hub and from a daemon."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import pytest
from rich.console import Console
from rich.live import Live

from tests.stand.test_control_cli import STATUS
from thermostand.experiments.steps import Capture, Role, Soak, number_steps
from thermostand.foundation.clock import NS_PER_S
from thermostand.foundation.events import CAMERA_EQUILIBRIUM, CAMERA_EQUILIBRIUM_LOST, SOAK_LONGER
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.recording.format.utc_offsets import UtcOffsets
from thermostand.stand.commands.control_cli import idle_lines
from thermostand.stand.config.stand_config import load_config, packaged
from thermostand.stand.estimating.estimate import price
from thermostand.stand.estimating.run_estimate import Night
from thermostand.stand.running.status import doing_in_words
from thermostand.stand.serving.desk import HeatByHand, ReadingState, StandState
from thermostand.stand.watching.follow import Follow
from thermostand.stand.watching.live import Foot, Lines, panel_lines, plain_line
from thermostand.stand.watching.moment import Moment, moment_of
from thermostand.stand.watching.remedies import next_command

BEGIN_NS = 1_767_290_400 * NS_PER_S  # 2026-01-01 18:00:00 UTC
MOMENT = Moment(
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


@pytest.fixture
def follow() -> tuple[Follow, list[Moment], list[str]]:
    config = load_config(packaged("", "simulated"))
    plan = number_steps([Soak(600.0), Capture(2, 1.0, 0.01, Role.FIT, 24.0)])
    moments: list[Moment] = []
    lines: list[str] = []
    return Follow("a night", Night(price(plan, config)), moments.append, lines.append), moments, lines


SOAK_ID = next(number_steps([Soak(600.0)])).step_id


def mark(seconds: float, index: int, state: StepState) -> StepMark:
    step = (Soak(600.0), Capture(2, 1.0, 0.01, Role.FIT, 24.0))[index]
    return StepMark(BEGIN_NS + int(seconds * NS_PER_S), str(index), index, step.kind, state, step.parameters)


def test_a_run_is_followed_from_its_first_step_on(follow: tuple[Follow, list[Moment], list[str]]):
    subscriber, moments, _ = follow
    now_ns = BEGIN_NS - NS_PER_S
    good = Reading("thermometers.air", 23.98, "degC", now_ns)
    broken = bad_reading("camera.temperature", "degC", now_ns, "no reply")
    subscriber(Batch("all", now_ns, (Reading("regulator.sp", 24.0, "degC", now_ns), good, broken)))
    assert moments == []
    subscriber(mark(0, 0, StepState.STARTED))
    first = moments[-1]
    assert (first.step, first.steps, first.doing, first.share) == (1, 2, "soak for 10 min", 0.0)
    assert (first.setpoint_degC, first.air_degC, first.camera_degC) == (24.0, 23.98, None)
    subscriber(mark(600, 0, StepState.DONE))
    subscriber(mark(600, 1, StepState.STARTED))
    assert moments[-1].doing == "2 frames at 24 °C (fit)"
    assert moments[-1].share == pytest.approx(600 / 601, abs=0.01)
    assert moments[-1].end_ns == pytest.approx(BEGIN_NS + 601 * NS_PER_S, abs=5 * NS_PER_S)


def test_what_a_step_waits_for_is_said_with_it(follow: tuple[Follow, list[Moment], list[str]]):
    subscriber, moments, _ = follow
    subscriber(mark(0, 0, StepState.STARTED))
    subscriber(Event(BEGIN_NS, "warning", CAMERA_EQUILIBRIUM_LOST, "it was off"))
    subscriber(Batch("all", BEGIN_NS + 120 * NS_PER_S, ()))
    again = doing_in_words("soak for 10 min", 120.0, goes_on=False)
    assert moments[-1].doing == again != "soak for 10 min"
    subscriber(Event(BEGIN_NS + 300 * NS_PER_S, "info", CAMERA_EQUILIBRIUM, "it is at rest"))
    subscriber(Event(BEGIN_NS + 600 * NS_PER_S, "info", SOAK_LONGER, "", {"step_id": SOAK_ID, "by_s": 90.0}))
    subscriber(Batch("all", BEGIN_NS + 601 * NS_PER_S, ()))
    assert moments[-1].doing == doing_in_words("soak for 10 min", None, goes_on=True)
    assert moments[-1].end_ns > BEGIN_NS + 690 * NS_PER_S
    subscriber(mark(690, 1, StepState.STARTED))
    assert moments[-1].doing == "2 frames at 24 °C (fit)"


def test_each_warning_says_what_to_type(follow: tuple[Follow, list[Moment], list[str]]):
    subscriber, moments, lines = follow
    subscriber(mark(0, 0, StepState.STARTED))
    subscriber(Event(BEGIN_NS, "info", "reported", "of no importance"))
    subscriber(Event(BEGIN_NS, "warning", "held", "held by an operator's pause", {"reason": "operator"}))
    subscriber(Batch("all", BEGIN_NS, ()))
    at = UtcOffsets().local_text(BEGIN_NS)[11:]
    assert lines == [f"warning: {at} held by an operator's pause; `stand continue` ends the pause"]
    assert moments[-1].held == "held by an operator's pause"
    subscriber(Event(BEGIN_NS, "info", "released", "", {"reason": "operator"}))
    subscriber(Batch("all", BEGIN_NS, ()))
    assert moments[-1].held == ""


@pytest.mark.parametrize(
    ("kind", "data", "command"),
    [
        ("held", {"reason": "interlock"}, "`stand status`"),  # some rules end by themselves
        ("guard.stuck", {"action": "hold"}, "`stand clear`"),
        ("guard.stuck", {"action": "abort"}, "`stand resume DIR --clear`"),
        ("guard.stuck", {"action": "abort"}, "`stand clear` where a daemon has the stand"),
        ("guard.not_recorded", {"action": "hold", "ends_itself": True}, "by itself"),
        ("prompt", {}, "`stand continue`"),
        ("disk_nearly_full", {}, "`stand session archive`"),
        ("house_not_recorded", {}, "see that the disk has room"),
        ("flap_not_shut", {}, "close it by hand"),
        ("of a later version", {}, "`stand status`"),
    ],
)
def test_messages_name_the_next_command(kind: str, data: dict[str, object], command: str):
    assert command in next_command(kind, data)


def test_a_run_that_has_ended_early_is_resumed_by_the_name_of_its_folder(tmp_path: Path):
    lines: list[str] = []
    follow = Follow("a night", Night(()), lambda moment: None, lines.append, directory=tmp_path / "all nights")
    follow(Event(BEGIN_NS, "info", "run.start", "recipe demo", {"session": "20260101T180000Z-demo"}))
    follow(Event(BEGIN_NS, "error", "run.end", "aborted: stopped by the operator", {"status": "stopped"}))
    assert f"`stand resume '{tmp_path}/all nights/20260101T180000Z-demo'` continues it" in lines[0]


def test_a_terminal_that_is_gone_does_not_end_what_it_follows():
    def gone(_: object) -> None:
        raise BrokenPipeError

    follow = Follow("a night", Night(()), gone, gone)
    follow(Event(BEGIN_NS, "error", "guard.rule", "it is so"))
    follow(mark(0, 0, StepState.STARTED))


def test_the_panel_has_a_line_for_each_question():
    assert panel_lines(MOMENT) == [
        "step 12 of 87: soak for 45 min",
        "set 31.00 °C   air 30.98 °C   camera –",
        "frames 120 of 640   drift 0.123 px   disk 12.3 GB free",
        "━━━━━━╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌╌ 25%   ends 2026-01-01 19:00 UTC ± 12 min (in 1:00:00)",
    ]
    held = replace(MOMENT, held="held by an operator's pause", frames_lost=3)
    assert "(held by an operator's pause)" in panel_lines(held)[0]
    assert "3 LOST" in panel_lines(held)[2]


def test_the_same_is_one_line_in_a_log():
    assert plain_line(MOMENT) == (
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
    seen = moment_of(state, 0.2)
    assert (seen.title, seen.step, seen.steps, seen.frames) == ("thermal-cycle on a stand", 12, 87, 120)
    assert (seen.setpoint_degC, seen.air_degC, seen.camera_degC, seen.drift_px) == (24.0, 23.98, None, 0.2)
    assert (seen.held, seen.end_within_s) == ("held by an operator's pause", 90.0)
    idle = moment_of(state.model_copy(update={"run": None, "reasons": (), "queue_halted": "somebody pressed STOP"}))
    assert (idle.doing, idle.held, idle.end_ns) == ("no run", "somebody pressed STOP", None)
    by_hand = HeatByHand(setpoint_degC=40.0, since_ns=BEGIN_NS)
    heated = state.model_copy(update={"run": None, "reasons": (), "phase": "idle", "by_hand": by_hand})
    since = "heated by hand to 40 °C since 2026-01-01 18:00:00 UTC"
    assert moment_of(heated).doing == f"no run; {since}"
    assert f"state         {since}" in idle_lines("out", heated)
    hand = by_hand.model_copy(update={"cut_ns": BEGIN_NS + 60 * NS_PER_S})
    cut = heated.model_copy(update={"by_hand": hand, "now_ns": air.time_ns + 61 * NS_PER_S})
    lines = list(idle_lines("out", cut))
    assert f"state         {since}; heat cut by the relay board's timer at 2026-01-01 18:01:00 UTC" in lines
    assert "temperatures  thermometers.air 23.98 degC, 0:01:01 ago" in lines


def shown_shares(lines: list[str]) -> list[int]:
    return [int(line[4:].split("%")[0]) for line in lines]


@pytest.mark.parametrize(("is_virtual", "shares"), [(False, [0, 5, 10]), (True, [10])])
def test_without_a_terminal_a_line_a_minute_and_in_virtual_time_one_at_each_tenth(
    capsys: pytest.CaptureFixture[str], is_virtual: bool, shares: list[int]
):
    clock = SetClock()
    lines = Lines(clock, is_virtual=is_virtual)
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
        foot = Foot(live, SetClock())
        foot.show(MOMENT)
        foot.show(replace(MOMENT, doing="too soon after the last"))
        foot.tell("warning: held; `stand continue` ends the pause")
        before = out.getvalue()
        foot.draw()
    text = out.getvalue()
    assert "too soon" not in before
    assert "too soon" in text  # at the end the last one is drawn
    assert before.index("thermal-cycle on a stand") < before.index("warning: held") < before.rindex("step 12 of 87")
