"""Register map: YAML -> checked points and commands. How they are read, scaled and written: modbus_unit.py.

A point is one quantity at one address (base 0); a word may carry named bits, and a coil or discrete input is a bit
named by its point. One map drives a unit and can be compared with its manual line by line.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import Field, model_validator

from thermostand.foundation.documents import Document, load_document

Space = Literal["holding", "input", "coil", "discrete"]
Word = Annotated[int, Field(ge=0, le=0xFFFF)]
PointType = Literal["bit", "int16", "uint16", "int32", "uint32", "float32"]
BIT_SPACES = ("coil", "discrete")


class Transport(Document):
    """How the unit is spoken to. Line settings and time-outs belong to the bus, which all units share."""

    kind: Literal["modbus-rtu"]
    unit: int = Field(ge=1, le=247)
    write_fc: Literal[6, 16] = 6
    max_read_words: int = Field(default=32, ge=1, le=125)
    max_gap_words: int = Field(default=4, ge=0, le=125)  # four words too many cost less than another request


class RawFault(Document):
    """A raw word that is no measurement; `code` says why."""

    raw: Word
    code: str = Field(min_length=1)


class Split(Document):
    """One signed point as two: `positive` = max(value, 0), `negative` = max(-value, 0)."""

    positive: str
    negative: str


class Pulse(Document):
    """Where a coil takes "on for value x step_s" (FC 05). unverified: as of a point."""

    address: Word
    step_s: float = Field(gt=0)
    unverified: str = ""


class Point(Document):
    """One quantity: value = raw * scale + offset.

    word_order: of 32-bit points, which half comes first. valid: values outside are no measurement. limits: values
    outside are never written. bits: bit number -> name. bad_if: bits that make this point no measurement. eeprom: a
    write wears the memory unless every start-up command is confirmed; without such commands it is written only when it
    differs. refresh: it is written again at each poll, or the unit falls back to a value of its own.
    unverified: what of it was never seen on a unit, and how to see it; `stand check` reads it back and says so.
    """

    address: Word
    space: Space = "holding"
    type: PointType = "uint16"
    word_order: Literal["high_first", "low_first"] = "high_first"
    scale: float = 1.0
    offset: float = 0.0
    unit: str = "1"
    access: Literal["r", "rw"] = "r"
    poll: Literal["fast", "once"] = "once"
    valid: tuple[float, float] | None = None
    limits: tuple[float, float] | None = None
    bits: dict[int, str] = Field(default_factory=dict)
    faults: tuple[RawFault, ...] = ()
    bad_if: tuple[str, ...] = ()
    split: Split | None = None
    pulse: Pulse | None = None
    unverified: str = ""
    eeprom: bool = False
    refresh: bool = False

    @property
    def words(self) -> int:
        """Addresses it takes."""
        return 2 if self.type in ("int32", "uint32", "float32") else 1

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if (self.type == "bit") != (self.space in BIT_SPACES):
            raise ValueError(f"type {self.type} cannot live in space {self.space}")
        if self.address + self.words > 0x10000:
            raise ValueError("runs past address 0xFFFF")
        if self.scale == 0:
            raise ValueError("scale must not be 0")
        for name, interval in (("valid", self.valid), ("limits", self.limits)):
            if interval is not None and interval[0] >= interval[1]:
                raise ValueError(f"{name} must be [low, high], not {list(interval)}")
        if any(not 0 <= bit < 16 * self.words for bit in self.bits) or (self.bits and self.type in ("bit", "float32")):
            raise ValueError(f"a {self.type} has no bits {sorted(self.bits)}")
        if self.access == "rw" and self.space in ("input", "discrete"):
            raise ValueError(f"space {self.space} cannot be written")
        if self.access == "r" and (self.limits or self.pulse or self.eeprom or self.refresh):
            raise ValueError("limits, pulse, eeprom and refresh need access: rw")
        return self


class Confirm(Document):
    """What shows that a command took effect: a bit of a point that `is`, or a point that `equals` a value."""

    point: str
    bit: str = ""
    is_: bool = Field(default=True, alias="is")
    equals: float | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if bool(self.bit) == (self.equals is not None):
            raise ValueError("a command is confirmed by a bit, or by what its point equals")
        return self


class Write(Document):
    """One register written."""

    address: Word
    value: Word


class RegisterCommand(Document):
    """Register writes that make the unit do something: one, `address` and `value`, or `writes`, in their order."""

    address: Word | None = None
    value: Word | None = None
    writes: tuple[Write, ...] = ()
    confirm: Confirm

    @model_validator(mode="after")
    def _complete(self) -> Self:
        if (self.address is None) != (self.value is None) or (self.address is None) == (not self.writes):
            raise ValueError("a command is `address` and `value`, or `writes`")
        return self

    @property
    def steps(self) -> tuple[Write, ...]:
        """What is written, in order."""
        if self.address is None or self.value is None:
            return self.writes
        return (Write(address=self.address, value=self.value),)


class InForceCheck(Document):
    """What has to be so for the set-point that was written to be the one that acts: a bit of a point that `is`, a point
    that `equals` a value, or one that `follows` another `within` so much. while_running: it says nothing of a unit that
    is stopped. says: the sentence when it is not so, with what to do at the panel."""

    point: str
    bit: str = ""
    is_: bool = Field(default=True, alias="is")
    equals: float | None = None
    follows: str = ""
    within: float = Field(default=0.05, gt=0)
    while_running: bool = False
    says: str = Field(min_length=1)

    @model_validator(mode="after")
    def _one_way(self) -> Self:
        if bool(self.bit) + (self.equals is not None) + bool(self.follows) != 1:
            raise ValueError("what is in force is shown by a bit, by what its point equals, or by the point it follows")
        return self

    def __str__(self) -> str:
        if self.follows:
            return f"{self.point} follows {self.follows}"
        return f"{self.bit} is {int(self.is_)}" if self.bit else f"{self.point} is {self.equals:g}"


class UnitProof(Document):
    """A point whose value proves that the unit is the one this map describes."""

    point: str
    expect: float


class IdentityPoint(Document):
    """A point by which the unit reports what it is, read as a number (scaled) or as hexadecimal digits."""

    point: str
    shown: Literal["number", "hex"] = "number"


class RegisterMap(Document):
    """All that is known about one kind of unit. `fault_bits`: bits that mean trouble, reported as they are.
    `when_silent`: what to look at when it does not answer. identity: where the unit reports its serial number, model
    and version; a unit that refuses such a point does not tell it. in_force: of a regulator, what shows that the
    set-point written is the one that acts; unverified: what of that no register shows."""

    schema_: Literal["regmap/1"] = Field(alias="schema")
    vendor: str
    model: str
    source: str
    when_silent: str = ""
    transport: Transport
    probe: tuple[UnitProof, ...] = ()
    identity: dict[Literal["serial_number", "model", "version"], IdentityPoint] = Field(default_factory=dict)
    points: dict[str, Point] = Field(min_length=1)
    fault_bits: tuple[str, ...] = ()
    in_force: tuple[InForceCheck, ...] = ()
    unverified: str = ""
    commands: dict[str, RegisterCommand] = Field(default_factory=dict)
    startup: tuple[str, ...] = ()
    safe_state: tuple[str, ...] = ()

    def at_unit(self, unit: int) -> RegisterMap:
        """The same map for a unit at another address of the bus, 1..247."""
        transport = Transport.model_validate({**self.transport.model_dump(), "unit": unit})
        return self.model_copy(update={"transport": transport})

    def polled(self) -> tuple[str, ...]:
        """Names of the points of every poll."""
        return tuple(name for name, point in self.points.items() if point.poll == "fast")

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        faults = [*self._overlaps(), *self._missing_names(), *self._double_names()]
        if faults:
            raise ValueError("; ".join(faults))
        return self

    def _overlaps(self) -> Iterator[str]:
        taken: dict[tuple[Space, int], str] = {}
        for name, point in self.points.items():
            for address in range(point.address, point.address + point.words):
                other = taken.setdefault((point.space, address), name)
                if other != name:
                    yield f"points {other} and {name} overlap at {point.space} {address:#06x}"

    def _missing_names(self) -> Iterator[str]:
        bits = set(self._bit_names())
        for name, point in self.points.items():
            yield from (f"points.{name}.bad_if: no bit {bit}" for bit in point.bad_if if bit not in bits)
        yield from (f"fault_bits: no bit {bit}" for bit in self.fault_bits if bit not in bits)
        named = (
            ("probe", [probe.point for probe in self.probe]),
            ("identity", [t.point for t in self.identity.values()]),
        )
        for key, points in named:
            yield from (f"{key}: no point {point}" for point in points if point not in self.points)
        for each in self.in_force:
            yield from (
                f"in_force: no point {name}"
                for name in (each.point, each.follows or each.point)
                if name not in self.points
            )
            if each.bit and each.bit not in bits:
                yield f"in_force: no bit {each.bit}"
        for name, command in self.commands.items():
            confirm, point = command.confirm, self.points.get(command.confirm.point)
            if confirm.equals is not None and point is None:
                yield f"commands.{name}.confirm: no point {confirm.point}"
            elif confirm.bit and (point is None or confirm.bit not in point.bits.values()):
                yield f"commands.{name}.confirm: no bit {confirm.bit} in point {confirm.point}"
        for name in (*self.startup, *self.safe_state):
            if name not in self.commands:
                yield f"startup, safe_state: no command {name}"

    def _double_names(self) -> Iterator[str]:
        bits = list(self._bit_names())
        yield from (f"bit {bit} is named twice" for bit in sorted({bit for bit in bits if bits.count(bit) > 1}))
        for point in self.points.values():
            for name in (point.split.positive, point.split.negative) if point.split else ():
                if name in self.points:
                    yield f"split {name} is also a point"

    def _bit_names(self) -> Iterator[str]:
        for name, point in self.points.items():
            yield from [name] if point.type == "bit" else point.bits.values()


def load_register_map(path: Path) -> RegisterMap:
    """The map in a YAML file; raises ConfigError naming file, path and fault."""
    return load_document(path, RegisterMap)
