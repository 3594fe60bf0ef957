"""Home checks and approaches made again, against the fake controller on its wire; time is virtual."""

import math
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from tests.system.stage_bench import OVERSHOOT, UNIT_PER_STEP, Bench, Kind, running_bench
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import DeviceFault
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Event, Item
from thermostand.foundation.readings import Quality
from thermostand.stand.imaging.table import check_home, prepare_axes


@pytest.fixture
def kind() -> Kind:
    return "linear"


@pytest.fixture
async def bench(kind: Kind, tmp_path: Path) -> AsyncIterator[Bench]:
    async with running_bench(kind, "serial", tmp_path) as bench:
        yield bench


class IdentityPoint:
    """A hub, and what was published on it."""

    def __init__(self) -> None:
        self.hub = Hub()
        self.items: list[Item] = []
        self.hub.subscribe(self.items.append)

    @property
    def events(self) -> list[tuple[str, str]]:
        return [(item.level, item.kind) for item in self.items if isinstance(item, Event)]

    @property
    def text(self) -> str:
        (event,) = [item for item in self.items if isinstance(item, Event)]
        return event.text


each_kind = pytest.mark.parametrize("kind", ["linear", "rotary"])


@each_kind
@pytest.mark.parametrize(
    ("lost_steps", "expected"),
    [(0.0, ("info", "home_residual")), (1.5, ("info", "home_residual")), (4.0, ("warning", "home_residual_large"))],
)
async def test_a_home_check_tells_lost_steps_in_units_and_steps(
    bench: Bench, lost_steps: float, expected: tuple[str, str]
) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(30.0)
    bench.fake.lost_steps = lost_steps
    residual = await check_home(axis, notes.hub, bench.clock)
    assert residual == pytest.approx(lost_steps * UNIT_PER_STEP[bench.kind], abs=1e-9)
    assert notes.events == [expected]
    assert f"{residual:.5f} {'mm' if bench.kind == 'linear' else 'deg'} ({lost_steps:.2f} steps)" in notes.text
    assert bench.mechanical == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("kind", ["rotary"])
@pytest.mark.parametrize("place", [-40.0, -5.0, 0.0, 12.0, 40.0])
async def test_a_home_check_never_turns_the_table_round(bench: Bench, place: float) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(place)
    bench.trajectory, began_s = [], bench.now_s
    await check_home(axis, notes.hub, bench.clock)
    assert notes.events == [("info", "home_residual")]
    assert min(bench.trajectory) >= min(place, 0.0) - 1.01
    assert max(bench.trajectory) <= max(place, 16.0) + 0.01
    assert bench.now_s - began_s < 60.0


async def test_the_limit_of_a_home_check_is_the_callers(bench: Bench) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(30.0)
    bench.fake.lost_steps = 4.0
    await check_home(axis, notes.hub, bench.clock, limit_steps=5.0)
    assert notes.events == [("info", "home_residual")]


async def test_an_axis_without_scale_is_homed_and_has_no_residual(bench: Bench) -> None:
    notes = IdentityPoint()
    await bench.axis.open()
    assert math.isnan(await check_home(bench.axis, notes.hub, bench.clock))
    assert await bench.axis.homed()
    assert notes.events == [("warning", "homed")]


async def test_a_stage_whose_motor_went_off_is_approached_again_from_below(bench: Bench) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(30.0)
    await bench.clock.sleep_until(bench.clock.now_ns() + to_ns(120))
    assert (await bench.position()).quality is Quality.STALE
    bench.trajectory = []
    await prepare_axes({"linear": axis}, {"linear": 30.0}, notes.hub, bench.clock)
    assert (await bench.position()).quality is Quality.GOOD
    assert min(bench.trajectory) == pytest.approx(30.0 - OVERSHOOT["linear"], abs=0.01)
    assert bench.mechanical == pytest.approx(30.0, abs=1e-4)
    assert notes.events == [("info", "re-approached")]
    assert "motor off" in notes.text


async def test_a_stage_with_current_in_its_place_is_left_alone(bench: Bench) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(30.0)
    moves = bench.tap.count("move")
    await prepare_axes({"linear": axis}, {"linear": 30.0}, notes.hub, bench.clock)
    assert (bench.tap.count("move"), notes.events) == (moves, [])


async def test_an_axis_the_plan_never_moved_is_left_alone(bench: Bench) -> None:
    notes = IdentityPoint()
    await bench.axis.open()
    await prepare_axes({"linear": bench.axis}, {}, notes.hub, bench.clock)
    assert (bench.tap.count("move"), notes.events) == (0, [])


async def test_a_stage_stopped_on_its_way_is_brought_to_its_place(bench: Bench) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(20.0)
    await prepare_axes({"linear": axis}, {"linear": 30.0}, notes.hub, bench.clock)
    assert bench.mechanical == pytest.approx(30.0, abs=1e-4)
    assert "stands at 20.0000 mm" in notes.text


async def test_a_stage_that_lost_its_scale_is_homed_before_it_is_approached(bench: Bench) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(30.0)
    bench.fake.power_cycle()
    await prepare_axes({"linear": axis}, {"linear": 30.0}, notes.hub, bench.clock)
    assert bench.mechanical == pytest.approx(30.0, abs=1e-4)
    assert (await bench.position()).value == pytest.approx(30.0, abs=1e-9)
    assert "not homed" in notes.text


async def test_an_alarm_is_not_moved_away(bench: Bench) -> None:
    axis, notes = await bench.ready(), IdentityPoint()
    await axis.move_to(30.0)
    bench.fake.alarm = True
    with pytest.raises(DeviceFault, match="alarm"):
        await prepare_axes({"linear": axis}, {"linear": 30.0}, notes.hub, bench.clock)
    assert notes.events == []
