"""Which rule of the guard holds a run for a device error that a step has met."""

import pytest

from tests.stand.guard_bench import Bench
from thermostand.foundation.errors import (
    DeviceAlarm,
    DeviceError,
    DeviceFault,
    GarbledReply,
    Occupied,
    Refused,
    Superseded,
    Unreachable,
)
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.stand.guarding.step_errors import StepErrors

KINDS = {"flap": "flap", "linear": "axis", "regulator": "regulator", "relays": "relays", "camera": "camera"}
TABLE = [
    (DeviceAlarm("linear", ""), "stage_alarm", False),
    (DeviceFault("linear", ""), "device_fault", False),
    (Refused("linear", ""), "device_fault", False),
    (Unreachable("linear", ""), "device_lost", True),
    (Unreachable("flap", ""), "device_lost", True),
    (GarbledReply("flap", ""), "device_lost", True),
    (DeviceFault("flap", ""), "device_fault", False),
    (Unreachable("regulator", ""), "device_lost", True),
    (Refused("regulator", ""), "device_fault", False),
    (Occupied("regulator", ""), "device_fault", False),
    (DeviceFault("relays.heat", ""), "device_fault", False),
    (Superseded("flap", ""), "device_fault", False),
    (Unreachable("camera", ""), "device_lost", False),
    (Unreachable("unknown", ""), "device_lost", False),
]


def bench_of(*actions: str) -> Bench:
    bench, met = Bench(*actions), StepErrors(KINDS)
    bench.guard.step_errors = met
    bench.guard.watches = (*bench.guard.watches, *met.watches)
    bench.hub.subscribe(met)
    return bench


def read(bench: Bench, device: str) -> None:
    reading = Reading(f"{device}.position", 0.0, "1", bench.clock.now_ns())
    bench.hub.publish(Batch(device, bench.clock.now_ns(), (reading,)))


@pytest.mark.parametrize(("error", "rule", "ends_itself"), TABLE, ids=lambda each: type(each).__name__)
async def test_each_error_holds_at_once_by_its_rule_and_ends_as_that_does(
    error: DeviceError, rule: str, ends_itself: bool
):
    bench = bench_of("hold")
    bench.guard.handle_step_error(error)
    assert bench.guard.held is not None
    assert (bench.guard.held.rule, bench.guard.held.action, bench.guard.held.ends_itself) == (rule, "hold", ends_itself)
    await bench.run_for(3)
    bad = bad_reading(f"{error.device}.position", "1", bench.clock.now_ns(), "silent", "wire")
    bench.hub.publish(Batch(error.device, bench.clock.now_ns(), (bad,)))
    await bench.run_for(3)
    assert bench.guard.held is not None
    read(bench, error.device)
    await bench.run_for(3)
    assert (bench.guard.held is None) is ends_itself
    bench.clear()
    assert bench.guard.held is None


async def test_what_does_not_answer_yet_holds_again_at_once_when_it_is_cleared():
    bench = bench_of("hold")
    bench.guard.handle_step_error(Unreachable("flap", "gone"))
    bench.clear()
    assert bench.log == ["hold device_lost", "revoke", "hold device_lost", "revoke"]


async def test_a_device_that_is_lost_again_and_again_needs_an_operator():
    bench = bench_of("hold")
    for times in range(4):
        bench.guard.handle_step_error(Unreachable("flap", "gone"))
        read(bench, "flap")
        await bench.run_for(3)
        assert (bench.guard.held is not None) is (times == 3)
    assert bench.guard.held is not None
    assert not bench.guard.held.ends_itself


async def test_what_the_guards_table_aborts_for_aborts_also_in_the_hold_of_a_step():
    bench = bench_of("abort")
    bench.guard.handle_step_error(Unreachable("regulator", "silent"))
    await bench.run_for(2)
    bench.objecting = {0}
    assert not await bench.run_for(2)
    assert [line for line in bench.log if line != "revoke"] == ["hold device_lost", "safe", "stop rule0", "safe"]
