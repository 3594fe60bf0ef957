"""An uninterruptible power supply, as the `upsd` of Network UPS Tools tells of it (TCP, usually port 3493).

Requests and replies are lines (RFC 9271, Network UPS Tools Network Protocol): `GET VAR ups ups.status` brings
`VAR ups ups.status "OB DISCHRG"` or `ERR` with one word. LOGIN makes upsd count this computer among those that the UPS
feeds, so that a primary upsmon waits for it before it cuts the output; it needs a user with a password.
"""

from __future__ import annotations

import asyncio
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import Field

from thermostand.drivers.devices.device_check import DeviceCheck
from thermostand.drivers.devices.kinds import DeviceKind, DriverContext
from thermostand.drivers.settings import Identity, Polled, PollPeriod_s
from thermostand.drivers.wires.line_client import LineClient
from thermostand.drivers.wires.link import SerialSettings
from thermostand.foundation.addresses import TcpAddress
from thermostand.foundation.clock import Clock
from thermostand.foundation.documents import Document
from thermostand.foundation.errors import DeviceError, DeviceFault, Refused, Unreachable
from thermostand.foundation.private_file import load_private_document
from thermostand.foundation.readings import Cause, Channel, Reading, bad_reading
from thermostand.foundation.workers import WorkerThread

CHARGE = Channel("charge", "%", "charge")
RUNTIME = Channel("runtime", "s", "duration")
ON_BATTERY = Channel("on_battery", "1", "flag")
LOW_BATTERY = Channel("low_battery", "1", "flag")
CHANNELS = (CHARGE, RUNTIME, ON_BATTERY, LOW_BATTERY)

_NAME = r"[A-Za-z0-9_.-]{1,64}"
_WORD = r"[!-~]{1,100}"
_VALUE = re.compile(r'VAR \S+ \S+ "((?:[^"\\]|\\.)*)"')
_LISTED = re.compile(rf'UPS ({_NAME}) "')
_NOT_REPORTED = ("VAR-NOT-SUPPORTED", "UNKNOWN-VAR")
# upsd answers, and knows nothing of the UPS now: as if nobody had answered.
_SILENT = {"DATA-STALE": "upsd has no fresh data of it", "DRIVER-NOT-CONNECTED": "its driver is not connected to upsd"}
_LOW = {"LB", "FSD"}  # FSD: a primary upsmon has ordered the shutdown
_CARE = {*_LOW, "RB", "OVER", "ALARM"}  # replace the battery, overloaded: a person has to know
_KNOWN_POWER = {"OL", "OB", "OFF", "BYPASS", *_LOW}


class UpsSettings(Polled):
    """A UPS by the upsd at `address`; ups: its name there, the only one when it is not given. secrets: a YAML file
    (mode 0600) with `user` and `password`, with which this computer is counted among those that the UPS feeds.

    On battery for hold_after_s the stand is held, safe; mains back for back_after_s, it goes on by itself. Below
    end_below_percent, with less than end_below_s left, or when the UPS says that its battery is low, the run ends.
    """

    kind: Literal["ups"]
    address: TcpAddress
    ups: str | None = Field(default=None, pattern=rf"^{_NAME}$")
    secrets: Path | None = None
    timeout_s: float = Field(default=1.0, gt=0, le=10)
    poll_s: PollPeriod_s = 5.0
    # Round numbers; nothing was measured. A self-test of a UPS takes some seconds.
    hold_after_s: float = Field(default=5.0, ge=0, le=600)
    back_after_s: float = Field(default=300.0, ge=0, le=86400)
    end_below_percent: float = Field(default=30.0, ge=0, le=95)
    end_below_s: float = Field(default=300.0, ge=60, le=86400)


class UpsSecrets(Document):
    """The file that a UPS' secrets name: a user of upsd.users, and the password."""

    user: str = Field(pattern=rf"^{_WORD}$")
    password: str = Field(pattern=rf"^{_WORD}$")


@dataclass(frozen=True, slots=True)
class _Reported:
    """What upsd tells of the UPS. None: it does not tell that."""

    status: str
    charge: float | None
    runtime: float | None


class Ups:
    """charge (%), runtime (s left on battery), on_battery and low_battery (flags; the reason of these is the UPS'
    status, unless all is well).

    One that does not answer gives BAD readings and raises nothing: a stand is opened and run without it, and the guard
    warns. is_required: it raises instead, for who wants to know why.
    """

    def __init__(self, name: str, settings: UpsSettings, clock: Clock) -> None:
        self.name = name
        self.identity: Identity | None = None
        self.is_required = False
        self._settings = settings
        self._clock = clock
        self._worker: WorkerThread | None = None
        self._lock = asyncio.Lock()
        self._ups = settings.ups or ""
        self._has_begun = False  # over this connection
        self._client = LineClient.at(name, settings.address, SerialSettings(9600, 1), (settings.timeout_s, 0.0))

    async def open(self) -> None:
        """Ask which UPS it is, as far as anybody answers; ConfigError when its file of secrets cannot be used."""
        if self._settings.secrets is not None:
            self._load_secrets(self._settings.secrets)
        self._worker = self._worker or WorkerThread(self.name, self._clock)
        await self.read()

    async def close(self) -> None:
        """Let go of the connection; may be called twice."""
        worker, self._worker = self._worker, None
        if worker is not None:
            await worker.call(self._client.close)
            worker.close()

    async def read(self) -> tuple[Reading, ...]:
        """All it tells. What it does not tell is BAD; all are when upsd, or its driver, does not answer."""
        try:
            if self._worker is None:
                raise Unreachable(self.name, "not open")
            async with self._lock:
                reported = await self._worker.call(self._ask_all)
        except DeviceError as error:
            if self.is_required:
                raise
            now_ns, cause = self._clock.now_ns(), _find_cause(error)
            return tuple(
                bad_reading(f"{self.name}.{each.name}", each.unit, now_ns, str(error), cause) for each in CHANNELS
            )
        return tuple(self._make_readings(reported))

    def _make_readings(self, reported: _Reported) -> list[Reading]:
        now_ns, words = self._clock.now_ns(), set(reported.status.split())
        is_known = bool(words & _KNOWN_POWER)
        flags = (("OB" in words), bool(words & _LOW)) if is_known else (None, None)
        is_well = "OL" in words and not words & _CARE
        readings: list[Reading] = []
        for channel, value in zip(CHANNELS, (reported.charge, reported.runtime, *flags), strict=True):
            name, reason = f"{self.name}.{channel.name}", reported.status
            if value is None:
                reason = f"the UPS does not tell it (its status is {reported.status!r})"
                readings.append(bad_reading(name, channel.unit, now_ns, reason))
            else:
                reason = reported.status if channel.kind == "flag" and not is_well else ""
                readings.append(Reading(name, float(value), channel.unit, now_ns, reason=reason))
        return readings

    # Below: in the worker's thread.

    def _ask_all(self) -> _Reported:
        self._has_begun = self._has_begun and self._client.connected
        if not self._has_begun:
            self._begin()  # again, too, where upsd did not know the UPS yet
            self._has_begun = True
        status = self._get("ups.status")
        if status is None:
            raise DeviceFault(self.name, "does not tell its status")
        if self.identity is None or not self.identity.vendor:  # a driver that has just started tells it later
            reported = (self._get(f"device.{each}") or "" for each in ("mfr", "model", "serial"))
            self.identity = Identity(*(each.strip() for each in reported), version="")
        return _Reported(status, self._get_number("battery.charge"), self._get_number("battery.runtime"))

    def _begin(self) -> None:
        """Over each new connection: which UPS there is, and the login."""
        self.identity = None
        self._ups = self._settings.ups or self._find_only()
        if self._settings.secrets is None:
            return
        secrets = self._load_secrets(self._settings.secrets)
        for request in (f"USERNAME {secrets.user}", f"PASSWORD {secrets.password}", f"LOGIN {self._ups}"):
            if (error := self._ask(request)[0]) is not None:
                self._client.close()
                raise Refused(self.name, f"upsd refuses {request.partition(' ')[0]}: {error}")

    def _load_secrets(self, path: Path) -> UpsSecrets:
        return load_private_document(path, f"devices.{self.name}.secrets", UpsSecrets, "`user:` and `password:`")

    def _find_only(self) -> str:
        found = self._client.query(b"LIST UPS\n", _parse_list)
        if len(found) != 1:
            named = ", ".join(found) or "none"
            raise Refused(self.name, f"upsd has {named}; name one as `ups`")
        return found[0]

    def _get_number(self, variable: str) -> float | None:
        text = self._get(variable)
        try:
            value = math.nan if text is None else float(text)
        except ValueError:
            value = math.nan
        return value if math.isfinite(value) and value >= 0 else None

    def _get(self, variable: str) -> str | None:
        """The value of a variable; None when the UPS does not tell it."""
        error, reply = self._ask(f"GET VAR {self._ups} {variable}", f"VAR {self._ups} {variable} ")
        if error is None:
            found = _VALUE.fullmatch(reply)
            return None if found is None else re.sub(r"\\(.)", r"\1", found[1])
        if error in _NOT_REPORTED:
            return None
        if error in _SILENT:
            raise Unreachable(self.name, _SILENT[error])
        raise Refused(self.name, f"upsd answers {error} about {self._ups}")

    def _ask(self, request: str, begins: str = "OK") -> tuple[str | None, str]:
        """The word of an error, None when there was none, and the line."""

        def parse(data: bytes) -> str | None:
            line, newline, rest = data.decode("latin-1").partition("\n")
            if not newline:
                return None
            line = line.rstrip("\r")
            if rest or not line.startswith((begins, "ERR ")):
                raise ValueError(f"no reply to {request.partition(' ')[0]}")
            if begins != "OK" and not line.startswith("ERR ") and _VALUE.fullmatch(line) is None:
                raise ValueError("its value is not quoted")
            return line

        line = self._client.query(request.encode() + b"\n", parse)
        return (line.split(" ", 2)[1] if line.startswith("ERR ") else None), line


def _find_cause(error: DeviceError) -> Cause:
    return "wire" if error.retryable else "device"


def _parse_list(data: bytes) -> list[str] | None:
    """The names of LIST UPS; None until the list has ended."""
    lines = data.decode("latin-1").splitlines()
    if lines and lines[0].startswith("ERR "):
        raise ValueError("upsd lists no UPS")
    if not data.endswith(b"\n") or lines[-1] != "END LIST UPS":
        return None
    return [found[1] for line in lines if (found := _LISTED.match(line))]


def _make(name: str, settings: UpsSettings, around: DriverContext) -> Ups:
    return Ups(name, settings, around.clock)


def _advise(error: DeviceError, name: str, settings: UpsSettings) -> str:
    if isinstance(error, Unreachable):
        return (
            f"does `upsc {settings.ups or 'UPS'}@HOST` answer, and does upsd LISTEN on the address of devices.{name}?"
        )
    return f"compare devices.{name} with `upsc -l HOST` and the users of upsd.users"


async def _check(look: DeviceCheck) -> None:
    """Whether it answers, and what its status says."""
    look.device.is_required = True
    await look.open_and_read()


KIND = DeviceKind(
    name="ups",
    settings=UpsSettings,
    make=_make,
    channels=CHANNELS,
    places=lambda settings: (),  # upsd answers any number of stands
    advise=_advise,
    check=_check,
)
