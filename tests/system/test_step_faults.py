"""A device error that a step meets first is the guard's hold, as one that its rule finds: the run goes on where the
rule's hold ends, else by `reset`, and what still stands holds again. Over every wire, in virtual time."""

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from typer.testing import CliRunner

from tests.daemon_queries import ask
from thermostand.foundation.clock import NS_PER_S, to_ns
from thermostand.foundation.exit_codes import FAILED, NOT_RESET
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.tasks import cancel_all
from thermostand.recording.reading.session import Session
from thermostand.stand.commands.command_table import app
from thermostand.stand.running.order import Order
from thermostand.stand.safety.gate import INTERLOCK
from thermostand.stand.service.run import run_virtual

RECIPE = """
name: two-places
steps:
  - close_flap
  - move_to: {linear: 0, rotary: 0}
  - start_chamber: 24
  - soak: 120
  - open_flap
  - capture: {frames: 2, role: reference}
  - close_flap
  - set_temperature: 34
  - soak: 600
  - move_to: {linear: 40, rotary: 5}
  - open_flap
  - capture: {frames: 2, role: fit}
  - close_flap
  - set_temperature: 27
  - soak: 600
  - open_flap
  - capture: {frames: 2, role: fit}
  - close_flap
  - stop_chamber
"""


@dataclass
class Operator:
    """Resets a hold that does not end by itself so many s after it began, at most `most` times, and notes each hold as
    (rule, whether it ends itself)."""

    after_s: float
    holds: list[tuple[str, bool]] = field(default_factory=list[tuple[str, bool]])
    directory: Path = Path()
    _asking: list[asyncio.Task[object]] = field(default_factory=list[asyncio.Task[object]])
    _due_ns: int | None = None

    async def begun(self, directory: Path) -> None:
        self.directory = directory

    def watch(self, hub: Hub) -> None:
        hub.subscribe(self._receive)

    async def leave(self) -> None:
        await cancel_all(self._asking)

    def _receive(self, item: Item) -> None:
        if isinstance(item, Event) and item.kind.startswith("guard.") and item.data.get("action") == "hold":
            self.holds.append((str(item.data["rule"]), bool(item.data["ends_itself"])))
            if not item.data["ends_itself"]:
                self._due_ns = item.time_ns + to_ns(self.after_s)
        if isinstance(item, Batch) and self._due_ns is not None and item.time_ns >= self._due_ns:
            self._due_ns = None
            self._asking.append(asyncio.create_task(asyncio.to_thread(ask, self.directory, "reset")))


async def run_with(order: Order, out: Path, operator: Operator) -> Session:
    try:
        return Session.open(await run_virtual(order, out, None, operator.watch, operator.begun))
    finally:
        await operator.leave()


# By what it is: the fault, the rules that hold the run for it in turn, and whether each hold ends by itself. The first
# two are the same fault, met by the guard in a soak and by a step before a capture.
FAULTS = {
    "alarm in a soak": ("axis.alarm=linear@755:60", [("stage_alarm", False)]),
    "alarm before a capture": ("axis.alarm=linear@1370:60", [("stage_alarm", False)]),
    "flap jams": ("flap.jam@1370:60", [("device_fault", False)]),
    "flap stalls": ("flap.stall@1370:60", [("device_fault", False)]),
    "flap's replies are short": ("flap.short_read@1370:60", [("device_lost", True)]),
    "flap unplugged": ("flap.unplugged@1370:60", [("device_lost", True)]),
    "stage unplugged": ("linear.unplugged@735:100", [("device_lost", True)]),
}


@pytest.mark.parametrize("name", FAULTS)
async def test_a_fault_holds_the_run_wherever_it_is_met_and_the_plan_is_completed(
    tmp_path: Path, order: Callable[..., Order], name: str
):
    text, holds = FAULTS[name]
    ordered, operator = order(RECIPE, simulation={"faults": [text]}), Operator(100.0)
    session = await run_with(ordered, tmp_path / "out", operator)
    assert operator.holds == holds
    ends = [event.data["status"] for event in session.events() if event.kind == "run.end"]
    assert (ends, session.frame_count) == (["complete"], 6)


@pytest.mark.parametrize(
    ("fault", "rule"), [("axis.alarm=linear@1370:400", "stage_alarm"), ("flap.stall@1370:400", "device_fault")]
)
async def test_what_still_stands_when_it_is_cleared_holds_again_at_once(
    tmp_path: Path, order: Callable[..., Order], fault: str, rule: str
):
    ordered, operator = order(RECIPE, simulation={"faults": [fault]}), Operator(150.0)
    session = await run_with(ordered, tmp_path / "out", operator)
    assert operator.holds == [(rule, False)] * 3
    held = [event for event in session.events() if event.data.get("reason") == INTERLOCK]
    assert [event.kind for event in held] == ["held", "released"] * 3
    assert all((held[i].time_ns - held[i - 1].time_ns) < to_ns(5.0) for i in (2, 4))


async def test_the_rule_of_a_lost_flap_takes_over_from_the_step_that_has_met_it(
    tmp_path: Path, order: Callable[..., Order]
):
    """The hold of a wire that is back within the rule's grace time ends by itself; later it is an operator's."""
    ordered, operator = order(RECIPE, simulation={"faults": ["flap.unplugged@1370:400"]}), Operator(150.0)
    session = await run_with(ordered, tmp_path / "out", operator)
    assert operator.holds == [("device_lost", True), ("sensor_bad", False)]
    assert session.frame_count == 6


async def test_a_regulator_that_a_step_does_not_reach_is_waited_for_while_its_rule_allows(
    tmp_path: Path, order: Callable[..., Order]
):
    """`stop_chamber` meets it; the guard aborts for a regulator that is silent for longer."""
    faults = {"faults": ["regulator.silent@1385:8"]}
    ordered, operator = order(RECIPE, simulation=faults, bus={"timeout_s": 0.1}), Operator(100.0)
    await run_with(ordered, tmp_path / "out", operator)
    assert operator.holds == [("device_lost", True)]


def test_a_virtual_run_that_nobody_clears_ends_safe_with_its_own_status_and_is_resumed(
    tmp_path: Path, config_text: Callable[..., str]
):
    config, recipe, out = tmp_path / "config.yaml", tmp_path / "recipe.yaml", tmp_path / "out"
    config.write_text(config_text(simulation={"faults": ["flap.jam@735:60"]}))
    recipe.write_text(RECIPE)
    ended = CliRunner().invoke(app, ["run", str(recipe), "--config", str(config), "--out", str(out), "--virtual-time"])
    assert ended.exit_code == NOT_RESET
    (directory,) = out.iterdir()
    session = Session.open(directory)
    assert session.readings("relays.heater_enable")[1][-1] == session.readings("regulator.running")[1][-1] == 0
    (trip,) = [event for event in session.events() if event.kind == "guard.device_fault"]
    (end,) = [event for event in session.events() if event.kind == "run.end"]
    assert 1800.0 <= (end.time_ns - trip.time_ns) / NS_PER_S <= 1860.0
    assert end.data["status"] == "tripped"
    again = ["resume", str(directory), "--config", str(config)]
    assert CliRunner().invoke(app, again).exit_code == FAILED  # nobody has reset it
    # Its laboratory is a new one, and the plan is done before the fault comes in that.
    assert CliRunner().invoke(app, [*again, "--reset"]).exit_code == 0
    assert Session.open(directory).frame_count == 6
