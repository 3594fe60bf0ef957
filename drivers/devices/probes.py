"""Instruments with a serial line of their own that answer in text: a precision thermometer, a hygrometer.

hart: Fluke Calibration / Hart Scientific 1502A, 1504 and their like. T -> `t:   25.587 C`; *IDN? -> maker, model,
serial number, version (1504 user's guide, 7.3). vaisala: HMT330 and its like as delivered, in STOP mode. SEND ->
`RH=  38.3 %RH T=  22.2 'C` (HMT330 user's guide M210566EN, p. 102); it reports no serial number. Neither has a
checksum, and either may echo what it was asked. Read from guides, not from units.
"""

from __future__ import annotations

import asyncio
import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

from pydantic import Field

from thermostand.drivers.devices.kinds import DeviceKind, DriverContext
from thermostand.drivers.devices.thermometers import Calibration
from thermostand.drivers.settings import Identity, Polled, PollPeriod_s, check_same_device
from thermostand.drivers.wires.line_client import LineClient
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.addresses import ByteAddress
from thermostand.foundation.clock import Clock, compute_call_pause_s
from thermostand.foundation.errors import DeviceError, Refused, Unreachable
from thermostand.foundation.readings import Channel, Reading, bad_reading
from thermostand.foundation.workers import WorkerThread

_GAP_S = 0.02  # between a reply and the next request; round number, nothing was measured
_FAILED = re.compile(r"\*+")  # in the place of a number: not measured


@dataclass(frozen=True, slots=True)
class _Language:
    """line: as delivered. read: the request; values: what its reply has of each channel."""

    line: SerialSettings
    read: bytes
    values: Mapping[Channel, re.Pattern[str]]
    vendor: str
    model: str
    is_named: bool = False  # by *IDN?


_NUMBER = r"\s*(-?\d+(?:\.\d+)?|\*+)\s*"
_TEMPERATURE = Channel("temperature", "degC", "temperature")
_LANGUAGES = {
    "hart": _Language(
        SerialSettings(2400, 1),
        b"T\r",
        {_TEMPERATURE: re.compile(rf"^t:{_NUMBER}(\w)")},
        "Hart",
        "1502A",
        is_named=True,
    ),
    "vaisala": _Language(
        SerialSettings(4800, 1, "E", 7),
        b"SEND\r",
        {
            _TEMPERATURE: re.compile(rf"\bT={_NUMBER}'(\w)"),
            Channel("humidity", "%", "humidity"): re.compile(rf"\bRH={_NUMBER}(%)RH"),
        },
        "Vaisala",
        "HMT330",
    ),
}
_UNITS = {"degC": "C", "%": "%"}
_IDENTITY = re.compile(r"^([^,\r\n]+),([^,\r\n]+),([^,\r\n]+),([^,\r\n]+)\r?\n", re.MULTILINE)


class ProbeSettings(Polled):
    """protocol: which kind answers. baud: as the unit is set, none as delivered. serial_number: refused when the unit
    reports another one. calibration: of its temperature."""

    protocol: Literal["hart", "vaisala"]
    address: ByteAddress
    baud: int | None = Field(default=None, ge=300, le=115200)
    serial_number: str | None = Field(default=None, pattern=r"^[ -~]{1,32}$")
    timeout_s: float = Field(default=1.0, gt=0, le=10)
    poll_s: PollPeriod_s = 5.0
    calibration: Calibration = Calibration()


class Probe:
    """temperature (degC), and humidity (% of saturation) of a hygrometer."""

    def __init__(self, name: str, settings: ProbeSettings, clock: Clock) -> None:
        self.name = name
        self.identity: Identity | None = None  # which unit has answered
        self._settings = settings
        self._clock = clock
        self._language = _LANGUAGES[settings.protocol]
        self._worker: WorkerThread | None = None
        self._lock = asyncio.Lock()
        as_delivered = self._language.line
        line = SerialSettings(
            settings.baud or as_delivered.baud, as_delivered.stopbits, as_delivered.parity, as_delivered.databits
        )
        self._client = LineClient.at(
            name, settings.address, line, (settings.timeout_s, compute_call_pause_s(clock, _GAP_S)), clock=clock
        )

    async def open(self) -> None:
        """Open it, and return which unit answers; Refused when it is another one."""
        if self._worker is None:
            self._worker = WorkerThread(self.name, self._clock)
        await self.read()

    async def close(self) -> None:
        """Let go of the port; may be called twice."""
        lane, self._worker = self._worker, None
        if lane is not None:
            await lane.call(self._client.close)
            lane.close()

    async def read(self) -> tuple[Reading, ...]:
        """All it measures; what it cannot measure now is BAD. DeviceError when it does not answer in its language."""
        if self._worker is None:
            raise Unreachable(self.name, "not open")
        async with self._lock:
            values = await self._worker.call(self._read_values)
        now_ns, calibration = self._clock.now_ns(), self._settings.calibration
        readings: list[Reading] = []
        for channel, value in values.items():
            name = f"{self.name}.{channel.name}"
            if math.isnan(value):
                readings.append(bad_reading(name, channel.unit, now_ns, "the instrument measures nothing"))
            elif channel == _TEMPERATURE:
                readings.append(calibration.reading(name, value, now_ns))
            else:
                readings.append(Reading(name, value, channel.unit, now_ns))
        return tuple(readings)

    # Below: in the lane's thread.

    def _read_values(self) -> dict[Channel, float]:
        if not self._client.connected:
            self._identify()
        return self._client.query(self._language.read, self._parse_reply)

    def _identify(self) -> None:
        """Identify the probe on each new link."""
        if not self._language.is_named:
            self.identity = Identity(self._language.vendor, self._language.model, "", "", by_map=True)
            return
        vendor, model, serial_number, version = self._client.query(b"*IDN?\r", _parse_identity)
        wanted = self._settings.serial_number
        if wanted is not None and serial_number != wanted:
            self._client.close()
            raise Refused(self.name, f"serial number {serial_number} answers, expected {wanted}")
        self.identity = check_same_device(self.name, Identity(vendor, model, serial_number, version), self.identity)

    def _parse_reply(self, data: bytes) -> dict[Channel, float] | None:
        """The values of the first line that has them all; None until such a line has ended."""
        for line in data.decode("latin-1").split("\n")[:-1]:
            found = {channel: pattern.search(line) for channel, pattern in self._language.values.items()}
            if all(found.values()):
                return {channel: self._value(channel, match) for channel, match in found.items() if match is not None}
        return None

    def _value(self, channel: Channel, match: re.Match[str]) -> float:
        if match[2] != _UNITS[channel.unit]:
            raise ValueError(f"{channel.name} is not in {channel.unit}; set the instrument so")
        return math.nan if _FAILED.fullmatch(match[1]) else float(match[1])


def _parse_identity(data: bytes) -> tuple[str, str, str, str] | None:
    """The four fields of *IDN?."""
    match = _IDENTITY.search(data.decode("latin-1"))
    return None if match is None else (match[1].strip(), match[2].strip(), match[3].strip(), match[4].strip())


def _make(name: str, settings: ProbeSettings, around: DriverContext) -> Probe:
    return Probe(name, settings, around.clock)


def _advise(error: DeviceError, name: str, settings: ProbeSettings) -> str:
    if isinstance(error, Unreachable):
        return f"is it plugged in and on, and baud as probes.{name} has it? `stand devices` lists the ports"
    return f"compare probes.{name} with the instrument: its protocol, serial number and unit (degC)"


KIND = DeviceKind(
    name="thermometers",
    settings=ProbeSettings,
    make=_make,
    channels=lambda probe, of_section, map_of: _LANGUAGES[probe.protocol].values,
    section="probes",
    rank=50,
    advise=_advise,
    fakes=tuple(f"probes.{protocol}" for protocol in _LANGUAGES),
)
