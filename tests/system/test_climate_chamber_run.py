"""Whole runs with a commercial climate chamber in the place of regulator and relay board, over its wire."""

import asyncio
from collections.abc import Callable, Mapping
from pathlib import Path

import pytest
import yaml

from tests.addresses import find_free_port
from tests.daemon_queries import ask
from tests.system.test_guard_run import LONG_SOAK, Watcher, run_operated, trips_of
from tests.system.test_run import fault, ignore
from tests.system.test_run_ends import SHORTER
from thermostand.foundation.documents import load_document, parse_document
from thermostand.foundation.errors import ConfigError, DeviceFault
from thermostand.recording.reading.session import Session
from thermostand.stand.config.recipe import Recipe
from thermostand.stand.config.stand_config import StandConfig, find_packaged, load_config
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

MAKES = ("espec", "cts", "ascii2")
NIGHTLY = [pytest.param(make, marks=pytest.mark.nightly) for make in ("simserv", "julabo")]


def settings_of(make: str, **changes: object) -> dict[str, object]:
    settings: dict[str, object] = {
        "protocol": make,
        "address": f"tcp:127.0.0.1:{find_free_port()}",
        "gap_s": 0.0,
        "poll_s": 5.0,
    }
    if make not in ("espec", "simserv"):
        settings["limits_at_panel_degC"] = [-10, 60]
    return {**settings, **changes}


def with_chamber(text: str, chamber: Mapping[str, object]) -> str:
    data = yaml.safe_load(text)
    del data["regulator"], data["relays"]
    return yaml.safe_dump({**data, "climate_chamber": dict(chamber)})


@pytest.fixture
def chamber_order(tmp_path: Path, config_text: Callable[..., str]) -> Callable[..., Order]:
    def build(make: str, *, recipe: str = SHORTER, **changes: object) -> Order:
        text = with_chamber(config_text(bus={"timeout_s": 0.3}), settings_of(make, **changes))
        config_file, recipe_file = tmp_path / "config.yaml", tmp_path / "recipe.yaml"
        config_file.write_text(text)
        recipe_file.write_text(recipe)
        target = find_packaged("targets", "paper-9x6").read_text()
        loaded = load_document(recipe_file, Recipe)
        return Order(load_config(config_file), loaded, text, recipe, target, at_configured_addresses=True)

    return build


@pytest.mark.parametrize("make", [*MAKES, *NIGHTLY])
async def test_a_stand_with_a_commercial_chamber_needs_no_relay_board(
    tmp_path: Path, chamber_order: Callable[..., Order], make: str
):
    session = Session.open(await run_virtual(chamber_order(make), tmp_path / "out", None, ignore))
    events = {event.kind: event for event in session.events()}
    assert not [kind for kind in events if kind.startswith("guard.")]
    assert events["no_dead_man"].data["device"] == "regulator"
    assert events["no_dead_man"].data["ends_it"].startswith("nothing: ")
    _, pv_degC = session.readings("regulator.pv")
    assert max(pv_degC) > 25
    assert session.readings("regulator.running")[1][-1] == 0
    assert len(session.frame_metas()) == 3


@pytest.mark.parametrize(
    ("make", "name", "value", "sentence"),
    [
        ("espec", "chamber.set_point_degC", 45, "set point changed at the unit, from "),
        ("julabo", "chamber.bank", 1, "working temperature T2 acts"),
    ],
)
async def test_a_set_point_changed_at_its_panel_holds_the_run(
    tmp_path: Path, chamber_order: Callable[..., Order], make: str, name: str, value: int, sentence: str
):
    ordered, out, watcher = chamber_order(make, recipe=LONG_SOAK), tmp_path / "out", Watcher()

    async def operate() -> None:
        await watcher.event("run.start", 60)
        (directory,) = out.iterdir()
        await watcher.wait(1800)
        await fault(ordered, name, value)
        trip = await watcher.event("guard.device_fault", 300)
        assert sentence in trip.text
        await asyncio.to_thread(ask, directory, "stop")

    await run_operated(ordered, out, watcher, operate())
    (directory,) = out.iterdir()
    assert trips_of(directory) == ["device_fault"]
    assert Session.open(directory).readings("regulator.running")[1][-1] == 0


async def test_a_chamber_whose_controller_allows_more_is_refused_before_anything_runs(
    tmp_path: Path, chamber_order: Callable[..., Order]
):
    ordered = chamber_order("cts", limits_at_panel_degC=[-10, 90])
    with pytest.raises(DeviceFault, match=r"limits_at_panel_degC allows set-points of -10\.\.90"):
        await run_virtual(ordered, tmp_path / "out", None, ignore)


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"regulator": {"registers": "omron-e5cc", "unit": 1}}, "either a regulator or a climate_chamber"),
        ({"climate_chamber": None}, "either a regulator or a climate_chamber"),
        ({"climate_chamber": {"protocol": "binder", "address": "tcp:a:1"}}, "climate_chamber"),
        ({"climate_chamber": {"protocol": "espec", "address": "tcp:a:1", "start_bit": 1}}, "start_bit: unknown key"),
    ],
)
def test_a_section_that_does_not_fit_is_refused(
    config_text: Callable[..., str], change: dict[str, object], complaint: str
):
    data = yaml.safe_load(with_chamber(config_text(), settings_of("espec")))
    with pytest.raises(ConfigError, match=complaint) as caught:
        parse_document(yaml.safe_dump({**data, **change}), StandConfig, "stand.yaml")
    assert "\n" not in str(caught.value)


def test_a_regulator_needs_its_relay_board(config_text: Callable[..., str]):
    data = yaml.safe_load(config_text())
    del data["relays"]
    with pytest.raises(ConfigError, match="relays is missing"):
        parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")
