"""What the guard does when a rule objects; the rules and the stand's wires have tests of their own."""

import asyncio
from dataclasses import replace

import pytest

from tests.stand.guard_bench import Bench, NotedFile
from thermostand.foundation.clock import VirtualClock, WallClock, block_until, to_ns
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Reading
from thermostand.stand.safety.fault import Fault


async def test_a_guard_that_fails_aborts_and_makes_safe():
    bench = Bench("hold")
    bench.broken = KeyError("channel")
    time = asyncio.create_task(bench.clock.run())
    with pytest.raises(KeyError):
        await bench.guard.run()
    await bench.safety.wait_until_tried()
    time.cancel()
    assert bench.log == ["stop guard_failed", "revoke", "safe"]
    text = "the guard failed (KeyError: 'channel')"
    assert [(event.level, event.kind, event.text) for event in bench.events] == [("error", "guard.guard_failed", text)]


async def test_permits_may_be_renewed_while_every_rule_holds_and_the_guard_looks():
    bench = Bench("abort", "hold", "warn")
    assert not bench.guard.may_permit()
    assert not bench.guard.is_on_time
    assert await bench.run_for(11.5)
    assert bench.guard.may_permit()
    assert bench.guard.is_on_time
    bench.clock = VirtualClock(bench.clock.now_ns() + to_ns(2.1))
    bench.guard.clock = bench.clock
    assert not bench.guard.may_permit()  # nobody has looked for more than two periods
    assert not bench.guard.is_on_time
    assert bench.log == []


async def test_an_abort_latches_then_makes_safe_and_ends_the_watch():
    bench = Bench("hold", "abort")
    bench.objecting = {0, 1}
    assert not await bench.run_for(3)
    assert bench.log == ["stop rule1", "revoke", "safe"]
    assert not bench.guard.is_on_time
    assert [(event.level, event.kind, event.text) for event in bench.events] == [("error", "guard.rule1", "it is so")]


async def test_a_hold_latches_then_makes_safe_once_and_renews_nothing():
    bench = Bench("hold", "hold")
    bench.objecting = {1}
    assert await bench.run_for(20)
    assert bench.log == ["hold rule1", "revoke", "safe"]
    assert bench.guard.held == Fault("rule1", "it is so", "hold")


async def test_what_is_still_wrong_when_it_is_cleared_holds_before_anything_can_move():
    bench = Bench("hold")
    bench.objecting = {0}
    await bench.run_for(2)
    bench.clear()
    assert bench.guard.held == Fault("rule0", "it is so", "hold")
    assert "it is so" in bench.guard.describe_remaining_faults()
    assert bench.log == ["hold rule0", "revoke", "safe", "hold rule0", "revoke"]
    await bench.run_for(2)
    assert bench.log[5:] == ["safe"]


async def test_a_hold_that_is_not_confirmed_safe_is_made_safe_again_every_minute_until_it_is():
    bench = Bench("hold")
    bench.actuator.failure = "no answer"
    bench.objecting = {0}
    await bench.run_for(130)
    assert bench.log == ["hold rule0", "revoke"] + ["safe"] * 3
    bench.actuator.failure = ""
    await bench.run_for(130)
    assert bench.log == ["hold rule0", "revoke"] + ["safe"] * 4
    assert [event.kind for event in bench.events] == ["guard.rule0", "not_confirmed_safe", "confirmed_safe"]


async def test_a_run_that_cannot_be_ended_does_not_keep_the_stand_from_being_made_safe():
    bench = Bench("abort")

    def fails(fault: Fault) -> None:
        raise KeyError(fault.rule)

    bench.guard.stop = fails
    bench.objecting = {0}
    with pytest.raises(KeyError):
        bench.guard.look()
    await bench.safety.wait_until_tried()
    assert bench.log == ["revoke", "safe"]


async def test_a_guard_that_was_kept_from_looking_says_so():
    """Real time goes on while somebody computes in the event loop."""
    bench = Bench("hold", clock=WallClock())
    bench.guard.period_s = 0.5
    watching = asyncio.create_task(bench.guard.run())
    while not bench.guard.may_permit():
        await asyncio.sleep(0)
    block_until(bench.clock, bench.clock.now_ns() + to_ns(1.2))
    assert not bench.guard.may_permit()
    while not bench.events:
        await asyncio.sleep(0)
    watching.cancel()
    await asyncio.wait([watching])
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "guard_late")]
    assert bench.events[0].text.startswith("the guard has not")
    assert bench.events[0].data["gap_s"] > 1.2


async def test_after_a_late_look_permits_wait_for_readings_taken_since():
    """A reading whose reply lay in a buffer meanwhile does not count either."""
    bench = Bench("hold")
    bench.guard.vital = ("regulator.pv", "thermometers.air")

    def read(*channels: str) -> None:
        now_ns = bench.clock.now_ns()
        for channel in channels:
            bench.hub.publish(Batch("device", now_ns, (Reading(channel, 24.0, "degC", now_ns),)))

    read("regulator.pv", "thermometers.air")
    await bench.run_for(3)
    assert bench.guard.may_permit()
    bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + to_ns(13))
    assert bench.guard.look()
    assert [event.kind for event in bench.events] == ["guard_late"]
    read("regulator.pv", "thermometers.air")
    assert not bench.guard.may_permit()
    await bench.run_for(1.5)
    assert not bench.guard.may_permit()
    read("regulator.pv")
    assert not bench.guard.may_permit()
    read("thermometers.air")
    assert bench.guard.may_permit()


async def test_after_a_late_look_what_could_not_be_renewed_has_time_to_be():
    bench = Bench("abort", "hold")
    bench.guard.watches[0].after_gap_s = 5.0
    await bench.run_for(3)
    bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + to_ns(60))
    bench.objecting = {0}
    assert bench.guard.look()
    await bench.run_for(4)
    assert bench.log == []
    bench.objecting = set()
    await bench.run_for(10)
    assert bench.log == []
    bench.objecting = {0}
    await bench.run_for(2)
    assert "stop rule0" in bench.log


async def test_after_a_late_look_what_is_not_renewed_in_time_trips_and_other_rules_do_at_once():
    for objecting, within_s, log in (({0}, 4, False), ({0}, 7, True), ({1}, 1, True)):
        bench = Bench("abort", "abort")
        bench.guard.watches[0].after_gap_s = 5.0
        await bench.run_for(3)
        bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + to_ns(60))
        bench.objecting = objecting
        bench.guard.look()
        await bench.run_for(within_s)
        assert bool(bench.log) == log


async def test_a_hold_does_not_end_because_its_cause_is_passed_over_after_a_late_look():
    """A disk that hangs, and a process that was stopped meanwhile."""
    bench = Bench("hold")
    bench.guard.watches[0].ends_itself, bench.guard.watches[0].after_gap_s = True, 5.0
    bench.objecting = {0}
    await bench.run_for(3)
    bench.clock = bench.guard.clock = VirtualClock(bench.clock.now_ns() + to_ns(60))
    await bench.run_for(10)
    assert bench.guard.held is not None
    assert bench.log == ["hold rule0", "revoke", "safe"]
    bench.objecting = set()
    await bench.run_for(2)
    assert bench.log[3:] == ["release"]


async def test_a_hold_that_ends_by_itself_ends_when_the_stand_is_safe_and_nothing_is_wrong_three_times_an_hour():
    bench = Bench("hold")
    bench.guard.watches[0].ends_itself = True
    bench.actuator.failure = "no answer"
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = set()
    await bench.run_for(30)
    assert bench.guard.held is not None  # not confirmed safe
    bench.actuator.failure = ""
    await bench.run_for(60)
    assert bench.log == ["hold rule0", "revoke", "safe", "safe", "release"]
    for _ in range(3):
        bench.objecting = {0}
        await bench.run_for(2)
        bench.objecting = set()
        await bench.run_for(2)
    assert bench.log.count("release") == 3
    assert bench.guard.held is not None
    assert bench.events[-1].kind == "hold_stays"
    assert bench.events[-1].text == bench.guard.held.text
    assert bench.guard.held.text.startswith("it is so; ")
    await bench.run_for(7200)
    assert bench.log.count("release") == 3
    bench.clear()
    assert bench.guard.held is None


async def test_a_hold_for_the_disk_ends_with_the_recording_and_is_not_reported_as_over():
    bench = Bench("hold")
    bench.guard.recording_ended()  # nothing is held
    bench.latch.trip(held := Fault("not_recorded", "3 s are not on the disk", "hold"))
    bench.guard.recording_ended()
    assert bench.guard.held is not None  # for an operator
    bench.latch.trip(replace(held, ends_itself=True))
    bench.guard.recording_ended()
    assert (bench.guard.held, bench.log) == (None, ["release"])
    (ended,) = bench.events
    assert ended.kind == "hold_ended"
    assert ended.text.startswith("the recording ended")


async def test_a_fault_that_needs_an_operator_replaces_a_hold_that_would_end_by_itself():
    bench = Bench("hold", "hold")
    bench.guard.watches[0].ends_itself = True
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = {1}
    await bench.run_for(2)
    bench.objecting = set()
    await bench.run_for(10)
    assert bench.guard.held == Fault("rule1", "it is so", "hold")


async def test_only_an_operator_clears_a_hold_and_what_is_still_wrong_trips_again():
    bench = Bench("hold")
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = set()
    await bench.run_for(10)
    assert bench.guard.held is not None
    assert not bench.guard.may_permit()
    assert bench.log == ["hold rule0", "revoke", "safe"]
    bench.clear()
    await bench.run_for(1)
    assert bench.guard.may_permit()
    bench.objecting = {0}
    await bench.run_for(2)
    bench.clear()
    await bench.run_for(2)
    assert bench.log == ["hold rule0", "revoke", "safe"] * 3
    assert [event.kind for event in bench.events] == ["guard.rule0"] * 3


async def test_clearing_restarts_the_grace_time_of_every_rule():
    bench = Bench("hold")
    watch = bench.guard.watches[0]
    watch.grace_s = 10.0
    bench.objecting = {0}
    await bench.run_for(8)
    bench.guard.reset_grace_times()
    assert "it is so" in bench.guard.describe_remaining_faults()
    await bench.run_for(8)
    assert bench.guard.held is None
    await bench.run_for(4)
    assert bench.guard.held is not None
    bench.objecting = set()
    bench.clear()
    await bench.run_for(1)
    assert bench.guard.describe_remaining_faults() == ""


async def test_a_fault_that_aborts_does_so_during_a_hold():
    bench = Bench("hold", "abort")
    bench.objecting = {0}
    await bench.run_for(2)
    bench.objecting = {0, 1}
    assert not await bench.run_for(2)
    assert bench.log == ["hold rule0", "revoke", "safe", "stop rule1", "revoke", "safe"]


async def test_a_guard_that_keeps_on_looks_after_an_abort_which_stays_until_it_is_cleared():
    bench = Bench("hold", "abort")
    bench.guard.keeps_running = True
    bench.objecting = {1}
    assert await bench.run_for(5)
    assert bench.log == ["stop rule1", "revoke", "safe"]  # once, though it still objects
    bench.objecting = {0, 1}
    assert await bench.run_for(2)
    assert bench.log == ["stop rule1", "revoke", "safe"]
    assert not bench.guard.may_permit()
    assert bench.guard.is_on_time
    bench.clear()
    assert bench.guard.held == Fault("rule0", "it is so", "hold")  # still wrong: held again, before anything moves
    bench.objecting = set()
    bench.clear()
    assert await bench.run_for(2)
    assert bench.guard.may_permit()


async def test_what_only_an_operator_ends_is_latched_before_anything_else_is_done():
    for action, ends_itself, log in (
        ("abort", False, ["latch rule0", "stop rule0", "revoke"]),
        ("hold", False, ["latch rule0", "hold rule0", "revoke"]),
        ("hold", True, ["hold rule0", "revoke"]),
    ):
        bench = Bench(action)
        bench.guard.watches[0].ends_itself = ends_itself
        bench.latch.file = NotedFile(bench.log)
        bench.objecting = {0}
        assert bench.guard.look() is (action == "hold")
        assert bench.log == log
        await bench.safety.wait_until_tried()


async def test_without_a_way_to_hold_every_trip_aborts():
    bench = Bench("hold", can_hold=False)
    bench.objecting = {0}
    assert not await bench.run_for(2)
    assert bench.log == ["stop rule0", "revoke", "safe"]


async def test_a_warning_is_reported_when_it_begins_and_changes_nothing():
    bench = Bench("warn")
    for objecting in ({0}, {0}, set[int](), {0}):
        bench.objecting = objecting
        assert bench.guard.look()
    assert bench.log == []
    assert [(event.level, event.kind) for event in bench.events] == [("warning", "guard.rule0")] * 2
