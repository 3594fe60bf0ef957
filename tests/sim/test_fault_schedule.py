"""Faults by name: each of the table can be set and mended, and is planned in one line of text."""

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from tests.addresses import allocate_camera_address
from thermostand.drivers.sim.control import Control
from thermostand.drivers.sim.laboratory import Laboratory, LaboratorySpec
from thermostand.drivers.sim.laboratory_faults import (
    FAULTS,
    FaultSchedule,
    PlannedFault,
    inject,
    list_known_faults,
    parse_fault,
)
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.stand.assembly.simulator import describe_laboratory
from thermostand.stand.config.stand_config import find_packaged, load_config

START_NS = 1_767_290_400_000_000_000
S = 1_000_000_000


CHAMBER = {"protocol": "espec", "address": "tcp:127.0.0.1:0", "unit": 1, "limits_degC": [-10, 60]}


@pytest.fixture(params=[None, CHAMBER], ids=["regulator", "chamber"])
def laboratory(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Laboratory]:
    config = load_config(find_packaged("", "simulated"))
    described = describe_laboratory(config, virtual=True, seed=None, start_ns=START_NS, is_anywhere=True)
    devices = cast("dict[str, Any]", described["devices"])
    if request.param is not None:
        devices["chamber"] = {"fake": "climate_chamber.espec", "settings": request.param}
    devices["heat_module"] = {"fake": "heat_module", "settings": {"unit": 9, "channel": 0}}
    devices["imager"] = {"fake": "imager", "settings": {"folder": None, "spots": {"lens": {"x_px": 80, "y_px": 60}}}}
    devices["reference"] = {
        "fake": "probes.hart",
        "settings": {"protocol": "hart", "serial_number": None, "address": "tcp:127.0.0.1:0"},
    }
    devices["ups"] = {"fake": "ups", "settings": {"ups": None, "address": "tcp:127.0.0.1:0"}}
    devices["linear"]["settings"]["address"] = f"serial:{tmp_path / 'linear'}"
    devices["camera"]["settings"]["address"] = allocate_camera_address()
    built = Laboratory(parse_document(json.dumps(described), LaboratorySpec, "laboratory"))
    yield built
    built.close()


@pytest.mark.parametrize(
    ("text", "planned"),
    [
        ("flap.jam", PlannedFault("flap.jam", 2000)),
        ("bus.drop@600", PlannedFault("bus.drop", 0.05, 600.0)),
        ("bus.drop:30", PlannedFault("bus.drop", 0.05, 0.0, 30.0)),
        ("bus.drop=0.5@1.5h:2min", PlannedFault("bus.drop", 0.5, 5400.0, 120.0)),
        ("linear.limit_hit=left@5s", PlannedFault("linear.limit_hit", "left", 5.0)),
        ('thermometer.offset_K={"air": 3}@1h:60', PlannedFault("thermometer.offset_K", {"air": 3}, 3600.0, 60.0)),
    ],
)
def test_a_fault_is_one_line(text: str, planned: PlannedFault):
    assert parse_fault(text) == planned


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("bus.drip", "did you mean bus.drop"),
        ("drop", "expected NAME"),
        ("bus.drop@soon", "expected NAME"),
        ("bus.drop:1day", "expected NAME"),
        ("qq.zz", "--faults"),
    ],
)
def test_what_is_no_fault_is_refused_by_a_sentence(text: str, word: str):
    with pytest.raises(ConfigError, match=word):
        parse_fault(text)


def test_each_fault_of_the_table_is_set_and_mended(laboratory: Laboratory):
    for name, fault in FAULTS.items():
        if name.startswith("chamber.") and "chamber" not in laboratory.fakes:
            with pytest.raises(ValueError, match="has no"):
                inject(laboratory, name, fault.worst)
            continue
        inject(laboratory, name, fault.worst)
        inject(laboratory, name, fault.mended)
        assert fault.text, name


def test_every_line_of_the_stand_has_the_faults_of_a_link(laboratory: Laboratory):
    with pytest.raises(ConfigError, match=r"no reference\.drop"):
        parse_fault("reference.drop=0.5")
    schedule = FaultSchedule(laboratory, [parse_fault("reference.drop=0.5", list_known_faults(laboratory))])
    assert schedule.list_standing() == {"reference.drop": 0.5}
    assert laboratory.link("reference").faults.drop == 0.5
    schedule.mend("reference.drop")
    assert laboratory.link("reference").faults.drop == 0.0


def test_planned_faults_come_and_go_at_their_instants(laboratory: Laboratory):
    planned = ("regulator.sensor_break@10:5", 'thermometer.offset_K={"air": 2.5}@12', "bus.unplugged@3:4", "bus.silent")
    schedule = FaultSchedule(laboratory, map(parse_fault, planned))
    assert laboratory.link("bus").faults.silent
    seen: list[tuple[int, bool]] = []
    laboratory.plant.on_step.append(lambda at_ns, _: seen.append((at_ns - START_NS, laboratory.regulator.sensor_break)))
    for second in (5, 9, 30):
        schedule.advance(START_NS + second * S)
    broken_ns = [at_ns for at_ns, broken in seen if broken]
    assert 10 * S <= min(broken_ns) <= max(broken_ns) < 15 * S
    assert not laboratory.regulator.sensor_break
    assert laboratory.thermometers.offset_K == {3: 2.5}


def test_time_without_a_plan_moves_as_before(laboratory: Laboratory):
    control = Control(laboratory, FaultSchedule(laboratory, ()), lambda: None)
    request = json.dumps({"do": "advance", "now_ns": START_NS + S}).encode()
    assert json.loads(control.answer(request)) == {"now_ns": START_NS + S}
    assert laboratory.now_ns == START_NS + S


def test_a_plan_for_a_missing_device_is_refused(laboratory: Laboratory):
    laboratory.fakes.pop("rotary")
    for text in ("rotary.restart", "axis.alarm=rotary@2h", 'thermometer.offset_K={"roof": 1}@10'):
        with pytest.raises(ConfigError, match=r"rotary|roof"):
            FaultSchedule(laboratory, [parse_fault(text)])
    assert FaultSchedule(laboratory, [parse_fault("bus.unplugged@3:4")]).list_standing() == {}
    assert not laboratory.link("bus").faults.silent


def test_an_unplugged_port_is_another_one_when_it_is_back(laboratory: Laboratory, tmp_path: Path):
    was = (tmp_path / "linear").readlink()
    held = open(was, "rb+", buffering=0)  # noqa: SIM115 - the driver still has it open
    inject(laboratory, "linear.unplugged", True)
    assert not (tmp_path / "linear").exists()
    inject(laboratory, "linear.unplugged", False)
    assert (tmp_path / "linear").exists()
    assert (tmp_path / "linear").readlink() != was
    held.close()


def test_the_simulator_lists_its_faults():
    listed = subprocess.run(
        [sys.executable, "-m", "thermostand.drivers.sim", "--faults"], capture_output=True, check=True
    ).stdout
    assert [row["name"] for row in json.loads(listed)] == sorted(FAULTS)


def test_a_second_laboratory_on_the_same_serial_lines_is_refused_with_a_sentence(laboratory: Laboratory):
    text = laboratory.spec.model_dump_json()
    spec = parse_document(text, LaboratorySpec, "laboratory")
    spec = spec.model_copy(update={"cameras": {}})  # the other addresses are free ones
    with pytest.raises(ConfigError, match=r"another simulator .*serial:.*linear\)"):
        Laboratory(spec)
