"""The guard in whole runs, over every wire in virtual time: a trip is latched, made safe, recorded and noted, and only
an operator clears it."""

import asyncio
import os
import signal
from collections.abc import Callable, Coroutine
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import pytest

from tests.daemon_queries import ask, ask_status
from tests.journals import read_lines
from tests.nightly import mark_nightly
from tests.system.conftest import AS_INSTALLED
from tests.system.test_guard_wire import write_by_another_master
from tests.system.test_run import at_step, fault
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import SessionError, StandTripped
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.recording.reading.session import Session
from thermostand.stand.config.alerts_section import AlertsConfig
from thermostand.stand.running.memory.entries import Reset, Tripped
from thermostand.stand.running.memory.journal import JOURNAL_NAME
from thermostand.stand.running.order import Order
from thermostand.stand.running.resume import load_interruption
from thermostand.stand.service.run import Interrupted, run_virtual

POLLED = AS_INSTALLED

LONG_SOAK = """
name: soak
experiments:
  - thermal_cycle:
      table_position: {linear: 2, rotary: 1}
      reference_degC: 40
      equilibrium_s: 400000
      set_points_degC: [41]
      reference_frames: 1
      frames_per_point: 1
"""
TELL = 'printf "%s\\n" "$1" >> "$0"'


@dataclass
class Watcher:
    """What a run says, and waiting for it on the stand's time."""

    events: list[Event] = field(default_factory=list[Event])
    now_ns: int = 0
    _changed: asyncio.Event = field(default_factory=asyncio.Event)

    def __call__(self, item: Item) -> None:
        if isinstance(item, Event):
            self.events.append(item)
        self.now_ns = max(self.now_ns, item.time_ns if isinstance(item, Event | Batch) else 0)
        self._changed.set()

    async def until(self, condition: Callable[[], bool]) -> None:
        while not condition():
            self._changed.clear()
            await self._changed.wait()

    async def event(self, kind: str, within_s: float) -> Event:
        """The next event of that kind, forgotten with those before it."""
        await self.until(lambda: self.now_ns > 0)
        limit_ns = self.now_ns + to_ns(within_s)
        await self.until(lambda: kind in {event.kind for event in self.events} or self.now_ns > limit_ns)
        kinds = [event.kind for event in self.events]
        assert kind in kinds, f"{kind} did not come within {within_s} s: {kinds}"
        found = self.events[kinds.index(kind)]
        del self.events[: kinds.index(kind) + 1]
        return found

    async def wait(self, duration_s: float) -> None:
        end_ns = self.now_ns + to_ns(duration_s)
        await self.until(lambda: self.now_ns >= end_ns)


def telling(order: Order, path: Path) -> Order:
    """The same, and every alert of its command is written to `path`."""
    alerts = AlertsConfig(command=("/bin/sh", "-c", TELL, str(path)), grace_s=0)
    return replace(order, config=order.config.model_copy(update={"alerts": alerts}))


def trips_of(directory: Path) -> list[str]:
    entries = read_lines((directory / JOURNAL_NAME).read_bytes())[0]
    return [
        entry.rule if isinstance(entry, Tripped) else "reset" for entry in entries if isinstance(entry, Tripped | Reset)
    ]


def check_safe(session: Session) -> None:
    """The last word of every device is that of a stand at rest."""
    for channel in ("regulator.running", "relays.heater_enable", "relays.compressor", "linear.moving"):
        assert session.readings(channel)[1][-1] == 0, channel
    assert session.readings("flap.position")[1][-1] == pytest.approx(0, abs=0.02)


def once_warm(action: Callable[[], object]) -> Callable[[Hub], None]:
    """Do `action` when the regulator's value has first risen to 30 degC."""
    done: list[object] = []

    def follow(item: Item) -> None:
        if isinstance(item, Batch) and not done:
            done.extend(action() for each in item.readings if each.channel == "regulator.pv" and each.value >= 30)

    return lambda hub: hub.subscribe(follow)


@pytest.mark.parametrize(
    ("name", "value", "rule", "text"),
    [
        (
            "camera.sensor_degC",
            95,
            "over_temperature",
            "camera.temperature is 9",
        ),
        ("thermometers.no_fault_bits", True, "sensor_stale", "was last good 20.0 s ago, limit 15.0 s"),
        ("thermometers.silent", True, "sensor_bad", "thermometers.air is BAD"),
        ("heater.cut_out", True, "no_heat_response", "degC while the regulator heats by"),
        ("heater.welded_share", 0.9, "warming_while_off", "degC with the heater off"),
    ],
)
async def test_a_fault_of_the_heat_or_its_sensors_ends_the_run_and_only_an_operator_may_resume_it(
    tmp_path: Path, order: Callable[..., Order], name: str, value: object, rule: str, text: str
):
    tasks = list[asyncio.Task[None]]()
    ordered = order(LONG_SOAK, bus={"timeout_s": 0.1})
    begins = once_warm if name == "heater.cut_out" else partial(at_step, "soak")  # the first heat has its own rule
    watch = begins(lambda: tasks.append(asyncio.create_task(fault(ordered, name, value))))
    with pytest.raises(StandTripped) as caught:
        await run_virtual(ordered, tmp_path / "out", None, watch)
    await asyncio.gather(*tasks)
    (directory,) = (tmp_path / "out").iterdir()
    session = Session.open(directory)
    guarded = [event for event in session.events() if event.kind.startswith("guard.")]
    (trip,) = [event for event in guarded if event.data["action"] != "warn"]
    assert {event.kind for event in guarded} - {trip.kind} <= {"guard.sensor_jumped"}
    assert (trip.level, trip.kind) == ("error", f"guard.{rule}")
    assert text in trip.text
    assert str(caught.value) == f"{trip.text}; the stand is safe"
    assert trips_of(directory) == [rule]
    if name != "thermometers.silent":
        check_safe(session)
    supply = session.readings("relays.camera_power")[1][-1]
    assert supply == (0 if name == "camera.sensor_degC" else 1)  # one that is too warm itself is switched off
    with pytest.raises(SessionError, match=r"tripped: .*resume with --reset"):
        load_interruption(directory)


async def run_operated(order: Order, out: Path, watcher: Watcher, operate: Coroutine[None, None, None]) -> None:
    """A run that `operate` stops; what that raises ends it, too."""
    run = asyncio.create_task(run_virtual(order, out, None, lambda hub: hub.subscribe(watcher)))
    operating = asyncio.create_task(operate)
    await asyncio.wait([run, operating], return_when=asyncio.FIRST_COMPLETED)
    if not run.done() and operating.exception() is not None:
        run.cancel()
    elif run.done() and not operating.done():
        operating.cancel()
    await asyncio.wait([run, operating])
    if not operating.cancelled():
        operating.result()
    with pytest.raises(Interrupted, match="stopped by the operator"):
        run.result()


SET_POINT, OPERATION = 0x2103, 0x0000  # of the regulator's registers
TO_BE_PUT_RIGHT: dict[str, tuple[str, tuple[object, ...], tuple[object, ...]]] = {
    "set point by hand": ("device_fault", (SET_POINT, 450), ()),
    "manual output": ("device_fault", ("regulator.manual_percent", 30), ("regulator.manual_percent", None)),
    "stopped by hand": ("regulator_stopped", (OPERATION, 0x0101), ()),
    "lost writes": ("permit_missing", ("relays.lost_writes", True), ("relays.lost_writes", False)),
    "stage alarm": ("stage_alarm", ("axis.alarm", "rotary"), ("axis.alarm", None)),
    "welded relay": ("cooling_in_vain", ("heater.welded_share", 0.3), ("heater.welded_share", None)),
}
"""rule, what breaks it (a fault of the simulator, or a register written by another master), and what mends it."""
BY_DAY = {"set point by hand", "lost writes"}


@pytest.mark.parametrize(
    "name", [name if name in BY_DAY else mark_nightly(name) for name in TO_BE_PUT_RIGHT], ids=list(TO_BE_PUT_RIGHT)
)
async def test_what_an_operator_can_put_right_holds_the_run_until_one_clears_it(
    tmp_path: Path, order: Callable[..., Order], name: str
):
    """It holds, stays held when its cause is gone, and is reset over the socket."""
    rule, breaks, mends = TO_BE_PUT_RIGHT[name]
    out, watcher = tmp_path / "out", Watcher()
    ordered = order(LONG_SOAK)

    async def do(what: object, value: object) -> None:
        if isinstance(what, str):
            await fault(ordered, what, value)
        else:
            assert isinstance(what, int)
            assert isinstance(value, int)
            await asyncio.to_thread(write_by_another_master, ordered, 1, 6, what, value)

    async def operate() -> None:
        await watcher.event("run.start", 60)
        (directory,) = out.iterdir()
        await watcher.wait(1800 if rule == "cooling_in_vain" else 300)
        await do(*breaks)
        trip = await watcher.event(f"guard.{rule}", 3000)
        assert trip.level == "error"
        if rule == "stage_alarm":  # reset without a look at the cause
            reset = await asyncio.to_thread(ask, directory, "reset")
            assert reset["reasons"] == ["interlock"]
            assert trip.text in str(reset["text"])
            await watcher.event("guard.stage_alarm", 60)
        if mends:
            await do(*mends)
        await watcher.wait(300)
        status = await asyncio.to_thread(ask_status, directory)
        assert (status.state, status.reasons) == ("held", ("interlock",))
        assert (await asyncio.to_thread(ask, directory, "reset"))["reasons"] == []
        await watcher.event("restored", 60)
        await asyncio.to_thread(ask, directory, "stop")

    await run_operated(ordered, out, watcher, operate())
    (directory,) = out.iterdir()
    session = Session.open(directory)
    check_safe(session)
    trips = [event for event in session.events() if event.kind.startswith("guard.") and event.level == "error"]
    assert [trip.kind for trip in trips] == [f"guard.{rule}"] * (2 if rule == "stage_alarm" else 1)
    assert [entry for entry in trips_of(directory) if entry != "reset"] == [rule] * len(trips)
    assert trips_of(directory).count("reset") == len(trips)


async def test_a_full_disk_trips_after_its_time_and_a_reset_frees_no_space(tmp_path: Path, order: Callable[..., Order]):
    ordered, watcher, out = order(LONG_SOAK), Watcher(), tmp_path / "out"
    recording = ordered.config.recording.model_copy(update={"stop_frames_below_GB": 1e9})
    ordered = replace(ordered, config=ordered.config.model_copy(update={"recording": recording}))

    async def operate() -> None:
        await watcher.event("run.start", 60)
        await watcher.event("guard.disk_low", 1200)
        (directory,) = out.iterdir()
        assert (await asyncio.to_thread(ask_status, directory)).reasons == ("disk_low", "interlock")
        assert (await asyncio.to_thread(ask, directory, "reset"))["reasons"] == ["disk_low"]
        await watcher.event("guard.disk_low", 1200)
        await asyncio.to_thread(ask, directory, "stop")

    await run_operated(ordered, out, watcher, operate())


async def test_a_terminal_that_is_closed_leaves_the_stand_safe(tmp_path: Path, order: Callable[..., Order]):
    hang_up = at_step("soak", lambda: os.kill(os.getpid(), signal.SIGHUP))
    with pytest.raises(Interrupted, match="stopped by the operator"):
        await run_virtual(order(LONG_SOAK), tmp_path / "out", None, hang_up)
    (directory,) = (tmp_path / "out").iterdir()
    check_safe(Session.open(directory))


@pytest.mark.parametrize("who", ["thermometers", "regulator"])
async def test_a_poller_or_listener_that_fails_unexpectedly_leaves_the_stand_safe(
    tmp_path: Path, order: Callable[..., Order], who: str
):
    """A listener fails at a reading, in the poller's task, and at the end of the run."""
    failing = list[bool]()

    def listen(item: Item) -> None:
        if isinstance(item, Batch) and item.device == who and failing:
            failing.clear()
            raise RuntimeError("nobody expected this")
        if isinstance(item, Event) and item.kind == "run.end":
            raise RuntimeError("nor that")

    def watch(hub: Hub) -> None:
        hub.subscribe(listen)
        at_step("soak", lambda: failing.append(True))(hub)

    with pytest.raises(RuntimeError, match="nor that"):
        await run_virtual(order(LONG_SOAK), tmp_path / "out", None, watch)
    (directory,) = (tmp_path / "out").iterdir()
    check_safe(Session.open(directory))
