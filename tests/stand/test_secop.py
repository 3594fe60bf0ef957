"""The SECoP node, line by line: the specification's own exchanges, refusals, and clients who mean no good."""

import asyncio
import json
import time
from functools import partial
from pathlib import Path

import pytest

from tests.stand.secop_service import JAM, NO, WIRE, SecopService, node
from tests.stand.secop_talk import talking
from thermostand.foundation.readings import Quality
from thermostand.stand.assembly.assemble import load_unit_map
from thermostand.stand.config.stand_config import find_packaged, load_config
from thermostand.stand.safety.gate import INTERLOCK
from thermostand.stand.service.bench import GRAB, READ, REGISTERS, list_devices
from thermostand.stand.service.stand_service import StandService
from thermostand.stand.serving.api_models import FaultState, HeatByHand, ReadingState
from thermostand.stand.serving.commands import collect_commands
from thermostand.stand.serving.secop import SecopRequest, make_message, parse_request
from thermostand.stand.serving.secop_modules import make_modules


@pytest.mark.parametrize(
    ("line", "request_"),
    [
        (b"*IDN?", SecopRequest("*IDN?")),
        (b"describe\r", SecopRequest("describe")),
        (b"", SecopRequest("help")),
        (b"ping  ", SecopRequest("ping", "", "")),
        (b"read mf:status", SecopRequest("read", "mf:status")),
        (b"change mf:target 12", SecopRequest("change", "mf:target", "12")),
        (b'do t1:setpid {"p": 100.0, "i": 5.0}', SecopRequest("do", "t1:setpid", '{"p": 100.0, "i": 5.0}')),
    ],
)
def test_lines_are_split_at_the_first_two_spaces(line: bytes, request_: SecopRequest):
    assert parse_request(line) == request_


def test_a_message_is_one_line_whatever_it_says():
    assert make_message("pong", "", [None, {}]) == b"pong  [null, {}]\n"  # the specification's two spaces
    assert make_message("active") == b"active\n"
    assert make_message("update", "a:value", ["two\nlines", {}]) == b'update a:value ["two\\nlines", {}]\n'
    with pytest.raises(ValueError, match="JSON"):
        make_message("update", "a:value", [float("nan"), {}])


async def test_identification_description_and_heartbeat(tmp_path: Path):
    async with node(SecopService(), tmp_path) as port, talking(port) as talk:
        assert await talk.ask("*IDN?") == "ISSE&SINE2020,SECoP,V2019-09-16,v1.0"
        action, dot, described = await talk.asked("describe")
        assert (action, dot, described["equipment_id"]) == ("describing", ".", "thermostand.a-stand")
        found = {name: module["interface_classes"] for name, module in described["modules"].items()}
        assert found == {
            "chamber": ["Drivable"],
            "thermometers_air": ["Readable"],
            "thermometers_granite": ["Readable"],
            "flap": ["Drivable"],
            "linear": ["Drivable"],
            "camera_temperature": ["Readable"],
            "run": ["Readable"],
        }
        target = described["modules"]["chamber"]["accessibles"]["target"]
        assert target["datainfo"] == {"type": "double", "unit": "degC", "min": -10.0, "max": 60.0}
        assert (target["readonly"], described["modules"]["linear"]["accessibles"]["value"]["readonly"]) == (False, True)
        for module in described["modules"].values():
            needed = {"value", "status"} | ({"target", "stop"} if "Drivable" in module["interface_classes"] else set())
            assert needed <= module["accessibles"].keys()
            assert all(each["description"] for each in (module, *module["accessibles"].values()))
        action, token, (nothing, qualifiers) = await talk.asked("ping 123")
        assert (action, token, nothing) == ("pong", "123", None)
        assert abs(qualifiers["t"] - time.time()) < 5  # noqa: TID251 - the host's clock is what it must be
        assert (await talk.ask("ping")).startswith("pong  [null")
        assert (await talk.ask("help")).startswith('helping  "')


async def test_each_device_of_an_installed_stand_is_operated_by_what_it_takes_and_read_by_its_channels():
    config = load_config(find_packaged("", "simulated"))
    devices = tuple(
        each.model_copy(update={"verbs": tuple(v for v in each.verbs if v.verb not in (READ, REGISTERS, GRAB))})
        for each in list_devices(config)
    )
    channels = [
        (f"{each.name}.{channel.name}", channel.unit)
        for each in config.equipment
        for channel in each.channels(partial(getattr, config), load_unit_map)
    ]
    readings = {name: ReadingState(value=1.0, unit=unit, quality=Quality.GOOD, time_ns=1) for name, unit in channels}
    named = [
        each.model_copy(update={"channels": tuple(name for name in readings if name.startswith(f"{each.name}."))})
        for each in devices
    ]
    modules = make_modules(named, readings, collect_commands(StandService))
    driven = {name: each.parameters["target"].info for name, each in modules.items() if each.drive is not None}
    limits = {"type": "double", "unit": "degC", **dict(zip(("min", "max"), config.limits.chamber_degC, strict=True))}
    assert driven["chamber"] == limits
    assert driven.keys() == {"chamber", "flap", *config.axes}
    read = {name for name, each in modules.items() if each.drive is None}
    skipped = ("regulator.", "flap.", *(f"{name}." for name in config.axes))
    degC = {name for name, unit in channels if unit == "degC" and not name.startswith(skipped)}
    assert read == {name.replace(".", "_") for name in degC} | {"run"}
    assert "camera_temperature" in read
    assert {"stop", "clear_errors", "_pause", "_continue", "_submit", "_skip", "_cancel", "_resume"} <= set(
        modules["run"].commands
    )


async def test_what_is_read_has_its_time_and_what_is_no_measurement_is_an_error(tmp_path: Path):
    desk = SecopService()
    read_s = desk.hub.readings["thermometers.air"].time_ns / 1e9
    async with node(desk, tmp_path) as port, talking(port) as talk:
        action, specifier, (value, qualifiers) = await talk.asked("read thermometers_air:value")
        assert (action, specifier, value) == ("reply", "thermometers_air:value", 24.0)
        assert qualifiers["t"] == pytest.approx(read_s, abs=1e-5)
        assert (await talk.asked("read thermometers_air"))[:2] == ("reply", "thermometers_air")  # its value
        assert (await talk.asked("read thermometers_air:status:of:it"))[2][0] == [100, ""]
        action, _, (error, text, qualifiers) = await talk.asked("read thermometers_granite")
        assert (action, error, text) == ("error_read", "HardwareError", "wire is broken")
        assert "t" in qualifiers
        assert (await talk.asked("read thermometers_granite:status"))[2][0] == [400, "wire is broken"]


async def test_an_active_client_gets_everything_and_then_what_changes(tmp_path: Path):
    desk = SecopService()
    async with node(desk, tmp_path) as port, talking(port) as talk:
        assert await talk.ask("activate") == "active"
        described = (await talk.asked("describe"))[2]["modules"]
        parameters = {
            f"{name}:{each}"
            for name, module in described.items()
            for each, accessible in module["accessibles"].items()
            if accessible["datainfo"]["type"] != "command"
        }
        assert {line.split(" ")[1] for line in talk.updates} >= parameters
        broken = [line for line in talk.updates if line.startswith("error_update")]
        assert any(line.startswith('error_update thermometers_granite:value ["HardwareError"') for line in broken)
        desk.air_degC = 25.5
        desk.poll()
        assert "[25.5," in await talk.until("update chamber:value ")
        desk.lose("regulator.pv")
        assert '["CommunicationFailed", "no answer within 0.5 s"' in await talk.until("error_update chamber:value ")
        assert "[400," in await talk.until("update chamber:status ")
        assert await talk.ask("deactivate") == "inactive"
        assert await talk.ask("activate linear") == "active linear"
        talk.updates.clear()
        desk.air_degC = desk.linear_mm = 30.0
        desk.poll()
        assert "[30.0," in await talk.until("update linear:value ")
        assert [line for line in talk.updates if " linear:" not in line] == []
        assert await talk.ask("*IDN?") == "ISSE&SINE2020,SECoP,V2019-09-16,v1.0"  # and nothing is followed any more
        desk.linear_mm = 40.0
        desk.poll()
        await asyncio.sleep(0.7)  # a snapshot is made each half second
        talk.updates.clear()
        await talk.ask("ping 1")
        assert talk.updates == []


async def test_a_set_point_is_busy_from_before_its_answer_until_the_air_has_arrived(tmp_path: Path):
    desk = SecopService()
    async with node(desk, tmp_path) as port, talking(port) as talk, talking(port) as other:
        await other.ask("activate chamber")
        assert (await talk.asked("change chamber:target 30.5"))[2][0] == 30.5
        assert "[300," in await other.until("update chamber:status ")
        assert (await talk.asked("read chamber:status"))[2][0][0] == 300
        desk.poll()
        assert "[370," in await other.until("update chamber:status ")
        desk.air_degC = 30.2
        desk.poll()
        assert '[100, "at 30.5 degC"]' in await other.until("update chamber:status ")
        assert (await talk.asked("do chamber:stop"))[:2] == ("done", "chamber:stop")
        desk.poll()
        assert "false" in await other.until("update chamber:control_active ")
    who, verb, arguments = desk.orders[0]
    assert (who.how, verb, arguments["device"], arguments["verb"]) == ("secop", "device", "regulator", "set")
    assert [order[2]["verb"] for order in desk.orders] == ["set", "stop"]


async def test_a_stage_is_busy_until_it_has_been_read_where_it_is(tmp_path: Path):
    desk = SecopService()
    desk.is_slow = True
    async with node(desk, tmp_path) as port, talking(port) as talk:
        assert (await talk.asked("change linear:target 12"))[2][0] == 12.0
        desk.busy = ()
        desk.tell("the move has ended")
        await asyncio.sleep(0.3)
        assert (await talk.asked("read linear:status"))[2][0][0] == 300  # else its old position would be taken for it
        await talk.ask("activate linear")
        desk.poll()
        assert "[100," in await talk.until("update linear:status ")
        assert (await talk.asked("read linear"))[2][0] == 12.0
        assert (await talk.asked("do linear:_home"))[0] == "done"
        assert (await talk.asked("change flap:target 1"))[2][0] == 1
        assert (await talk.asked('change flap:target "closed"'))[2][0] == 0  # an enum takes its names, too
    assert [order[2]["verb"] for order in desk.orders] == ["move", "home", "open", "close"]


async def test_heat_by_hand_is_in_the_status_of_the_stand(tmp_path: Path):
    desk = SecopService()
    desk.by_hand = HeatByHand(setpoint_degC=40.0, since_ns=0)
    async with node(desk, tmp_path) as port, talking(port) as talk:
        assert (await talk.asked("read run:status"))[2][0] == [100, "heat by hand, set-point 40 degC"]


async def test_stop_and_what_concerns_runs(tmp_path: Path):
    desk = SecopService()
    desk.phase = "running"
    async with node(desk, tmp_path) as port, talking(port) as talk:
        assert (await talk.asked("read run"))[2][0] == 1
        for line in ("_pause", "_continue", "stop"):
            assert (await talk.asked(f"do run:{line}"))[:2] == ("done", f"run:{line}")
        assert (await talk.asked('do run:_submit "overnight"'))[2][0] == 1  # its number in the queue
        assert (await talk.asked("do run:clear_errors"))[2][0] == "IsBusy"
    assert [verb for _, verb, _ in desk.orders] == ["pause", "continue", "stop", "submit"]
    assert {who.how for who, _, _ in desk.orders} == {"secop"}


@pytest.mark.parametrize(
    ("line", "error"),
    [
        ("read tx:target", "NoSuchModule"),
        ("change ts:target 12", "NoSuchModule"),
        ("read chamber:volt", "NoSuchParameter"),
        ("do chamber:explode", "NoSuchCommand"),
        ("do chamber", "NoSuchCommand"),
        ("change chamber:value 3", "ReadOnly"),
        ("change thermometers_air 3", "NoSuchParameter"),
        ("change chamber:target 61", "RangeError"),
        ("change chamber:target -1e999", "RangeError"),
        ('change chamber:target "30"', "WrongType"),
        ("change chamber:target true", "WrongType"),
        ("change chamber:target null", "WrongType"),
        ("change chamber:target", "WrongType"),
        ("change chamber:target NaN", "BadJSON"),
        ("change chamber:target {", "BadJSON"),
        ("change chamber:target " + "[" * 10_000, "BadJSON"),
        ("change flap:target 2", "RangeError"),
        ("change flap:target 1.0", "WrongType"),
        ("do chamber:stop 1", "WrongType"),
        ("do run:_submit", "WrongType"),
        ("do run:_submit " + json.dumps("x" * 300), "RangeError"),
        ("meas:volt?", "ProtocolError"),
        ("logging chamber true", "ProtocolError"),
        ("activate nothing", "NoSuchModule"),
    ],
)
async def test_what_is_wrong_has_its_class_and_a_sentence(tmp_path: Path, line: str, error: str):
    desk = SecopService()
    async with node(desk, tmp_path) as port, talking(port) as talk:
        await talk.ask("*IDN?")
        action, _, (found, text, _) = await talk.asked(line)
        assert (action, found) == (f"error_{line.split(' ')[0]}", error)
        assert len(text) > 5
        assert (await talk.asked("read chamber"))[0] == "reply"
    assert desk.orders == []


@pytest.mark.parametrize(
    ("failure", "error"),
    [(WIRE, "CommunicationFailed"), (JAM, "HardwareError"), (NO, "Impossible"), (KeyError("x"), "Impossible")],
)
async def test_what_a_device_says_has_its_class(tmp_path: Path, failure: Exception, error: str):
    desk = SecopService()
    desk.fails = failure
    async with node(desk, tmp_path) as port, talking(port) as talk:
        assert (await talk.asked("change linear:target 3"))[2][:2] == [error, str(failure)]


async def test_a_run_and_a_trip_refuse_orders_with_classes_of_their_own(tmp_path: Path):
    desk = SecopService()
    desk.phase = "running"
    async with node(desk, tmp_path) as port, talking(port) as talk:
        assert (await talk.asked("change linear:target 3"))[2][0] == "IsBusy"
        desk.phase = "held"
        desk.tripped = FaultState(rule="air_too_warm", text="the air is at 71 degC", since_ns=0)
        desk.gate.hold(INTERLOCK)
        desk.tell("tripped")
        await talk.ask("activate")
        while "[400, " not in await talk.until("update run:status "):
            pass
        assert (await talk.asked("change linear:target 3"))[2][0] == "Disabled"
        assert (await talk.asked("read chamber:status"))[2][0][0] == 400
        assert (await talk.asked("do run:clear_errors"))[0] == "done"


async def test_a_control_loop_that_hangs_is_an_error_and_no_old_value(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("thermostand.stand.serving.secop._OLD_S", -1.0)
    async with node(SecopService(), tmp_path) as port, talking(port) as talk:
        assert (await talk.asked("read chamber"))[2][0] == "CommunicationFailed"
