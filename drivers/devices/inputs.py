"""Contacts of the stand on the digital inputs of a relay board or an input module: door, emergency stop, cut-out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal, Self

from pydantic import Field, model_validator

from thermostand.drivers.devices.device_check import DeviceCheck
from thermostand.drivers.devices.kinds import DeviceKind, DriverContext
from thermostand.drivers.settings import DeviceName, Identity, Line, OnBus
from thermostand.drivers.wires.bus import Bus
from thermostand.drivers.wires.modbus_unit import ModbusUnit
from thermostand.drivers.wires.registers import RegisterMap
from thermostand.foundation.clock import Clock
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import ConfigError, Unreachable
from thermostand.foundation.readings import Channel, Reading


class ContactSettings(Document):
    """One contact. channel: its input, 0 is the first. fault_when: open (a contact that is closed while all is well, as
    safety contacts are: a broken wire opens them) or closed. action: what then happens; trip ends the run, hold waits
    for an operator, warn says so. after_s: how long it must last. means: the sentence that people read."""

    channel: int = Field(ge=0, le=31)
    fault_when: Literal["open", "closed"] = "open"
    action: Literal["trip", "hold", "warn"] = "hold"
    after_s: float = Field(default=0.0, ge=0, le=60)
    means: Line = ""


class InputsSettings(OnBus):
    """The contacts of the stand, by name; `unit` may be that of the relay board, when it has the inputs."""

    contacts: dict[DeviceName, ContactSettings] = Field(min_length=1)

    @model_validator(mode="after")
    def _each_its_own(self) -> Self:
        if len({contact.channel for contact in self.contacts.values()}) < len(self.contacts):
            raise ValueError("two contacts share one input")
        return self


class Inputs:
    """Named contacts of one unit, points input_<n> of the map: 1 closed, 0 open."""

    def __init__(
        self, name: str, bus: Bus, register_map: RegisterMap, channels: Mapping[str, int], clock: Clock
    ) -> None:
        self.name = name
        self._unit = ModbusUnit(name, bus, register_map)
        self._points = {contact: f"input_{channel}" for contact, channel in channels.items()}
        self._clock = clock
        self._probe_due = True
        for contact, point in self._points.items():
            if point not in register_map.points:
                raise ConfigError(f"{name}.{contact}: register map {register_map.model} has no {point}")

    @property
    def identity(self) -> Identity | None:
        """The unit that has answered; None before `open`."""
        return self._unit.identity

    async def open(self) -> None:
        """See that the unit answers, and which it is; raises DeviceError."""
        self._probe_due = True
        await self.read()

    async def close(self) -> None:
        """Do nothing: there is nothing to release."""

    async def read(self) -> tuple[Reading, ...]:
        """Every contact; raises DeviceError."""
        try:
            if self._probe_due:
                await self._unit.probe()
                self._probe_due = False
            bits = (await self._unit.snapshot(self._points.values())).bits
        except Unreachable:
            self._probe_due = True  # another unit may stand there when something answers again
            raise
        now_ns = self._clock.now_ns()
        return tuple(
            Reading(f"{self.name}.{contact}", float(bits[point]), "1", now_ns)
            for contact, point in self._points.items()
        )


def _make(name: str, settings: InputsSettings, around: DriverContext) -> Inputs:
    channels = {contact: each.channel for contact, each in settings.contacts.items()}
    return Inputs(name, around.bus, around.map_of("inputs", settings), channels, around.clock)


async def _check(look: DeviceCheck) -> None:
    """Return whether each contact is as it is while all is well."""
    readings = await look.open_and_read()
    for name, contact in look.settings.contacts.items():
        closed = readings.get(name)
        if closed is not None and (closed == 1) == (contact.fault_when == "closed"):
            text = f"{name} is {'closed' if closed == 1 else 'open'}, which means {contact.means or 'a fault'}"
            look.warn(text, "is it so now? else exchange fault_when, or look at its wire")


KIND = DeviceKind(
    name="contacts",
    settings=InputsSettings,
    make=_make,
    channels=lambda unit, of_section, map_of: (Channel(name, "1", "flag") for name in unit.contacts),
    section="inputs",
    device="inputs",
    rank=40,
    is_opened=False,
    address_key="",
    simulated_map="waveshare-inputs",
    check=_check,
)
