"""Probes that are wrong together, over the real wires: the guard finds it before the air is too warm."""

from collections.abc import Callable
from pathlib import Path

import pytest

from tests.nightly import mark_nightly
from tests.stand.guarded_recipes import RECIPES
from tests.system.conftest import AS_INSTALLED, CORNER, WHOLE_SENSOR
from tests.system.test_guard_wire import Bench, bench_of
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.simulator import Simulator
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.order import Order
from thermostand.stand.service.run import run_virtual

POLLED = AS_INSTALLED

Start = Callable[[StandConfig, bool], Simulator]
HOT_DEGC = 52.0

# Each failure as the simulator's faults; what is None is what the plant shows then, a little lower.
FAILURES: dict[str, dict[str, object]] = {
    "PV stuck low": {"regulator.stuck_pv_degC": None},
    "air stuck low": {"thermometer.held_degC": None},
    "both stuck low": {"regulator.stuck_pv_degC": None, "thermometer.held_degC": None},
    "PV out of the chamber": {"regulator.probe_out": True},
    "air out of the chamber": {"thermometer.pulled_out": "air"},
    "both out of the chamber": {"regulator.probe_out": True, "thermometer.pulled_out": "air"},
    "PV drifts": {"regulator.pv_drift_K_per_h": -1.0},
    "air drifts": {"thermometer.drift_K_per_h": {"air": -1.0}},
    "both drift": {"regulator.pv_drift_K_per_h": -1.0, "thermometer.drift_K_per_h": {"air": -1.0}},
    "PV and air exchanged": {"regulator.probe_exchanged": True},
    "air shorted": {"thermometer.shorted": "air"},
    "granite stuck, PV low": {"thermometer.stuck_degC": {"granite_inside": 45.0}, "regulator.stuck_pv_degC": None},
}
HARMLESS = ("air stuck low", "PV and air exchanged")  # the probe that controls is right
WATCHED_S = 10 * 3600.0
LOOKED_AT = ("thermal-cycle-settled",)  # the guard sees no image, but dwells that end when it stands still need one


async def _inject(bench: Bench, failure: str) -> None:
    shown_degC = await bench.plant("air_degC") - 0.3
    for name, value in FAILURES[failure].items():
        held = {"air": shown_degC} if name == "thermometer.held_degC" else round(shown_degC, 1)
        await bench.fault(name, held if value is None else value)


async def _hottest_degC(bench: Bench, longest_s: float) -> float:
    """Of the air's bulk, until 20 min after a trip."""
    hottest_degC, left_s = -300.0, longest_s
    while left_s > 0:
        await bench.wait(20)
        left_s = min(left_s - 20, 1200.0) if bench.trips else left_s - 20
        hottest_degC = max(hottest_degC, await bench.plant("bulk_air_degC"))
    return hottest_degC


async def _check(bench: Bench, failure: str) -> None:
    config = bench.assembly.config
    await bench.start(24, 600)
    await bench.assembly.stand.chamber.set_temperature(HOT_DEGC)
    await bench.wait(2400)
    assert bench.trips == []
    await _inject(bench, failure)
    assert await _hottest_degC(bench, WATCHED_S) < config.guard.max_air_degC + 3
    assert bench.trips or failure in HARMLESS


@pytest.mark.parametrize("failure", ["both stuck low", mark_nightly("both out of the chamber")])
async def test_the_heat_is_cut_before_the_air_is_too_warm(order: Callable[..., Order], simulator: Start, failure: str):
    async with bench_of(order(simulation={"chamber_seed": 9}), simulator) as bench:
        await _check(bench, failure)
        assert [trip.action for trip in bench.trips][:1] == ["abort"]


@pytest.mark.nightly
@pytest.mark.parametrize("failure", FAILURES)
async def test_the_air_stays_below_its_limit_in_every_failure(
    order: Callable[..., Order], simulator: Start, failure: str
):
    async with bench_of(order(simulation={"chamber_seed": 9}), simulator) as bench:
        await _check(bench, failure)


async def test_a_first_heat_that_reaches_no_probe_holds_the_stand(order: Callable[..., Order], simulator: Start):
    """As with another chamber's regulator at this one's address: neither its value rises nor the air."""
    async with bench_of(order(), simulator) as bench:
        await bench.fault("heater.cut_out", True)
        await bench.start(35, 20)
        trip = await bench.tripped(180)
        assert (trip.rule, trip.action) == ("first_heat", "hold")
        assert "regulator the one" in trip.text


@pytest.mark.nightly
@pytest.mark.parametrize("recipe", RECIPES)
async def test_a_whole_recipe_on_a_drawn_chamber_is_not_disturbed(
    tmp_path: Path, order: Callable[..., Order], recipe: str
):
    chamber_seed = RECIPES.index(recipe)
    text = find_packaged("recipes", recipe).read_text()
    camera = WHOLE_SENSOR if recipe in LOOKED_AT else CORNER
    ordered = order(text, camera=camera, simulation={"chamber_seed": chamber_seed})
    session_folder = await run_virtual(ordered, tmp_path / "out", None, lambda hub: None)
    kinds = [event.kind for event in Session.open(session_folder).events()]
    assert [kind for kind in kinds if kind.startswith("guard.")] == []
