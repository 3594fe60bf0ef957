"""Which device has answered: what each tells, and one that was exchanged while nobody could reach it."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
import yaml

from thermostand.drivers.devices.inputs import Inputs
from thermostand.drivers.devices.relays import Relays
from thermostand.drivers.devices.thermometers import Thermometers, ThermometerSettings
from thermostand.drivers.settings import Identity, check_same_device
from thermostand.drivers.sim.physics.plant import Plant, PlantSpec
from thermostand.drivers.sim.units.modbus import TcpEngine
from thermostand.drivers.sim.units.relays import FakeRelays
from thermostand.drivers.sim.units.thermometers import FakeThermometers
from thermostand.drivers.sim.wire import LinkFaults, TcpWire
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import RegisterMap, load_register_map
from thermostand.foundation.clock import FollowedClock, WallClock
from thermostand.foundation.documents import parse_document
from thermostand.foundation.errors import DeviceFault, Unreachable

MAPS = Path(__file__).parents[2] / "configs" / "registers"
START_NS = 1_700_000_000_000_000_000
A = Identity("Make", "M", "1", "2.00")


class Bench:
    """A board and a module on one line, with their drivers."""

    def __init__(self) -> None:
        plant, clock = Plant(PlantSpec(), START_NS), FollowedClock(START_NS)
        self.board = FakeRelays(plant, clock, 2, {"heater_enable": 0, "compressor": 1})
        self.module = FakeThermometers(plant, clock, 3, {"air": 0}, seed=1)
        units = [self.board, self.module]
        self.wire = TcpWire("127.0.0.1", 0, lambda: TcpEngine(units), LinkFaults())
        self.bus = Bus("bus", BusSettings(address=self.wire.address, timeout_s=0.3), WallClock())
        relay_map = load_register_map(MAPS / "waveshare-relay.yaml").at_unit(2)
        self.relays = Relays("relays", self.bus, relay_map, {"heater_enable": 0, "compressor": 1})
        module_map = load_register_map(MAPS / "icpdas-m7015.yaml").at_unit(3)
        air = {"air": ThermometerSettings(channel=0)}
        self.thermometers = Thermometers("thermometers", self.bus, module_map, air, WallClock())


@pytest.fixture
async def bench() -> AsyncIterator[Bench]:
    bench = Bench()
    await bench.bus.open()
    await bench.relays.open()
    await bench.thermometers.open()
    yield bench
    await bench.bus.close()
    bench.wire.close()


async def test_units_tell_what_their_map_knows_to_ask(bench: Bench) -> None:
    assert str(bench.relays.identity) == "Waveshare Modbus RTU Relay (8) (by its register map), version 2"
    assert str(bench.thermometers.identity) == "ICP DAS M-7015 0x701500, version 0x10000"


async def test_a_board_exchanged_while_it_was_silent_is_not_switched_on_and_is_switched_off(bench: Bench) -> None:
    bench.board.silent = True
    with pytest.raises(Unreachable):
        await bench.relays.read()
    bench.board.silent, bench.board.version = False, 300
    with pytest.raises(DeviceFault, match=r"relays: was exchanged: .* version 3 answers where .* version 2 answered"):
        await bench.relays.hold_on("heater_enable", 3.0)
    assert not bench.board.closed("heater_enable")
    with pytest.raises(DeviceFault, match="was exchanged"):
        await bench.relays.read()
    await bench.relays.make_safe()


async def test_a_module_exchanged_while_it_was_silent_is_not_read(bench: Bench) -> None:
    bench.module.silent = True
    with pytest.raises(Unreachable):
        await bench.thermometers.read()
    bench.module.silent, bench.module.name = False, bytes.fromhex("00 70 18 00")
    with pytest.raises(DeviceFault, match=r"0x701800.* answers where .*0x701500.* answered before"):
        await bench.thermometers.read()


async def test_contacts_of_a_board_exchanged_while_it_was_silent_are_not_read(bench: Bench) -> None:
    data = yaml.safe_load((MAPS / "waveshare-inputs.yaml").read_text())
    relay_map = yaml.safe_load((MAPS / "waveshare-relay.yaml").read_text())
    data["points"]["version"] = relay_map["points"]["version"]
    data["identity"] = relay_map["identity"]
    inputs_map = parse_document(yaml.safe_dump(data), RegisterMap, "inputs")
    bench.board.closed_inputs = {0}
    inputs = Inputs("inputs", bench.bus, inputs_map, {"door": 0}, WallClock())
    await inputs.open()
    bench.board.silent = True
    with pytest.raises(Unreachable):
        await inputs.read()
    bench.board.silent, bench.board.version = False, 300
    for _ in range(2):
        with pytest.raises(DeviceFault, match="was exchanged"):
            await inputs.read()


@pytest.mark.parametrize(
    ("found", "is_same"),
    [
        (A, True),
        (Identity("Make", "M", "", ""), True),  # what is not stated cannot differ
        (Identity("Make", "M", "2", "2.00"), False),
        (Identity("Make", "M", "1", "2.01"), False),
        (Identity("Make", "N", "1", "2.00"), False),
        (Identity("Other", "M", "1", "2.00"), False),
    ],
)
def test_another_device_is_recognised_by_what_both_state(found: Identity, is_same: bool) -> None:
    assert check_same_device("camera", found, None) == found
    if is_same:
        assert check_same_device("camera", found, A) == found
    else:
        with pytest.raises(DeviceFault, match=r"exchanged: .* Make M, serial number 1, version 2\.00"):
            check_same_device("camera", found, A)
