"""`stand check` over the wires of a simulated stand: what it finds, what it leaves alone, and the record it keeps."""

import asyncio
import json
import os
import signal
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from typer.testing import CliRunner

from tests.addresses import find_free_port
from thermostand.drivers.devices.device_check import Finding
from thermostand.foundation.clock import WallClock
from thermostand.foundation.documents import read_document
from thermostand.foundation.errors import DeviceFault, InUse
from thermostand.foundation.hub import Hub
from thermostand.stand.assembly.assemble import assemble
from thermostand.stand.assembly.simulator import ControlSocket, Simulator
from thermostand.stand.commands.check_cli import app
from thermostand.stand.commissioning.commissioning import commission
from thermostand.stand.config.check_record import explain_unchecked, load_check_record
from thermostand.stand.config.stand_config import load_config
from thermostand.stand.running.opening.open_stand import open_assembly
from thermostand.stand.running.opening.stand_lock import lock_stand
from thermostand.stand.running.opening.stop import Interrupted, Stop
from thermostand.stand.running.order import Order, load_order, read_register_texts


@pytest.fixture
def config(tmp_path: Path, order: Callable[..., Order], simulator: Callable[..., Simulator]) -> Path:
    """The file of a stand that answers."""
    order(camera={"boot_s": 0.2, "serial_number": "TS-0001"}, relays={"self_test_s": 0.6})
    path = tmp_path / "config.yaml"
    simulator(load_config(path), False)
    return path


def check(config: Path, *options: str) -> tuple[int, list[dict[str, Any]]]:
    """Its status, and what it found."""
    done = CliRunner().invoke(app, ["--config", str(config), "--json", *options])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.output
    return done.exit_code, json.loads(done.stdout)["findings"]


def verdicts(findings: list[dict[str, Any]], verdict: str) -> set[tuple[str, str]]:
    return {(finding["device"], finding["what"]) for finding in findings if finding["verdict"] == verdict}


def laboratory(config: Path, *requests: Mapping[str, object]) -> dict[str, object]:
    """The answer of the simulated plant to the last of the requests."""
    simulation = load_config(config).simulation
    assert simulation is not None
    address = simulation.control

    async def ask() -> dict[str, object]:
        control, answer = ControlSocket(address), dict[str, object]()
        await control.open()
        for request in requests:
            answer = await control.request(request)
        await control.close()
        return answer

    return asyncio.run(ask())


def test_without_moves_each_device_tells_what_it_is_and_the_record_goes_with_sessions(config: Path) -> None:
    before = laboratory(config, {"do": "state"})
    status, findings = check(config)
    assert (status, verdicts(findings, "failed")) == (0, set())
    assert ("relays", "point version") in verdicts(findings, "unverified")
    assert ("regulator", "point mv_at_pv_error") in verdicts(findings, "ok")  # by what its map expects
    reported = {each["device"]: each["data"] for each in findings if each["what"] == "identity"}
    assert {name: data["serial_number"] for name, data in reported.items()} == {
        "regulator": "", "thermometers": "", "relays": "", "flap": "00351210", "linear": "4101", "rotary": "4102"
    }  # fmt: skip
    after = laboratory(config, {"do": "state"})
    still = [name for name in before if name.endswith(("enabled", "_on", "powered", "position", "flap_open"))]
    assert still
    assert {name: after[name] for name in still} == {name: before[name] for name in still}

    record = load_check_record(config)
    assert record is not None
    assert not record.moved
    assert config.with_name("config.check.html").read_text().count("<tr>") > len(findings)
    assert load_order("demo", str(config)).attachments()["commissioning.json"] == record.text
    texts = {"config.yaml": read_document(config), **read_register_texts(load_config(config))}
    assert explain_unchecked(config, record, texts, is_simulated=False) == ""
    changed = explain_unchecked(config, record, {**texts, "config.yaml": "another"}, is_simulated=True)
    assert changed.startswith(f"{config} has changed since ")
    assert "registers-relays.yaml has changed" in explain_unchecked(
        config, record, {**texts, "registers-relays.yaml": ""}, is_simulated=True
    )
    assert "was never checked" in explain_unchecked(config, None, texts, is_simulated=False)
    assert explain_unchecked(config, None, texts, is_simulated=True) == ""


def test_what_is_wrong_is_reported_for_its_device_and_keeps_none_of_the_others(config: Path) -> None:
    known = yaml.safe_load(config.read_text())
    known["relays"]["unit"] = 7
    known["axes"]["linear"]["serial_number"] = 4109
    known["flap"]["serial_number"] = "1"
    known["bus"]["timeout_s"] = 0.2
    config.write_text(yaml.safe_dump(known))
    status, findings = check(config)
    assert status == 1
    assert verdicts(findings, "failed") == {
        ("relays", "link"), ("flap", "link"), ("linear", "identity"), ("camera", "link")
    }  # fmt: skip
    advice = {finding["device"]: finding["advice"] for finding in findings if finding["verdict"] == "failed"}
    assert "its number 7 and its line 115200 baud, parity N" in advice["relays"]
    assert "axes.linear.address and serial_number" in advice["linear"]
    assert "mend the relays first" in advice["camera"]
    assert ("thermometers", "each other") in verdicts(findings, "ok")
    record = load_check_record(config)
    assert record is not None
    assert record.failed == 4


def test_a_set_point_that_would_not_be_in_force_is_found_and_no_run_begins_with_it(
    tmp_path: Path, config_text: Callable[..., str], simulator: Callable[..., Simulator]
) -> None:
    data = yaml.safe_load(config_text(axes={}))
    del data["regulator"], data["relays"], data["axes"]["linear"], data["axes"]["rotary"]
    address = f"tcp:127.0.0.1:{find_free_port()}"
    limits: dict[str, object] = {"limits_at_panel_degC": [-10, 60], "gap_s": 0.0, "poll_s": 0.5}
    data["climate_chamber"] = {"protocol": "julabo", "address": address, **limits}
    config = tmp_path / "config.yaml"
    config.write_text(yaml.safe_dump(data))
    simulator(load_config(config), False)
    _, findings = check(config)
    assert ("regulator", "in force") in verdicts(findings, "ok")
    laboratory(config, {"do": "fault", "name": "chamber.bank", "value": 1})
    status, findings = check(config)
    assert (status, ("regulator", "in force") in verdicts(findings, "failed")) == (1, True)

    async def run() -> None:
        assembly = assemble(load_config(config), Hub(), WallClock())
        async with Stop() as stop, open_assembly(assembly, None, stop, is_for_one=True):
            pytest.fail("it is open")

    with pytest.raises(DeviceFault, match="working temperature T2 acts"):
        asyncio.run(run())


def test_with_moves_timer_flap_and_camera_are_measured_and_all_is_as_before(config: Path) -> None:
    known = yaml.safe_load(config.read_text())
    del known["axes"]  # homing takes longer than all the rest
    known["relays"]["self_test_s"] = 3.0  # a test that a busy machine holds up says nothing of the board
    config.write_text(yaml.safe_dump(known))
    laboratory(config, {"do": "fault", "name": "relays.no_rearm", "value": True})
    status, findings = check(config, "--moves")
    data = {(each["device"], each["what"]): each["data"] for each in findings}
    assert status == 1
    assert verdicts(findings, "failed") == {("relays", "timed-on")}
    assert not data["relays", "timed-on"]["rearmed"]
    assert 0.5 < data["flap", "travel"]["open_s"] < 5
    assert data["camera", "frames"]["dropped"] == 0
    assert data["camera", "identity"]["serial_number"] == "TS-0001"
    state = laboratory(config, {"do": "state"})
    assert not state["heater_enabled"]
    assert not state["camera_powered"]


async def test_one_that_is_broken_off_switches_the_cameras_off_again_that_it_has_switched_on(config: Path) -> None:
    known = yaml.safe_load(config.read_text())
    del known["axes"]
    known["cameras"]["camera"]["boot_s"] = 4.0
    config.write_text(yaml.safe_dump(known))
    found: list[Finding] = []
    checking = asyncio.create_task(commission(load_config(config), found.extend, has_moves=True))
    while not (await asyncio.to_thread(laboratory, config, {"do": "state"}))["camera_powered"]:
        await asyncio.sleep(0.1)
    os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(Interrupted, match="the stand is safe"):
        await checking
    assert not (await asyncio.to_thread(laboratory, config, {"do": "state"}))["camera_powered"]


async def test_a_stand_that_another_program_has_is_not_touched(config: Path, tmp_path: Path) -> None:
    reported: list[tuple[Finding, ...]] = []
    async with lock_stand(load_config(config), tmp_path / "session"):
        with pytest.raises(InUse, match="in use by session "):
            await commission(load_config(config), reported.append, has_moves=False)
    assert reported == []
