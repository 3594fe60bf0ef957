import math
from dataclasses import dataclass, replace

import pytest

from thermostand.foundation.clock import to_ns
from thermostand.foundation.hub import Hub
from thermostand.foundation.items import Batch
from thermostand.foundation.readings import Cause, Quality, Reading, bad_reading
from thermostand.stand.guarding.interlocks import (
    forbid_changed_settings,
    forbid_device_fault,
    forbid_intrusion,
    forbid_open_flap,
    forbid_stage_alarm,
    forbid_uncontrolled_heat,
    limit_disagreement,
    limit_temperature,
    require_camera_temperature,
    require_contact_state,
    require_durable_recording,
    require_frame_recording,
    require_fresh_reading,
    require_permit_relay,
    require_recording_process,
    require_regulator_running,
    require_session_folder,
)
from thermostand.stand.safety.fault import Fault, Rule, Watch

PV, AIR = "regulator.pv", "thermometers.air"
RUNNING, PERMIT = "regulator.running", "relays.heater_enable"


def reading(value: float, time_s: float = 0.0, quality: Quality = Quality.GOOD) -> Reading:
    return Reading(AIR, value, "degC", to_ns(time_s), quality)


def hub_of(*readings: Reading) -> Hub:
    hub = Hub()
    for one in readings:
        hub.publish(Batch("thermometers", one.time_ns, (one,)))
    return hub


def hub_with(**values: float) -> Hub:
    """A hub with one reading per channel, `regulator_pv` standing for regulator.pv; NaN is BAD."""
    channels = {name.replace("_", ".", 1): value for name, value in values.items()}
    return hub_of(
        *(
            bad_reading(channel, "1", 0, "lost") if math.isnan(value) else Reading(channel, value, "1", 0)
            for channel, value in channels.items()
        )
    )


def rule_of(fault: Fault | None) -> str | None:
    return None if fault is None else fault.rule


@pytest.mark.parametrize(
    ("value", "trips"), [(64.9, False), (65.0, False), (65.1, True), (-20.0, False), (math.inf, True)]
)
def test_over_temperature_trips_above_its_limit(value: float, trips: bool):
    fault = limit_temperature(AIR, 65.0)(hub_of(reading(value)), 0)
    assert (fault is not None) is trips
    if fault is not None:
        assert AIR in fault.text
        assert "65.0 degC" in fault.text


def test_a_camera_that_was_cut_off_too_warm_can_be_cleared_when_it_has_not_been_read_for_a_while():
    """Its supply is off and it will not be read; air that is not read is another rule's business."""
    read_ns = to_ns(1000)
    hub = hub_of(
        reading(94.0), Reading("camera.temperature", 94.0, "degC", read_ns), bad_reading(AIR, "degC", 1, "", "wire")
    )
    camera, air = limit_temperature("camera.temperature", 85.0, cuts_camera=True), limit_temperature(AIR, 65.0)
    assert camera(hub, read_ns + to_ns(60)) is not None
    assert camera(hub, read_ns + to_ns(61)) is None
    assert air(hub, to_ns(3600)) is not None


STALE = Quality.STALE


@pytest.mark.parametrize(
    ("readings", "rule"),
    [
        ([], "sensor_missing"),
        ([reading(24.0, 99.0), bad_reading(AIR, "degC", to_ns(100), "open wire")], None),
        ([bad_reading(AIR, "degC", to_ns(100), "open wire")], "sensor_bad"),
        ([reading(24.0, 86.0), bad_reading(AIR, "degC", to_ns(100), "late", "wire")], None),
        ([reading(24.0, 84.0), bad_reading(AIR, "degC", to_ns(100), "late", "wire")], "sensor_bad"),
        ([reading(24.0, 84.0)], "sensor_stale"),
        ([reading(24.0, 86.0)], None),
        ([reading(24.0, 90.0), reading(24.0, 100.0, STALE)], None),
        ([reading(24.0, 80.0), reading(24.0, 90.0, STALE), reading(24.0, 100.0, STALE)], "sensor_stale"),
        ([reading(24.0, 100.0, STALE)], "sensor_stale"),
    ],
    ids=[
        "never read",
        "once bad",
        "bad from the start",
        "lost for short",
        "lost for long",
        "old",
        "fresh",
        "one stale poll",
        "stale for long",
        "never good",
    ],
)
def test_a_safety_sensor_must_exist_and_be_good_and_fresh(readings: list[Reading], rule: str | None):
    assert rule_of(require_fresh_reading(AIR, 15.0)(hub_of(*readings), to_ns(100))) == rule


@pytest.mark.parametrize(
    ("polls", "trips_at"),
    [
        ("gdd", 2),
        ("gdgdgd", None),
        ("gwgwgwgg", None),
        ("g" + 17 * "w", 15),  # at 1 s each, the limit being 15 s
        ("gdwwd", 4),
        ("gwdwd", 4),
        ("gdwwg", None),
        ("gdsd", 3),
        ("gdww" + 15 * "w", 15),
        ("guu", 2),
    ],
)
def test_bad_by_the_device_counts_at_the_second_poll_and_bad_by_the_wire_when_it_lasts(
    polls: str, trips_at: int | None
):
    """One letter a poll: good, stale, bad by the wire, by the device, or by nobody knows whom; looked at twice each."""
    hub, rule, trips = Hub(), require_fresh_reading(AIR, 15.0), list[int]()
    causes: dict[str, Cause] = {"w": "wire", "d": "device", "u": ""}
    for index, letter in enumerate(polls):
        now_ns = to_ns(100 + index)
        if letter in causes:
            polled = bad_reading(AIR, "degC", now_ns, "no sense", causes[letter])
        else:
            polled = Reading(AIR, 24.0, "degC", now_ns, Quality.GOOD if letter == "g" else Quality.STALE)
        hub.publish(Batch("thermometers", now_ns, (polled,)))
        if [rule_of(rule(hub, now_ns)), rule_of(rule(hub, now_ns + 1))] != [None, None]:
            trips.append(index)
    assert (trips[0] if trips else None) == trips_at


def test_a_device_that_was_good_between_two_looks_begins_again():
    hub, rule = hub_of(reading(24.0, 99.0)), require_fresh_reading(AIR, 15.0)
    for time_s in (100, 101, 102, 103):
        bad = bad_reading(AIR, "degC", to_ns(time_s), "open wire")
        hub.publish(Batch("thermometers", bad.time_ns, (bad,)))
        assert rule(hub, bad.time_ns) is None
        good = reading(24.0, time_s + 0.5)
        hub.publish(Batch("thermometers", good.time_ns, (good,)))


def test_rules_know_the_last_value_over_a_poll_that_was_lost_on_the_wire():
    """Else a line that loses a reply now and then would let each rule that needs time begin again."""
    hub = hub_of(reading(70.0, 99.0), bad_reading(AIR, "degC", to_ns(100), "late", "wire"))
    assert rule_of(limit_temperature(AIR, 65.0)(hub, to_ns(100))) == "over_temperature"
    reported = Reading("regulator.fault", 1.0, "1", 0, reason="manual")
    hub = hub_of(reported, bad_reading("regulator.fault", "1", to_ns(1), "late", "wire"))
    assert rule_of(forbid_device_fault("regulator.fault")(hub, to_ns(1))) == "device_fault"


@pytest.mark.parametrize(
    ("air_degC", "trips"), [(24.0, False), (30.0, False), (30.1, True), (17.9, True), (math.nan, False)]
)
def test_two_sensors_of_one_air_may_differ_by_so_much(air_degC: float, trips: bool):
    fault = limit_disagreement(PV, AIR, 6.0)(hub_with(regulator_pv=24.0, thermometers_air=air_degC), 0)
    assert (fault is not None) is trips
    if fault is not None:
        assert fault.text.startswith("regulator.pv 24.00 degC and thermometers.air")


def test_a_device_that_reports_a_fault_is_believed():
    rule = forbid_device_fault("regulator.fault")
    assert rule(hub_with(regulator_fault=0.0), 0) is None
    assert rule(hub_with(regulator_fault=math.nan), 0) is None
    reported = Reading("regulator.fault", 1.0, "1", 0, reason="set point changed at the unit")
    fault = rule(hub_of(reported), 0)
    assert fault is not None
    assert "set point changed" in fault.text


@pytest.mark.parametrize(
    ("running", "permit", "objection"),
    [
        (1.0, 1.0, None),
        (0.0, 0.0, None),
        (0.0, 1.0, "regulator_stopped"),
        (1.0, 0.0, "permit_missing"),
        (math.nan, 1.0, None),
        (1.0, math.nan, None),
    ],
    ids=["heating", "at rest", "keys pressed", "relay stuck open", "regulator unknown", "relay unknown"],
)
def test_regulator_and_permit_belong_together(running: float, permit: float, objection: str | None):
    hub = hub_with(regulator_running=running, relays_heater_enable=permit)
    objections = [rule_of(rule(RUNNING, PERMIT)(hub, 0)) for rule in (require_regulator_running, require_permit_relay)]
    assert [name for name in objections if name] == ([objection] if objection else [])


@pytest.mark.parametrize(
    ("reason", "cause", "trips"),
    [
        ("", "", False),
        ("not homed", "", False),
        ("motor off, the rotor may have moved by up to a step", "", False),
        ("controller alarm, flags 0x00000040", "alarm", True),
        ("in an alarm, by other words", "alarm", True),
    ],
)
def test_only_an_alarm_of_a_stage_is_one(reason: str, cause: Cause, trips: bool):
    position = Reading("linear.position", 1.0, "mm", 0, STALE if reason else Quality.GOOD, reason, cause)
    assert (rule_of(forbid_stage_alarm("linear.position")(hub_of(position), 0)) == "stage_alarm") is trips


def test_a_stage_that_is_set_otherwise_is_a_warning():
    homed = Reading("linear.homed", 1.0, "1", 0, reason="speed 500 steps/s, not 1000 steps/s as in its profile")
    assert rule_of(forbid_changed_settings("linear.homed")(hub_of(homed), 0)) == "settings_changed"
    assert rule_of(forbid_changed_settings("linear.homed")(hub_of(replace(homed, reason="")), 0)) is None


def test_an_open_flap_may_be_excused():
    excuse = [False]
    rule = forbid_open_flap("flap.position", lambda: excuse[0])
    assert rule(hub_with(flap_position=0.02), 0) is None
    assert rule(hub_with(flap_position=math.nan), 0) is None
    assert rule_of(rule(hub_with(flap_position=0.3), 0)) == "flap_open"
    excuse[0] = True
    assert rule(hub_with(flap_position=1.0), 0) is None


def test_a_recorder_that_takes_no_frames_is_reported_with_its_reason():
    reason = [""]
    rule = require_frame_recording(lambda: reason[0])
    assert rule(Hub(), 0) is None
    reason[0] = "less than 2.0 GB free"
    assert rule(Hub(), 0) == Fault("disk_low", "less than 2.0 GB free")


def objecting(instants: set[int]) -> Rule:
    return lambda readings, now_ns: Fault("rule", "it is so") if now_ns // to_ns(1) in instants else None


def test_a_watch_waits_until_its_rule_has_objected_without_a_break_for_its_grace_time():
    watch = Watch(objecting({1, 2, 4, 5, 6, 7, 8}), grace_s=3.0, action="hold")
    seen = {second: watch.check(Hub(), to_ns(second)) for second in range(10)}
    expected = Fault("rule", "it is so, for 3 s", "hold")
    assert {second for second, fault in seen.items() if fault is not None} == {7, 8}
    assert seen[7] == expected


def test_a_watch_without_grace_objects_at_once():
    assert Watch(objecting({0})).check(Hub(), 0) == Fault("rule", "it is so", "abort")


@dataclass
class Recorder:
    waiting_since_ns: int | None = None
    folder_lost: str = ""
    writer_ended: str = ""


def test_what_is_not_recorded_in_time_or_cannot_be_any_more_is_a_fault():
    readings, recorder = Hub(), Recorder()
    late, moved, ended = (
        require_durable_recording(recorder, 10.0),
        require_session_folder(recorder),
        require_recording_process(recorder),
    )
    assert [rule(readings, to_ns(100)) for rule in (late, moved, ended)] == [None] * 3
    recorder.waiting_since_ns = to_ns(90)
    assert late(readings, to_ns(100)) is None
    fault = late(readings, to_ns(102))
    assert rule_of(fault) == "not_recorded"
    assert fault is not None
    assert "12 s ago" in fault.text
    recorder.folder_lost, recorder.writer_ended = "it was renamed", "it was killed"
    assert [rule_of(rule(readings, 0)) for rule in (moved, ended)] == ["folder_lost", "recording_ended"]


def test_heat_that_others_switch_on_twice_and_heat_that_does_not_obey_are_faults():
    for times, rule in ((0, None), (1, None), (2, "switched_on_without_permission")):
        assert rule_of(forbid_intrusion(lambda times=times: times)(Hub(), 0)) == rule
    assert forbid_uncontrolled_heat(lambda: "")(Hub(), 0) is None
    assert rule_of(forbid_uncontrolled_heat(lambda: "it reads back 30 %")(Hub(), 0)) == "heat_uncontrolled"


def test_a_cameras_temperature_that_is_lost_is_a_fault_while_frames_are_to_come():
    channel = "camera.temperature"
    good, bad = Reading(channel, 40.0, "degC", 0), bad_reading(channel, "degC", 0, "no answer")
    for found, to_come, rule in (
        (bad, True, "camera_temperature_bad"),
        (bad, False, None),
        (good, True, None),
        (None, True, None),
    ):
        asked = require_camera_temperature(channel, lambda to_come=to_come: to_come)
        assert rule_of(asked(hub_of(found) if found else Hub(), 0)) == rule


@pytest.mark.parametrize(("value", "trips"), [(1.0, True), (0.0, False), (math.nan, False), (None, False)])
def test_a_contact_is_a_fault_in_the_state_that_is_one(value: float | None, trips: bool):
    hub = Hub() if value is None else hub_with(inputs_door=value)
    assert (require_contact_state("inputs.door", 1.0, "the door is open")(hub, 0) is not None) is trips
