"""One unit on a bus, spoken to in the names of its register map; every write is read back."""

from __future__ import annotations

from collections.abc import Awaitable, Callable, Iterable

from drivers.settings import Identity, same_device
from drivers.wires.bus import Bus
from drivers.wires.registers import (
    Block,
    Command,
    RegisterMap,
    Snapshot,
    Told,
    decode,
    decode_blocks,
    encode,
    plan_blocks,
)
from foundation.errors import DeviceError, DeviceFault, Refused, Unreachable

WRITE_TRIES = 2
CONFIRM_LOOKS = 3  # a status bit may lag its command by a scan of the unit


class ModbusUnit:
    """Points and commands of one unit. `name` is the device in every error. identity: as of the last probe, None before
    the first."""

    def __init__(self, name: str, bus: Bus, register_map: RegisterMap) -> None:
        self.name = name
        self.map = register_map
        self.identity: Identity | None = None
        self._bus = bus
        self._unit = register_map.transport.unit
        self._plans: dict[tuple[str, ...], tuple[Block, ...]] = {}  # of the polls, which ask for the same every time

    async def snapshot(self, names: Iterable[str]) -> Snapshot:
        """Read the named points, in as few requests as possible."""
        wanted = tuple(names)
        if wanted not in self._plans:
            self._plans[wanted] = plan_blocks(self.map, wanted)
        try:
            replies = {
                block: await self._bus.read(self.name, self._unit, block.space, block.address, block.count)
                for block in self._plans[wanted]
            }
        except Unreachable as error:
            if self.map.when_silent and self._bus.is_up:
                raise Unreachable(self.name, f"{error.text}; {self.map.when_silent}") from error
            raise
        return decode_blocks(self.map, replies)

    async def probe(self) -> None:
        """Read what proves the unit's identity and settings; DeviceFault when it is not what the map says, or another
        unit than the one that was probed first."""
        snapshot = await self.snapshot(probe.point for probe in self.map.probe)
        for probe in self.map.probe:
            found = snapshot.samples[probe.point].value
            if found != probe.expect:
                raise DeviceFault(
                    self.name, f"{probe.point} is {found:g} where the register map expects {probe.expect:g}; not used"
                )
        self.identity = same_device(self.name, await self._told(), self.identity)

    async def _told(self) -> Identity:
        """What the unit tells of itself; vendor and model are otherwise those of the map."""
        told = {field: await self._told_one(told) for field, told in self.map.identity.items()}
        model = told.get("model", "")
        return Identity(
            self.map.vendor,
            f"{self.map.model} {model}".rstrip(),
            told.get("serial_number", ""),
            told.get("version", ""),
            by_map=not model,
        )

    async def _told_one(self, told: Told) -> str:
        """Nothing when the unit does not have the point: it refuses it, or one that was never seen cannot be read."""
        try:
            sample = (await self.snapshot([told.point])).samples[told.point]
        except DeviceError as error:
            if isinstance(error, Refused) or self.map.points[told.point].unverified:
                return ""
            raise
        if sample.reason:
            return ""
        return f"{sample.value:g}" if told.shown == "number" else f"{sample.raw:#x}"

    async def write(self, point_name: str, value: float) -> float:
        """Write a register point and read it back; the value as the unit took it, rounded to its scale.

        Refused: outside the limits (nothing is sent), or not taken over.
        """
        point = self.map.points[point_name]
        try:
            words = encode(point, value)
        except ValueError as error:
            raise Refused(self.name, f"{point_name}: {error}; nothing was sent") from error

        async def send() -> None:
            if len(words) == 1 and self.map.transport.write_fc == 6:
                await self._bus.write_register(self.name, self._unit, point.address, words[0])
            else:
                await self._bus.write_registers(self.name, self._unit, point.address, words)

        async def holds() -> bool:
            return await self._bus.read(self.name, self._unit, point.space, point.address, point.words) == words

        await self.checked(send, holds, f"{point_name} = {value:g} {point.unit}")
        return decode(point, words).value

    async def write_coil(self, address: int, raw_value: int) -> None:
        """FC 05 once, not read back: for `checked`."""
        await self._bus.write_coil(self.name, self._unit, address, raw_value)

    async def command(self, command_name: str) -> None:
        """Send a command of the map, all its writes in order, and see it confirmed."""
        command = self.map.commands[command_name]
        is_sent = False  # whole: what confirms it may be the effect of its first write alone

        async def send() -> None:
            nonlocal is_sent
            is_sent = len(command.steps) == 1
            for step in command.steps:
                if self.map.transport.write_fc == 6:
                    await self._bus.write_register(self.name, self._unit, step.address, step.value)
                else:
                    await self._bus.write_registers(self.name, self._unit, step.address, [step.value])
            is_sent = True

        async def holds() -> bool:
            for _ in range(CONFIRM_LOOKS if is_sent else 0):
                if is_confirmed(command, await self.snapshot([command.confirm.point])):
                    return True
            return False

        await self.checked(send, holds, f"command {command_name}")

    async def checked(
        self, send: Callable[[], Awaitable[None]], holds: Callable[[], Awaitable[bool]], what: str
    ) -> None:
        """Send, then see that it holds. Only when its reply was lost and it does not hold is it sent once more."""
        lost: DeviceError | None = None
        for _ in range(WRITE_TRIES):
            lost = None
            try:
                await send()
            except DeviceError as error:
                if not error.retryable:
                    raise
                lost = error
            if await holds():
                return
            if lost is None:
                raise Refused(self.name, f"{what} was acknowledged but reads back otherwise")
        if lost is not None:
            raise lost


def is_confirmed(command: Command, snapshot: Snapshot) -> bool:
    """Whether what confirms `command` is so in a snapshot that has read its point."""
    confirm = command.confirm
    if confirm.equals is not None:
        return snapshot.samples[confirm.point].value == confirm.equals
    return snapshot.bits[confirm.bit] == confirm.is_
