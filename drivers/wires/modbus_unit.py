"""One unit on a bus, spoken to in the names of its register map; every write is read back.

Below `ModbusUnit` is its codec, without I/O: words to values and back, and which requests cover what is asked for.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Awaitable, Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

from thermostand.drivers.settings import Identity, check_same_device
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.registers import (
    IdentityPoint,
    InForceCheck,
    Point,
    PointType,
    RegisterCommand,
    RegisterMap,
    Space,
    Split,
)
from thermostand.foundation.errors import DeviceError, DeviceFault, Refused, Unreachable

WRITE_TRIES = 2  # a write is read back, so a second one does no harm
CONFIRM_LOOKS = 3  # a status bit may lag its command by a scan of the unit
FORMATS: dict[PointType, str] = {"int16": ">h", "uint16": ">H", "int32": ">i", "uint32": ">I", "float32": ">f"}
_SMALLEST = 1e-30  # a float of exchanged words is next to nothing: 25.0 would be 2.4e-41


@dataclass(frozen=True, slots=True)
class Block:
    """Addresses read in one request, and the points in it."""

    space: Space
    address: int
    count: int
    names: tuple[str, ...]


class Sample(NamedTuple):
    """One decoded point: the raw word(s) as an unsigned number; `value` is NaN exactly when `reason` is not empty."""

    raw: int
    value: float
    reason: str = ""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Decoded points (split ones under both names) and bits of one poll."""

    samples: Mapping[str, Sample]
    bits: Mapping[str, bool]


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
        self.identity = check_same_device(self.name, await self._read_identity(), self.identity)

    async def _read_identity(self) -> Identity:
        """Return what the unit reports of itself; vendor and model are otherwise those of the map."""
        stated = {field: await self._identity_field(stated) for field, stated in self.map.identity.items()}
        model = stated.get("model", "")
        return Identity(
            self.map.vendor,
            f"{self.map.model} {model}".rstrip(),
            stated.get("serial_number", ""),
            stated.get("version", ""),
            by_map=not model,
        )

    async def _identity_field(self, stated: IdentityPoint) -> str:
        """Read a part of the identity; "" when the unit does not have the point: it refuses it, or one that was never
        seen cannot be read."""
        try:
            sample = (await self.snapshot([stated.point])).samples[stated.point]
        except DeviceError as error:
            if isinstance(error, Refused) or self.map.points[stated.point].unverified:
                return ""
            raise
        if sample.reason:
            return ""
        return f"{sample.value:g}" if stated.shown == "number" else f"{sample.raw:#x}"

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

        await self.send_and_check(send, holds, f"{point_name} = {value:g} {point.unit}")
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

        await self.send_and_check(send, holds, f"command {command_name}")

    async def send_and_check(
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


def is_confirmed(command: RegisterCommand, snapshot: Snapshot) -> bool:
    """Return whether what confirms `command` is so in a snapshot that has read its point."""
    confirm = command.confirm
    if confirm.equals is not None:
        return snapshot.samples[confirm.point].value == confirm.equals
    return snapshot.bits[confirm.bit] == confirm.is_


def find_objection(check: InForceCheck, snapshot: Snapshot) -> str:
    """Return why the set-point that was written is not the one that acts, by a snapshot that has read the points of the
    check; "" when this one does not object."""
    if check.bit:
        return "" if snapshot.bits[check.bit] == check.is_ else f"{check.says} ({check.bit} is {int(not check.is_)})"
    found, wanted = snapshot.samples[check.point], check.equals
    if check.follows:
        wanted = snapshot.samples[check.follows].value
    if wanted is None or abs(found.value - wanted) <= (check.within if check.follows else 0.0):
        return ""
    shown = found.reason or f"{found.value:g}"
    folder = f", {check.follows} {wanted:g}" if check.follows else ""
    return f"{check.says} ({check.point} is {shown}{folder})"


def plan_blocks(register_map: RegisterMap, names: Iterable[str]) -> tuple[Block, ...]:
    """The fewest reads that cover `names`: by address, gaps and lengths as the transport allows."""
    blocks: list[Block] = []
    points = register_map.points
    for name in sorted(set(names), key=lambda name: (points[name].space, points[name].address)):
        point = points[name]
        end = point.address + point.words
        last = blocks[-1] if blocks else None
        if (
            last is not None
            and last.space == point.space
            and point.address - (last.address + last.count) <= register_map.transport.max_gap_words
            and end - last.address <= register_map.transport.max_read_words
        ):
            blocks[-1] = Block(last.space, last.address, end - last.address, (*last.names, name))
        else:
            blocks.append(Block(point.space, point.address, point.words, (name,)))
    return tuple(blocks)


def decode_blocks(register_map: RegisterMap, replies: Mapping[Block, list[int]]) -> Snapshot:
    """Replies of planned blocks as samples and bits; `bad_if` bits that were not read spoil nothing."""
    samples: dict[str, Sample] = {}
    bits: dict[str, bool] = {}
    points = register_map.points
    for block, words in replies.items():
        for name in block.names:
            point = points[name]
            start = point.address - block.address
            sample = samples[name] = decode(point, words[start : start + point.words])
            if point.type == "bit":
                bits[name] = bool(sample.raw)
            for bit, bit_name in point.bits.items():
                bits[bit_name] = bool(sample.raw >> bit & 1)
    for name, sample in tuple(samples.items()):
        point = points[name]
        if point.bad_if and (alarms := [bit for bit in point.bad_if if bits.get(bit)]):
            samples[name] = Sample(sample.raw, math.nan, ", ".join(alarms))
        if point.split is not None:
            samples.update(_split(point.split, samples[name]))
    return Snapshot(samples, bits)


def decode(point: Point, words: list[int]) -> Sample:
    """Raw words (0..65535, in order of address) as a value in the point's unit."""
    raw = 0
    for word in words if point.word_order == "high_first" else reversed(words):
        raw = raw << 16 | word
    for fault in point.faults:
        if raw == fault.raw:
            return Sample(raw, math.nan, fault.code)
    number = _to_number(point.type, raw)
    if point.type == "float32" and 0 < abs(number) < _SMALLEST:
        return Sample(raw, math.nan, f"{number:g} is no measurement; is word_order {point.word_order} right?")
    value = number * point.scale + point.offset
    if not math.isfinite(value):
        return Sample(raw, math.nan, "not a number")
    if point.valid is not None and not point.valid[0] <= value <= point.valid[1]:
        return Sample(raw, math.nan, f"{value:g} {point.unit} is outside {point.valid[0]:g}..{point.valid[1]:g}")
    return Sample(raw, value)


def _to_number(kind: PointType, raw: int) -> float:
    """Return what the raw word or words stand for."""
    match kind:
        case "int16":
            return raw - (raw >> 15 << 16)
        case "int32":
            return raw - (raw >> 31 << 32)
        case "float32":
            return struct.unpack(">f", raw.to_bytes(4, "big"))[0]
        case _:
            return raw


def encode(point: Point, value: float) -> list[int]:
    """The words to write for `value`; ValueError when it is read-only, outside its limits or does not fit."""
    if point.access != "rw" or point.type == "bit":
        raise ValueError("not a writable register")
    if point.limits is not None and not point.limits[0] <= value <= point.limits[1]:
        raise ValueError(f"{value:g} {point.unit} is outside the limits {point.limits[0]:g}..{point.limits[1]:g}")
    if not math.isfinite(value):
        raise ValueError(f"{value} cannot be written")
    number = (value - point.offset) / point.scale
    try:
        packed = struct.pack(FORMATS[point.type], number if point.type == "float32" else round(number))
    except (struct.error, OverflowError) as error:
        raise ValueError(f"{value:g} {point.unit} does not fit {point.type}") from error
    words = [int.from_bytes(packed[i : i + 2], "big") for i in range(0, len(packed), 2)]
    return words if point.word_order == "high_first" else words[::-1]


def _split(split: Split, sample: Sample) -> dict[str, Sample]:
    return {
        split.positive: Sample(sample.raw, max(sample.value, 0.0) if not sample.reason else math.nan, sample.reason),
        split.negative: Sample(sample.raw, max(-sample.value, 0.0) if not sample.reason else math.nan, sample.reason),
    }
