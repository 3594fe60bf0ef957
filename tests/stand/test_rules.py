"""The guard's table with the installed limits: what is reported on the hub, who is excused, what costs how much
time."""

import math
from pathlib import Path

import pytest

from thermostand.foundation.clock import to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch, Event, StepMark, StepState
from thermostand.foundation.readings import Reading, bad_reading
from thermostand.recording.writing.notices import SpaceWatch
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.guarding.rules import Announcements, make_channel_models, make_watches
from thermostand.stand.safety.fault import Fault
from thermostand.stand.safety.gate import OPERATOR


class Table:
    """The whole table over a hub on which all is well."""

    def __init__(self) -> None:
        self.hub, self.announced = Hub(), Announcements()
        self.hub.subscribe(self.announced.receive)
        self.watches = make_watches(load_config(find_packaged("", "simulated")), self.announced)
        self.values = {
            "regulator.pv": 24.0,
            "regulator.running": 1.0,
            "relays.heater_enable": 1.0,
            "relays.compressor": 0.0,
            "thermometers.air": 24.0,
            "thermometers.granite_inside": 24.0,
            "flap.position": 0.0,
        }

    def look(self, time_s: float, **changed: float) -> list[Fault]:
        """All read again, with a little noise, then every rule asked."""
        time_ns = to_ns(time_s)
        values = self.values | {name.replace("_", ".", 1): value for name, value in changed.items()}
        noise = {"thermometers.air", "thermometers.granite_inside"}
        for channel, value in values.items():
            noisy = value + (time_s % 7) * 1e-3 * (channel in noise)
            lost = math.isnan(value)
            bad = bad_reading(channel, "1", time_ns, "lost", "wire")
            reading = bad if lost else Reading(channel, noisy, "1", time_ns)
            self.hub.publish(Batch("device", time_ns, (reading,)))
        return [fault for watch in self.watches if (fault := watch.check(self.hub, time_ns)) is not None]

    def first_s(self, until_s: int, **changed: float) -> tuple[int, Fault] | None:
        """When something is first said, looked at every 10 s, and what."""
        for time_s in range(0, until_s, 10):
            if faults := self.look(time_s, **changed):
                return time_s, faults[0]
        return None


def mark(kind: str, state: StepState) -> StepMark:
    return StepMark(0, "id", 0, kind, state)


def test_a_stand_at_rest_is_left_alone():
    assert Table().first_s(7200) is None


@pytest.mark.parametrize(
    ("channel", "value", "rule"),
    [
        ("regulator_pv", 65.1, "over_temperature"),
        ("thermometers_air", 65.1, "over_temperature"),
        ("thermometers_granite_inside", 60.1, "over_temperature"),
        ("camera_temperature", 85.1, "over_temperature"),
    ],
)
def test_what_is_too_hot_aborts_at_once(channel: str, value: float, rule: str):
    found = Table().first_s(100, **{channel: value})
    assert found is not None
    assert (found[0], found[1].rule, found[1].action) == (0, rule, "abort")


def test_an_open_flap_holds_after_five_minutes_unless_a_capture_is_under_way():
    found = Table().first_s(4000, flap_position=1.0)
    assert found is not None
    assert (found[0], found[1].rule, found[1].action) == (300, "flap_open", "hold")

    capturing = Table()
    capturing.hub.publish(mark("open_flap", StepState.STARTED))
    capturing.hub.publish(mark("capture", StepState.STARTED))
    found = capturing.first_s(4000, flap_position=1.0)
    assert found is not None
    assert (found[0], found[1].rule) == (2700, "flap_open")


@pytest.mark.parametrize(("channel", "after_s"), [("flap_position", 310), ("relays_heater_enable", 70)])
def test_a_flap_or_relay_board_that_cannot_be_asked_holds_after_its_time(channel: str, after_s: int):
    """300 s and 60 s after the first look that finds the last good reading too old by half of that."""
    table = Table()
    table.look(0)
    found = table.first_s(4000, **{channel: math.nan})
    assert found is not None
    assert (found[0], found[1].rule, found[1].action) == (after_s, "sensor_bad", "hold")


@pytest.mark.parametrize("end", [StepState.DONE, StepState.FAILED])
def test_a_capture_that_has_ended_excuses_nothing(end: StepState):
    table = Table()
    table.hub.publish(mark("capture", StepState.STARTED))
    table.hub.publish(mark("capture", end))
    found = table.first_s(4000, flap_position=1.0)
    assert found is not None
    assert found[0] == 300


def test_a_disk_without_space_for_frames_holds_after_a_quarter_of_an_hour(tmp_path: Path):
    """What the recorder's own watch says, at a limit that no disk keeps."""
    notices: list[Event] = []
    SpaceWatch(tmp_path, 10**18, 0.0, lambda: 0, notices.append).check()
    table = Table()
    table.hub.publish(notices[0])
    found = table.first_s(4000)
    assert found is not None
    assert (found[0], found[1].rule, found[1].action) == (900, "disk_low", "hold")
    assert "frames are not recorded" in found[1].text
    table.hub.publish(Event(0, "info", "frames_resumed", "frames are recorded again"))
    assert table.look(5000) == []


def test_what_no_probe_and_no_camera_can_be_is_no_measurement():
    config = load_config(find_packaged("", "simulated"))
    lowest, highest = config.limits.chamber_degC
    known = make_channel_models(config)
    for channel in ("regulator.pv", "camera.temperature"):
        low, high = known[channel].range_degC
        assert -100.0 < low < lowest
        assert highest < high < 200.0


def test_before_any_event_and_after_a_run_no_capture_is_under_way_and_frames_are_taken():
    announced = Announcements()
    assert (announced.is_capturing, announced.frames_stopped, announced.is_paused) == (False, "", False)
    announced.receive(mark("capture", StepState.STARTED))
    announced.receive(Event(0, "error", "frames_stopped", "the disk is full"))
    announced.receive(Event(0, "warning", "held", "paused", {"reason": OPERATOR}))
    assert (announced.is_capturing, announced.frames_stopped, announced.is_paused) == (True, "the disk is full", True)
    announced.forget()
    assert (announced.is_capturing, announced.frames_stopped, announced.is_paused) == (False, "", False)


def test_all_other_events_and_steps_are_no_business_of_the_rules():
    table = Table()
    table.hub.publish(Event(0, "error", "frames_dropped", "the disk is too slow"))
    table.hub.publish(mark("soak", StepState.STARTED))
    assert (table.announced.is_capturing, table.announced.frames_stopped) == (False, "")


def test_a_pause_of_twelve_hours_holds_the_stand_and_a_shorter_one_does_not():
    table = Table()
    held = Event(0, "warning", "held", "operator", {"reason": "operator"})
    released = Event(0, "info", "released", "operator", {"reason": "operator"})
    table.hub.publish(held)
    found = table.first_s(13 * 3600)
    assert found is not None
    time_s, fault = found
    assert (time_s, fault.rule, fault.action) == (12 * 3600, "paused_too_long", "hold")
    table = Table()
    table.hub.publish(held)
    assert table.first_s(3600) is None
    table.hub.publish(released)
    assert table.first_s(13 * 3600) is None
