"""The relay driver against pymodbus servers with the Waveshare board's coils and timed-on commands."""

from __future__ import annotations

import struct
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import ClassVar

import pytest
from pymodbus.datastore import ModbusServerContext
from pymodbus.pdu import ModbusPDU
from pymodbus.simulator import DataType, SimData, SimDevice

from thermostand.drivers.devices.relays import Relays
from thermostand.drivers.wires.bus import Bus, BusSettings
from thermostand.drivers.wires.registers import load_register_map
from thermostand.foundation.clock import WallClock
from thermostand.foundation.errors import ConfigError, DeviceFault, GarbledReply, Refused, Unreachable

Serve = Callable[..., Awaitable[str]]  # the fixture serve_modbus

MAP = load_register_map(Path(__file__).parents[2] / "configs" / "registers" / "waveshare-relay.yaml")
UNIT = 2
CHANNELS = {"heater_enable": 0, "compressor": 1, "camera_power": 4}


class BoardWrite(ModbusPDU):
    """FC 05 on the server's side, where pymodbus keeps no raw value: on, off, timed-on."""

    function_code = 5
    rtu_frame_size = 8
    stuck: ClassVar[set[int]] = set()  # coils that do not move
    lost_replies: ClassVar[list[bool]] = []  # consumed one a write: True = the write acts, its reply is mangled
    lost_writes: ClassVar[list[bool]] = []  # consumed one a write: True = it has no effect
    written: ClassVar[list[tuple[int, int]]] = []

    def encode(self) -> bytes:
        return struct.pack(">HH", self.address, self.registers[0])

    def decode(self, data: bytes) -> None:
        self.address, value = struct.unpack(">HH", data[:4])
        self.registers = [value]

    async def datastore_update(self, context: ModbusServerContext, device_id: int) -> ModbusPDU:
        value = self.registers[0]
        self.written.append((self.address, value))
        coil, on = (self.address, value == 0xFF00) if self.address < 8 else (self.address - 0x0200, True)
        lost = bool(self.lost_writes) and self.lost_writes.pop(0)
        if coil not in self.stuck and not lost:
            await context.async_setValues(device_id, 5, coil, [on])
        if self.lost_replies and self.lost_replies.pop(0):
            self.registers = [value ^ 1]
        return self


@pytest.fixture
def board() -> type[BoardWrite]:
    BoardWrite.stuck, BoardWrite.lost_replies, BoardWrite.written = set(), [], []
    BoardWrite.lost_writes = []
    return BoardWrite


@pytest.fixture
async def bus(serve_modbus: Serve, board: type[BoardWrite]) -> AsyncIterator[Bus]:
    coils = [SimData(0, values=[False] * 8, datatype=DataType.BITS)]
    words = [SimData(0, values=0, datatype=DataType.REGISTERS)]
    address = await serve_modbus([SimDevice(UNIT, simdata=(coils, coils, words, words))], [board])
    bus = Bus("rs485", BusSettings(address=address, timeout_s=0.3, gap_s=0.0), WallClock())
    await bus.open()
    yield bus
    await bus.close()


@pytest.fixture
async def relays(bus: Bus) -> Relays:
    relays = Relays("relays", bus, MAP, CHANNELS)
    await relays.open()
    return relays


async def states(relays: Relays) -> dict[str, float]:
    return {reading.channel: reading.value for reading in await relays.read()}


async def test_relays_switch_and_are_read_back(relays: Relays, board: type[BoardWrite]) -> None:
    await relays.switch("compressor", True)
    assert board.written == [(1, 0xFF00)]
    assert await states(relays) == {"relays.heater_enable": 0, "relays.compressor": 1, "relays.camera_power": 0}
    await relays.switch("compressor", False)
    assert board.written[1:] == [(1, 0x0000)]
    assert await states(relays) == {"relays.heater_enable": 0, "relays.compressor": 0, "relays.camera_power": 0}


async def test_hold_on_sends_the_time_in_tenths_of_a_second(relays: Relays, board: type[BoardWrite]) -> None:
    await relays.hold_on("heater_enable", 15.0)
    await relays.hold_on("camera_power", 0.7)
    assert board.written == [(0x0200, 150), (0x0204, 7)]
    assert (await states(relays))["relays.heater_enable"] == 1.0


async def test_a_time_the_board_cannot_count_is_a_mistake(relays: Relays, board: type[BoardWrite]) -> None:
    for duration_s in (0.0, 0.04, 3276.9):
        with pytest.raises(ValueError, match="is not 1"):
            await relays.hold_on("heater_enable", duration_s)
    assert board.written == []


async def test_a_relay_that_does_not_move_is_an_error(relays: Relays, board: type[BoardWrite]) -> None:
    board.stuck = {0}
    with pytest.raises(Refused, match="relays: heater_enable on was acknowledged"):
        await relays.switch("heater_enable", True)
    with pytest.raises(Refused):
        await relays.hold_on("heater_enable", 15.0)


async def test_a_lost_reply_is_settled_by_reading_back(relays: Relays, board: type[BoardWrite]) -> None:
    board.lost_replies = [True]
    await relays.switch("compressor", True)
    assert len(board.written) == 1


async def test_a_lost_write_is_sent_once_more_after_reading_back(relays: Relays, board: type[BoardWrite]) -> None:
    board.lost_replies, board.stuck = [True, True], {1}
    with pytest.raises(GarbledReply, match="the reply has"):
        await relays.switch("compressor", True)
    assert len(board.written) == 2


async def test_make_safe_turns_off_all_but_the_camera(relays: Relays) -> None:
    for channel in CHANNELS:
        await relays.switch(channel, True)
    await relays.make_safe()
    assert await states(relays) == {"relays.heater_enable": 0, "relays.compressor": 0, "relays.camera_power": 1}


async def test_make_safe_tries_every_relay_and_names_the_one_still_on(relays: Relays, board: type[BoardWrite]) -> None:
    await relays.switch("heater_enable", True)
    await relays.switch("compressor", True)
    board.stuck = {0}
    with pytest.raises(DeviceFault, match="not confirmed off: heater_enable"):
        await relays.make_safe()
    assert await states(relays) == {"relays.heater_enable": 1, "relays.compressor": 0, "relays.camera_power": 0}


async def test_make_safe_tries_once_more_what_was_not_confirmed(relays: Relays, board: type[BoardWrite]) -> None:
    await relays.switch("heater_enable", True)
    board.lost_replies, board.lost_writes = [True, True], [True, True]  # the first attempt and its repetition
    await relays.make_safe()
    assert await states(relays) == {"relays.heater_enable": 0, "relays.compressor": 0, "relays.camera_power": 0}


async def test_a_missing_board_fails_to_open(bus: Bus) -> None:
    with pytest.raises((Unreachable, Refused), match="unit 9"):
        await Relays("relays", bus, MAP.at_unit(9), CHANNELS).open()


def test_a_relay_that_the_map_has_not_is_a_config_error() -> None:
    bus = Bus("rs485", BusSettings(address="tcp:localhost:502"), WallClock())
    with pytest.raises(ConfigError, match=r"relays.a: register map .* has no relay_8"):
        Relays("relays", bus, MAP, {"a": 8})


def test_a_board_without_a_timed_on_is_refused_for_heat_and_cold_and_may_feed_a_camera() -> None:
    bus = Bus("rs485", BusSettings(address="tcp:localhost:502"), WallClock())
    points = {name: point.model_copy(update={"pulse": None}) for name, point in MAP.points.items()}
    plain = MAP.model_copy(update={"points": points})
    for channel in ("heater_enable", "compressor", "heat"):
        with pytest.raises(ConfigError, match=rf"relays.{channel}: .* no timed-on of relay_0"):
            Relays("relays", bus, plain, {channel: 0})
    Relays("relays", bus, plain, {"camera_power": 0})
