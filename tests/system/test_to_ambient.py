"""The end of a run: the chamber comes back to the laboratory's temperature before the run is complete."""

from pathlib import Path

import pytest
import yaml

from foundation.hub import Hub
from foundation.items import Event, Item
from recording.reading.run_word import Run
from recording.reading.session import Session
from stand.config.stand_config import packaged
from stand.running.order import load_order
from stand.running.run import run_virtual

RECIPE = "name: away\nsteps:\n  - start_chamber: {set_point}\n  - soak: {soak_s}\n  - stop_chamber\n"


async def night(folder: Path, set_point: float, soak_s: int = 900, **ending: object) -> tuple[Session, list[Event]]:
    """A run of a stand without a camera that ends away from the laboratory's 24 degC."""
    data = yaml.safe_load(packaged("", "simulated").read_text())
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
    session, seen = await night(tmp_path, set_point)
    kinds = [event.kind for event in seen]
    assert kinds.index("to_ambient") < kinds.index("at_ambient") < kinds.index("run.end")
    laboratory_degC = session.readings("thermometers.laboratory")[1][-1]
    for channel in ("thermometers.air", "thermometers.artifact"):
        at_the_end = session.readings(channel)[1][-1]
        assert at_the_end > laboratory_degC - 3.5
        assert channel.endswith("artifact") or at_the_end < laboratory_degC + 3.5
    assert session.run is Run.COMPLETE
    assert session.readings("relays.heater_enable")[1][-1] == 0.0
    assert session.readings("relays.compressor")[1][-1] == 0.0
    assert session.readings("regulator.running")[1][-1] == 0.0
    assert [event.text for event in seen if event.level == "error"] == []


async def test_after_the_longest_time_it_is_told_that_it_is_not(tmp_path: Path):
    _, seen = await night(tmp_path, 14.0, max_s=60)
    (told,) = (event for event in seen if event.kind == "not_at_ambient")
    assert told.level == "warning"
    assert told.text.startswith("after 1 min the air is ")


@pytest.mark.parametrize(("set_point", "ending"), [(24.5, {}), (14.0, {"to_ambient": False})])
async def test_nothing_happens_where_it_is_there_or_not_wanted(
    tmp_path: Path, set_point: float, ending: dict[str, bool]
):
    _, seen = await night(tmp_path, set_point, 300, **ending)
    assert not {"to_ambient", "at_ambient", "not_at_ambient"} & {event.kind for event in seen}
