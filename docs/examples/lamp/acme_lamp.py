"""A lamp on a serial line or TCP: `?` is answered by its current, `I=0.25`; a number sets the light in percent."""

from typing import Any, Literal

from thermostand.drivers.devices.kinds import (
    Arguments,
    DeviceKind,
    DriverContext,
    ManualActions,
    Verb,
    VerbNumber,
    Work,
)
from thermostand.drivers.settings import Identity, Polled
from thermostand.drivers.wires.line_client import LineClient
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.addresses import ByteAddress
from thermostand.foundation.clock import Clock
from thermostand.foundation.readings import Channel, Reading
from thermostand.foundation.workers import WorkerThread


class Settings(Polled):
    """Its keys in a stand's file. Polled adds `poll_s`, the period in which it is read."""

    kind: Literal["lamp"]
    address: ByteAddress
    most_percent: float = 90.0


class Lamp:
    """The driver. Every request waits in a thread of its own, so that a slow lamp holds nothing up."""

    def __init__(self, name: str, settings: Settings, clock: Clock) -> None:
        self.name = name
        self.identity: Identity | None = None
        self._clock = clock
        self._lane: WorkerThread | None = None
        self._client = LineClient.at(name, settings.address, SerialSettings(9600, 1), (1.0, 0.0), clock=clock)

    async def _ask(self, text: str) -> str:
        def whole(data: bytes) -> str | None:
            return data.decode() if data.endswith(b"\n") else None

        assert self._lane is not None, "open() comes first"  # noqa: S101 - an example keeps to what matters
        return (await self._lane.call(self._client.query, text.encode() + b"\n", whole)).strip()

    async def open(self) -> None:
        """Connect. Raises Unreachable when it does not answer."""
        self._lane = self._lane or WorkerThread(self.name, self._clock)
        await self._ask("?")
        self.identity = Identity("Acme", "L1", "7", "")

    async def close(self) -> None:
        """Let it go."""
        lane, self._lane = self._lane, None
        if lane is not None:
            await lane.call(self._client.close)
            lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """A reading for each channel of KIND."""
        current_A = float((await self._ask("?")).removeprefix("I="))
        return (Reading(f"{self.name}.current", current_A, "A", self._clock.now_ns()),)

    async def shine(self, percent: float) -> None:
        """Set the light."""
        await self._ask(f"{percent:g}")

    async def make_safe(self) -> None:
        """A driver that has this is made safe with the stand, and again until it succeeds."""
        await self.shine(0.0)


def _make(name: str, settings: Settings, around: DriverContext) -> Lamp:
    return Lamp(name, settings, around.clock)


def _shine(stand: ManualActions, name: str, given: Arguments) -> Work:
    return stand.device(name).shine(given["percent"])


def _numbers(settings: Settings, of_section: Any) -> tuple[VerbNumber, ...]:
    return (VerbNumber("percent", "%", 0.0, settings.most_percent),)


KIND = DeviceKind(
    name="lamp",
    settings=Settings,
    make=_make,
    channels=(Channel("current", "A", "current"),),
    verbs=(Verb("shine", "give light", _shine, _numbers),),
)
