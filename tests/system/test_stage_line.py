"""The stage driver over a wire that loses and damages, is unplugged and leads elsewhere."""

import asyncio
import re
import threading
import time
from collections.abc import AsyncIterator
from pathlib import Path

import pytest

from thermostand.foundation.errors import DeviceError, DeviceFault, Refused, Unreachable
from thermostand.foundation.readings import Quality

from .stage_bench import Bench, Tap, running_bench


@pytest.fixture
def wire() -> str:
    return "serial"


@pytest.fixture
async def bench(wire: str, tmp_path: Path) -> AsyncIterator[Bench]:
    async with running_bench("linear", wire, tmp_path) as bench:
        yield bench


each_wire = pytest.mark.parametrize("wire", ["serial", "tcp"])


async def test_a_move_whose_acknowledgement_is_lost_is_not_sent_twice(bench: Bench) -> None:
    axis = await bench.ready()
    bench.tap.lost_replies["move"] = 1
    await axis.move_to(10.0)
    assert bench.tap.count("move") == 1
    assert bench.mechanical == pytest.approx(10.0, abs=1e-9)


async def test_a_move_that_never_arrived_is_not_taken_for_the_one_before(bench: Bench) -> None:
    """GETS still names the last command, MOVE; and the way is shorter than any tolerance of the end position."""
    axis = await bench.ready()
    await axis.move_to(10.0)
    bench.tap.lost_requests["move"] = 1
    await axis.move_to(10.6)
    assert bench.mechanical == pytest.approx(10.6, abs=5e-6)
    assert bench.tap.count("move") == 3
    bench.tap.lost_requests["move"] = 2
    with pytest.raises(Unreachable, match="no answer to move"):
        await axis.move_to(10.602)
    assert (await bench.position()).value == pytest.approx(10.6, abs=5e-6)


async def test_a_homing_that_never_arrived_is_not_taken_for_the_one_before(bench: Bench) -> None:
    """Else ZERO would make wherever the stage stands its home."""
    axis = await bench.ready()
    bench.fake.lost_steps = 40.0
    bench.tap.lost_requests["home"] = 1
    assert await axis.home() == pytest.approx(40 * 0.0025, abs=1e-9)
    assert bench.mechanical == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize("letters", ["home", "zero"])
async def test_a_lost_acknowledgement_does_not_spoil_homing(bench: Bench, letters: str) -> None:
    await bench.axis.open()
    bench.tap.lost_replies[letters] = 1
    assert await bench.axis.home() == pytest.approx(-0.25, abs=1e-9)
    assert bench.tap.count(letters) == 1
    assert (await bench.position()).value == 0


async def test_a_zero_that_never_comes_through_is_a_fault(bench: Bench) -> None:
    await bench.axis.open()
    bench.tap.ignored = {"zero"}
    with pytest.raises(DeviceFault, match=r"it is -100\.00"):
        await bench.axis.home()


@each_wire
async def test_a_noisy_line_changes_nothing_but_the_time_it_takes(bench: Bench) -> None:
    bench.faults.flip, bench.faults.junk, bench.faults.drop = 0.06, 0.05, 0.005
    await bench.ready()
    for target in (12.3456, 3.0, 3.002):
        await bench.axis.move_to(target)
        assert bench.mechanical == pytest.approx(target, abs=5e-6)
    assert sum(bench.faults.injected.values()) > 5


async def test_a_silent_controller_is_reported_in_bounded_time_and_answers_again_by_itself(bench: Bench) -> None:
    axis = await bench.ready()
    bench.faults.silent = True
    begun_s = time.monotonic()
    with pytest.raises(Unreachable, match=r"^linear: "):
        await axis.read()
    assert time.monotonic() - begun_s < 10.0
    bench.faults.silent = False
    bench.tap.requests.clear()
    assert (await bench.position()).value == 0
    assert bench.tap.requests[0] == "gser"


async def test_a_port_unplugged_and_plugged_in_again_is_read_again_its_identity_first(bench: Bench) -> None:
    axis = await bench.ready()
    bench.unplug()
    for _ in range(2):
        with pytest.raises(Unreachable, match=r"^linear: "):
            await axis.read()
    bench.tap.requests.clear()
    bench.plug(bench.tap)
    assert (await bench.position()).quality is Quality.GOOD
    assert bench.tap.requests == ["gser", "geti", "gfwv", "geng", "gmov", "gpwr", "gets"]


async def test_what_somebody_has_set_otherwise_meanwhile_is_reported_when_it_is_back(bench: Bench) -> None:
    axis = await bench.ready()
    assert [each.reason for each in await axis.read()] == ["", "", ""]
    bench.unplug()
    bench.set_speed(500)
    bench.set_power_off(None)
    with pytest.raises(Unreachable):
        await axis.read()
    bench.plug(bench.tap)
    position, _, homed = await axis.read()
    assert position.quality is homed.quality is Quality.GOOD
    assert re.findall(r"\d+ steps/s|\d+ s\b|none", homed.reason) == ["500 steps/s", "1000 steps/s", "none", "60 s"]


async def test_speeds_in_thousandths_are_read_as_such_and_a_move_has_the_time_it_takes(bench: Bench) -> None:
    axis = await bench.ready()
    bench.set_thousandths()
    bench.set_speed(100_000)
    bench.unplug()
    with pytest.raises(Unreachable):
        await axis.read()
    bench.plug(bench.tap)
    *_, homed = await axis.read()
    assert "speed 100 steps/s, not 1000" in homed.reason
    await axis.move_to(6.0)  # takes longer than at 1000 steps/s
    assert (await bench.position()).value == pytest.approx(6.0)


@pytest.mark.parametrize("wire", ["tcp"])
async def test_a_gateway_that_hung_up_costs_one_reading(bench: Bench) -> None:
    axis = await bench.ready()
    bench.unplug()
    bench.plug(bench.tap, "tcp", int(bench.address.rpartition(":")[2]))
    with pytest.raises(Unreachable, match=r"^linear: 127\.0\.0\.1:"):
        await axis.read()
    assert (await bench.position()).quality is Quality.GOOD


async def test_another_controller_on_the_same_port_gets_no_command(bench: Bench) -> None:
    axis = await bench.ready()
    bench.unplug()
    stranger = Tap(bench.controller(9999).engine())
    bench.plug(stranger)
    outcomes: list[str] = []
    for verb in (lambda: axis.move_to(5.0), axis.home, axis.make_safe, axis.read, axis.make_safe):
        with pytest.raises(DeviceError) as caught:
            await verb()
        outcomes.append(type(caught.value).__name__)
    assert outcomes == ["Unreachable", *["Refused"] * 4]
    assert set(stranger.requests) == {"gser"}


async def test_a_port_lost_with_the_acknowledgement_of_a_move_leads_to_no_stranger(bench: Bench) -> None:
    axis = await bench.ready()
    stranger = Tap(bench.controller(9999).engine())

    class Thief(Tap):
        """Takes the plug out when a MOVE arrives and puts a stranger in."""

        def feed(self, data: bytes) -> bytes:
            if data.lstrip(b"\0").startswith(b"move"):
                thread = threading.Thread(target=lambda: (bench.unplug(), bench.plug(stranger), swapped.set()))
                thread.start()
                return b""
            return super().feed(data)

    swapped = threading.Event()
    bench.unplug()
    bench.plug(Thief(bench.fake.engine()))
    with pytest.raises(Unreachable):
        await axis.read()
    with pytest.raises(DeviceError):
        await axis.move_to(5.0)
    assert await asyncio.to_thread(swapped.wait, 5)
    with pytest.raises(Refused, match="controller 9999"):
        await axis.move_to(5.0)
    assert set(stranger.requests) == {"gser"}


async def test_an_axis_may_be_closed_twice_and_opened_again(bench: Bench) -> None:
    axis = await bench.ready()
    await axis.close()
    await axis.close()
    with pytest.raises(Unreachable, match=r"^linear: not open$"):
        await axis.read()
    await axis.open()
    assert await axis.homed()


async def test_the_port_is_free_after_a_refused_opening(bench: Bench) -> None:
    stranger = bench.another("rotary", 1)
    with pytest.raises(Refused):
        await stranger.open()
    await bench.axis.open()
    await stranger.close()
