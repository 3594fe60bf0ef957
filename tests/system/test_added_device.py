"""A kind of device that another package adds is found everywhere by its one row, and its fake by its name."""

import asyncio
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
import yaml

from tests.addresses import find_free_port
from tests.installed import install, see_it_everywhere
from thermostand.drivers.devices.device_check import Finding
from thermostand.drivers.devices.kinds import ADDED, load_built_in_kinds
from thermostand.drivers.sim.fakes import FAKES, get_fake
from thermostand.foundation.clock import VirtualClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import ConfigError
from thermostand.foundation.hub import Hub
from thermostand.recording.reading.session import Session
from thermostand.stand.assembly.assemble import assemble, list_device_kinds
from thermostand.stand.assembly.simulator import Simulator, describe_laboratory, relocate
from thermostand.stand.commissioning.commissioning import commission
from thermostand.stand.config.stand_config import StandConfig, find_packaged
from thermostand.stand.running.opening.stand_lock import list_addresses
from thermostand.stand.running.order import Order
from thermostand.stand.service.bench import list_devices, run_device_verb
from thermostand.stand.service.run import run_virtual

EXAMPLE = Path(__file__).parents[2] / "docs" / "examples" / "lamp"
MODULE = (EXAMPLE / "acme_lamp.py").read_text(encoding="utf-8")
FAKE = (EXAMPLE / "acme_fake.py").read_text(encoding="utf-8")


@pytest.fixture
def lamp(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """The package, installed, for this process and those that it starts; nothing of this program knows it."""
    folder = tmp_path / "site"
    points = {
        "thermostand.devices": "lamp = acme_lamp:KIND\ndim = acme_lamp:KIND\nnone = acme_none:KIND",
        "thermostand.fakes": "lamp = acme_fake:FakeLamp\nburnt = acme_burnt:FakeLamp",
    }
    install(folder, "acme-lamp", {"acme_lamp": MODULE, "acme_fake": FAKE}, points)
    see_it_everywhere(folder, monkeypatch)
    yield
    sys.modules.pop("acme_lamp", None)


RECIPE = """
name: short
experiments:
  - steps: [{start_chamber: 24}, {soak: 60}]
"""


def stand_with(**device: object) -> StandConfig:
    data: dict[str, Any] = yaml.safe_load(find_packaged("", "simulated").read_text())
    data["devices"] = {"beam": {"kind": "lamp", "address": "tcp:127.0.0.1:15099", **device}}
    return parse_document(yaml.safe_dump(data), StandConfig, "stand.yaml")


def test_each_kind_of_device_has_its_fake_and_each_fake_its_kind():
    named = [(kind.name if kind.section == ADDED else kind.section, kind) for kind in load_built_in_kinds()]
    settings = {name: kind.fakes if kind.fakes is not None else (name,) for name, kind in named}
    settings["regulator"] = ("regulator",)  # of the two kinds in that section, one has nothing to be simulated
    get_fake("relays")
    assert sorted(FAKES) == sorted(key for keys in settings.values() for key in keys)


@pytest.mark.usefixtures("lamp")
def test_a_fake_that_cannot_be_loaded_is_named_with_its_package():
    with pytest.raises(ConfigError, match=r"burnt: acme-lamp 1.0 cannot be loaded .*; reinstall it"):
        get_fake("burnt")


@pytest.fixture
def laboratory(lamp: None) -> Iterator[StandConfig]:
    """The stand with a lamp, at the addresses of a simulated laboratory that runs in real time."""
    config = stand_with()
    config = config.model_copy(update={"cameras": {}, "axes": {}, "flap": None})
    started = Simulator(describe_laboratory(config, virtual=False, seed=None, is_anywhere=True))
    yield relocate(config, started.addresses)
    started.stop()


@pytest.mark.usefixtures("lamp")
def test_a_stand_s_file_names_it_and_its_settings_are_checked():
    assert [(each.name, each.kind.name, each.poll_s) for each in stand_with().equipment if each.name == "beam"] == [
        ("beam", "lamp", 1.0)
    ]
    for device, sentence in (
        ({"poll_s": -1}, "devices.beam: poll_s: must be greater than 0"),
        ({"colour": "red"}, "devices.beam: colour: unknown key"),
        ({"kind": "torch"}, "devices.beam: no package adds a device of kind 'torch'; there are dim, lamp, none"),
        ({"kind": "none"}, "devices.beam: none: acme-lamp 1.0 cannot be loaded .*; reinstall it"),
        ({"kind": "dim"}, "devices.beam: dim: acme-lamp 1.0 has no DeviceKind of that name there"),
        ({"address": "tcp:127.0.0.1:15020"}, "bus and devices need addresses of their own"),
    ):
        with pytest.raises(ConfigError, match=sentence):
            stand_with(**device)


@pytest.mark.usefixtures("lamp")
def test_it_is_locked_made_polled_shown_and_rehearsed():
    config = stand_with()
    assert ("beam", "tcp 127.0.0.1:15099") in {
        (each.device, each.place.partition(" in ")[0]) for each in list_addresses(config)
    }
    assembly = assemble(config, Hub(), VirtualClock(0))
    assert "beam" in [poller.sensor.name for poller in assembly.make_pollers()]
    assert list_device_kinds(config)["beam"] == "lamp"
    (known,) = [each for each in list_devices(config) if each.name == "beam"]
    assert [verb.verb for verb in known.verbs] == ["read", "shine"]
    assert [(each.name, each.unit, each.maximum) for each in known.verbs[1].arguments] == [("percent", "%", 90.0)]


def test_the_check_looks_at_it_and_says_what_to_do(laboratory: StandConfig):
    found: list[Finding] = []
    asyncio.run(commission(laboratory, found.extend, has_moves=False))
    assert [(each.what, each.verdict, each.text) for each in found if each.device == "beam"] == [
        ("identity", "ok", "Acme L1, serial number 7"),
        ("reading", "ok", "current 0 A"),
    ]
    device = laboratory.devices["beam"].model_copy(update={"address": "tcp:127.0.0.1:9"})
    found.clear()
    silent = laboratory.model_copy(update={"devices": {"beam": device}})
    asyncio.run(commission(silent, found.extend, has_moves=False))
    (lost,) = [each for each in found if each.device == "beam"]
    assert (lost.what, lost.verdict) == ("link", "failed")
    assert "its address right" in lost.advice


def test_it_obeys_by_hand_and_is_safe_afterwards(laboratory: StandConfig):
    def ask(verb: str, **arguments: int) -> float:
        done = asyncio.run(run_device_verb(laboratory, "beam", verb, arguments, None, print))
        ((reading,),) = (cast("list[dict[str, float]]", done.data),)
        return reading["value"]

    assert ask("shine", percent=40) == pytest.approx(0.4)
    assert ask("read") == 0.0
    with pytest.raises(ConfigError, match=r"dim; .* read, shine"):
        ask("dim")


@pytest.mark.usefixtures("lamp")
async def test_a_run_records_what_it_reads(tmp_path: Path, order: Callable[..., Order]):
    ordered = order(RECIPE, devices={"beam": {"kind": "lamp", "address": f"tcp:127.0.0.1:{find_free_port()}"}})
    session = Session.open(await run_virtual(ordered, tmp_path / "out", None, lambda hub: None))
    times_ns, values, *_ = session.readings("beam.current")
    assert len(times_ns) > 10
    assert set(values) == {0.0}
    (identity,) = [
        each for each in session.events() if each.kind == "device_identity" and each.data["device"] == "beam"
    ]
    assert identity.data["vendor"] == "Acme"
