"""The stage driver against the fake controller over real wires; time is virtual, so that a move costs none."""

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from thermostand.drivers.devices.motion.stage import AxisSettings
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import DeviceFault, Refused
from thermostand.foundation.readings import Quality, Reading

from .stage_bench import OVERSHOOT, START_STEPS, UNIT_PER_STEP, Bench, Kind, running_bench


@pytest.fixture
def kind() -> Kind:
    return "linear"


@pytest.fixture
def wire() -> str:
    return "serial"


@pytest.fixture
async def bench(kind: Kind, wire: str, tmp_path: Path) -> AsyncIterator[Bench]:
    async with running_bench(kind, wire, tmp_path) as bench:
        yield bench


each_wire = pytest.mark.parametrize("wire", ["serial", "tcp"])
each_kind = pytest.mark.parametrize("kind", ["linear", "rotary"])


# Homing and moving


@each_wire
@each_kind
async def test_homing_makes_its_end_zero_and_tells_where_the_scale_had_it(bench: Bench) -> None:
    """The stage stands to the right of its home and counts from there."""
    await bench.axis.open()
    assert not await bench.axis.homed()
    assert await bench.axis.home() == pytest.approx(-START_STEPS[bench.kind] * UNIT_PER_STEP[bench.kind], abs=1e-9)
    assert await bench.axis.homed()
    assert bench.mechanical == pytest.approx(0.0, abs=1e-9)
    assert await bench.position() == Reading(
        f"{bench.kind}.position", 0.0, "mm" if bench.kind == "linear" else "deg", bench.clock.now_ns()
    )


async def test_steps_lost_since_are_the_residual_of_the_next_homing(bench: Bench) -> None:
    axis = await bench.ready()
    await axis.move_to(30.0)
    assert await axis.home() == pytest.approx(0.0, abs=1e-9)
    await axis.move_to(30.0)
    bench.fake.lost_steps = 40.0
    assert await axis.home() == pytest.approx(40 * 0.0025, abs=1e-9)
    assert bench.mechanical == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(
    ("kind", "targets"),
    [
        ("linear", [12.0, 5.0, 5.001, 5.0009, 5.0009, 0.0, 0.3, 60.0, 59.9999, 0.0]),
        ("rotary", [0.05, 40.0, -40.0, -39.99, 0.0, 12.5]),
    ],
)
async def test_every_move_ends_upwards_by_the_whole_overshoot(bench: Bench, targets: list[float]) -> None:
    await bench.ready()
    overshoot, half_microstep = OVERSHOOT[bench.kind], UNIT_PER_STEP[bench.kind] / 256 / 2
    for target in targets:
        trajectory = await bench.move(target)
        lowest = max(index for index, place in enumerate(trajectory) if place == min(trajectory))
        assert trajectory[-1] - trajectory[lowest] >= overshoot * 0.999, f"to {target}"
        assert all(
            after >= before for before, after in zip(trajectory[lowest:], trajectory[lowest + 1 :], strict=False)
        )
        assert min(trajectory) >= min(trajectory[0], target - overshoot) - 1.001 * half_microstep
        assert max(trajectory) <= max(trajectory[0], target) + 1.001 * half_microstep


@each_kind
async def test_a_position_is_reached_and_read_to_half_a_microstep(bench: Bench) -> None:
    axis = await bench.ready()
    half_microstep = UNIT_PER_STEP[bench.kind] / 256 / 2
    for target in (1.0, 7.123456789, 7.12345, 33.3333333, 0.0000123):
        await axis.move_to(target)
        assert bench.mechanical == pytest.approx(target, abs=half_microstep * 1.001)
        reading = await bench.position()
        assert reading.value == pytest.approx(bench.mechanical, abs=1e-9)
        assert reading.quality is Quality.GOOD


@pytest.mark.parametrize("kind", ["rotary"])
async def test_places_below_zero_are_as_exact(bench: Bench) -> None:
    axis = await bench.ready()
    for target in (-0.0049, -39.98765):
        await axis.move_to(target)
        assert bench.mechanical == pytest.approx(target, abs=0.01 / 256 / 2 * 1.001)
        assert (await bench.position()).value == pytest.approx(bench.mechanical, abs=1e-9)


async def test_a_moving_stage_says_so(bench: Bench) -> None:
    axis = await bench.ready()
    readings: list[Reading] = []

    async def look() -> None:
        readings.extend(await axis.read())

    await asyncio.gather(axis.move_to(20.0), bench.after(3.0, look))
    position, moving, homed = readings
    assert 5 < position.value < 8
    assert (moving.value, homed.value) == (1.0, 1.0)


# What is refused before anything moves


@pytest.mark.parametrize("target", [-0.001, 299.951, 1e9, float("nan"), float("inf")])
async def test_a_target_outside_the_limits_is_refused_and_nothing_is_sent(bench: Bench, target: float) -> None:
    axis = await bench.ready()
    before = list(bench.tap.requests)
    with pytest.raises(Refused, match=r"^linear: .* limits 0\.0\.\.299\.95 mm$"):
        await axis.move_to(target)
    assert bench.tap.requests == before


async def test_a_stage_that_is_not_homed_refuses_to_move_and_its_position_is_suspect(bench: Bench) -> None:
    await bench.axis.open()
    with pytest.raises(Refused, match="not homed"):
        await bench.axis.move_to(1.0)
    assert bench.tap.count("move") == 0
    reading = await bench.position()
    assert (reading.quality, reading.reason) == (Quality.STALE, "not homed")


async def test_after_a_power_cycle_it_refuses_until_it_is_homed(bench: Bench) -> None:
    axis = await bench.ready()
    await axis.move_to(10.0)
    bench.fake.power_cycle()
    assert (await bench.position()).quality is Quality.STALE
    assert not await axis.homed()
    with pytest.raises(Refused, match="not homed"):
        await axis.move_to(10.0)
    await axis.home()
    await axis.move_to(10.0)
    assert bench.mechanical == pytest.approx(10.0, abs=1e-9)


@each_wire
async def test_another_controller_is_refused_and_reported_by_its_number(bench: Bench) -> None:
    other = bench.another("rotary", 4102)
    for verb in (other.open, other.read, other.home, other.make_safe):
        with pytest.raises(Refused, match=r"^rotary: controller 4101 answers at .*, expected 4102$"):
            await verb()
    await other.close()
    assert set(bench.tap.requests) == {"gser"}


async def test_another_microstep_division_is_refused(bench: Bench) -> None:
    bench.change_microsteps(8)
    with pytest.raises(Refused, match=r"microstep mode 8, expected 9 \(1/256\)"):
        await bench.axis.open()
    assert "home" not in bench.tap.requests


async def test_a_division_that_a_power_cycle_brought_is_found_before_homing(bench: Bench) -> None:
    axis = await bench.ready()
    bench.change_microsteps(8)
    bench.fake.power_cycle()
    with pytest.raises(Refused, match="microstep mode 8"):
        await axis.home()
    assert bench.tap.count("home") == 1


def test_an_unknown_profile_is_a_mistake_of_the_caller() -> None:
    with pytest.raises(ValueError, match="profile"):
        AxisSettings.model_validate(
            {"address": "serial:none", "serial_number": 1, "profile": "8MT999", "limits": (0, 1)}
        )


# Trouble on the way


async def test_a_limit_switch_ends_the_move_and_the_way_back_is_open(bench: Bench) -> None:
    """The right switch closes at 298.75 mm, below the software limit of this test."""
    axis = await bench.ready()
    await axis.move_to(290.0)
    for _ in range(2):
        with pytest.raises(DeviceFault, match=r"^linear: .* step \d+\.\d\d instead of 119800"):
            await axis.move_to(299.5)
        assert bench.mechanical == pytest.approx(298.75, abs=0.003)
    assert (await bench.position()).value == pytest.approx(bench.mechanical, abs=0.003)
    trajectory = await bench.move(290.0)
    assert max(trajectory) <= 298.754
    assert bench.mechanical == pytest.approx(290.0, abs=1e-5)


async def test_a_switch_that_closes_in_the_middle_stops_the_move(bench: Bench) -> None:
    axis = await bench.ready()

    def close() -> None:
        bench.fake.limit = "right"

    with pytest.raises(DeviceFault, match="at a limit switch"):
        await asyncio.gather(axis.move_to(100.0), bench.after(5.0, close))
    assert 10 < bench.mechanical < 13
    assert (await bench.position()).value == pytest.approx(bench.mechanical, abs=1e-9)


async def test_an_alarm_ends_the_move_and_is_left_for_the_operator(bench: Bench) -> None:
    axis = await bench.ready()

    def alarm() -> None:
        bench.fake.alarm = True

    with pytest.raises(DeviceFault, match="controller alarm, flags 0x00000040"):
        await asyncio.gather(axis.move_to(100.0), bench.after(5.0, alarm))
    reading = await bench.position()
    assert (reading.quality, reading.reason) == (Quality.STALE, "controller alarm, flags 0x00000040")
    moves, homings = bench.tap.count("move"), bench.tap.count("home")
    for verb in (lambda: axis.move_to(1.0), axis.home):
        with pytest.raises(DeviceFault, match="must be looked into"):
            await verb()
    await axis.make_safe()
    assert bench.fake.alarm
    assert (bench.tap.count("move"), bench.tap.count("home"), bench.tap.count("stop")) == (moves, homings, 0)


async def test_lost_steps_that_the_controller_notices_stop_the_stage_at_once(bench: Bench) -> None:
    """CTP_ERROR does not stop the motor by itself."""
    axis = await bench.ready()

    def notice() -> None:
        bench.fake.ctp_error = True

    with pytest.raises(DeviceFault, match="flags 0x00000080"):
        await asyncio.gather(axis.move_to(100.0), bench.after(5.0, notice))
    assert (await bench.position()).quality is Quality.STALE
    assert bench.mechanical < 13.5
    assert bench.fake.ctp_error
    assert not await axis.homed()


async def test_the_wrong_limit_switch_is_an_alarm(bench: Bench) -> None:
    axis = await bench.ready()
    bench.fake.wrong_limit = True
    await axis.move_to(290.0)
    with pytest.raises(DeviceFault, match="flags 0x00008040"):
        await axis.move_to(299.5)


async def test_homing_that_runs_against_a_wrong_end_is_a_fault(bench: Bench) -> None:
    await bench.axis.open()

    def close() -> None:
        bench.fake.limit = "right"

    with pytest.raises(DeviceFault, match="without a home position"):
        await asyncio.gather(bench.axis.home(), bench.after(2.0, close))
    assert bench.tap.count("zero") == 0


async def test_a_move_that_never_ends_is_stopped_softly_in_time(bench: Bench) -> None:
    axis = await bench.ready()
    bench.fake.endless = True
    begun_s = bench.now_s
    with pytest.raises(DeviceFault, match="still moving after 8 s; stopped"):
        await axis.move_to(10.0)  # 4000 steps at 1000 steps/s, times 1.5, and 2 s
    assert bench.now_s - begun_s == pytest.approx(8.0, abs=0.5)
    assert (await bench.position()).value == pytest.approx(10.0, abs=1e-9)
    assert (bench.tap.count("sstp"), bench.tap.count("stop")) == (1, 0)


async def test_a_motor_without_current_is_suspect_and_the_same_target_approaches_again(bench: Bench) -> None:
    """The rotor falls into the next full step, here by 0.4 of one."""
    axis = await bench.ready()
    await axis.move_to(10.001)
    bench.fake.motor_off = True
    assert bench.mechanical == pytest.approx(10.0, abs=1e-9)
    reading = await bench.position()
    assert (reading.quality, reading.value) == (Quality.STALE, pytest.approx(10.001, abs=5e-6))
    assert "motor off" in reading.reason
    trajectory = await bench.move(10.001)
    assert min(trajectory) == pytest.approx(9.501, abs=1e-4)
    assert bench.mechanical == pytest.approx(10.001, abs=5e-6)
    assert (await bench.position()).quality is Quality.GOOD


async def test_the_profile_switches_the_motor_off_after_a_minute_and_the_reading_tells(bench: Bench) -> None:
    axis = await bench.ready()
    await axis.move_to(10.001)
    await bench.clock.sleep_until(bench.clock.now_ns() + to_ns(59.0))
    assert (await bench.position()).quality is Quality.GOOD
    await bench.clock.sleep_until(bench.clock.now_ns() + to_ns(2.0))
    assert (await bench.position()).quality is Quality.STALE
