"""The end of a run: the chamber comes back to the laboratory's temperature before the run is complete."""

import asyncio
import os
import signal
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.addresses import move_to_free
from tests.daemon_queries import ask
from tests.system.test_run import fault
from thermostand.foundation.errors import SessionError, StandTripped
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item, StepState
from thermostand.recording.reading.run_status import RunOutcome
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.running.order import Order, load_order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import Interrupted, resume, run_virtual

RECIPE = "name: away\nsteps:\n  - start_chamber: {set_point}\n  - soak: {soak_s}\n  - stop_chamber\n"


async def run_session(
    folder: Path, set_point: float, soak_s: int = 900, **ending: object
) -> tuple[Session, list[Event]]:
    """A run of a stand without a camera that ends away from the laboratory's 24 degC."""
    data = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["cameras"], data["axes"] = {}, {}
    data["ending"] = {"to_ambient": True, **ending}
    (folder / "stand.yaml").write_text(yaml.safe_dump(data))
    (folder / "away.yaml").write_text(RECIPE.format(set_point=set_point, soak_s=soak_s))
    seen: list[Event] = []

    def follow(item: Item) -> None:
        if isinstance(item, Event):
            seen.append(item)

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)

    order = load_order(str(folder / "away.yaml"), str(folder / "stand.yaml"))
    return Session.open(await run_virtual(order, folder / "out", None, watch)), seen


@pytest.mark.parametrize("set_point", [14.0, 36.0])
async def test_a_chamber_that_is_away_comes_back(tmp_path: Path, set_point: float):
    session, seen = await run_session(tmp_path, set_point)
    kinds = [event.kind for event in seen]
    assert kinds.index("to_ambient") < kinds.index("at_ambient") < kinds.index("run.end")
    laboratory_degC = session.readings("thermometers.laboratory")[1][-1]
    for channel in ("thermometers.air", "thermometers.artifact"):
        at_the_end = session.readings(channel)[1][-1]
        assert at_the_end > laboratory_degC - 3.5
        assert channel.endswith("artifact") or at_the_end < laboratory_degC + 3.5
    assert session.run is RunOutcome.COMPLETE
    assert session.readings("relays.heater_enable")[1][-1] == 0.0
    assert session.readings("relays.compressor")[1][-1] == 0.0
    assert session.readings("regulator.running")[1][-1] == 0.0
    assert [event.text for event in seen if event.level == "error"] == []


async def test_after_the_longest_time_it_is_reported_that_it_is_not(tmp_path: Path):
    _, seen = await run_session(tmp_path, 14.0, max_s=60)
    (reported,) = (event for event in seen if event.kind == "not_at_ambient")
    assert reported.level == "warning"
    assert reported.text.startswith("after 1 min the air is ")


@pytest.mark.parametrize(("set_point", "ending"), [(24.5, {}), (14.0, {"to_ambient": False})])
async def test_nothing_happens_where_it_is_reached_or_not_wanted(
    tmp_path: Path, set_point: float, ending: dict[str, bool]
):
    _, seen = await run_session(tmp_path, set_point, 300, **ending)
    assert not {"to_ambient", "at_ambient", "not_at_ambient"} & {event.kind for event in seen}


def on_the_way(do: Callable[[], object], batches: int = 5) -> Callable[[Hub], None]:
    """Do it once the chamber has been on its way back for so many polls."""
    left: list[int] = []

    def follow(item: Item) -> None:
        if isinstance(item, Event) and item.kind == "to_ambient":
            left[:] = [batches]
        if isinstance(item, Batch) and left:
            left[0] -= 1
            if left[0] == 0:
                do()

    return lambda hub: hub.subscribe(follow)


def far(folder: Path) -> Order:
    """Of a stand that knows its laboratory's temperature from its file only: 18 degC, where a new simulated chamber is
    at 24, so that a resumed run has a way to go, too."""
    data = move_to_free(yaml.safe_load(find_packaged("", "simulated").read_text()), folder)
    data["cameras"], data["axes"] = {}, {}
    data["thermometers"].pop("laboratory")
    data["ending"] = {"to_ambient": True, "ambient_degC": 18.0}
    (folder / "stand.yaml").write_text(yaml.safe_dump(data))
    (folder / "away.yaml").write_text(RECIPE.format(set_point=30.0, soak_s=300))
    return load_order(str(folder / "away.yaml"), str(folder / "stand.yaml"))


def check_ended(directory: Path, *ends: str) -> list[str]:
    """Safe, and ended so each time; the kinds of its events."""
    session = Session.open(directory)
    for channel in ("relays.heater_enable", "relays.compressor", "regulator.running"):
        assert session.readings(channel)[1][-1] == 0.0
    events = session.events()
    assert [event.text.partition(":")[0] for event in events if event.kind == "run.end"] == list(ends)
    return [event.kind for event in events]


def test_a_stop_on_the_way_back_leaves_the_stand_safe_and_a_resume_goes_on_with_the_way(tmp_path: Path):
    with pytest.raises(Interrupted, match="stopped by the operator"):
        asyncio.run(run_virtual(far(tmp_path), tmp_path / "out", None, on_the_way(interrupt)))
    (directory,) = (tmp_path / "out").glob("*-away")
    assert "at_ambient" not in check_ended(directory, "aborted")
    assert asyncio.run(resume(load_interruption(directory), lambda hub: None)) == directory
    kinds = check_ended(directory, "aborted", "complete")
    assert kinds.count("to_ambient") == 2
    assert kinds.index("at_ambient") > kinds.index("run.resume")
    session = Session.open(directory)
    assert session.run is RunOutcome.COMPLETE
    done = Counter(mark.step_id for mark in session.steps() if mark.state is StepState.DONE)
    assert set(done.values()) == {1}
    assert session.readings("thermometers.air")[1][-1] == pytest.approx(18.0, abs=3.5)


def interrupt() -> None:
    os.kill(os.getpid(), signal.SIGINT)


async def test_a_trip_on_the_way_back_ends_it_and_it_goes_on_when_that_is_cleared(tmp_path: Path):
    order, works = replace(far(tmp_path), at_configured_addresses=True), list[asyncio.Task[None]]()

    def broken() -> None:
        works.append(asyncio.create_task(fault(order, "thermometer.open", "air")))

    with pytest.raises(StandTripped, match=r"thermometers\.air is BAD"):
        await run_virtual(order, tmp_path / "out", None, on_the_way(broken))
    (directory,) = (tmp_path / "out").glob("*-away")
    check_ended(directory, "aborted")
    with pytest.raises(SessionError, match="resume with --reset"):
        load_interruption(directory)
    await resume(load_interruption(directory, reset=True), lambda hub: None)
    assert "at_ambient" in check_ended(directory, "aborted", "complete")


async def test_a_hold_on_the_way_back_stops_the_chamber_which_goes_on_after_it(tmp_path: Path):
    """Somebody stops the regulator with its keys, and an operator resets that."""
    order, works, seen = replace(far(tmp_path), at_configured_addresses=True), list[asyncio.Task[Any]](), list[Event]()

    async def reset() -> None:
        (directory,) = (tmp_path / "out").glob("*-away")
        await asyncio.to_thread(ask, directory, "reset")

    def follow(item: Item) -> None:
        if isinstance(item, Event):
            seen.append(item)
            if item.kind == "held":
                works.append(asyncio.create_task(reset()))

    def watch(hub: Hub) -> None:
        hub.subscribe(follow)
        on_the_way(lambda: works.append(asyncio.create_task(fault(order, "regulator.stop_key", True))))(hub)

    directory = await run_virtual(order, tmp_path / "out", None, watch)
    await asyncio.gather(*works)
    kinds = [event.kind for event in seen]
    assert kinds.index("to_ambient") < kinds.index("held") < kinds.index("released") < kinds.index("at_ambient")
    check_ended(directory, "complete")
