"""The mains fails: over the wire of a simulated upsd, in virtual time. The run holds, goes on by itself when mains is
back, ends before the battery does, and takes no notice of a UPS that is silent but for a warning."""

from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.addresses import find_free_port
from thermostand.drivers.devices.ups import UpsSettings
from thermostand.foundation.clock import to_ns
from thermostand.foundation.errors import StandError, StandTripped
from thermostand.foundation.events import RUN_END, SOAK_CREDITED, SOAK_RESTARTED
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, Item
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.recording.reading.session import Session
from thermostand.stand.config.stand_config import find_packaged
from thermostand.stand.guarding.mains import end_before_battery, require_mains
from thermostand.stand.running.order import load_order
from thermostand.stand.service.run import run_virtual

STEPS = """
name: rest
steps:
  - start_chamber: DEGC
  - soak: 1800
  - stop_chamber
"""


def stand(folder: Path, *faults: str, degC: float = 26.0, **ups: object) -> Path:
    """A simulated stand without a camera, with a UPS."""
    data: dict[str, Any] = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["cameras"], data["axes"] = {}, {}
    data["devices"] = {"ups": {"kind": "ups", "address": f"tcp:127.0.0.1:{find_free_port()}", **ups}}
    data["simulation"]["faults"] = list(faults)
    (folder / "stand.yaml").write_text(yaml.safe_dump(data))
    (folder / "rest.yaml").write_text(STEPS.replace("DEGC", f"{degC:g}"))
    return folder / "stand.yaml"


async def run(folder: Path, config: Path) -> tuple[Session, list[Event], str]:
    """The session, its events, and how the run ended."""
    seen: list[Event] = []
    order = load_order(str(folder / "rest.yaml"), str(config))

    def follow(item: Item) -> None:
        if isinstance(item, Event):
            seen.append(item)

    ended = "complete"
    try:
        await run_virtual(order, folder / "out", None, lambda hub: hub.subscribe(follow))
    except StandError as error:
        ended = type(error).__name__
    (directory,) = (path for path in (folder / "out").iterdir() if path.is_dir())
    return Session.open(directory), seen, ended


def guard_events(seen: list[Event]) -> list[tuple[str, str]]:
    return [(each.kind, str(each.data["action"])) for each in seen if each.kind.startswith("guard.")]


async def test_a_run_on_battery_holds_safe_and_goes_on_by_itself_when_mains_is_back(tmp_path: Path):
    session, seen, ended = await run(tmp_path, stand(tmp_path, "ups.mains_failed@300:240", back_after_s=120))
    assert (ended, guard_events(seen)) == ("complete", [("guard.mains_lost", "hold")])
    (held,) = (each.time_ns for each in seen if each.kind == "guard.mains_lost")
    (over,) = (each.time_ns for each in seen if each.kind == "hold_ended")
    times_ns, on_battery = session.readings("ups.on_battery")
    lost_ns, back_ns = times_ns[on_battery == 1][0], times_ns[(on_battery == 0) & (times_ns > held)][0]
    assert 0 <= held - lost_ns <= to_ns(20)
    assert to_ns(120) <= over - back_ns <= to_ns(140)
    times_ns, permits = session.readings("relays.heater_enable")
    assert not permits[(times_ns > held + to_ns(20)) & (times_ns < over)].any()
    assert permits[times_ns > over + to_ns(20)][:-2].any()
    assert session.readings("ups.charge")[1].min() < 90


async def test_a_chamber_that_has_left_its_band_is_soaked_again(tmp_path: Path):
    limits = {"back_after_s": 60, "end_below_percent": 0, "end_below_s": 60}
    _, seen, ended = await run(tmp_path, stand(tmp_path, "ups.mains_failed@900:600", degC=40.0, **limits))
    assert (ended, guard_events(seen)) == ("complete", [("guard.mains_lost", "hold")])
    (over,) = (each.time_ns for each in seen if each.kind == "hold_ended")
    (end,) = (each.time_ns for each in seen if each.kind == RUN_END)
    assert [each.kind for each in seen if each.kind in (SOAK_CREDITED, SOAK_RESTARTED)] == [SOAK_RESTARTED]
    assert end - over > to_ns(1800)  # what was soaked before does not count any more


@pytest.mark.parametrize(
    "faults",
    [("ups.mains_failed@300", "ups.charge_percent=35@310"), ("ups.status=OB LB@300",), ("ups.status=FSD OL@300",)],
)
async def test_the_run_ends_in_order_before_the_battery_does(tmp_path: Path, faults: tuple[str, ...]):
    session, seen, ended = await run(tmp_path, stand(tmp_path, *faults))
    assert ended == StandTripped.__name__
    assert guard_events(seen)[-1] == ("guard.battery_low", "abort")
    assert session.readings("relays.heater_enable")[1][-1] == 0.0
    assert session.readings("ups.charge")[1].min() > 20
    assert [each.data["status"] for each in seen if each.kind == RUN_END] == ["tripped"]


@pytest.mark.parametrize(
    "fault",
    ["ups.stale@300:100", "ups.driver_gone@300:100", "ups.silent@300:100", "ups.unplugged@300:100", "ups.silent:100"],
)
async def test_a_silent_upsd_warns_and_never_holds(tmp_path: Path, fault: str):
    _, seen, ended = await run(tmp_path, stand(tmp_path, fault, timeout_s=0.02, poll_s=20))
    assert (ended, guard_events(seen)) == ("complete", [("guard.ups_silent", "warn")])


class Reported:
    """What a UPS has told, and the rules on it."""

    def __init__(self, **settings: object) -> None:
        given = {"kind": "ups", "address": "tcp:127.0.0.1:3493", "hold_after_s": 5, "back_after_s": 100, **settings}
        self.hub, made = Hub(), UpsSettings.model_validate(given)
        self.hold, self.end = require_mains("ups", made), end_before_battery("ups", made)

    def look(self, at_s: int, on_battery: float | None, left_s: float = 1000.0) -> tuple[bool, bool]:
        """Whether it holds, and whether it ends; None: it is silent."""
        time_ns = to_ns(at_s)
        reported = {"charge": 80.0, "runtime": left_s, "on_battery": on_battery, "low_battery": 0.0}
        readings = tuple(
            bad_reading(f"ups.{name}", "1", time_ns, "silent", "wire")
            if on_battery is None or value is None
            else Reading(f"ups.{name}", value, "1", time_ns)
            for name, value in reported.items()
        )
        self.hub.publish(Batch("ups", time_ns, readings))
        return self.hold(self.hub, time_ns) is not None, self.end(self.hub, time_ns) is not None


def test_a_short_loss_is_none_and_a_second_loss_begins_the_wait_again():
    ups = Reported()
    assert [ups.look(at_s, value)[0] for at_s, value in ((0, 1), (4, 1), (6, 0), (8, 1), (12, 0))] == [False] * 5
    assert [ups.look(at_s, value)[0] for at_s, value in ((20, 1), (25, 1), (30, 0), (120, 0))] == [
        False,
        True,
        True,
        True,
    ]
    assert [ups.look(at_s, value)[0] for at_s, value in ((125, 1), (130, 0), (229, 0), (230, 0))] == [True] * 3 + [
        False
    ]


def test_silence_begins_no_hold_ends_none_and_the_time_that_was_left_goes_on():
    ups = Reported(end_below_s=300)
    assert ups.look(0, None) == (False, False)
    assert ups.look(10, 0) == (False, False)
    assert ups.look(5000, None) == (False, False)
    assert ups.look(5010, 1) == (False, False)
    assert ups.look(5020, 1, 900.0) == (True, False)
    assert ups.look(5600, None) == (True, False)
    assert ups.look(5630, None) == (True, True)


def test_silence_after_mains_came_back_does_not_end_the_hold():
    ups = Reported()
    assert [ups.look(at_s, value)[0] for at_s, value in ((0, 1), (6, 1), (10, 0), (60, None), (500, None))] == [
        False,
        True,
        True,
        True,
        True,
    ]
    assert ups.look(510, 0) == (False, False)  # it answers again, and mains has been back since
